"""The files of a study: everything as JSON, tables in Markdown, a picture."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from taichi_msm.errors import writing
from taichi_msm.results.whole import staged
from taichi_msm.study.page import page
from taichi_msm.study.result import Measured, Reference, Stepping, Study

PICTURE, PAGE, RECORD = "study.png", "study.md", "study.json"

WITHOUT_MATPLOTLIB = "study.png needs matplotlib: pip install matplotlib"


def require_writable(directory: Path) -> None:
    """Check before a long measurement that its report can be written; raises FilesError."""
    with writing(directory), staged(directory):
        pass


def write_report(study: Study, directory: Path) -> list[str]:
    """Write the report of a study, replacing an earlier one; other files in the directory stay.

    Every file is written as a whole or not at all, study.json last. A note is added to the study if its picture cannot
    be drawn.

    Returns:
        The names of the files, study.json last.

    Raises:
        FilesError: when the directory cannot be written.
    """
    with writing(directory), staged(directory) as hidden:
        outputs = [*([PICTURE] if _draw(study, hidden / PICTURE) else []), PAGE, RECORD]
        record = json.dumps({**as_record(study), "outputs": outputs}, indent=2, ensure_ascii=False, allow_nan=False)
        for file, text in ((PAGE, page(study)), (RECORD, record + "\n")):
            # A file name that is not UTF-8 has surrogates; written with backslashes they are valid in JSON too.
            (hidden / file).write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
        if PICTURE not in outputs:
            (directory / PICTURE).unlink(missing_ok=True)
        for output in outputs:
            (hidden / output).replace(directory / output)
    return outputs


def as_record(study: Study) -> dict[str, Any]:
    """Give the whole study as data for JSON; numbers that are not finite become null."""
    return {**_as_data(vars(study)), "recommendation": study.recommendation()}


def _as_data(value: Any) -> Any:
    if isinstance(value, Measured):
        method = {"method": value.method} if isinstance(value, Stepping) else {}
        return {**method, **{key: _as_data(inner) for key, inner in vars(value).items() if key != "samples"}} | {
            "seconds": asdict(value.seconds)
        }
    if isinstance(value, Reference):
        return _as_data(asdict(value))
    if isinstance(value, dict):
        return {key: _as_data(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_data(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _draw(study: Study, path: Path) -> bool:
    """Draw the picture, if there is something to draw and Matplotlib is installed; returns whether it was drawn."""
    try:
        from taichi_msm.study.plot import panels, plot
    except ImportError:
        if WITHOUT_MATPLOTLIB not in study.notes:
            study.notes.append(WITHOUT_MATPLOTLIB)
        return False
    if not any(panels(study)):
        return False
    try:
        plot(study, path)
    except Exception as error:
        # Minutes of measurement must not be lost because their picture fails.
        study.notes.append(f"study.png could not be drawn: {type(error).__name__}: {error}")
        return False
    return True
