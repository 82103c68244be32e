"""What was written: files byte for byte, and how long a GIF lasts."""

from __future__ import annotations

from pathlib import Path

from PIL import Image


def files(directory: Path) -> dict[str, bytes]:
    """All files below a directory."""
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def results(directory: Path) -> dict[str, bytes]:
    """All files but the record, which tells the time."""
    return {name: data for name, data in files(directory).items() if name != "run.json"}


def duration(film: str) -> int:
    """How long a GIF lasts [ms]."""
    total = 0
    with Image.open(film) as image:
        for n in range(getattr(image, "n_frames", 1)):
            image.seek(n)
            total += image.info["duration"]
    return total
