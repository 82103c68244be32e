"""The content of run.json."""

from __future__ import annotations

from typing import Any, Literal, TypedDict

from typing_extensions import NotRequired

from taichi_msm.physics.probe_force import ProbeRecord


class ErrorRecord(TypedDict):
    """The error of a run, as fractions of the largest displacement; None: not known, because a pilot diverged."""

    error: float | None  # None at rest, too; largest of any point at any frame, due to the step and to rounding
    rounding: float | None  # the part of it that comes from f32; None also where a coarse pilot does not tell the parts
    in_f64: float | None  # the error of the same step in f64; None likewise
    order: int | None  # of the method; None at rest
    at_least: bool  # whether `error` may be larger
    mesh_error: NotRequired[float | None]  # the error that the number of points makes; only with tissue
    mesh_doubt: NotRequired[str]  # why `mesh_error` may be larger or is not known; empty: it is about that
    force_error: NotRequired[float | None]  # of tools on a path, as a fraction of the greatest force
    force_doubt: NotRequired[str]  # why `force_error` is not known


class RunRecord(TypedDict, total=False):
    """What was run, on which machine, how far it came, and its error."""

    status: Literal["complete", "diverged", "interrupted"]
    error: str  # where and why the run diverged; only if it did
    dump: str | None  # file with the last good state; only if the run diverged. None: there is no such file
    scene: dict[str, Any]  # as it was run, with the points, the step and the precision that were chosen
    asked: dict[str, Any]  # keys by their paths, with the values of the scene where others were chosen
    working_directory: str  # from which the paths of the scene's pictures start
    # Of the files of the picture and the maps, by the keys that name them, such as image and tissue.map.image; without
    # one that could not be read and was not drawn.
    sha256: dict[str, str]
    overrides: list[str]  # of the scene file
    points: list[int]  # rows and columns of mass points
    step: float | None  # [s]; None: at rest, as the next ones
    stable_step: float | None  # the largest stable step [s]; None: every step is stable
    steps_per_frame: int | None
    precision: str  # of the steps
    steps: int | None  # in the run so far
    residual: float  # at rest: the largest force left on a point at any frame, as a share of the largest force
    evaluations: int  # at rest: of the forces, in the run so far
    max_displacement: float  # [m]
    shortest_spring: float  # smallest ratio of a spring's length to its rest length
    longest_spring: float  # and the largest
    probes: list[ProbeRecord]  # forces of each
    notes: list[str]  # what to know before trusting the result
    error_estimate: ErrorRecord | None  # None: there is none, for the reason that follows
    error_estimate_reason: str
    resumed: int  # number of frames that an earlier run had simulated
    timings: dict[str, float]  # of every stage [s]
    arch: str
    device: str
    threads: int
    lanes: int
    workers: int
    versions: dict[str, str]  # of all that the results depend on
    frames: int
    outputs: list[str]  # names of the files written, and of the folders with a file for every frame
