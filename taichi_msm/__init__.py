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
    from taichi_msm.scene.sheet import (
        Foundation,
        RelaxationBranch,
        Sheet,
        SheetMask,
        Springs,
        Stiffening,
        StiffnessMap,
        Tissue,
    )
    from taichi_msm.scene.surface import DepthMap, Dome, Folds, HeightField, PointGrid, RestSurface, Tube
    from taichi_msm.scene.tools import Instrument, Probe
    from taichi_msm.solver.state import TipForce
    from taichi_msm.sweeps.runs import Outcome
    from taichi_msm.sweeps.sweep import sweep


# Public names by their module.
_NAMES = {
    "errors": "ArgumentError DeviceError DivergedError FilesError MsmError NotInstalledError SceneError",
    "exports.export": "export",
    "fitting.fit": "fit",
    "fitting.result": "FitResult FittedMap",
    "gradients.gradient": "Gradient gradient",
    "load.scene_file": "load_scene",
    "model.surface": "Surface",
    "render.labels": "Flow Labels Sight",
    "runs.playback": "Playback",
    "runs.run": "resume run",
    "runs.simulation": "Simulation",
    "scene.camera": "Camera Distortion Intrinsics Pose",
    "scene.render": "Light Render",
    "scene.scene": "Scene Time",
    "scene.sheet": "Foundation RelaxationBranch Sheet SheetMask Springs Stiffening StiffnessMap Tissue",
    "scene.surface": "DepthMap Dome Folds HeightField PointGrid RestSurface Tube",
    "scene.tools": "Instrument Probe",
    "solver.state": "TipForce",
    "sweeps.runs": "Outcome",
    "sweeps.sweep": "sweep",
}

__all__ = ["ArgumentError", "DeviceError", "DivergedError", "FilesError", "MsmError", "NotInstalledError", "SceneError"]
__all__ += ["Camera", "Distortion", "Foundation", "Instrument", "Intrinsics", "Light", "Pose", "Probe"]
__all__ += [
    "RelaxationBranch",
    "Render",
    "Scene",
    "Sheet",
    "SheetMask",
    "Springs",
    "Stiffening",
    "StiffnessMap",
    "Time",
    "Tissue",
]
__all__ += ["DepthMap", "Dome", "Folds", "HeightField", "PointGrid", "RestSurface", "Tube"]
__all__ += ["Flow", "Labels", "Outcome", "Playback", "Sight", "Simulation", "Surface", "TipForce"]
__all__ += ["FitResult", "FittedMap", "Gradient"]
__all__ += ["export", "fit", "gradient", "load_scene", "resume", "run", "sweep"]


def __dir__() -> list[str]:
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    from importlib import import_module

    for module, names in _NAMES.items():
        if name in names.split():
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
