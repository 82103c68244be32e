"""The mutants of `python -m tests.mutants` fit the source."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.golden import Messages
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
    ("function", "find"),
    [("no_such_function", "2 *  frequency)\n+ g"), ("__init__", "self"), ("stability_limit", "g")],
    ids=["moved", "many functions", "twice"],
)
def test_a_mutant_that_fits_no_longer_names_the_places(function: str, find: str, message: Messages) -> None:
    with message.raises(ValueError, "name", hide=r"(?<=not; ).*__init__.*(?= contains)"):
        Mutant("name", "wrong", function, find, "", []).definition()


def test_there_are_enough_mutants_of_different_names() -> None:
    assert len({mutant.name for mutant in ALL}) == len(ALL) >= 20
