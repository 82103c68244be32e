"""Write the tables of keys and camera files into the pages, from the program's descriptions.

PYTHONPATH=. python docs/make_tables.py
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.marked import replace_marked
from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.readers import CALIBRATION_READERS, TRAJECTORY_READERS
from taichi_msm.camera_files.trajectory import TrajectoryReader
from taichi_msm.load.scene_file import schema
from taichi_msm.scene.section import Section
from taichi_msm.sweeps.distribution import Distribution
from taichi_msm.sweeps.spec import SweepSettings
from taichi_msm.view.events import KEYS, POINTER

DOCS = Path(__file__).parent


def rows(section: dict[str, Any], definitions: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield a line for every key of a section and of its subsections."""
    for name, key in section["properties"].items():
        below = list(_references(key))
        default = f"`{json.dumps(key['default'])}`" if key.get("default") is not None else ""
        # Sections with alternatives begin with the common one.
        alternatives = [section, *section.get("anyOf", ())[:1]]
        if any(name in alternative.get("required", ()) for alternative in alternatives):
            default = "**required**"
        elif below and "then" not in key:
            default = "none" if "items" in key else "those below"
        yield f"| `{prefix}{name}` | {key['description']} | {key['expects']} | {default} |"
        for reference in below:
            yield from rows(definitions[reference], definitions, f"{prefix}{name}.{'N.' if 'items' in key else ''}")


def _references(key: dict[str, Any]) -> Iterator[str]:
    for schema_part in (key, key.get("items", {}), key.get("then", {}), *key.get("anyOf", ())):
        if "$ref" in schema_part:
            yield schema_part["$ref"].rsplit("/", 1)[-1]


def scene_keys() -> str:
    """Return the table of a scene's keys, from its JSON Schema."""
    root = schema()
    return "| key | meaning | value | default |\n|---|---|---|---|\n" + "\n".join(rows(root, root["$defs"])) + "\n"


def page_keys() -> str:
    """Return the table of the pointer and the keys of a session's page."""
    lines = [f"| {name} | {action} |" for name, action in POINTER.items()]
    lines += [f"| `{name}` | {action} |" for name, action in KEYS.items()]
    return "| | |\n|---|---|\n" + "\n".join(lines) + "\n"


def model_keys(model: type[Section], *titles: str) -> str:
    """Return the table of the keys of a section without subsections."""
    lines = []
    for name, field in model.model_fields.items():
        assert isinstance(field.json_schema_extra, dict)
        default = (
            "**required**" if field.is_required() else "" if field.default in (None, {}, []) else f"`{field.default}`"
        )
        cells = [f"`{name}`", field.description, field.json_schema_extra["expects"], default][: len(titles)]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}\n" + "\n".join(lines) + "\n"


def readers(table: Sequence[CalibrationReader] | Sequence[TrajectoryReader]) -> str:
    """Return the table of readers of camera files."""
    lines = [
        f"| {reader.name} | {reader.recognised_by} | {', '.join(f'`{example}`' for example in reader.examples)} |"
        for reader in table
    ]
    return "| program | file | keys of the camera |\n|---|---|---|\n" + "\n".join(lines) + "\n"


# Functions that make the tables, by page and name.
TABLES: dict[tuple[str, str], Callable[[], str]] = {
    ("keys", "keys"): scene_keys,
    ("view", "hands"): page_keys,
    ("sweep", "sweep keys"): partial(model_keys, SweepSettings, "key", "meaning", "value", "default"),
    ("sweep", "distributions"): partial(model_keys, Distribution, "way", "how the key varies", "value"),
    ("cameras", "calibrations"): partial(readers, CALIBRATION_READERS),
    ("cameras", "trajectories"): partial(readers, TRAJECTORY_READERS),
}


def with_table(text: str, name: str, table: str) -> str:
    """Return the text of a page with a table between its marks."""
    return replace_marked(text, name, "docs/make_tables.py", table)


def main() -> None:
    """Write every table."""
    for (page, name), make in TABLES.items():
        path = DOCS / f"{page}.md"
        path.write_text(with_table(path.read_text(encoding="utf-8"), name, make()), encoding="utf-8")


if __name__ == "__main__":
    main()
