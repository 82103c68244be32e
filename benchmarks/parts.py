"""The parts of the benchmarks, and their effort."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks import bounds, compilers, gradients, looks, terms, whole_run
from benchmarks.drawing import FLAT, LIT
from benchmarks.race import Progress, race
from benchmarks.stepping import FASTEST, PEERS
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import vector_bits

STEPPING, DRAWING = "benchmarks.stepping.measure", "benchmarks.drawing.measure"

# Width of the vectors of AVX2 [bits].
NARROW = 256

# The picture, and the sheets for every number of threads.
PIXELS, REFINE = 512, 10
THREADS_POINTS = (331, 1024)


@dataclass(frozen=True)
class Effort:
    """Effort of a measurement: sizes and rounds."""

    rounds: int
    points: tuple[int, ...]  # sizes of the sheet for all steppers
    sizes: tuple[int, ...]  # sizes of the sheet for the fastest steppers
    pixels: tuple[int, ...]  # sizes of the picture for all drawing peers
    refines: tuple[int, ...]  # refinements for this program
    resolutions: tuple[int, ...]  # sizes of the picture for this program


FULL = Effort(
    rounds=3,
    points=(31, 101, 331, 1024),
    sizes=(11, 31, 101, 331, 1024, 2048, 4096),
    pixels=(512, 1024),
    refines=(0, 1, 2, 4, 10, 20, 40, 64),
    resolutions=(128, 256, 512, 1024, 2048, 4096),
)
QUICK = Effort(
    rounds=2, points=(31, 331), sizes=(11, 101, 1024), pixels=(512,), refines=(0, 10, 40), resolutions=(256, 1024)
)

Entries = list[dict[str, Any]]


def _race(*arguments: Any, **work: Any) -> Entries:
    return [asdict(entry) for entry in race(*arguments, **work)]


def stepping(effort: Effort, progress: Progress) -> dict[str, Entries]:
    """Time steps of all peers."""
    return _step(PEERS, effort.points, effort, progress)


def drawing(effort: Effort, progress: Progress) -> dict[str, dict[str, Entries]]:
    """Time pictures of all peers, lit and flat."""
    return {
        "lit": _draw_peers(LIT, True, effort, prefixed(progress, "lit")),
        "flat": _draw_peers(FLAT, False, effort, prefixed(progress, "flat")),
    }


def narrow(effort: Effort, progress: Progress) -> dict[str, Entries]:
    """Time steps of sheets of every size with vectors of 256 bits, if the processor has wider ones."""
    if vector_bits() <= NARROW:
        return {}
    return _step(FASTEST, effort.sizes, effort, progress, bits=NARROW)


def size(effort: Effort, progress: Progress) -> dict[str, Entries]:
    """Time steps of sheets of every size."""
    return _step(FASTEST, effort.sizes, effort, progress)


def refine(effort: Effort, progress: Progress) -> dict[str, Entries]:
    """Time pictures with every refinement."""
    return {
        str(n): _draw(effort, prefixed(progress, f"refine {n}"), pixels=PIXELS, refine=n, lit=True)
        for n in effort.refines
    }


def resolution(effort: Effort, progress: Progress) -> dict[str, Entries]:
    """Time pictures of every size."""
    return {
        str(pixels): _draw(effort, prefixed(progress, f"{pixels} px"), pixels=pixels, refine=REFINE, lit=True)
        for pixels in effort.resolutions
    }


def threads(effort: Effort, progress: Progress) -> dict[str, dict[str, Entries]]:
    """Time steps and pictures with every number of threads."""
    results: dict[str, dict[str, Entries]] = {}
    for count in thread_counts():
        report = prefixed(progress, f"{count} threads")
        for points in THREADS_POINTS:
            results.setdefault(f"{points} × {points} points", {})[str(count)] = _race(
                STEPPING, FASTEST, effort.rounds, report, threads=count, points=points
            )
        results.setdefault(f"{PIXELS} × {PIXELS} pixels", {})[str(count)] = _draw(
            effort, report, threads=count, pixels=PIXELS, refine=REFINE, lit=True
        )
    return results


def thread_counts() -> list[int]:
    """Return 1, 2, 4, ... and the number of available threads."""
    most = available_threads()
    return sorted({most, *(1 << k for k in range(most.bit_length()) if 1 << k < most)})


def _step(
    peers: Mapping[str, str], points: Sequence[int], effort: Effort, progress: Progress, **work: Any
) -> dict[str, Entries]:
    """Time steps of several sizes."""
    return {
        str(n): _race(STEPPING, peers, effort.rounds, prefixed(progress, f"{n} x {n}"), points=n, **work)
        for n in points
    }


def _draw_peers(peers: Mapping[str, str], lit: bool, effort: Effort, progress: Progress) -> dict[str, Entries]:
    """Time pictures of several sizes."""
    return {
        str(n): _race(DRAWING, peers, effort.rounds, prefixed(progress, f"{n} px"), pixels=n, refine=REFINE, lit=lit)
        for n in effort.pixels
    }


def _draw(effort: Effort, progress: Progress, **work: Any) -> Entries:
    """Time this program's drawing."""
    return _race(DRAWING, {"taichi_msm": LIT["taichi_msm"]}, effort.rounds, progress, **work)


def prefixed(progress: Progress, prefix: str) -> Progress:
    """Return a progress that begins with a prefix."""
    return lambda text: progress(f"{prefix}: {text}")


PARTS: dict[str, Callable[[Effort, Progress], Any]] = {
    "stepping": stepping,
    "drawing": drawing,
    "terms": lambda effort, progress: terms.measure(effort.rounds, progress),
    "gradient": lambda effort, progress: gradients.measure(effort.rounds, progress),
    "looks": lambda effort, progress: looks.measure(effort.rounds, progress),
    # A run takes seconds, and varies by a tenth.
    "whole_run": lambda effort, progress: whole_run.measure(3 * effort.rounds, progress),
    "compilers": lambda effort, progress: compilers.measure(2 * effort.rounds - 1, progress),
    "size": size,
    "refine": refine,
    "resolution": resolution,
    "threads": threads,
    "narrow": narrow,
    "bounds": lambda effort, progress: bounds.measure(effort.sizes, effort.rounds, progress),
}
