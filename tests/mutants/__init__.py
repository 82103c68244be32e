"""Mistakes that the tests must notice: `python -m tests.mutants` makes one at a time and runs the tests."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parent.parent.parent
DOCUMENT = ROOT / "docs" / "trust.md"
START = "<!-- mutants: made by python -m tests.mutants --write -->\n"
END = "<!-- end of mutants -->\n"


class Mutant(NamedTuple):
    """One mistake.

    Attributes:
        name: what to call it.
        wrong: what is wrong with it.
        file: where it is made, in taichi_msm/.
        find: the text there that is right, which stands there once.
        replace: what takes its place.
        tests: files of tests that are to notice it, in tests/; those first that are likely to, or quick.
    """

    name: str
    wrong: str
    file: str
    find: str
    replace: str
    tests: list[str]

    def path(self, root: Path = ROOT) -> Path:
        """Tell where the file is in a copy of the project."""
        return root / "taichi_msm" / self.file

    def source(self) -> str:
        """Give the file's text with the mistake in it."""
        right = self.path().read_text(encoding="utf-8")
        if (count := right.count(self.find)) != 1:
            raise ValueError(f"{self.name}: {self.file} has {self.find!r} {count} times; it must be there once")
        return right.replace(self.find, self.replace)


def mutants() -> list[Mutant]:
    """Read the list of mistakes."""
    text = Path(__file__).with_name("mutants.yaml").read_text(encoding="utf-8")
    return [Mutant(**fields) for fields in yaml.safe_load(text)]


def table(killers: Mapping[str, str]) -> str:
    """Lay out which test kills which mutant.

    Args:
        killers: the tests by the names of the mutants.
    """
    rows = [f"| {m.name} | {m.wrong} | `{killers[m.name]}` |\n" for m in mutants() if m.name in killers]
    return "| mutant | what is wrong | killed by |\n|---|---|---|\n" + "".join(rows)


def listed() -> dict[str, str]:
    """Read the table in the document: the tests by the names of the mutants."""
    return dict(re.findall(r"^\| (\S+) \| .* \| `(\S+)` \|$", split_document()[1], flags=re.MULTILINE))


def write(killers: Mapping[str, str]) -> None:
    """Renew the table in the document; mutants that are not given keep their tests."""
    before, _, after = split_document()
    DOCUMENT.write_text(before + START + table({**listed(), **killers}) + END + after, encoding="utf-8")


def split_document() -> tuple[str, str, str]:
    """Take the document apart: what is before the table, the table, what is after it."""
    before, rest = DOCUMENT.read_text(encoding="utf-8").split(START)
    inside, after = rest.split(END)
    return before, inside, after
