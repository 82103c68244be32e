"""Mistakes that the tests must notice: `python -m tests.mutants` makes one at a time and runs the tests."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import yaml

from tests.mutants.definitions import Definition, definitions, named, replaced

ROOT = Path(__file__).parent.parent.parent


class Mutant(NamedTuple):
    """One mistake."""

    name: str
    wrong: str  # what is wrong with it
    # A function, method, class or constant of the package or of the twin in tests/reference, of nested functions the
    # innermost; qualified where others of that name have the same text (`step`, `Solver.step`, `solver.Solver.step`).
    function: str
    find: str  # right text, which is there once; line breaks and indentation do not count
    replace: str  # wrong text
    tests: list[str]  # files in tests/ that notice it, the quickest or likeliest first

    def definition(self) -> Definition:
        """Find where the mistake is made; a ValueError names the places that have the text."""
        known = definitions(ROOT, "taichi_msm") + definitions(ROOT, "tests/reference")
        places = [place for place in named(self.function, known) if place.spans(self.find)]
        if len(places) == 1 and len(places[0].spans(self.find)) == 1:
            return places[0]
        found = places or [place for place in known if place.spans(self.find)]
        innermost = [p.name for p in found if not any(q.name.startswith(f"{p.name}.") for q in found)]
        raise ValueError(
            f"{self.name} ({self.wrong}): `function` must be one that has {self.find!r} once, and {self.function} is "
            f"not; {', '.join(innermost) or 'no function'} contains it"
        )

    def source(self) -> str:
        """Give the text of its file with the mistake in it."""
        place = self.definition()
        (span,) = place.spans(self.find)
        return replaced((ROOT / place.file).read_text(encoding="utf-8"), span, self.replace)


def mutants() -> list[Mutant]:
    """Read the list of mistakes."""
    text = Path(__file__).with_name("mutants.yaml").read_text(encoding="utf-8")
    return [Mutant(**fields) for fields in yaml.safe_load(text)]
