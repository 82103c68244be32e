"""Write the table of largest deviations between labels into labels.md, as measured by tests/test_consistency.py.

PYTHONPATH=. python docs/make_consistency.py
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.marked import replace_marked
from taichi_msm import run
from tests.test_consistency import AGREEMENTS, CAMERAS, largest_deviations, scene

PAGE = Path(__file__).parent / "labels.md"
THREADS = 2


def cell(deviation: float | None) -> str:
    """Format a number with one digit."""
    return "" if deviation is None else f"{deviation:.1g}".replace("e-0", "e-")


def table() -> str:
    """Return the table: a row for each agreement, a column for each camera."""
    worst = {}
    for name, camera in CAMERAS.items():
        with TemporaryDirectory() as folder:
            run(scene(camera), folder, threads=THREADS, estimate_error=False)
            worst[name] = largest_deviations(Path(folder), name, THREADS)
    lines = [f"| at most apart | in | {' | '.join(CAMERAS)} | bound |", f"|---|---|{'---|' * len(CAMERAS)}---|"]
    for key, (description, unit, bound) in AGREEMENTS.items():
        cells = [cell(worst[name].get(key)) for name in CAMERAS]
        lines.append(f"| {description} | {unit} | {' | '.join(cells)} | {cell(bound)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the table."""
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_marked(page, "consistency", "docs/make_consistency.py", table()), encoding="utf-8")


if __name__ == "__main__":
    main()
