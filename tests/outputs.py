"""Files of results, and the duration of a GIF."""

from __future__ import annotations

from pathlib import Path

from PIL import Image


def files(directory: Path) -> dict[str, bytes]:
    """Contents of all files below a directory, by relative path."""
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def results(directory: Path) -> dict[str, bytes]:
    """Contents of all files except run.json, which contains durations."""
    return {name: data for name, data in files(directory).items() if name != "run.json"}


def duration(film: str) -> int:
    """Duration of a GIF [ms]."""
    total = 0
    with Image.open(film) as image:
        for n in range(getattr(image, "n_frames", 1)):
            image.seek(n)
            total += image.info["duration"]
    return total
