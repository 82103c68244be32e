"""Write the tables of the scene's keys and of the window's keys into the README, from the program's own words.

python docs/make_key_table.py
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from taichi_msm.scenefile.load import schema
from taichi_msm.viewer.events import KEYS, POINTER

README = Path(__file__).parent.parent / "README.md"
MARKS = "<!-- {}: made by docs/make_key_table.py -->\n", "<!-- end of {} -->\n"


def rows(section: dict[str, Any], definitions: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Give a line for every key of a section and of the sections below it."""
    for name, key in section["properties"].items():
        below = list(_references(key))
        default = f"`{json.dumps(key['default'])}`" if key.get("default") is not None else ""
        if name in section.get("required", ()):
            default = "**required**"
        elif below and name != "camera" and {"type": "null"} not in key.get("anyOf", ()):
            default = "none" if "items" in key else "those below"
        yield f"| `{prefix}{name}` | {key['description']} | {key['expects']} | {default} |"
        for reference in below:
            yield from rows(definitions[reference], definitions, f"{prefix}{name}.{'N.' if 'items' in key else ''}")


def _references(key: dict[str, Any]) -> Iterator[str]:
    for place in (key, key.get("items", {}), *key.get("anyOf", ())):
        if "$ref" in place:
            yield place["$ref"].rsplit("/", 1)[-1]


def tables() -> dict[str, str]:
    """Give both tables by the names of their places."""
    whole = schema()
    keys = "| key | meaning | value | default |\n|---|---|---|---|\n" + "\n".join(rows(whole, whole["$defs"])) + "\n"
    hands = "".join(f"| {name} | {does} |\n" for name, does in POINTER.items())
    hands += "".join(f"| `{name}` | {does} |\n" for name, does in KEYS.items())
    return {"keys": keys, "hands": "| | |\n|---|---|\n" + hands}


def main() -> None:
    """Replace what is between the marks."""
    text = README.read_text(encoding="utf-8")
    for name, table in tables().items():
        start, end = (mark.format(name) for mark in MARKS)
        before, rest = text.split(start)
        _, after = rest.split(end)
        text = before + start + table + end + after
    README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
