"""Mistakes that the tests must notice: `python -m tests.mutants` makes one at a time and runs the tests."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import yaml

from tests.mutants.definitions import Definition, definitions, named, replaced

ROOT = Path(__file__).parent.parent.parent


class Mutant(NamedTuple):
    """One mistake.

    Attributes:
        name: what to call it.
        wrong: what is wrong with it.
        function: where it is made: a function, method, class or constant of the package or of the twin in
            tests/reference, of nested functions the innermost; qualified where others of that name have the same text
            (`step`, `Solver.step`, `solver.Solver.step`).
        find: the text there that is right, which stands there once; line breaks and indentation do not count.
        replace: what takes its place.
        tests: files of tests that are to notice it, in tests/; those first that are likely to, or quick.
    """

    name: str
    wrong: str
    function: str
    find: str
    replace: str
    tests: list[str]

    def definition(self) -> Definition:
        """Find where the mistake is made.

        Raises:
            ValueError: when no definition or more than one has the name, or the text is not in it once; it says what
                to write in mutants.yaml instead.
        """
        known = definitions(ROOT, "taichi_msm") + definitions(ROOT, "tests/reference")
        same_name = named(self.function, known)
        places = [place for place in same_name if place.spans(self.find)]
        if len(places) == 1 and len(places[0].spans(self.find)) == 1:
            return places[0]
        if len(places) == 1:
            raise ValueError(f"{self.name}: {self.function} has {self.find!r} more than once; make `find` longer")
        if places:
            raise ValueError(f"{self.name}: `function` must say which of {_names(places)} it is")
        reason = f"{self.function} does not contain {self.find!r}" if same_name else f"there is no {self.function}"
        elsewhere = [place for place in known if place.spans(self.find)]
        if elsewhere:
            innermost = [p for p in elsewhere if not any(q.name.startswith(f"{p.name}.") for q in elsewhere)]
            raise ValueError(f"{self.name}: {reason}; if it moved to {_names(innermost)}, name that in `function`")
        raise ValueError(
            f"{self.name}: {reason}, nor does any other function; find the code that can have this mistake now "
            f"({self.wrong}), write it in `function`, `find` and `replace`, "
            f"and see that python -m tests.mutants {self.name} still kills it"
        )

    def source(self) -> str:
        """Give the text of its file with the mistake in it."""
        place = self.definition()
        (span,) = place.spans(self.find)
        return replaced((ROOT / place.file).read_text(encoding="utf-8"), span, self.replace)


def _names(places: list[Definition]) -> str:
    return ", ".join(place.name.removeprefix("taichi_msm.") for place in places)


def mutants() -> list[Mutant]:
    """Read the list of mistakes."""
    text = Path(__file__).with_name("mutants.yaml").read_text(encoding="utf-8")
    return [Mutant(**fields) for fields in yaml.safe_load(text)]
