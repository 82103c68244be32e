"""Measurements of a drawing peer: correctness, and time of a picture."""

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

# Least PSNR [dB]: of this program against the NumPy reference, without refinement for speed; of others against this
# program. Peers with the same triangles differ by rounding and in pixels on edges; peers that warp the picture, also by
# the curvature within a cell.
WANTED = {True: 45.0, False: 40.0}


def prepare(peer: str, problem: Problem, threads: int | None) -> Artist:
    """Set up a peer."""
    return importlib.import_module(peer).prepare(problem, threads)


def check(peer: str, pixels: int, refine: int, lit: bool, threads: int | None = None) -> dict[str, Any]:
    """Compare a peer's picture with this program's, which is checked first, and time its start."""
    importlib.import_module(peer)
    problem = Problem(pixels, refine, lit)
    _ = problem.texture
    start = time.perf_counter()
    artist = prepare(peer, problem, threads)
    picture = artist.draw(problem.position)
    compile_seconds = time.perf_counter() - start
    cached = CACHE / f"picture-{pixels}-{refine}-{lit}.npy"
    if peer == LIT["taichi_msm"]:
        np.save(cached, picture)
        coarse = Problem(pixels, 0, lit)
        picture = prepare(peer, coarse, threads).draw(coarse.position)
        truth = reference.draw(coarse.scene, coarse.position.astype(float), coarse.texture)
    else:
        truth = np.load(cached)
    answer, wanted = psnr(picture, truth), WANTED[lit]
    decibel = math.inf if answer is None else answer
    return {
        "answer": answer,
        "correct": decibel >= wanted,
        "wanted": f"{decibel:.1f} dB, of at least {wanted:g}",
        "compile": compile_seconds,
    }


def clock(peer: str, pixels: int, refine: int, lit: bool, threads: int | None = None) -> float:
    """Return the time of a picture [s]."""
    problem = Problem(pixels, refine, lit)
    artist, position = prepare(peer, problem, threads), problem.position
    artist.draw(position)

    def draw(count: int) -> None:
        for _ in range(count):
            artist.draw(position)

    return seconds(draw)
