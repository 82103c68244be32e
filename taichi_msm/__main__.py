"""`python -m taichi_msm` is the command `taichi-msm`."""

import sys

from taichi_msm.cli import main

sys.exit(main())
