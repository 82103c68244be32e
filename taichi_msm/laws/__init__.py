"""Laws of springs and of the foundation, one per file, and the table of all laws."""

from typing import Any

from taichi_msm.laws.law import Law, LawNumbers
from taichi_msm.laws.locking import Locking

LAWS: tuple[Law, ...] = (Locking(),)


def law_of(section: Any) -> LawNumbers | None:
    """Return the law whose scale a section of the scene has, with its numbers; None without one, or if it is linear."""
    for law in LAWS:
        if (scale := getattr(section, law.scale, None)) is not None:
            numbers = tuple(getattr(section, key) for key in law.keys)
            return None if law.largest_slope(*numbers) == 1 else LawNumbers(law, scale, numbers)
    return None
