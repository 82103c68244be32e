"""Version of the program."""

from __future__ import annotations

from functools import cache
from pathlib import Path

__version__ = "0.1.0"


@cache
def commit() -> str | None:
    """Return the commit of the clone that this package is in; None if it is installed, or without git."""
    import subprocess  # Slow to import, and most commands do not need it.

    folder = Path(__file__).parents[1] / ".git"
    if not folder.exists():
        return None
    try:
        # The folder is named, as git would also find a repository around this one.
        git = ["git", f"--git-dir={folder}", "rev-parse", "--verify", "HEAD"]
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
