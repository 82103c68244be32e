"""Deformation of images by a mass-spring model of soft tissue.

The public names are imported at their first use, so that `import taichi_msm` does not start the compiler.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from taichi_msm.version import __version__ as __version__

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
    from taichi_msm.exports.export import export
    from taichi_msm.fitting.fit import fit
    from taichi_msm.fitting.result import FitResult, FittedMap
    from taichi_msm.gradients.gradient import Gradient, gradient
    from taichi_msm.load.scene_file import load_scene
    from taichi_msm.model.surface import Surface
    from taichi_msm.render.labels import Flow, Labels, Sight
    from taichi_msm.runs.playback import Playback
    from taichi_msm.runs.run import resume, run
    from taichi_msm.runs.simulation import Simulation
    from taichi_msm.scene.camera import Camera, Distortion, Intrinsics, Pose
    from taichi_msm.scene.render import Light, Render
    from taichi_msm.scene.scene import Scene, Time
    from taichi_msm.scene.sheet import Foundation, RelaxationBranch, Sheet, Springs, Stiffening, StiffnessMap, Tissue
    from taichi_msm.scene.tools import Instrument, Probe
    from taichi_msm.solver.state import TipForce
    from taichi_msm.sweeps.runs import Outcome
    from taichi_msm.sweeps.sweep import sweep


# Module of each public name.
_MODULES = {
    **dict.fromkeys(
        ("ArgumentError", "DeviceError", "DivergedError", "FilesError", "MsmError", "NotInstalledError", "SceneError"),
        "errors",
    ),
    "export": "exports.export",
    "fit": "fitting.fit",
    **dict.fromkeys(("FitResult", "FittedMap"), "fitting.result"),
    **dict.fromkeys(("Gradient", "gradient"), "gradients.gradient"),
    "TipForce": "solver.state",
    "Playback": "runs.playback",
    **dict.fromkeys(("Flow", "Labels", "Sight"), "render.labels"),
    "Surface": "model.surface",
    **dict.fromkeys(("resume", "run"), "runs.run"),
    **dict.fromkeys(("Camera", "Distortion", "Intrinsics", "Pose"), "scene.camera"),
    **dict.fromkeys(("Light", "Render"), "scene.render"),
    **dict.fromkeys(("Scene", "Time"), "scene.scene"),
    **dict.fromkeys(
        ("Foundation", "RelaxationBranch", "Sheet", "Springs", "Stiffening", "StiffnessMap", "Tissue"), "scene.sheet"
    ),
    **dict.fromkeys(("Instrument", "Probe"), "scene.tools"),
    "load_scene": "load.scene_file",
    "Simulation": "runs.simulation",
    "Outcome": "sweeps.runs",
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
    "RelaxationBranch",
    "Render",
    "Scene",
    "SceneError",
    "Sheet",
    "Sight",
    "Simulation",
    "Springs",
    "Stiffening",
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

    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
