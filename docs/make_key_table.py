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
        default = json.dumps(key["default"]) if "default" in key else ""
        below = list(_references(key))
        if below and name != "camera":
            default = ""
        shown = f"`{default}`" if default not in ("", "null") else ""
        required = " (required)" if name in section.get("required", ()) and not below else ""
        yield f"| `{prefix}{name}` | {key['description']}{required} | {key['expects']} | {shown} |"
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
