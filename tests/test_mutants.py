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
    [
        ("no_such_function", "2 *  frequency)\n+ g"),
        ("stability_limit", "(0.5 - down) * height"),
        ("__init__", "self"),
        ("stability_limit", "g"),
        ("stability_limit", "no such code"),
    ],
    ids=["moved", "elsewhere", "many functions", "twice", "nowhere"],
)
def test_a_mutant_that_fits_no_longer_says_what_to_do(function: str, find: str, message: Messages) -> None:
    with message.raises(ValueError, "name", hide=r"(?<=which of ).*(?= it is)"):
        Mutant("name", "wrong", function, find, "", []).definition()


def test_there_are_enough_mutants_of_different_names() -> None:
    assert len({mutant.name for mutant in ALL}) == len(ALL) >= 20
