"""The files that a sweep ends with."""

from __future__ import annotations

from taichi_msm.errors import writing
from taichi_msm.sweeps.result import SweepResult
from taichi_msm.sweeps.table import write_table


def write_reports(result: SweepResult) -> tuple[list[str], list[str]]:
    """Write them; returns their names, and what the user should know about them."""
    with writing(result.directory):
        return write_table(result), []
