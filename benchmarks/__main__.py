"""Measure, print the tables, and write docs/performance.md and its plots.

    python -m benchmarks [--quick] [PART ...]

Without a part all are measured. Results stay in output/benchmarks, so that a part can be measured again alone; `page`
only writes the page again. Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from benchmarks import page, plots
from benchmarks.parts import FULL, PARTS, QUICK, prefixed
from benchmarks.process import CACHE, OUTPUT, ROOT


def progress(text: str) -> None:
    """Report the current measurement."""
    print(text, file=sys.stderr, flush=True)


def save(results: dict[str, Any], path: Path) -> None:
    """Write the results so far."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(results, indent=1), encoding="utf-8")


def publish(results: dict[str, Any], quick: bool) -> None:
    """Write the page and its plots; those of a quick run go to another folder."""
    folder = OUTPUT / "quick" if quick else ROOT / "docs"
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    plots.draw(results, images)
    text = page.page(results)
    (folder / "performance.md").write_text(text, encoding="utf-8")
    print(text)


def main() -> None:
    """Measure and publish."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=str(__doc__).splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(["page", *PARTS]))
    parser.add_argument(
        "--quick", action="store_true", help="fewer sizes and rounds; writes to output/benchmarks/quick"
    )
    options = parser.parse_args()
    unknown = set(options.parts) - {"page", *PARTS}
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: not a part; take some of {', '.join(['page', *PARTS])}")
    effort = QUICK if options.quick else FULL
    saved = OUTPUT / ("quick.json" if options.quick else "results.json")
    results = json.loads(saved.read_text(encoding="utf-8")) if saved.exists() else {}
    # Kernels and answers of an earlier run may be out of date.
    shutil.rmtree(CACHE, ignore_errors=True)
    if options.parts != ["page"] or not results:
        results |= {"machine": page.machine(), "rounds": effort.rounds}
    for part in options.parts or PARTS:
        if part != "page":
            results[part] = PARTS[part](effort, prefixed(progress, part))
            save(results, saved)
    shutil.rmtree(CACHE, ignore_errors=True)
    publish(results, options.quick)


if __name__ == "__main__":
    main()
