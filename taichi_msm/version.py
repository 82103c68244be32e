"""Version of the program."""

from __future__ import annotations

from functools import cache
from pathlib import Path

__version__ = "0.1.0"


@cache
def commit() -> str | None:
    """Return the git commit of the clone of this package; None for an installed package, or without git."""
    import subprocess  # Slow to import, and most commands do not need it.

    folder = Path(__file__).parents[1] / ".git"
    if not folder.exists():
        return None
    try:
        # Without --git-dir, git also searches the parent folders, and may find another project.
        git = ["git", f"--git-dir={folder}", "rev-parse", "--verify", "HEAD"]
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
