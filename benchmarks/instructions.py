"""How wide the vectors of the fastest peers are, by the instructions in the memory of their processes."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile

from benchmarks.process import FailedError, UnavailableError, call
from benchmarks.race import Progress
from benchmarks.stepping.measure import prepare

# Registers of 512, 256 and 128 bits.
REGISTERS = {"512": "zmm", "256": "ymm", "128": "xmm"}

# Arithmetic with packed numbers in f32.
PACKED = re.compile(r"\tv(?:add|sub|mul|div|sqrt|rsqrt14|rsqrt|fn?m(?:add|sub)\d+)ps\s")

POINTS = 331


def count(peer: str) -> dict[str, int]:
    """Count the packed operations of each width in the code that a peer has compiled for its steps."""
    if shutil.which("objdump") is None:
        raise UnavailableError("objdump is not installed")
    before = _code()
    stepper = prepare(peer, POINTS, None)
    stepper.advance(2)
    found: Counter[str] = Counter()
    for code in _code() - before:
        found.update(_operations(code))
    return {width: found[width] for width in REGISTERS}


def _code() -> set[bytes]:
    """Read the code in memory that belongs to no file but our own library."""
    parts = set()
    with Path("/proc/self/mem").open("rb") as memory:
        for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines():
            addresses, rights, _, _, inode, *name = line.split(maxsplit=5)
            if "x" in rights and (inode == "0" or "benchmarks" in "".join(name)) and "[v" not in line:
                first, end = (int(address, 16) for address in addresses.split("-"))
                memory.seek(first)
                parts.add(memory.read(end - first))
    return parts


def _operations(code: bytes) -> Counter[str]:
    with NamedTemporaryFile(suffix=".bin") as file:
        file.write(code)
        file.flush()
        said = subprocess.run(
            ["objdump", "-D", "-b", "binary", "-m", "i386:x86-64", file.name],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    lines = [line for line in said.splitlines() if PACKED.search(line)]
    return Counter(
        next(width for width, register in REGISTERS.items() if register in line)
        for line in lines
        if any(register in line for register in REGISTERS.values())
    )


def measure(
    peers: Mapping[str, str], widths: Sequence[int], progress: Progress
) -> dict[str, dict[str, dict[str, int]]]:
    """Count for all peers, with vectors of every width."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for bits in widths:
        for name, peer in peers.items():
            progress(f"{name}, {bits} bits")
            try:
                found.setdefault(str(bits), {})[name] = call("benchmarks.instructions:count", peer=peer, bits=bits)
            except (UnavailableError, FailedError) as error:
                progress(str(error))
    return found
