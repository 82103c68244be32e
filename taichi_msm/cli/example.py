"""The command `example`."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import Any

import click

from taichi_msm.cli import options
from taichi_msm.errors import FilesError, did_you_mean, printable, writing
from taichi_msm.runs.directory import replacing


@options.program.command()
@click.argument("name", metavar="[NAME]", required=False)
@click.argument("directory", metavar="[DIR]", default=".")
def example(name: str | None, directory: str) -> None:
    """List the shipped scenes, or write scene NAME with its pictures into DIR, by default the current directory."""
    shipped, scenes = scenes_folder(), shipped_scenes()
    if name is None:
        click.echo("\n".join(f"{scene:16}{summary(path)}" for scene, path in scenes.items()))
        return
    if name not in scenes:
        message = f"{name} is not a shipped scene{did_you_mean(name, scenes)}; `taichi-msm example` lists them"
        raise click.BadParameter(message, param_hint="NAME")
    targets = {path: Path(directory) / path.relative_to(shipped) for path in _files(scenes[name])}
    for path, target in targets.items():
        _require_free(path, target, is_scene=path == scenes[name])
    for path, target in targets.items():
        with writing(target, "DIR"), replacing(target) as file:
            file.write(path.read_bytes())
        click.echo(printable(str(target)))
    command = "sweep" if "vary" in _content(scenes[name]) else "run"
    click.echo(printable(f"next: taichi-msm {command} {shlex.quote(str(targets[scenes[name]]))}"))


def scenes_folder() -> Path:
    """Return the folder of the shipped scenes: in the package if installed from a wheel, next to it in a clone."""
    package = Path(__file__).parent.parent
    return next(folder for folder in (package / "scenes", package.parent / "scenes") if folder.is_dir())


def shipped_scenes() -> dict[str, Path]:
    """Return the files of the shipped scenes and sweeps by name."""
    return {
        path.stem: path for pattern in ("*.yaml", "sweeps/*.yaml") for path in sorted(scenes_folder().glob(pattern))
    }


def _content(path: Path) -> Any:
    from taichi_msm.load.yaml_reader import read_yaml

    return read_yaml(path.read_text(encoding="utf-8")).data


def summary(path: Path) -> str:
    """Return the first sentence of the comment at the head of a scene file."""
    lines = re.match("(#.*\n)+", path.read_text(encoding="utf-8"))
    return re.split(r"[:;] |(?<=[.?]) (?=[A-Z])", " ".join(lines[0].replace("#", "").split()))[0] if lines else ""


def _files(path: Path) -> Iterator[Path]:
    """Yield a shipped file and, recursively, the files that it names, also by patterns."""
    yield path
    if path.suffix == ".yaml":
        for text in _texts(_content(path)):
            for name in sorted(glob(text, root_dir=path.parent)):  # noqa: PTH207  # Path.glob refuses ".."
                yield from _files((path.parent / name).resolve())


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts(item)


def _require_free(path: Path, target: Path, is_scene: bool) -> None:
    """Raise a FilesError if a target exists; a file other than the scene may exist with equal content."""
    with writing(target, "DIR"):
        if target.is_symlink() or (target.exists() and (is_scene or target.read_bytes() != path.read_bytes())):
            raise FilesError(f"{target}: exists already; move it away or choose another DIR")
