"""What a run is to do, written down so that another process can continue it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from taichi_msm.errors import DamagedError, FilesError
from taichi_msm.physics import material, timestep
from taichi_msm.physics.error_control import Estimate
from taichi_msm.physics.material import factors
from taichi_msm.physics.mesh_error import MeshEstimate
from taichi_msm.render import camera
from taichi_msm.render.texture import load_texture
from taichi_msm.results.publication import CHECKPOINT, MANIFEST, STAGING, open_checkpoint
from taichi_msm.results.sealed import unseal
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import ARCHS

# A manifest contains its scene twice; each may come from a file of 1 MiB.
MAX_BYTES = 1 << 26


@dataclass(frozen=True)
class Manifest:
    """Everything that the bits of a result depend on, and facts for its record.

    Attributes:
        given: the scene as it was loaded.
        scene: the scene with the points, the step and the precision that were chosen.
        overrides: of the scene file.
        estimate: of the error, if a tolerance required it before the run; else None.
        mesh: error of the points, if a tolerance of the sheet required it before the run; else None.
        asks_estimate: whether to estimate the error beside the run; None: if it is cheap.
        folder: the current directory, from which the path of the scene's picture starts.
        arch: cpu, cuda or vulkan.
        picture: digest of the picture on the sheet.
        map: digest of the map's factors.
        versions: of all that the results depend on.
    """

    given: Scene
    scene: Scene
    overrides: tuple[str, ...]
    estimate: Estimate | None
    mesh: MeshEstimate | None
    asks_estimate: bool | None
    folder: str
    arch: str
    picture: str
    map: str
    versions: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """Convert the manifest to data for JSON."""
        known = {key: one and asdict(one) for key, one in (("estimate", self.estimate), ("mesh", self.mesh))}
        scenes = {"given": self.given.model_dump(mode="json"), "scene": self.scene.model_dump(mode="json")}
        return {**vars(self), **scenes, **known}

    def load_texture(self) -> NDArray[np.uint8] | None:
        """Read the picture of the scene, if the scene draws; raises what `texture.load_texture` does."""
        if not self.scene.draws:
            return None
        image = str(Path(self.folder) / str(self.scene.image))
        return load_texture(self.scene.model_copy(update={"image": image}))

    def require_same(self, picture: str, map_: str, versions: Mapping[str, str]) -> None:
        """Make sure that the rest of the run would have the same bits as if it had not been interrupted.

        Raises:
            FilesError: when the picture, the map or a version has changed.
        """
        if picture != self.picture:
            raise FilesError(f"{self.scene.image} has changed since the run began; run the scene again")
        if map_ != self.map:
            image = getattr(self.scene.stiffness_map, "image", None)
            raise FilesError(f"{image} has changed since the run began; run the scene again")
        others = [f"{key} {self.versions.get(key)}" for key in versions if versions[key] != self.versions.get(key)]
        if others:
            raise FilesError(f"the run began with {', '.join(others)}; use these versions, or run the scene again")

    def gives_the_bits_of(self, other: Manifest) -> bool:
        """Tell whether the results of both runs have the same bits, so that one can continue the other."""
        renamed = other.scene.model_copy(update={"image": self.scene.image})
        if self.scene.stiffness_map is not None:
            renamed = renamed.with_map_image(self.scene.stiffness_map.image)
        mine, its = (
            (self.arch, self.picture, self.map, self.versions),
            (other.arch, other.picture, other.map, other.versions),
        )
        return self.scene == renamed and mine == its


_PLAN = TypeAdapter(Manifest)


def read_manifest(directory: Path) -> Manifest:
    """Read the manifest of the unfinished run into a directory.

    Raises:
        FilesError: when there is no such run.
        DamagedError: when the manifest is damaged or impossible.
        SceneError: when the map of its scene cannot be read.
    """
    path = directory / STAGING / CHECKPOINT / MANIFEST
    try:
        with open_checkpoint(directory) as folder, folder.open(MANIFEST) as file:
            data = file.read(MAX_BYTES + 1)
        manifest = _found_from_here(_PLAN.validate_python(unseal(data)))
    except (FileNotFoundError, NotADirectoryError):
        raise FilesError(f"{directory}: there is no unfinished run to resume") from None
    except OSError as error:
        raise FilesError(f"{path}: {(error.strerror or str(error)).lower()}") from None
    except ValueError:  # pydantic's too
        raise DamagedError(f"{path} is damaged; run the scene again") from None
    factors(manifest.scene)
    # Not trusted: anybody may have written it.
    numbers = () if manifest.estimate is None else asdict(manifest.estimate).values()
    possible = manifest.arch in ARCHS and all(number >= 0 for number in numbers)
    checks = (material.problems, timestep.problems, camera.problems)
    if not possible or any(list(check(manifest.scene)) for check in checks):
        raise DamagedError(f"{path} is of a scene that cannot be run; run the scene again")
    return manifest


def _found_from_here(manifest: Manifest) -> Manifest:
    """Change the path of the map so that it starts from the current directory."""
    stiffness_map = manifest.scene.stiffness_map
    if stiffness_map is None:
        return manifest
    image = str(Path(manifest.folder) / stiffness_map.image)
    return replace(manifest, scene=manifest.scene.with_map_image(image))


def digest(array: NDArray[Any] | None) -> str:
    """Compute a digest of an array; empty if there is none."""
    if array is None:
        return ""
    found = hashlib.sha256(repr(array.shape).encode())
    found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


def map_digest(scene: Scene) -> str:
    """Compute a digest of the factors of a scene's map; empty if there is none.

    Raises:
        SceneError: when the map cannot be read.
    """
    return digest(None if scene.stiffness_map is None else factors(scene))
