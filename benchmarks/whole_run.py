"""Time a whole run, with an empty cache of compiled kernels and with a warm one, and a check.

python benchmarks/whole_run.py [SCENE]
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROUNDS = 5
SCENE = Path(__file__).parent.parent / "scenes" / "press.yaml"


def command(*arguments: str, cache: str) -> tuple[float, str]:
    """Run the program; gives its time from start to end [s], and what it printed."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "taichi_msm", *arguments],
        env={**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": cache},
        check=True,
        capture_output=True,
        text=True,
    )
    return time.perf_counter() - start, done.stdout


def main(scene: str) -> None:
    """Print a table of medians."""
    samples: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    checks = []
    with tempfile.TemporaryDirectory() as directory:
        for n in range(ROUNDS):
            cache = f"{directory}/cache{n}"
            for kind in ("cold", "warm"):
                seconds, text = command("run", scene, "--json", "--out", f"{directory}/out", cache=cache)
                samples[kind].append({"process": seconds, **json.loads(text)["timings"]})
            checks.append(command("check", scene, cache=cache)[0])
    stages = list(samples["cold"][0])
    print("| [s] | " + " | ".join(stages) + " |")
    print("|---|" + "---:|" * len(stages))
    for kind, runs in samples.items():
        print(f"| {kind} | " + " | ".join(f"{statistics.median(run[s] for run in runs):.2f}" for s in stages) + " |")
    print(f"\ncheck: {statistics.median(checks):.2f} s")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else str(SCENE))
