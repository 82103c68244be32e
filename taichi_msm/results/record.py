"""What is in run.json."""

from __future__ import annotations

from typing import Any, Literal, TypedDict

from typing_extensions import NotRequired

from taichi_msm.physics.probe_force import ProbeRecord


class ErrorRecord(TypedDict):
    """The error of a run, as fractions of the largest displacement; None: not known, as a pilot diverged.

    Attributes:
        error: the largest of any point and frame.
        rounding: the part that f32 makes.
        in_f64: the error of the same step in f64.
        order: of the method.
        mesh_error: made by the number of points; only with tissue.
    """

    error: float | None
    rounding: float | None
    in_f64: float | None
    order: int
    mesh_error: NotRequired[float | None]


class RunRecord(TypedDict, total=False):
    """What was run, on what, how far it came and how wrong it is.

    Attributes:
        status: how it ended.
        error: where and why it diverged; only then.
        dump: the file with the last good state; only then.
        scene: as it was loaded.
        working_directory: from which the scene's image is found.
        overrides: what made the scene beside its file.
        points: rows and columns of mass points.
        step, stable_step: the step, and the largest stable one [s]; None: every one is.
        steps_per_frame, steps: steps of a frame, and of the run so far.
        precision: that was stepped in.
        max_displacement: largest displacement [m].
        shortest_spring, longest_spring: least and largest length of a spring over its rest length.
        probes: what each does at 100 %.
        notes: what one should know before trusting the result.
        error_estimate: None: there is none, for the reason in `error_estimate_reason`.
        resumed: how many frames an earlier run had simulated.
        timings: seconds of every stage.
        arch, device, threads, lanes, workers: what it ran on.
        versions: what the results depend on.
        frames, outputs: what was written.
    """

    status: Literal["complete", "diverged", "interrupted"]
    error: str
    dump: str | None
    scene: dict[str, Any]
    working_directory: str
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
