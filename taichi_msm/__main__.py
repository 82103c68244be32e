"""`taichi-msm`, which `python -m taichi_msm` is too."""

import sys

from taichi_msm import interruption


def main() -> int:
    """Run the command line of the process."""
    interruption.leave_at_once()
    from taichi_msm.cli import main

    return main()


if __name__ == "__main__":
    sys.exit(main())
