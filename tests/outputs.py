"""What a run wrote, byte for byte."""

from __future__ import annotations

from pathlib import Path


def files(directory: Path) -> dict[str, bytes]:
    """All files below a directory."""
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def results(directory: Path) -> dict[str, bytes]:
    """All files but the record, which tells the time."""
    return {name: data for name, data in files(directory).items() if name != "run.json"}
