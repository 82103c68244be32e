"""Named places in an array: the index of each name follows from the sizes of the names before it.

With TOOL = Places(tip=3, radius=1) and all = Places(weight=1, tools=[TOOL] * 2)

    TOOL.tip, TOOL.radius           range(0, 3) and 3
    all.tools[1].radius             8
    all.at(100).weight              100
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Union

# A size is 1 for an index, another number for a range, or places for a group of names; in a list, several in turn.
Size = Union[int, "Places", Sequence[Union[int, "Places"]]]


class Places:
    """Consecutive places by name, from `first` on."""

    def __init__(self, first: int = 0, /, **sizes: Size) -> None:
        self.first, self.end, self._sizes = first, first, sizes
        for name, size in sizes.items():
            setattr(self, name, self._append(size))

    @property
    def count(self) -> int:
        """Number of places."""
        return self.end - self.first

    @property
    def all(self) -> slice:
        """Slice of all places."""
        return slice(self.first, self.end)

    def at(self, first: int) -> Places:
        """Return the same places from another index on."""
        return Places(first, **self._sizes)

    def _append(self, size: Size) -> Any:
        if isinstance(size, Sequence):
            return [self._append(each) for each in size]
        begin, self.end = self.end, self.end + (size.count if isinstance(size, Places) else size)
        if isinstance(size, Places):
            return size.at(begin)
        return begin if size == 1 else range(begin, self.end)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...
