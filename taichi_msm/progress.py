"""Functions by which work reports its progress; an exception from one stops the work at that point."""

from __future__ import annotations

from collections.abc import Callable

# Called some times a second.
Pause = Callable[[], None]

# Called with how much is done and how much there is in all.
Count = Callable[[int, int], None]

# Called with the stage of the work, then the same two.
Progress = Callable[[str, int, int], None]
