"""The scene: one frozen model per section of the YAML file, with every default and limit, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import (
    ConfigDict,
    Field,
    model_validator,
)

from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.render import Render
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
    """The time span, the frames and the steps."""

    duration: Positive = key(
        ..., "simulated time [s]; duration x frames_per_second is a whole number", "a number above 0, in seconds"
    )
    frames_per_second: Positive = key(25.0, "frames per simulated second", "a number above 0")
    motion: Literal["dynamic", "quasistatic"] = key(
        "dynamic",
        "dynamic: the sheet moves; quasistatic: every frame is the sheet at rest under its loads, and mass, density, "
        "damping and step do not matter",
        "dynamic or quasistatic",
    )
    step: Literal["auto"] | Positive = key(
        "auto",
        "time step [s], a whole fraction of a frame; auto: half the stability limit or less",
        "auto, or a number above 0, in seconds",
    )
    tolerance: Tolerance | None = key(
        None,
        "with step: auto, largest allowed error of any frame due to the step, as a fraction of the largest "
        "displacement; pilot runs find the step",
        f"a number, {MIN_TOLERANCE:g} to {MAX_TOLERANCE:g}",
    )
    damping_difference: Literal["central", "backward"] = key(
        "central",
        "finite difference for the velocity in the damping: central is of order 2, backward "
        "(the paper's eq. 3) of order 1",
        "central or backward",
    )
    precision: Literal["auto", "f32", "f64"] = key(
        "auto",
        "floating-point precision; auto: f64 if stepping is a small part of the run, else f32",
        "auto, f32 or f64",
    )

    @property
    def at_rest(self) -> bool:
        """Whether every frame is the sheet at rest."""
        return self.motion == "quasistatic"

    @property
    def frames(self) -> int:
        """F, the number of frame intervals; F + 1 frames are drawn."""
        return round(self.duration * self.frames_per_second)

    @model_validator(mode="after")
    def _whole_frames(self) -> Time:
        frames = self.duration * self.frames_per_second
        if not 0.5 < frames <= 1e9 or abs(frames - round(frames)) > FRAME_TOLERANCE:
            nearest = max(1, round(min(frames, 1e9))) / self.frames_per_second
            raise scene_fault(
                f"{self.duration:.12g} s x {self.frames_per_second:.12g} frames per second = {frames:.12g} frames, "
                f"not a whole number up to 1e9; try {nearest:.12g}",
                "duration",
            )
        return self

    @model_validator(mode="after")
    def _one_way_to_the_step(self) -> Time:
        if self.tolerance is not None and self.step != "auto":
            said = f"a tolerance chooses the step, but step is {self.step:.12g}"
            raise scene_fault(f"{said}; set step: auto or remove the tolerance", "tolerance")
        return self

    @model_validator(mode="after")
    def _fits_rest(self) -> Time:
        if self.at_rest and self.tolerance is not None:
            raise scene_fault(
                "is for the time step, and motion: quasistatic takes none; remove the tolerance", "tolerance"
            )
        if self.at_rest and self.precision == "f32":
            raise scene_fault("f32 is too coarse for motion: quasistatic; take auto or f64", "precision")
        return self


class Scene(Section):
    """Everything a run needs; what the YAML file says, checked and with its defaults filled in.

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
        "x, y, width, height [px] of the part of the image that the sheet carries; default: all of it",
        "four whole numbers: [x, y, width, height] in pixels",
    )
    sheet: Sheet = key(..., "the sheet of mass points", "a mapping with points and size")
    tissue: Tissue | None = key(None, "what the sheet is made of", "a mapping with young, thickness and density")
    springs: Springs | None = key(None, "instead of tissue: the springs", "a mapping with structural, shear, virtual")
    damping: NotNegative = key(0.0, "with springs: C, force per velocity [N s/m]", "a number, 0 or more, in N s/m")
    probes: Annotated[tuple[Probe, ...], Field(max_length=MAX_PROBES)] = key(
        (),
        "the tools",
        f"a list of at most {MAX_PROBES} mappings with at, total or force, load, or with path and instrument",
    )
    time: Time = key(..., "time span, frames and steps", "a mapping with at least duration")
    render: Render = key(Render(), "how a frame is drawn", "a mapping")
    output: tuple[OutputName, ...] = key(
        ("png", "gif", "trajectory"),
        "what is written besides run.json; [] simulates only",
        f"a list of {', '.join(OUTPUTS)}",
    )

    @property
    def folders(self) -> dict[str, tuple[str, ...]]:
        """The entries of output by their folders: what a camera sees goes to its own, the rest to that of the run."""
        wanted = [output for name, output in OUTPUTS.items() if name in self.output]
        folders = {"": tuple(output.name for output in wanted if not output.is_camera_output)}
        for camera in self.render.all_cameras:
            has_pair = bool(self.render.baseline(camera))
            seen = (
                output.name
                for output in wanted
                if output.is_camera_output and (has_pair or not output.needs_stereo_pair)
            )
            folders[camera] = (*folders.get(camera, ()), *seen)
        return folders

    def asks_for(self, *sources: str) -> bool:
        """Tell whether the values of any output are in one of these fields of `Observed`."""
        return any(OUTPUTS[name].source in sources for name in self.output)

    @property
    def draws(self) -> bool:
        """Whether any output is a picture."""
        return self.asks_for("picture")

    @property
    def labels_pixels(self) -> bool:
        """Whether any output is a label of every pixel."""
        return self.asks_for("labels", "flow", "stereo")

    @property
    def renders(self) -> bool:
        """Whether any output depends on what the camera sees."""
        return any(OUTPUTS[name].is_camera_output for name in self.output)

    @property
    def has_instruments(self) -> bool:
        """Whether any probe has an instrument, which is drawn."""
        return any(probe.instrument is not None for probe in self.probes)

    @property
    def kind(self) -> Literal["tissue", "springs"]:
        """The section that says what the sheet is made of."""
        return "springs" if self.tissue is None else "tissue"

    @property
    def stiffness_map(self) -> StiffnessMap | None:
        """The map of the springs or the tissue."""
        return self.maps.get("map")

    @property
    def maps(self) -> dict[str, StiffnessMap]:
        """The maps of the springs or the tissue, by the keys that name them: map, foundation_map."""
        return {name: value for name, value in (self.tissue or self.springs or ()) if isinstance(value, StiffnessMap)}

    @property
    def pictures(self) -> dict[str, str]:
        """The paths of the picture and the maps, by the keys that name them, such as image and tissue.map.image."""
        image = {} if self.image is None else {"image": self.image}
        return image | {f"{self.kind}.{name}.image": each.image for name, each in self.maps.items()}

    def with_pictures(self, path: Callable[[str], str]) -> Scene:
        """Give the picture and the maps other paths, each by its present one."""
        maps = {name: each.model_copy(update={"image": path(each.image)}) for name, each in self.maps.items()}
        image = None if self.image is None else path(self.image)
        sheet = self.tissue or self.springs
        material = None if sheet is None else sheet.model_copy(update=maps)
        return self.model_copy(update={"image": image, self.kind: material})

    @model_validator(mode="after")
    def _picture_given(self) -> Scene:
        if self.draws and self.image is None:
            raise scene_fault(
                "a picture is needed to draw png, gif or mp4; name one, or set output to [trajectory] or []", "image"
            )
        return self
