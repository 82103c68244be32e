"""Other loads, and other paths of tools, from a time of a run on.

A tool that is moved cannot jump: it goes straight from where it is to the first key of its new path. What it did before
stays part of its path as far as later steps depend on it: on its place when its grip began, and on whether it pressed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from taichi_msm.errors import ArgumentError, Problem, SceneError
from taichi_msm.physics.paths import LARGEST_STRIDE, Tool, too_fast, tools_of
from taichi_msm.physics.plan import Plan
from taichi_msm.scene import WHOLE, Probe

Key = tuple[float, float, float, float]


def steered(plan: Plan, probes: Sequence[Probe | Mapping[str, Any] | None], now: float) -> Plan:
    """Replace the probes of a plan from a time on [s].

    A tool that stays as it is, also on its path, is None or given as it is. Any other with a path gets the keys of its
    path from `now` on; in a mapping, what is not given of its instrument, friction and grips stays.

    Raises:
        ArgumentError: when they are more or fewer.
        SceneError: when one of them is not a probe; or when a tool that is moved would jump, or do something before
            `now`.
    """
    before = plan.scene.probes
    if len(probes) != len(before):
        raise ArgumentError(f"probes: {len(probes)} are given, and the scene has {len(before)}; give all of them")
    given = [_completed(*pair) for pair in zip(before, probes, strict=True)]
    after = plan.with_probes(given)
    steering = [
        _Steering(plan, index, *pair, now)
        for index, pair in enumerate(zip(before, after.scene.probes, strict=True))
        if pair[0].moved and pair[1].moved and pair[0] != pair[1]
    ]
    if lines := [str(problem) for one in steering for problem in one.problems()]:
        raise SceneError(lines)
    going_on = {one.index: one.probe for one in steering}
    if not going_on:
        return after
    return after.with_probes([going_on.get(index, probe) for index, probe in enumerate(after.scene.probes)])


def with_paths_of(plan: Plan, probes: Sequence[Probe]) -> Plan:
    """Give the tools that are moved the paths, and all else, that they have among these probes."""
    if not plan.tools:
        return plan
    pairs = zip(plan.scene.probes, probes, strict=True)
    return plan.with_probes([other if own.moved and other.moved else own for own, other in pairs])


def _completed(before: Probe, given: Probe | Mapping[str, Any] | None) -> Probe | Mapping[str, Any]:
    if given is None:
        return before
    if not (before.moved and isinstance(given, Mapping) and "path" in given):
        return given
    return {"instrument": before.instrument, "friction": before.friction, "grip": before.grip, **given}


class _Steering:
    """A tool that gets another path.

    Attributes:
        index: of its probe.
        probe: with the path that it has from now on, and what counts of that which it had before.
    """

    def __init__(self, plan: Plan, index: int, before: Probe, given: Probe, now: float) -> None:
        self.index, self._plan, self._before, self._given, self._now = index, plan, before, given, now
        # Times that are as good as now.
        self._nearly = WHOLE / plan.grid.frames_per_second
        assert before.path is not None
        assert given.path is not None
        self._past, h = _past(before.path, now, self._nearly), plan.grid.step
        begun = [begin for begin, end in given.grip if begin < now < end]
        if before.path[-1][0] < now - self._nearly and not begun:
            self._past = self._past[-1:]  # It has not pressed since the last key.
        # The averages of loads reach a step back, and bounds of the energy a frame.
        since = min([now - 1 / plan.grid.frames_per_second, *begun]) - 2 * h
        self._past = self._past[max((n for n, key in enumerate(self._past) if key[0] <= since), default=0) :]
        self.probe = given.model_copy(update={"path": (*self._past, *given.path)}) if self._is_later() else given

    def problems(self) -> Iterator[Problem]:
        """Find what a tool cannot do from one step to the next."""
        now, nearly, where = self._now, self._nearly, ("probes", self.index)
        assert self._given.path is not None
        if not self._is_later():
            said = f"is at {self._given.path[0][0]:g} s, and it is {now:g} s; give only times after that"
            yield Problem((*where, "path", 0), said)
            return
        grid, sheet = self._plan.grid, self._plan.scene.sheet
        (was,), (tool,) = tools_of((self._before,), sheet), tools_of((self.probe,), sheet)
        first = len(self._past) - 1
        if not self._plan.scene.time.at_rest and (fault := too_fast(tool, grid, first)):
            yield Problem((*where, "path", fault[0] - first - 1), fault[1])
        turned = _change(was, tool)
        if turned > LARGEST_STRIDE * tool.radius:
            yield Problem(
                (*where, "instrument"),
                f"changes its shape by {turned:.3g} m in a step, over half its radius; change it little by little",
            )
        for n, (begin, end) in enumerate(self._given.grip):
            is_over = end <= now + nearly
            goes_on = any(begin == began and ends > now + nearly for began, ends in self._before.grip)
            if begin < now - nearly and not (is_over or goes_on):
                said = f"begins at {begin:g} s, and it is {now:g} s; begin at that time or later"
                yield Problem((*where, "grip", n), said)

    def _is_later(self) -> bool:
        assert self._given.path is not None
        return self._given.path[0][0] > self._now + self._nearly


def _past(path: Sequence[Key], now: float, nearly: float) -> list[Key]:
    """Give the keys of a path up to a time, the last one at that time."""
    past = [key for key in path if key[0] <= now + nearly]
    if past and past[-1][0] >= now - nearly:
        return past
    times, *places = np.array(path).T
    across, down, height = (float(np.interp(now, times, place)) for place in places)
    return [*past, (now, across, down, height)]


def _change(before: Tool, after: Tool) -> float:
    """Bound how far any point of a rod moves when it becomes another one, whose lowest point is at the same place."""
    ends = np.linalg.norm(after.length * after.axis - before.length * before.axis)
    return float(ends) + 2 * abs(after.radius - before.radius)
