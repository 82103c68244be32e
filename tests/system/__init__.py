from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def python(folder: Path, code: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in another process in a folder; Taichi reads the source of a kernel from its file."""
    (folder / "kernels.py").write_text(code)
    return subprocess.run(
        [sys.executable, "kernels.py", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), **variables},
        capture_output=True,
        text=True,
        timeout=60,
    )
