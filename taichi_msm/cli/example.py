"""The command `example`."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import Any

import click

from taichi_msm.cli import common, options
from taichi_msm.errors import FilesError, did_you_mean, printable, writing
from taichi_msm.runs.directory import replacing

# Name of the file with the JSON Schema of scenes, for editors.
SCHEMA = "scene.schema.json"


@options.program.command()
@click.argument("name", metavar="[NAME]", required=False)
@click.argument("directory", metavar="[DIR]", default=".")
def example(name: str | None, directory: str) -> None:
    """List the shipped scenes, or write scene NAME, its pictures and its schema to DIR, by default this directory."""
    from taichi_msm.load.scene_file import schema

    shipped, scenes = scenes_folder(), shipped_scenes()
    if name is None:
        click.echo("\n".join(f"{scene:16}{summary(path)}" for scene, path in scenes.items()))
        return
    if name not in scenes:
        message = f"{name} is not a shipped scene{did_you_mean(name, scenes)}; `taichi-msm example` lists them"
        raise click.BadParameter(message, param_hint="NAME")
    names = {path.relative_to(shipped): path for path in _files(scenes[name])}
    contents = {Path(directory) / path: _with_schema(source, path) for path, source in names.items()}
    contents[Path(directory) / SCHEMA] = common.format_json(schema()).encode()
    first, *_ = contents
    for target, content in contents.items():
        _require_free(target, content, is_scene=target == first)
    for target, content in contents.items():
        with writing(target, "DIR"), replacing(target) as file:
            file.write(content)
        click.echo(printable(str(target)))
    command = "run" if "sheet" in _content(scenes[name]) else "sweep"
    click.echo(printable(f"next: taichi-msm {command} {shlex.quote(str(first))}"))


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


def _with_schema(source: Path, path: Path) -> bytes:
    """Return the content of a shipped file, of a scene with a comment that names its schema to editors.

    `path` is that of its copy, relative to the folder of the schema.
    """
    is_scene = source.suffix == ".yaml" and "sheet" in _content(source)
    comment = f"# yaml-language-server: $schema={'../' * (len(path.parts) - 1)}{SCHEMA}\n" if is_scene else ""
    return comment.encode() + source.read_bytes()


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


def _require_free(target: Path, content: bytes, is_scene: bool) -> None:
    """Raise a FilesError if a target exists; a file other than the scene may exist with equal content."""
    with writing(target, "DIR"):
        if target.is_symlink() or (target.exists() and (is_scene or target.read_bytes() != content)):
            raise FilesError(f"{target}: exists already; move it away or choose another DIR")
