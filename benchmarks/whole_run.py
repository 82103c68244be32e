"""Time of a whole run, with an empty and with a warm cache of compiled kernels, and of a check."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time

from benchmarks.process import ROOT
from benchmarks.race import Progress
from taichi_msm.system.compiler import COMPILER_VARIABLE, COMPILERS, active_compiler

SCENE = "scenes/press.yaml"

Samples = dict[str, dict[str, list[float]]]


def command(*arguments: str, cache: str, compiler: str | None = None) -> tuple[float, str]:
    """Run the program; return its time from start to end [s], and its output.

    Args:
        arguments: of the command line.
        cache: folder of compiled kernels.
        compiler: name of the compiler, by default that of this process.
    """
    used = COMPILERS[compiler] if compiler else active_compiler()
    # With cached bytecode, as for a user.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "taichi_msm", *arguments],
        cwd=ROOT,
        env={**environment, COMPILER_VARIABLE: used.name, used.folder_variable: cache},
        check=True,
        capture_output=True,
        text=True,
    )
    return time.perf_counter() - start, done.stdout


def measure(rounds: int, progress: Progress) -> Samples:
    """Return times of every stage of a cold run, a warm run and a check, measured in turn [s]."""
    samples: Samples = {"cold": {}, "warm": {}, "check": {}}
    with tempfile.TemporaryDirectory() as directory:
        # Not timed: compiles the bytecode, as pip does at installation.
        command("run", SCENE, "--json", "--out", f"{directory}/out", cache=f"{directory}/cache")
        for number in range(rounds):
            progress(f"round {number + 1} of {rounds}")
            cache = f"{directory}/cache{number}"
            for kind in ("cold", "warm"):
                seconds, text = command("run", SCENE, "--json", "--out", f"{directory}/out", cache=cache)
                _add(samples[kind], {"process": seconds, **json.loads(text)["timings"]})
            _add(samples["check"], {"process": command("check", SCENE, cache=cache)[0]})
    return samples


def _add(samples: dict[str, list[float]], stages: dict[str, float]) -> None:
    for stage, seconds in stages.items():
        samples.setdefault(stage, []).append(seconds)
