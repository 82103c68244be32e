"""The mutants of `python -m tests.mutants` apply to the source."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.golden import Messages
from tests.mutants import Mutant, mutants

ALL = mutants()


def test_every_mutant_changes_the_program(root: Path) -> None:
    assert len({mutant.name for mutant in ALL}) == len(ALL) >= 20
    for mutant in ALL:
        source = (root / mutant.definition().file).read_text(encoding="utf-8")
        assert ast.dump(ast.parse(mutant.source())) != ast.dump(ast.parse(source)), mutant.name
        assert mutant.tests, mutant.name
        assert all((root / "tests" / file).exists() for file in mutant.tests), mutant.name


@pytest.mark.parametrize(
    ("function", "find"),
    [("no_such_function", "2 *  frequency)\n+ g"), ("__init__", "self"), ("stability_limit", "g")],
    ids=["moved", "many functions", "twice"],
)
def test_outdated_mutants(function: str, find: str, message: Messages) -> None:
    with message.raises(ValueError, "name", hide=r"(?<=not; ).*__init__.*(?= contains)"):
        Mutant("name", "wrong", function, find, "", []).definition()
