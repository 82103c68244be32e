"""Named places follow from the order and the sizes of the names."""

from __future__ import annotations

from taichi_msm.terms.places import Places

TOOL = Places(tip=3, radius=1)


def test_places_follow_from_their_order() -> None:
    """A size of 1 is an index, another one a range, and places in a list are groups one after another."""
    both = Places(weight=1, tools=[TOOL] * 2, none=0, last=2)
    assert (both.weight, both.none, both.last) == (0, range(9, 9), range(9, 11))
    assert [(tool.tip, tool.radius) for tool in both.tools] == [(range(1, 4), 4), (range(5, 8), 8)]
    assert (both.count, both.all) == (11, slice(0, 11))
    moved = both.at(100)
    assert (moved.weight, moved.tools[1].radius, moved.all, moved.count) == (100, 108, slice(100, 111), 11)
    assert (TOOL.tip, Places().count) == (range(3), 0)
