"""How work tells how far it is; what these functions raise stops it there."""

from __future__ import annotations

from collections.abc import Callable

# Called some times a second.
Pause = Callable[[], None]

# Called with what is done and what is to be done in all.
Count = Callable[[int, int], None]

# Called with the stage of the work besides, first.
Progress = Callable[[str, int, int], None]
