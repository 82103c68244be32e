"""Write the table of labels.md that tells how far apart labels are that must agree, as the tests measure it.

PYTHONPATH=. python docs/make_consistency.py
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from taichi_msm import run
from tests.test_consistency import AGREEMENTS, CAMERAS, measured, scene

PAGE = Path(__file__).parent / "labels.md"
START, END = "<!-- consistency: made by docs/make_consistency.py -->\n", "<!-- end of consistency -->\n"
THREADS = 2


def cell(apart: float | None) -> str:
    """Write a number with one digit."""
    return "" if apart is None else f"{apart:.1g}".replace("e-0", "e-")


def table() -> str:
    """Give a row for every two things that must agree, and a column for every camera."""
    worst = {}
    for name, camera in CAMERAS.items():
        with TemporaryDirectory() as folder:
            run(scene(camera), folder, threads=THREADS, estimate_error=False)
            worst[name] = measured(Path(folder), name, THREADS)
    lines = [f"| at most apart | in | {' | '.join(CAMERAS)} | bound |", f"|---|---|{'---|' * len(CAMERAS)}---|"]
    for what, (said, unit, bound) in AGREEMENTS.items():
        cells = [cell(worst[name].get(what)) for name in CAMERAS]
        lines.append(f"| {said} | {unit} | {' | '.join(cells)} | {cell(bound)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Renew the table."""
    before, rest = PAGE.read_text(encoding="utf-8").split(START)
    PAGE.write_text(before + START + table() + END + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
