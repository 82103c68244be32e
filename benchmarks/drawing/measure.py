"""What is measured of a peer: whether its picture is right, and the time of a picture."""

from __future__ import annotations

import importlib
import math
import time
from typing import Any

import numpy as np

from benchmarks.clock import seconds
from benchmarks.drawing import LIT
from benchmarks.drawing.problem import Artist, Problem
from benchmarks.process import CACHE
from taichi_msm.study.measurements import psnr
from tests import reference

# PSNR of a right picture [dB]: of this program against its float64 twin, which is too slow for more than the mass
# points themselves; of others against this program. Who draws the same triangles differs by rounding and by who owns a
# pixel on an edge; who warps the picture, by the curvature within a cell too.
WANTED = {True: 45.0, False: 40.0}


def prepare(peer: str, problem: Problem, threads: int | None) -> Artist:
    """Set up a peer."""
    return importlib.import_module(peer).prepare(problem, threads)


def check(peer: str, pixels: int, refine: int, lit: bool, threads: int | None = None) -> dict[str, Any]:
    """Compare a peer's picture with this program's, which is checked before all others, and time its start."""
    importlib.import_module(peer)
    problem = Problem(pixels, refine, lit)
    _ = problem.texture
    start = time.perf_counter()
    artist = prepare(peer, problem, threads)
    picture = artist.draw(problem.position)
    compile_seconds = time.perf_counter() - start
    kept = CACHE / f"picture-{pixels}-{refine}-{lit}.npy"
    if peer == LIT["taichi_msm"]:
        np.save(kept, picture)
        coarse = Problem(pixels, 0, lit)
        picture = prepare(peer, coarse, threads).draw(coarse.position)
        truth = reference.draw(coarse.scene, coarse.position.astype(float), coarse.texture)
    else:
        truth = np.load(kept)
    answer, wanted = psnr(picture, truth), WANTED[lit]
    near = math.inf if answer is None else answer
    return {
        "answer": answer,
        "right": near >= wanted,
        "wanted": f"{near:.1f} dB, of at least {wanted:g}",
        "compile": compile_seconds,
    }


def clock(peer: str, pixels: int, refine: int, lit: bool, threads: int | None = None) -> float:
    """Time a picture [s]."""
    problem = Problem(pixels, refine, lit)
    artist, position = prepare(peer, problem, threads), problem.position
    artist.draw(position)

    def draw(count: int) -> None:
        for _ in range(count):
            artist.draw(position)

    return seconds(draw)
