"""Insert one mistake at a time in a copy of the project, and check that a test fails.

python -m tests.mutants              all of them
python -m tests.mutants richardson   some of them, by name
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.mutants import ROOT, Mutant, mutants

# Parts of the project that the tests need.
COPIED = ("pyproject.toml", "scenes", "taichi_msm", "tests")

# Longer than the tests of all mutants together [s].
MAX_TESTS_S = 1800.0

PYTEST = [sys.executable, "-m", "pytest", "-x", "-q", "--color=no", "-n", "0", "-p", "no:cacheprovider"]
PASSED, FAILED = 0, 1


class NoVerdictError(Exception):
    """The tests neither passed nor failed."""


def first_failure(files: Iterable[str], mutant: Mutant | None = None) -> str | None:
    """Return the first test that fails in a copy of the project, with a mistake if given; None if all pass."""
    with TemporaryDirectory() as directory:
        # Resolved like pytest's root: a temporary directory may be behind a link.
        copy = Path(directory).resolve()
        for name in COPIED:
            original = ROOT / name
            if original.is_dir():
                shutil.copytree(original, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(original, copy)
        if mutant:
            (copy / mutant.definition().file).write_text(mutant.source(), encoding="utf-8")
        try:
            done = subprocess.run(
                [*PYTEST, *(f"tests/{file}" for file in files)],
                cwd=copy,
                # Also for child processes in other directories.
                env={**os.environ, "PYTHONPATH": str(copy)},
                capture_output=True,
                text=True,
                timeout=MAX_TESTS_S,
            )
        except subprocess.TimeoutExpired:
            raise NoVerdictError(f"no end within {MAX_TESTS_S:g} s") from None
    failure = re.search(r"^(?:FAILED|ERROR) (\S+?::\w+)", done.stdout, flags=re.MULTILINE)
    if done.returncode == FAILED and failure:
        return failure[1]
    if done.returncode == PASSED:
        return None
    raise NoVerdictError(f"pytest ended with {done.returncode}\n{done.stdout}{done.stderr}")


def hunt(chosen: list[Mutant]) -> dict[str, str]:
    """Return the test that kills each mutant, by the mutant's name, without the survivors."""

    def report(text: str) -> None:
        print(f"{time.monotonic() - start:5.0f} s  {text}", file=sys.stderr, flush=True)

    start = time.monotonic()
    if broken := first_failure(dict.fromkeys(file for mutant in chosen for file in mutant.tests)):
        raise NoVerdictError(f"{broken} fails without any mutant")
    report("without a mutant all of these tests pass")
    killers = {}
    for mutant in chosen:
        if killer := first_failure(mutant.tests, mutant):
            killers[mutant.name] = killer
        report(f"{mutant.name}: {f'killed by {killer}' if killer else 'SURVIVED'}")
    report(f"{len(killers)} of {len(chosen)} killed")
    return killers


def main(arguments: list[str]) -> int:
    """Run the mutants that the command line names."""
    known = {mutant.name: mutant for mutant in mutants()}
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description="Check that tests notice mistakes.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="all, or some of: " + ", ".join(known))
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in known]:
        parser.error("no such mutant: " + ", ".join(unknown))
    chosen = [known[name] for name in options.names or known]
    try:
        killers = hunt(chosen)
    except NoVerdictError as error:
        print(error, file=sys.stderr)
        return 1
    return int(len(killers) < len(chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
