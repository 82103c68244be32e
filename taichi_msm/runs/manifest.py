"""What a run is to do, written down so that another process can continue it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from pydantic import TypeAdapter

from taichi_msm.accuracy.mesh import MeshEstimate
from taichi_msm.accuracy.time_step import TimeStepEstimate
from taichi_msm.errors import DamagedError, FilesError, SceneError
from taichi_msm.images import PictureError, file_sha256
from taichi_msm.model.plan import Plan
from taichi_msm.render.camera import camera_problems
from taichi_msm.runs.checkpoint import CHECKPOINT, MANIFEST, open_manifest, unseal
from taichi_msm.runs.directory import STAGING
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import try_plan
from taichi_msm.system.compiler import result_versions
from taichi_msm.system.runtime import ARCHS

# A manifest contains its scene twice; each may come from a file of 1 MiB.
MAX_BYTES = 1 << 26


@dataclass(frozen=True)
class Manifest:
    """Everything that the bits of a result depend on, and facts for its record."""

    given: Scene  # as it was loaded
    scene: Scene  # with the points, the step and the precision that were chosen
    overrides: tuple[str, ...]  # of the scene file
    estimate: TimeStepEstimate | None  # of the error, if a tolerance required it before the run
    mesh: MeshEstimate | None  # error of the points, if a tolerance of the sheet required it before the run
    asks_estimate: bool | None  # whether to estimate the error beside the run; None: if it is cheap
    folder: str  # the current directory, from which the paths of the scene's pictures start
    arch: str  # cpu, cuda or vulkan
    sha256: Mapping[str, str]  # of the files of the picture, the maps and the cameras, by the keys that name them
    versions: Mapping[str, str]  # of all that the results depend on

    def as_json(self) -> dict[str, Any]:
        """Convert the manifest to data for JSON."""
        return cast(dict[str, Any], _MANIFEST.dump_python(self, mode="json"))

    def require_same(self, sha256: Mapping[str, str], versions: Mapping[str, str]) -> None:
        """Raise a FilesError if the rest of the run would have other bits than if it had not been interrupted.

        This is so when the picture, a map, by their `digests`, or a version has changed.
        """
        for key, path in self.scene.pictures.items():
            if sha256.get(key) != self.sha256.get(key):
                raise FilesError(f"{path} has changed since the run began; put it back, or run the scene again")
        began, here = result_versions(self.versions, self.arch), result_versions(versions, self.arch)
        if began != here:
            # Where a tested compiler began the run, only the one that is here decides bits.
            named = began if any(version != here.get(name) for name, version in began.items()) else self.versions
            others = [f"{name} {version}" for name, version in named.items() if version != versions.get(name)]
            raise FilesError(f"the run began with {', '.join(others)}; use these versions, or run the scene again")

    def gives_the_bits_of(self, other: Manifest) -> bool:
        """Tell whether the results of both runs have the same bits, so that one can continue the other."""
        return self._deciding() == other._deciding()

    def _deciding(self) -> tuple[Any, ...]:
        """Give all that decides bits. Pictures count by what is in them, wherever they are."""
        scene = self.scene.with_pictures(lambda path: "any")
        # Dictionaries are equal in any order, but the first camera has the light.
        return (
            scene,
            list(scene.render.all_cameras),
            self.arch,
            self.sha256,
            result_versions(self.versions, self.arch),
        )


_MANIFEST = TypeAdapter(Manifest)


def read_manifest(directory: Path) -> tuple[Manifest, Plan]:
    """Read the manifest of the unfinished run into a directory, and plan its scene.

    Raises:
        FilesError: when there is no such run, or its manifest is damaged or impossible (DamagedError).
        SceneError: when a map of its scene cannot be read.
    """
    path = directory / STAGING / CHECKPOINT / MANIFEST
    try:
        with open_manifest(directory) as file:
            data = file.read(MAX_BYTES + 1)
        manifest = _MANIFEST.validate_python(unseal(data))
        # The current directory may be another one now.
        manifest = replace(manifest, scene=manifest.scene.with_pictures(partial(os.path.join, manifest.folder)))
    except (FileNotFoundError, NotADirectoryError):
        raise FilesError(f"{directory}: there is no unfinished run to resume") from None
    except OSError as error:
        raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    except ValueError:  # pydantic's too
        raise DamagedError(f"{path} is damaged; run the scene again") from None
    plan, problems = try_plan(manifest.scene)
    if unreadable := [str(problem) for problem in problems if problem.path[-1:] == ("image",)]:
        raise SceneError(unreadable)
    # Not trusted: anybody may have written it.
    numbers = () if manifest.estimate is None else asdict(manifest.estimate).values()
    possible = manifest.arch in ARCHS and all(number >= 0 for number in numbers)
    if plan is None or problems or not possible or list(camera_problems(manifest.scene)):
        raise DamagedError(f"{path} is of a scene that cannot be run; run the scene again")
    return manifest, plan


def digests(plan: Plan) -> dict[str, str]:
    """Compute the SHA-256 of the files of a scene's picture, maps and cameras, by the keys that name them.

    There is none of a picture that cannot be read. Those of maps and cameras are of the files as the plan read them.
    """
    scene = plan.scene
    sha256 = {**plan.sha256} | {f"{scene.kind}.{name}.image": image.sha256 for name, image in plan.maps.items()}
    if scene.image is not None:
        with suppress(PictureError):
            sha256["image"] = file_sha256(scene.image)
    return sha256
