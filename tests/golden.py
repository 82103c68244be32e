"""The golden file of messages: every message of the program, by the test that provokes it.

`python -m pytest --write-messages` writes the messages of the tests that run into tests/messages.yaml, to be read as a
diff. Tests themselves assert at most a key, a location and a word, so wording changes in that file alone.
"""

from __future__ import annotations

import fcntl
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

import pytest
import yaml

FILE = Path(__file__).parent / "messages.yaml"

AnyError = TypeVar("AnyError", bound=BaseException)

# Messages by file of tests and by test.
Golden = dict[str, dict[str, list[str]]]


class Dumper(yaml.SafeDumper):
    """YAML dumper that writes texts of several lines as blocks."""


def _represent_text(dumper: Dumper, text: str) -> yaml.ScalarNode:
    # A block cannot hold spaces at the end of a line.
    lines = [line.rstrip() for line in text.split("\n")]
    return dumper.represent_scalar("tag:yaml.org,2002:str", "\n".join(lines), style="|" if len(lines) > 1 else None)


Dumper.add_representer(str, _represent_text)


@cache
def read() -> Golden:
    return yaml.load(FILE.read_text(encoding="utf-8"), Loader=yaml.CSafeLoader) or {}


def write(changed: Golden) -> None:
    """Update the messages of the tests that ran in the file, under a lock, as workers of pytest-xdist share it."""
    with FILE.open("r+", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        golden: Golden = yaml.safe_load(file) or {}
        for tests, messages in changed.items():
            golden[tests] = {**golden.get(tests, {}), **messages}
        golden = {tests: dict(sorted(golden[tests].items())) for tests in sorted(golden)}
        file.seek(0)
        yaml.dump(golden, file, Dumper, allow_unicode=True, width=120, sort_keys=False)
        file.truncate()


class Messages:
    """The messages of one test, compared with the golden file in order.

    Args:
        node: id of the test.
        temporary: folder of the session's temporary folders, each of which is TMP in the file.
        written: where the session collects messages to write; None compares them.
    """

    def __init__(self, node: str, temporary: Path, written: Golden | None) -> None:
        self._tests, self._test = node.removeprefix("tests/").split("::", 1)
        self._temporary = re.compile(rf"{re.escape(str(temporary))}/[^/\s:;,'\"]+")
        self._written, self._count = written, 0

    def __call__(self, message: str | Iterable[str], *words: str, hide: str = r"(?!)") -> None:
        """Compare a message, or its lines, with the golden file.

        Args:
            message: text, or lines.
            words: keys, locations or words that it must contain.
            hide: pattern of parts that differ between machines, which become an ellipsis.
        """
        text = message if isinstance(message, str) else "\n".join(message)
        text = re.sub(hide, "…", self._temporary.sub("TMP", text)).rstrip("\n")
        text = "\n".join(line.rstrip() for line in text.split("\n"))
        for word in words:
            assert word in text
        if self._written is not None:
            self._written.setdefault(self._tests, {}).setdefault(self._test, []).append(text)
            return
        known = read().get(self._tests, {}).get(self._test, [])
        self._count += 1
        assert self._count <= len(known), f"not in {FILE.name} (write it with --write-messages): {text}"
        assert text == known[self._count - 1]

    def require_all(self) -> None:
        """Require that the test, unless it was skipped, has provoked all its messages in the golden file."""
        known = read().get(self._tests, {}).get(self._test, [])
        assert self._count in (0, len(known)), f"{self._count} of {len(known)} messages"

    @contextmanager
    def raises(
        self, error: type[AnyError] | tuple[type[AnyError], ...], *words: str, hide: str = r"(?!)"
    ) -> Iterator[pytest.ExceptionInfo[AnyError]]:
        """Expect an error, and compare its message; see `__call__`."""
        with pytest.raises(error) as caught:
            yield caught
        self(str(caught.value), *words, hide=hide)
