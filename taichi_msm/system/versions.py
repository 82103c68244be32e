"""The versions that results depend on."""

from __future__ import annotations

import platform
import sys

from taichi_msm import __version__
from taichi_msm.system.compiler import chosen


def versions() -> dict[str, str]:
    """Name the versions that the results depend on."""
    # Imported here, as they take a while.
    import numpy as np
    import PIL

    return {
        "taichi-msm": __version__,
        "python": platform.python_version(),
        chosen().name: chosen().version,
        "numpy": np.__version__,
        "pillow": PIL.__version__,
        "platform": f"{sys.platform} {platform.machine()}",
    }
