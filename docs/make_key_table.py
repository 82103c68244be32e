"""Write the table of the scene's keys into the README, from the JSON Schema.

python docs/make_key_table.py
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from taichi_msm.scene_file import schema

README = Path(__file__).parent.parent / "README.md"
START = "<!-- keys: made by docs/make_key_table.py -->\n"
END = "<!-- end of keys -->\n"


def rows(section: dict[str, Any], definitions: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Give a line for every key of a section and of the sections below it."""
    for name, key in section["properties"].items():
        below = list(_references(key))
        default = f"`{json.dumps(key['default'])}`" if key.get("default") is not None else ""
        if name in section.get("required", ()):
            default = "**required**"
        elif below and name != "camera":
            default = "none" if "items" in key else "those below"
        yield f"| `{prefix}{name}` | {key['description']} | {key['expects']} | {default} |"
        for reference in below:
            yield from rows(definitions[reference], definitions, f"{prefix}{name}.{'N.' if 'items' in key else ''}")


def _references(key: dict[str, Any]) -> Iterator[str]:
    for place in (key, key.get("items", {}), *key.get("anyOf", ())):
        if "$ref" in place:
            yield place["$ref"].rsplit("/", 1)[-1]


def table() -> str:
    """Give the whole table."""
    whole = schema()
    head = "| key | meaning | value | default |\n|---|---|---|---|\n"
    return head + "\n".join(rows(whole, whole["$defs"])) + "\n"


def main() -> None:
    """Replace what is between the marks."""
    before, rest = README.read_text(encoding="utf-8").split(START)
    _, after = rest.split(END)
    README.write_text(before + START + table() + END + after, encoding="utf-8")


if __name__ == "__main__":
    main()
