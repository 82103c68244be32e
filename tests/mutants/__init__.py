"""Mutation tests: `python -m tests.mutants` makes one mistake at a time and runs the tests that must notice it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import yaml

from tests.mutants.definitions import Definition, definitions, named, replaced

ROOT = Path(__file__).parent.parent.parent


class Mutant(NamedTuple):
    """One mistake."""

    name: str
    wrong: str  # description
    # A function, method, class or constant of the package or of tests/reference, of nested functions the innermost;
    # qualified if others of that name have the same text (`step`, `Solver.step`, `solver.Solver.step`).
    function: str
    find: str  # correct text, which occurs once; line breaks and indentation do not count
    replace: str  # wrong text
    tests: list[str]  # files in tests/ that notice it, the fastest or likeliest first

    def definition(self) -> Definition:
        """Return the definition to change; a ValueError names the definitions that contain the text."""
        known = definitions(ROOT, "taichi_msm") + definitions(ROOT, "tests/reference")
        matches = [definition for definition in named(self.function, known) if definition.spans(self.find)]
        if len(matches) == 1 and len(matches[0].spans(self.find)) == 1:
            return matches[0]
        matches = matches or [definition for definition in known if definition.spans(self.find)]
        innermost = [p.name for p in matches if not any(q.name.startswith(f"{p.name}.") for q in matches)]
        raise ValueError(
            f"{self.name} ({self.wrong}): `function` must be one that has {self.find!r} once, and {self.function} is "
            f"not; {', '.join(innermost) or 'no function'} contains it"
        )

    def source(self) -> str:
        """Return the text of its file with the mistake."""
        definition = self.definition()
        (span,) = definition.spans(self.find)
        return replaced((ROOT / definition.file).read_text(encoding="utf-8"), span, self.replace)


def mutants() -> list[Mutant]:
    """Read the list of mistakes."""
    text = Path(__file__).with_name("mutants.yaml").read_text(encoding="utf-8")
    return [Mutant(**fields) for fields in yaml.safe_load(text)]
