"""The mutants of `python -m tests.mutants` fit the source as it is, and the document lists them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.mutants import Mutant, listed, mutants, split_document, table

ALL = mutants()


@pytest.mark.parametrize("mutant", ALL, ids=lambda mutant: mutant.name)
def test_a_mutant_is_another_program(mutant: Mutant, root: Path) -> None:
    # It is made of text that must be in the file once.
    assert mutant.source() != mutant.path().read_text(encoding="utf-8")
    compile(mutant.source(), mutant.file, "exec")
    assert mutant.tests
    assert all((root / "tests" / file).exists() for file in mutant.tests)


def test_there_are_enough_mutants_of_different_names() -> None:
    assert len({mutant.name for mutant in ALL}) == len(ALL) >= 20


def test_the_document_lists_the_mutants() -> None:
    killers = listed()
    assert killers.keys() == {mutant.name for mutant in ALL}, "run python -m tests.mutants --write"
    assert split_document()[1] == table(killers), "run python -m tests.mutants --write"
