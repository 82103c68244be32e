"""The content of run.json."""

from __future__ import annotations

from typing import Any, Literal, TypedDict

from typing_extensions import NotRequired

from taichi_msm.physics.probe_force import ProbeRecord


class ErrorRecord(TypedDict):
    """The error of a run, as fractions of the largest displacement; None: not known, because a pilot diverged.

    Attributes:
        error: largest error of any point at any frame, due to the step and to rounding.
        rounding: the part of it that comes from f32; None also where a coarse pilot does not tell the parts.
        in_f64: the error of the same step in f64; None likewise.
        order: of the method.
        at_least: whether `error` may be larger.
        mesh_error: the error that the number of points makes; only with tissue.
        mesh_doubt: why `mesh_error` may be larger; empty: it is about that.
    """

    error: float | None
    rounding: float | None
    in_f64: float | None
    order: int
    at_least: bool
    mesh_error: NotRequired[float | None]
    mesh_doubt: NotRequired[str]


class RunRecord(TypedDict, total=False):
    """What was run, on which machine, how far it came, and its error.

    Attributes:
        status: how the run ended.
        error: where and why the run diverged; only if it did.
        dump: path of the file with the last good state; only if the run diverged. None: there is no such file.
        scene: as it was run, with the points, the step and the precision that were chosen.
        asked: keys by their paths, with the values that the scene had where others were chosen.
        working_directory: directory from which the paths of the scene's pictures start.
        sha256: of the files of the picture and the maps, by the keys that name them, such as image and
            tissue.map.image; without one that could not be read and was not drawn.
        overrides: of the scene file.
        points: rows and columns of mass points.
        step, stable_step: the step, and the largest stable one [s]; None: every step is stable.
        steps_per_frame, steps: number of steps in a frame, and in the run so far.
        precision: of the steps.
        max_displacement: largest displacement [m].
        shortest_spring, longest_spring: smallest and largest ratio of a spring's length to its rest length.
        probes: forces of each probe at 100 %.
        notes: what to know before trusting the result.
        error_estimate: None: there is none, for the reason in `error_estimate_reason`.
        resumed: number of frames that an earlier run had simulated.
        timings: time of every stage [s].
        arch, device, threads, lanes, workers: the machine, and how it was used.
        versions: of all that the results depend on.
        frames, outputs: number of frames, and names of the files written.
    """

    status: Literal["complete", "diverged", "interrupted"]
    error: str
    dump: str | None
    scene: dict[str, Any]
    asked: dict[str, Any]
    working_directory: str
    sha256: dict[str, str]
    overrides: list[str]
    points: list[int]
    step: float
    stable_step: float | None
    steps_per_frame: int
    precision: str
    steps: int
    max_displacement: float
    shortest_spring: float
    longest_spring: float
    probes: list[ProbeRecord]
    notes: list[str]
    error_estimate: ErrorRecord | None
    error_estimate_reason: str
    resumed: int
    timings: dict[str, float]
    arch: str
    device: str
    threads: int
    lanes: int
    workers: int
    versions: dict[str, str]
    frames: int
    outputs: list[str]
