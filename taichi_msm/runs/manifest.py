"""Manifest of a run: all inputs on which its results depend, stored so that another process can continue it."""

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
from taichi_msm.runs.checkpoint import CHECKPOINT_FOLDER, MANIFEST_FILE, load_with_checksum, open_manifest
from taichi_msm.runs.directory import STAGING_FOLDER
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import try_plan
from taichi_msm.system.compiler import result_versions
from taichi_msm.system.runtime import ARCHS

# A manifest contains the scene twice; a scene file may have 1 MiB.
MAX_MANIFEST_BYTES = 1 << 26


@dataclass(frozen=True)
class Manifest:
    """Inputs of a run."""

    given: Scene  # as loaded
    scene: Scene  # with resolved mesh, step and precision
    overrides: tuple[str, ...]  # of the scene file
    estimate: TimeStepEstimate | None  # time-step error, if `time.tolerance` required it before the run
    mesh: MeshEstimate | None  # mesh error, if `sheet.tolerance` required it before the run
    asks_estimate: bool | None  # whether to estimate the error during the run; None if it is cheap
    folder: str  # the current directory, to which picture paths are relative
    arch: str  # cpu, cuda or vulkan
    sha256: Mapping[str, str]  # of the files of picture, maps and cameras, by their keys in the scene
    versions: Mapping[str, str]  # of all software that affects the results

    def as_json(self) -> dict[str, Any]:
        """Convert the manifest to data for JSON."""
        return cast(dict[str, Any], _MANIFEST_ADAPTER.dump_python(self, mode="json"))

    def require_same_inputs(self, sha256: Mapping[str, str], versions: Mapping[str, str]) -> None:
        """Check that resuming the run yields the same bits as an uninterrupted run.

        Args:
            sha256: current digests of picture, maps and cameras, from `input_digests`.
            versions: current versions.

        Raises:
            FilesError: when a file or a relevant version has changed.
        """
        for key, path in self.scene.pictures.items():
            if sha256.get(key) != self.sha256.get(key):
                raise FilesError(f"{path} has changed since the run began; put it back, or run the scene again")
        original, current = result_versions(self.versions, self.arch), result_versions(versions, self.arch)
        if original != current:
            # If the run began with a tested compiler, and the current one is untested, only the latter is compared.
            changed = any(version != current.get(name) for name, version in original.items())
            named = original if changed else self.versions
            others = [f"{name} {version}" for name, version in named.items() if version != versions.get(name)]
            raise FilesError(f"the run began with {', '.join(others)}; use these versions, or run the scene again")

    def has_same_bits_as(self, other: Manifest) -> bool:
        """Return whether both runs produce results with the same bits, so that one can continue the other."""
        return self._result_inputs() == other._result_inputs()

    def _result_inputs(self) -> tuple[Any, ...]:
        # Pictures are compared by digest, not by path.
        scene = self.scene.with_pictures(lambda path: "any")
        # The order of the cameras matters, because the light is at the first one; dictionaries compare without order.
        return (
            scene,
            list(scene.render.all_cameras),
            self.arch,
            self.sha256,
            result_versions(self.versions, self.arch),
        )


_MANIFEST_ADAPTER = TypeAdapter(Manifest)


def read_manifest(directory: Path) -> tuple[Manifest, Plan]:
    """Read the manifest of the unfinished run in a directory, and plan its scene.

    Raises:
        DamagedError: when the manifest is damaged or its scene cannot be run.
        FilesError: when there is no unfinished run.
        SceneError: when a map of the scene cannot be read.
    """
    path = directory / STAGING_FOLDER / CHECKPOINT_FOLDER / MANIFEST_FILE
    try:
        with open_manifest(directory) as file:
            data = file.read(MAX_MANIFEST_BYTES + 1)
        manifest = _MANIFEST_ADAPTER.validate_python(load_with_checksum(data))
        # The current directory may be another one.
        manifest = replace(manifest, scene=manifest.scene.with_pictures(partial(os.path.join, manifest.folder)))
    except (FileNotFoundError, NotADirectoryError):
        raise FilesError(f"{directory}: there is no unfinished run to resume") from None
    except OSError as error:
        raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    except ValueError:  # includes pydantic's ValidationError
        raise DamagedError(f"{path} is damaged; run the scene again") from None
    plan, problems = try_plan(manifest.scene)
    if unreadable := [str(problem) for problem in problems if problem.path[-1:] == ("image",)]:
        raise SceneError(unreadable)
    # Validated, because the file may be untrusted.
    numbers = () if manifest.estimate is None else asdict(manifest.estimate).values()
    possible = manifest.arch in ARCHS and all(number >= 0 for number in numbers)
    if plan is None or problems or not possible or list(camera_problems(manifest.scene)):
        raise DamagedError(f"{path} is of a scene that cannot be run; run the scene again")
    return manifest, plan


def input_digests(plan: Plan) -> dict[str, str]:
    """Compute the SHA-256 of the files of picture, maps and cameras, by their keys in the scene.

    An unreadable picture is omitted. Digests of maps and cameras are those of the files as read for the plan.
    """
    scene = plan.scene
    sha256 = {**plan.sha256} | {f"{scene.kind}.{name}.image": image.sha256 for name, image in plan.maps.items()}
    if scene.image is not None:
        with suppress(PictureError):
            sha256["image"] = file_sha256(scene.image)
    return sha256
