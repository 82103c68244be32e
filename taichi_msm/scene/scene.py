"""The scene and its section `time`; the other modules have the other sections."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, model_validator

from taichi_msm.integrators import INTEGRATORS, Integrator
from taichi_msm.scene.framing import complete_framed, frame_sheet, framed_image_size, is_framed
from taichi_msm.scene.outputs import ENTRIES, OUTPUTS
from taichi_msm.scene.render import Render, calibrated_size
from taichi_msm.scene.section import (
    FRAME_TOLERANCE,
    MAX_PROBES,
    MAX_TOLERANCE,
    MIN_TOLERANCE,
    FilePath,
    Integer,
    NotNegative,
    OutputName,
    Positive,
    Section,
    Tolerance,
    key,
    scene_fault,
)
from taichi_msm.scene.sheet import Sheet, Springs, StiffnessMap, Tissue
from taichi_msm.scene.tools import Probe


class Time(Section):
    """Duration, frames and time steps."""

    duration: Positive = key(
        ..., "simulated time [s]; duration x frames_per_second is a whole number", "a number above 0, in seconds"
    )
    frames_per_second: Positive = key(25.0, "frames per simulated second", "a number above 0")
    motion: Literal["dynamic", "quasistatic"] = key(
        "dynamic",
        "dynamic: time integration; quasistatic: every frame is the equilibrium of the sheet under its loads, and "
        "mass, density, damping and step are ignored",
        "dynamic or quasistatic",
    )
    step: Literal["auto"] | Positive = key(
        "auto",
        "time step [s], a whole fraction of the frame interval; auto: at most half the stability limit",
        "auto, or a number above 0, in seconds",
    )
    tolerance: Tolerance | None = key(
        None,
        "with step: auto, largest allowed error of any frame due to the step, as a fraction of the largest "
        "displacement; companion runs find the step",
        f"a number, {MIN_TOLERANCE:g} to {MAX_TOLERANCE:g}",
    )
    damping_difference: Literal[tuple(INTEGRATORS)] = key(  # type: ignore[valid-type]
        "central",
        "finite difference for the velocity in the damping: "
        + "; ".join(f"{name}: {integrator.meaning}" for name, integrator in INTEGRATORS.items()),
        " or ".join(INTEGRATORS),
    )
    precision: Literal["auto", "f32", "f64"] = key(
        "auto",
        "floating-point precision; auto: f64 if time integration is a small part of the run, else f32",
        "auto, f32 or f64",
    )

    @property
    def at_rest(self) -> bool:
        """Whether every frame is an equilibrium of the sheet."""
        return self.motion == "quasistatic"

    @property
    def integrator(self) -> Integrator:
        """Integrator of `damping_difference`."""
        return INTEGRATORS[self.damping_difference]

    @property
    def frames(self) -> int:
        """Number of frame intervals, F; F + 1 frames are drawn."""
        return round(self.duration * self.frames_per_second)

    @model_validator(mode="after")
    def _check_combination(self) -> Time:
        frames = self.duration * self.frames_per_second
        if not 0.5 < frames <= 1e9 or abs(frames - round(frames)) > FRAME_TOLERANCE:
            nearest = max(1, round(min(frames, 1e9))) / self.frames_per_second
            raise scene_fault(
                f"{self.duration:.12g} s x {self.frames_per_second:.12g} frames per second = {frames:.12g} frames, "
                f"not a whole number up to 1e9; try {nearest:.12g}",
                "duration",
            )
        if self.tolerance is not None and self.step != "auto":
            message = f"a tolerance chooses the step, but step is {self.step:.12g}"
            raise scene_fault(f"{message}; set step: auto or remove the tolerance", "tolerance")
        if self.at_rest and self.tolerance is not None:
            message = "limits the error of the time step, and motion: quasistatic has none; remove the tolerance"
            raise scene_fault(message, "tolerance")
        if self.at_rest and self.precision == "f32":
            raise scene_fault("f32 is too coarse for motion: quasistatic; take auto or f64", "precision")
        return self


class Scene(Section):
    """Scene: the complete, validated input of a run, as in the YAML file, with defaults.

    Example:
        >>> from taichi_msm import Scene
        >>> tissue = {"young": 3e4, "thickness": 3e-3, "density": 1050}
        >>> sheet = {"points": [31, 31], "size": [0.1, 0.1]}
        >>> scene = Scene(sheet=sheet, tissue=tissue, time={"duration": 1}, output=["trajectory"])
        >>> scene.time.frames, scene.render.size
        (25, (512, 512))
    """

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["tissue"]}, {"required": ["springs"]}]})

    image: FilePath | None = key(
        None,
        "the picture on the sheet: PNG, JPEG, WebP, BMP or TIFF; relative to the scene file, "
        "in its folder or below; required to draw",
        "the path of a picture",
    )
    region: tuple[Integer, Integer, Integer, Integer] | None = key(
        None,
        "x, y, width, height [px] of the part of the image that is mapped to the sheet; default: all of it",
        "four whole numbers: [x, y, width, height] in pixels",
    )
    sheet: Sheet = key(..., "the sheet of mass points", "a mapping with points and size")
    tissue: Tissue | None = key(None, "material of the sheet", "a mapping with young, thickness and density")
    springs: Springs | None = key(None, "instead of tissue: the springs", "a mapping with structural, shear, virtual")
    damping: NotNegative = key(0.0, "with springs: C, force per velocity [N s/m]", "a number, 0 or more, in N s/m")
    probes: Annotated[tuple[Probe, ...], Field(max_length=MAX_PROBES)] = key(
        (),
        "the tools",
        f"a list of at most {MAX_PROBES} mappings with at, total or force, load, or with path and instrument or clamp",
    )
    time: Time = key(..., "duration, frames and time steps", "a mapping with at least duration")
    render: Render = key(Render(), "drawing of the frames", "a mapping")
    output: tuple[OutputName, ...] = key(
        ("png", "gif", "trajectory"),
        "results in addition to run.json; [] simulates only",
        f"a list of {', '.join(ENTRIES)}",
    )

    @property
    def calibrated_size(self) -> tuple[int, int] | None:
        """Width and height of the image to which the cameras refer [px]; None: the pictures."""
        frame = self.sheet.surface.frame if self.sheet.surface else None
        return frame.image_size if frame and frame.cameras else None

    @property
    def folders(self) -> dict[str, tuple[str, ...]]:
        """Names of the outputs by folder: a folder for each camera, and "" for the run."""
        selected = [output for output in OUTPUTS.values() if output.entry in self.output]
        folders = {"": tuple(output.name for output in selected if not output.is_camera_output)}
        for camera in self.render.all_cameras:
            has_pair = bool(self.render.companion(camera))
            possible = (output for output in selected if has_pair or not output.needs_stereo_pair)
            names = (output.name for output in possible if output.is_camera_output)
            folders[camera] = (*folders.get(camera, ()), *names)
        return folders

    def asks_for(self, *sources: str) -> bool:
        """Return whether any output has one of the given sources (`Output.source`)."""
        return any(OUTPUTS[name].source in sources for name in self.output)

    @property
    def draws(self) -> bool:
        """Whether any output is a picture."""
        return self.asks_for("picture")

    @property
    def labels_pixels(self) -> bool:
        """Whether any output is a ground-truth label of the pixels."""
        return self.asks_for("labels", "flow", "stereo")

    @property
    def renders(self) -> bool:
        """Whether any output depends on the camera."""
        return any(OUTPUTS[name].is_camera_output for name in self.output)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the shapes of all instruments, sorted."""
        return tuple(sorted({probe.instrument.shape for probe in self.probes if probe.instrument is not None}))

    @property
    def kind(self) -> Literal["tissue", "springs"]:
        """Name of the section with the material of the sheet."""
        return "springs" if self.tissue is None else "tissue"

    @property
    def stiffness_map(self) -> StiffnessMap | None:
        """Map of the stiffness of the springs or the tissue; None without one."""
        return self.maps.get("map")

    @property
    def maps(self) -> dict[str, StiffnessMap]:
        """Maps of the springs or the tissue, by key: map, foundation_map."""
        return {name: value for name, value in (self.tissue or self.springs or ()) if isinstance(value, StiffnessMap)}

    @property
    def pictures(self) -> dict[str, str]:
        """Paths of the image, the maps, surface and mask, by dotted key, such as image and tissue.map.image."""
        image = {} if self.image is None else {"image": self.image}
        maps = {f"{self.kind}.{name}.image": value.image for name, value in self.maps.items()}
        return image | self.sheet.files | maps

    def with_pictures(self, path: Callable[[str], str]) -> Scene:
        """Return a copy with the path p of the image, of each map, of surface and mask replaced by `path(p)`."""
        maps = {name: value.model_copy(update={"image": path(value.image)}) for name, value in self.maps.items()}
        image = None if self.image is None else path(self.image)
        material = self.tissue or self.springs
        changed = None if material is None else material.model_copy(update=maps)
        return self.model_copy(update={"image": image, self.kind: changed, "sheet": self.sheet.with_files(path)})

    @model_validator(mode="wrap")
    @classmethod
    def _frame(cls, data: Any, handler: ModelWrapValidatorHandler[Scene]) -> Scene:
        """Let cameras refer to the size of an image that one of them took, and give the surface its `Frame`."""
        size = framed_image_size(data) if isinstance(data, Mapping) else None
        with calibrated_size(size):
            scene = handler(complete_framed(data, size) if isinstance(data, Mapping) and is_framed(data) else data)
        # The scene is frozen.
        scene.__dict__["sheet"] = frame_sheet(scene.sheet, scene.render, scene.image, size, scene.region)
        return scene

    @model_validator(mode="after")
    def _check_image_given(self) -> Scene:
        if self.draws and self.image is None:
            raise scene_fault(
                "a picture is needed to draw png, gif or mp4; name one, or set output to [trajectory] or []", "image"
            )
        return self
