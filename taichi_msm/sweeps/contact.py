"""A picture of all: the last frames of some runs in a grid, with the values that made them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, wait
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from taichi_msm.errors import FilesError, printable
from taichi_msm.plot_style import GREY, INK, PALE
from taichi_msm.progress import Progress
from taichi_msm.results.finished_run import read_run, reading
from taichi_msm.results.whole import replacing
from taichi_msm.sweeps.captions import short_names, short_value
from taichi_msm.sweeps.result import CONTACT, SweepResult
from taichi_msm.sweeps.schedule import PATIENCE

WITHOUT_PICTURES = f"{CONTACT} needs pictures of the runs; take set: {{output: [png]}}, or trajectory, and an image"

MOST_RUNS, MOST_COLUMNS = 36, 8

# All in pixels. A tile is as wide as its frame, but not narrower than this, and all together not wider than the grid.
NARROWEST, GRID = 330, 2200
GAP, FONT_SIZE, LINE = 20, 17, 23

# Of a tile: its height by its width, and the lines of its caption.
TALLEST, MOST_LINES = 2, 8

# Letters of a part of a caption; more fit into no line.
LONGEST = 300


class Tile(NamedTuple):
    """A run in the picture."""

    frame: Image.Image | None  # its last
    status: str  # is written in place of a frame
    caption: list[str]  # parts between which lines may break


def write_contact(result: SweepResult, executor: Executor, progress: Progress) -> tuple[list[str], list[str]]:
    """Write the picture, if any run has one; returns its name, and what the user should know.

    The executor draws the runs that have a trajectory, but no pictures.
    """
    runs = result.some(MOST_RUNS)
    complete = [run for run in runs if result.outcomes[run].status == "complete"]
    frames, errors = _last_frames({run: result.run_directory(run) for run in complete}, executor, progress)
    if not frames:
        reason = WITHOUT_PICTURES if complete else f"{CONTACT} needs a complete run"
        return [], [f"no {CONTACT}: {errors[0]}" if errors else reason]
    names = short_names(result.sweep.keys)
    tiles = []
    for run in runs:
        values = [f"{name} = {short_value(value)}" for name, value in zip(names, result.values[run], strict=True)]
        outcome = result.outcomes[run]
        largest = outcome.max_displacement
        moved = [] if largest is None else [f"max_displacement = {short_value(largest)}"]
        tiles.append(Tile(frames.get(run), outcome.status, [f"run {run}", *moved, *map(printable, values)]))
    total = len(result.outcomes)
    which = f"{total} runs" if len(runs) == total else f"{len(runs)} of {total} runs, evenly spread"
    head = printable(f"{result.sweep.scene.name}: the last frames of {which}")
    picture = _grid(tiles, _columns(result, len(runs)), head)
    with replacing(result.directory / CONTACT) as file:
        picture.save(file, "JPEG", quality=90)
    lacks = f"{CONTACT} lacks the frames of {len(errors)} runs, for example: {errors[0]}" if errors else ""
    return [CONTACT], [lacks] if lacks else []


def draw_last(directory: Path) -> NDArray[np.uint8]:
    """Draw the last frame of a run, on one thread of a process that has taken runs."""
    from taichi_msm.playback import Playback

    with Playback(directory, threads=1) as run:
        return run.draw(len(run.time) - 1)


def _last_frames(
    directories: dict[int, Path], executor: Executor, progress: Progress
) -> tuple[dict[int, Image.Image], list[str]]:
    """Get the last frames of runs that are complete, and why some that should be there are not."""
    frames: dict[int, Image.Image] = {}
    drawn: dict[int, Future[NDArray[np.uint8]]] = {}
    errors = []
    for run, directory in directories.items():
        try:
            finished = read_run(directory)
            if finished.has("png"):
                frames[run] = Image.fromarray(finished.picture("png", finished.frames - 1))
            elif finished.has("gif"):
                frames[run] = last_picture(finished.result("gif"))
            elif finished.has("trajectory") and finished.scene.image is not None:
                drawn[run] = executor.submit(draw_last, directory.absolute())
        except FilesError as error:
            errors.append(str(error))
    rest = set(drawn.values())
    while rest:
        progress("contact", len(drawn) - len(rest), len(drawn))
        rest = wait(rest, PATIENCE).not_done
    for run, future in drawn.items():
        try:
            frames[run] = Image.fromarray(future.result())
        except Exception as error:
            errors.append(f"{directories[run]}: {error}")
    return frames, errors


def last_picture(path: Path) -> Image.Image:
    """Read the last picture of an animation."""
    with reading(path), Image.open(path, formats=["GIF"]) as film:
        film.seek(film.n_frames - 1)
        return film.convert("RGB")


def _columns(result: SweepResult, tiles: int) -> int:
    """Choose the number of columns: of a grid of values all of its last key's, else about as many as rows."""
    last = list(result.sweep.settings.vary.values())[-1]
    if tiles == len(result.outcomes) and last.kind == "grid" and 1 < len(last.values) <= MOST_COLUMNS:
        return len(last.values)
    few = math.ceil(math.sqrt(tiles))
    return min(few, few + 1, key=lambda columns: -tiles % columns)


def _grid(tiles: Sequence[Tile], columns: int, head: str) -> Image.Image:
    """Draw all tiles, each with its caption below, and a heading."""
    frames = [tile.frame for tile in tiles if tile.frame]
    width = min(max(NARROWEST, *(frame.width for frame in frames)), (GRID - GAP) // columns - GAP)
    height = round(width * min(TALLEST, median(frame.height / frame.width for frame in frames)))
    font = ImageFont.load_default(FONT_SIZE)
    captions = [_lines(tile.caption, lambda text: font.getlength(text) <= width) for tile in tiles]
    below = LINE * max(map(len, captions)) + GAP
    rows = math.ceil(len(tiles) / columns)
    size = GAP + columns * (width + GAP), 2 * GAP + LINE + rows * (height + below)
    picture = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(picture)
    draw.text((GAP, GAP // 2), head, INK, font)
    for number, (tile, caption) in enumerate(zip(tiles, captions, strict=True)):
        x, y = GAP + number % columns * (width + GAP), GAP + LINE + number // columns * (height + below)
        if tile.frame:
            frame = ImageOps.contain(tile.frame, (width, height), Image.Resampling.LANCZOS)
            picture.paste(frame, (x + (width - frame.width) // 2, y + height - frame.height))
        else:
            draw.rectangle((x, y, x + width - 1, y + height - 1), PALE)
            draw.text((x + width // 2, y + height // 2), tile.status, GREY, font, anchor="mm")
        for line, text in enumerate(caption):
            draw.text((x, y + height + 4 + LINE * line), text, INK, font)
    return picture


def _lines(parts: Iterable[str], fits: Callable[[str], bool]) -> list[str]:
    """Fill lines with parts; a part that does not fit into a line is cut, and so are lines that are too many."""
    lines = [""]
    for part in parts:
        longer = f"{lines[-1]}   {part}".lstrip()
        if fits(longer):
            lines[-1] = longer
            continue
        cut = part[:LONGEST]
        while not fits(cut):
            cut = f"{cut[:-2]}…"
        lines.append(cut)
    return lines if len(lines) <= MOST_LINES else [*lines[: MOST_LINES - 1], "…"]
