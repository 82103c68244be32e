"""The mutants of `python -m tests.mutants` fit the source."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.mutants import Mutant, mutants

ALL = mutants()


@pytest.mark.parametrize("mutant", ALL, ids=lambda mutant: mutant.name)
def test_a_mutant_is_another_program(mutant: Mutant, root: Path) -> None:
    # It is made of text that must be in its function once.
    right = (root / mutant.definition().file).read_text(encoding="utf-8")
    assert ast.dump(ast.parse(mutant.source())) != ast.dump(ast.parse(right))
    assert mutant.tests
    assert all((root / "tests" / file).exists() for file in mutant.tests)


@pytest.mark.parametrize(
    ("function", "find", "message"),
    [
        ("no_such_function", "2 *  w)\n+ g", "there is no.*moved to .*stable_step, name that"),
        ("stable_step", "(0.5 - down) * height", "does not contain.*moved to .*control_points"),
        ("__init__", "self", "must say which of "),
        ("stable_step", "g", "more than once; make `find` longer"),
        ("stable_step", "no such code", r"find the code that can have this mistake now \(wrong\)"),
    ],
)
def test_a_mutant_that_fits_no_longer_says_what_to_do(function: str, find: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Mutant("name", "wrong", function, find, "", []).definition()


def test_there_are_enough_mutants_of_different_names() -> None:
    assert len({mutant.name for mutant in ALL}) == len(ALL) >= 20
