"""A plugin of pytest that holds the tests of a copy to the copy's package, whatever else is installed."""

from __future__ import annotations

from pathlib import Path

import pytest

import taichi_msm


def pytest_sessionstart(session: pytest.Session) -> None:
    tested = Path(taichi_msm.__file__).parent
    if tested != session.config.rootpath / "taichi_msm":
        raise pytest.UsageError(f"the tests of {session.config.rootpath} import {tested}")
