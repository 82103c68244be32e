"""What a run has written is read again as it was, and what no run has written is not."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm.errors import ArgumentError, FilesError
from taichi_msm.runs.finished import read_run
from tests.scenes import speckle

RUN_AGAIN = "damaged, or not of this run; run the scene again"


def change(results: Path, **values: Any) -> None:
    """Change keys of run.json; None removes one."""
    record = json.loads((results / "run.json").read_text()) | values
    kept = {key: value for key, value in record.items() if value is not None}
    (results / "run.json").write_text(json.dumps(kept))


def change_scene(results: Path, **sections: Any) -> None:
    """Change keys in the sections of the scene of run.json."""
    scene = json.loads((results / "run.json").read_text())["scene"]
    for name, keys in sections.items():
        scene[name] = {**scene[name], **keys} if isinstance(keys, dict) else keys
    change(results, scene=scene)


def test_a_run_is_read_as_it_was(ran: Path) -> None:
    run = read_run(ran)
    assert (run.directory, run.frames) == (ran, 5)
    np.testing.assert_array_equal(run.time, [0, 0.1, 0.2, 0.3, 0.4])
    written = np.load(ran / "trajectory.npz")
    positions = run.positions()
    assert positions.dtype == np.float64
    assert not positions.flags.writeable
    np.testing.assert_array_equal(positions, written["position"])
    np.testing.assert_array_equal(run.time, written["time"])
    assert run.scene.time.precision == "f64"
    assert run.result_path("png", 4) == ran / "frames" / "0004.png"


def test_pictures_are_found_from_where_the_run_was(results: Path) -> None:
    Image.fromarray(speckle(4, 4)).save(results / "map.png")
    stiffness = {"structural": 20.0, "map": {"image": "sub/../map.png", "range": [1.0, 2.0]}}
    change_scene(results, image="sub/speckle.png", springs=stiffness)
    change(results, working_directory=str(results))
    (results / "sub").mkdir()
    made = read_run(results).scene
    assert made.image == str(results / "sub" / "speckle.png")
    assert made.stiffness_map is not None
    assert made.stiffness_map.image == str(results / "sub" / ".." / "map.png")
    change_scene(results, image=None, output=["trajectory"])
    assert read_run(results).scene.image is None


def test_a_picture_that_is_gone_is_no_damage(results: Path) -> None:
    """Not everything that is made of a run needs it."""
    change_scene(results, image="gone.png", springs={"map": {"image": "gone.png", "range": [1.0, 2.0]}})
    assert read_run(results).frames == 5


def test_what_is_missing_is_named_with_the_remedy(results: Path) -> None:
    (results / "trajectory.npz").unlink()
    (results / "frames" / "0003.png").unlink()
    run = read_run(results)
    missing, again = f"not among the results of {results}", 'run the scene again with --set "output=[png,gif,trajectory'
    with pytest.raises(FilesError) as caught:
        run.positions()
    assert str(caught.value) == f'trajectory.npz: {missing}; {again}]"'
    with pytest.raises(FilesError) as caught:
        run.result_path("flow")
    assert str(caught.value) == f'flow: {missing}; {again},flow]"'
    with pytest.raises(FilesError) as caught:
        run.result_path("png", 3)
    assert str(caught.value) == f'{results / "frames" / "0003.png"}: no such file; {again}]"'
    assert run.has_output("png")
    assert not run.has_output("flow")


@pytest.mark.parametrize("name", ["nowhere", "empty", "run.json"])
def test_a_folder_without_a_run_is_told_of(name: str, results: Path) -> None:
    (results / "empty").mkdir()
    with pytest.raises(FilesError) as caught:
        read_run(results / name)
    assert str(caught.value) == f"{results / name}: no results of a run; name the folder that `run --out` wrote"


def test_what_is_no_path_is_told_of() -> None:
    with pytest.raises(ArgumentError, match="take a path"):
        read_run("a\0b")


DAMAGE: dict[str, Callable[[Path], object]] = {
    "cut short": lambda path: (path / "run.json").write_bytes((path / "run.json").read_bytes()[:-20]),
    "not UTF-8": lambda path: (path / "run.json").write_bytes(b'{"frames": "\xff"}'),
    "a list": lambda path: (path / "run.json").write_text("[]"),
    "deep": lambda path: (path / "run.json").write_text("[" * 200_000),
    "no scene": lambda path: change(path, scene=None),
    "no frames": lambda path: change(path, frames=None),
    "no working directory": lambda path: change(path, working_directory=None),
    "too many frames": lambda path: change(path, frames=6),
    "no frame": lambda path: change(path, frames=0),
    "a name for frames": lambda path: change(path, frames="5"),
    "part of a frame": lambda path: change(path, frames=2.5),
    "one row": lambda path: change_scene(path, sheet={"points": [1, 11]}),
    "points in space": lambda path: change_scene(path, sheet={"points": [9, 11, 3]}),
    "unknown precision": lambda path: change_scene(path, time={"precision": "auto"}),
    "another precision": lambda path: change_scene(path, time={"precision": "f16"}),
    "a number for a folder": lambda path: change(path, working_directory=3),
    "a number for a scene": lambda path: change(path, scene=3),
    "an unknown key": lambda path: change_scene(path, sheet={"colour": 3}),
    "nothing to be made of": lambda path: change_scene(path, springs=None),
    "no mass": lambda path: change_scene(path, sheet={"mass": None}),
    "an eye at its target": lambda path: change_scene(
        path, render={"camera": {"eye": [0.0, 0.0, 0.0], "target": [0.0, 0.0, 0.0]}}
    ),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_record_is_one_line(damage: Callable[[Path], object], results: Path) -> None:
    damage(results)
    with pytest.raises(FilesError) as caught:
        read_run(results)
    assert str(caught.value) == f"{results / 'run.json'}: {RUN_AGAIN}"


def rewrite(results: Path, name: str = "position", **options: Any) -> None:
    """Write the trajectory anew, after `edit` made something else of its positions."""
    position = np.load(results / "trajectory.npz")["position"]
    edit = options.pop("edit", lambda values: values)
    save = options.pop("save", np.savez)
    save(results / "trajectory.npz", **{name: edit(position)})


def with_nan(position: Any) -> Any:
    position[3, 4, 5, 1] = np.nan
    return position


FORGERIES: dict[str, dict[str, Any]] = {
    "compressed": {"save": np.savez_compressed},
    "of other numbers": {"edit": lambda position: position.astype(np.float32)},
    "of fewer frames": {"edit": lambda position: position[:-1]},
    "of another shape": {"edit": lambda position: position.reshape(5, 11, 9, 3)},
    "in another order": {"edit": np.asfortranarray},
    "with NaN": {"edit": with_nan},
    "of a sheet that begins elsewhere": {"edit": lambda position: position + 1e-9},
    "without positions": {"name": "place"},
}


@pytest.mark.parametrize("forgery", FORGERIES.values(), ids=FORGERIES)
def test_a_forged_trajectory_is_refused(forgery: dict[str, Any], results: Path) -> None:
    rewrite(results)
    assert len(read_run(results).positions()) == 5, "NumPy's own files are taken"
    rewrite(results, **forgery)
    with pytest.raises(FilesError) as caught:
        read_run(results).positions()
    assert str(caught.value) == f"{results / 'trajectory.npz'}: {RUN_AGAIN}"


def test_an_array_that_claims_to_be_huge_takes_no_memory(results: Path) -> None:
    """A header and a record may both say so; the file is as long as it is."""
    with zipfile.ZipFile(results / "trajectory.npz", "w") as archive:
        archive.writestr("position.npy", np.lib.format.magic(1, 0) + b"v\0{'descr': '<f8', 'shape': (1000000000,)}")
    change_scene(results, time={"duration": 1e8})
    change(results, frames=10**9)
    with pytest.raises(FilesError, match=RUN_AGAIN):
        read_run(results).positions()


def test_a_flipped_bit_is_found_or_does_no_harm(results: Path) -> None:
    """The zip format has bytes that say nothing, such as dates; no other positions are ever read."""
    path, run = results / "trajectory.npz", read_run(results)
    whole, positions = path.read_bytes(), np.array(run.positions())
    rng = np.random.default_rng(0)
    # All of the headers at both ends, and places between.
    places = [*range(200), *range(len(whole) - 400, len(whole)), *rng.integers(200, len(whole) - 400, 200).tolist()]
    errors = set()
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.unlink()  # what is mapped stays as it was
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(run.positions(), positions)
        except FilesError as error:
            errors.add(str(error))
    assert errors == {f"{path}: {RUN_AGAIN}"}


@pytest.mark.parametrize("cut", [0, 10, 1000, -1])
def test_a_trajectory_that_was_cut_is_refused(cut: int, results: Path) -> None:
    path = results / "trajectory.npz"
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(FilesError, match=RUN_AGAIN):
        read_run(results).positions()


def test_the_record_of_another_run_does_not_fit(ran: Path, results: Path) -> None:
    change_scene(results, sheet={"size": [0.3, 0.5]})
    with pytest.raises(FilesError, match=RUN_AGAIN):
        read_run(results).positions()
    shutil.copy(ran / "run.json", results)
    assert len(read_run(results).positions()) == 5


def test_reading_a_run_does_not_start_the_compiler(ran: Path) -> None:
    code = (
        "import sys; from taichi_msm.runs.finished import read_run; read_run(sys.argv[1]).positions(); "
        "sys.exit(bool({'taichi', 'quadrants'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", code, str(ran)], check=True)
