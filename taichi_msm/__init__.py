"""Deform an image as tissue deforms.

The names of the API are imported when they are first used, so that `import taichi_msm` does not start the compiler.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from taichi_msm.errors import (
        ArgumentError,
        DeviceError,
        DivergedError,
        FilesError,
        MsmError,
        NotInstalledError,
        SceneError,
    )
    from taichi_msm.exports.convert import export
    from taichi_msm.fitting.fit import fit
    from taichi_msm.fitting.result import FitResult, FittedMap
    from taichi_msm.gradients import Gradient, gradient
    from taichi_msm.physics.state import TipForce
    from taichi_msm.playback import Playback
    from taichi_msm.render.labels import Flow, Labels, Sight
    from taichi_msm.render.surface import Surface
    from taichi_msm.runner import resume, run
    from taichi_msm.scene import (
        Camera,
        Distortion,
        Foundation,
        Instrument,
        Intrinsics,
        Light,
        Pose,
        Probe,
        Render,
        Scene,
        Sheet,
        Springs,
        StiffnessMap,
        Time,
        Tissue,
    )
    from taichi_msm.scenefile.load import load_scene
    from taichi_msm.simulation import Simulation
    from taichi_msm.sweeps.outcome import Outcome
    from taichi_msm.sweeps.sweep import sweep

__version__ = "0.1.0"

# The modules of all names but errors and the sections of a scene.
_HOMES = {
    **dict.fromkeys(("Flow", "Labels", "Sight"), "render.labels"),
    **dict.fromkeys(("resume", "run"), "runner"),
    **dict.fromkeys(("Gradient", "gradient"), "gradients"),
    "Playback": "playback",
    "TipForce": "physics.state",
    "Simulation": "simulation",
    **dict.fromkeys(("FitResult", "FittedMap"), "fitting.result"),
    "Surface": "render.surface",
    "Outcome": "sweeps.outcome",
    "export": "exports.convert",
    "fit": "fitting.fit",
    "load_scene": "scenefile.load",
    "sweep": "sweeps.sweep",
}

__all__ = [
    "ArgumentError",
    "Camera",
    "DeviceError",
    "Distortion",
    "DivergedError",
    "FilesError",
    "FitResult",
    "FittedMap",
    "Flow",
    "Foundation",
    "Gradient",
    "Instrument",
    "Intrinsics",
    "Labels",
    "Light",
    "MsmError",
    "NotInstalledError",
    "Outcome",
    "Playback",
    "Pose",
    "Probe",
    "Render",
    "Scene",
    "SceneError",
    "Sheet",
    "Sight",
    "Simulation",
    "Springs",
    "StiffnessMap",
    "Surface",
    "Time",
    "TipForce",
    "Tissue",
    "export",
    "fit",
    "gradient",
    "load_scene",
    "resume",
    "run",
    "sweep",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    home = _HOMES.get(name, "errors" if name.endswith("Error") else "scene")
    return getattr(import_module(f"{__name__}.{home}"), name)
