"""The results of a sweep against its parameters, as a picture.

A picture of all: the last frames of some runs in a grid, with the values that made them.

Keys and values of a sweep, as short as a person can read them in a picture.

The numbers that varied in a sweep, and those that came out.

First-order sensitivity: the share of a result's variance that one parameter explains alone.

Source: Plischke, "An effective algorithm for computing global sensitivity indices (EASI)", 2010, and Tissot and Prieur,
"Bias correction for the estimation of sensitivity indices based on random balance designs", 2012; both as RBD-FAST of
SALib. It takes the results in the order of a parameter, in which the others must come at random. In Sobol points and
grids they do not: of neighbours in one coordinate, one is low in another coordinate and one is high. So we shuffle
neighbours, and take the mean over some shuffles. (Without that, the index for y of 3 x + y from 64 Sobol points was
wrong by 0.3 in the root mean square; with it, by 0.07.)
"""

from __future__ import annotations

import json
import math
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, wait
from pathlib import Path
from statistics import median
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from taichi_msm.errors import FilesError, Progress, printable
from taichi_msm.plot_style import BLUE, DPI, GREY, INK, NARROW, ORANGE, PALE, STYLE, VERMILION
from taichi_msm.runs.directory import replacing
from taichi_msm.runs.finished import read_run, reading
from taichi_msm.sweeps.runs import CONTACT, POLL_INTERVAL_S, SweepResult
from taichi_msm.sweeps.spec import Distribution

pass  # REMOVED
pass  # REMOVED

MOST_COLUMNS = 8

# Of a panel, and what is beside and around all of them [in].
WIDTH, HEIGHT, BESIDE, AROUND = 1.75, 1.55, 0.9, 1.3

# Letters of a line in an inch; letters of a label, and of all labels that fit beside each other.
LETTERS, LABEL, ROOM = 17, 12, 20

# Of the dots: all their areas together [pt²], and how wide those at one label spread.
AREAS, SPREAD = 900, 0.3

# Beside the dots, as a share of the axis.
MARGIN = 0.05

UNITS = {"max_displacement": " [m]", "force": " [N]", "greatest": " [N]"}


class Content(NamedTuple):
    """What is drawn; arrays have a number for each run."""

    title: str
    parameters: Sequence[Parameter]
    results: Mapping[str, NDArray[np.float64]]
    failed: NDArray[np.bool_]
    indices: Sequence[Index]


def plot(content: Content, file: BinaryIO) -> None:
    """Draw a panel for each result and each parameter as a PNG; of more parameters, those of largest sensitivity."""
    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # A name may contain characters that the font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        # Without the version of Matplotlib.
        _figure(content).savefig(file, format="png", metadata={"Software": None})


def _figure(content: Content) -> Figure:
    indices = {(index.result, index.parameter): index for index in content.indices}
    parameters = _most_sensitive(content)
    size = max(BESIDE + WIDTH * len(parameters), NARROW), AROUND + HEIGHT * len(content.results)
    figure = Figure(figsize=size, dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06))
    FigureCanvasAgg(figure)
    figure.suptitle(printable(content.title), x=0.01, ha="left", parse_math=False)
    said = textwrap.fill(" ".join(_explanations(content, parameters)), round(LETTERS * size[0]))
    figure.supxlabel(said, x=0.01, ha="left", size=8, parse_math=False)
    panels = figure.subplots(len(content.results), len(parameters), sharex="col", sharey="row", squeeze=False)
    for row, (name, numbers) in zip(panels, content.results.items(), strict=True):
        row[0].set_ylabel(name + UNITS.get(name.rsplit(".", 1)[-1], ""))
        if is_wide(numbers):
            row[0].set_yscale("log")
        else:
            row[0].yaxis.set_major_formatter(FuncFormatter(_write))
        for axes, parameter in zip(row, parameters, strict=True):
            _plot_runs(axes, parameter, numbers, content.failed)
            if index := indices.get((name, parameter.name)):
                _plot_index(axes, index)
    for axes, parameter in zip(panels[-1], parameters, strict=True):
        _scale(axes, parameter)
    return figure


def _most_sensitive(content: Content) -> list[Parameter]:
    """Choose the parameters that are shown, in their order."""
    largest = dict.fromkeys((one.name for one in content.parameters), -math.inf)
    for index in content.indices:
        largest[index.parameter] = max(index.first_order, largest[index.parameter])
    ranked = sorted(content.parameters, key=lambda one: -largest[one.name])
    chosen = {one.name for one in ranked[:MOST_COLUMNS]}
    return [one for one in content.parameters if one.name in chosen]


def _explanations(content: Content, shown: Sequence[Parameter]) -> Iterator[str]:
    """Say what is not plain from the panels."""
    if content.indices:
        yield "Above a panel: first-order sensitivity, the share of the result's variance that follows from this"
        yield "parameter alone, with its 95 % interval (RBD-FAST)."
    if content.failed.any():
        yield "x: a run that failed."
    if rest := [one.name for one in content.parameters if one.name not in {other.name for other in shown}]:
        yield (
            f"Not shown, as less sensitive: {', '.join(rest)}." if content.indices else f"Not shown: {', '.join(rest)}."
        )


def _plot_runs(axes: Axes, parameter: Parameter, numbers: NDArray[np.float64], failed: NDArray[np.bool_]) -> None:
    """Draw a dot for each run, and crosses at the bottom edge for those that failed."""
    place = parameter.numbers
    if parameter.labels:
        place = place + SPREAD * (np.random.default_rng(0).random(len(place)) - 0.5)
    area = float(np.clip(AREAS / len(place), 1.5, 12))
    axes.scatter(place, numbers, area, color=BLUE, alpha=0.6, linewidths=0)
    crosses: dict[str, Any] = {"marker": "x", "color": VERMILION, "linewidths": 0.8, "clip_on": False, "zorder": 3}
    axes.scatter(place[failed], np.full(failed.sum(), 0.0), 12, transform=axes.get_xaxis_transform(), **crosses)


def _plot_index(axes: Axes, index: Index) -> None:
    """Draw a bar over a panel, as wide as the panel for 1."""
    low, middle, high = (
        min(max(value, 0.0), 1.0)
        for value in (index.first_order - index.confidence, index.first_order, index.first_order + index.confidence)
    )
    above: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False, "solid_capstyle": "butt"}
    for left, right, colour, width in ((0, 1, PALE, 5), (0, middle, ORANGE, 5), (low, high, INK, 0.8)):
        axes.plot([left, right], [1.06, 1.06], color=colour, linewidth=width, **above)
    text = f"{max(index.first_order, 0.0):.2f} ± {index.confidence:.2f}"
    axes.set_title(text, loc="right", fontsize=7.5, fontweight="normal", pad=10)


def _scale(axes: Axes, parameter: Parameter) -> None:
    """Fit an axis to a parameter, and name it."""
    axes.set_xlabel(textwrap.fill(printable(parameter.name), round(LETTERS * WIDTH)), parse_math=False)
    if parameter.labels:
        labels = [textwrap.shorten(printable(label), LABEL, placeholder="…") for label in parameter.labels]
        turned: dict[str, Any] = (
            {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if sum(map(len, labels)) > ROOM else {}
        )
        axes.set_xticks(range(len(labels)), labels, parse_math=False, **turned)
        return
    if parameter.is_logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=5))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.xaxis.set_major_formatter(FuncFormatter(_write))
    # All runs, as those that failed may lie beyond the others.
    axes.set_xlim(*_with_margin(parameter))


def _with_margin(parameter: Parameter) -> tuple[float, float]:
    """Give the ends of an axis that has all numbers of a parameter well inside."""
    low, high = float(parameter.numbers.min()), float(parameter.numbers.max())
    if parameter.is_logarithmic:
        factor = (high / low) ** MARGIN
        return low / factor, high * factor
    return low - MARGIN * (high - low), high + MARGIN * (high - low)


def _write(number: float, _: int) -> str:
    """Write a number at an axis, all of it, as an exponent above the axis would meet the bar."""
    if number == 0 or 1e-3 <= abs(number) < 1e5:
        return f"{number:.10g}"
    digits, exponent = f"{number:.10e}".split("e")
    return f"{float(digits):g}e{int(exponent)}"


pass  # REMOVED

WITHOUT_PICTURES = f"{CONTACT} needs pictures of the runs; take set: {{output: [png]}}, or trajectory, and an image"

MOST_RUNS, MAX_TILE_COLUMNS = 36, 8

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
    from taichi_msm.runs.playback import Playback

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
            if finished.has_output("png"):
                frames[run] = Image.fromarray(finished.read_picture("png", finished.frames - 1))
            elif finished.has_output("gif"):
                frames[run] = last_picture(finished.result_path("gif"))
            elif finished.has_output("trajectory") and finished.scene.image is not None:
                drawn[run] = executor.submit(draw_last, directory.absolute())
        except FilesError as error:
            errors.append(str(error))
    rest = set(drawn.values())
    while rest:
        progress("contact", len(drawn) - len(rest), len(drawn))
        rest = wait(rest, POLL_INTERVAL_S).not_done
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
    if tiles == len(result.outcomes) and last.kind == "grid" and 1 < len(last.values) <= MAX_TILE_COLUMNS:
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


def short_names(keys: Sequence[str]) -> list[str]:
    """Shorten keys to their last parts, as far as these are words and no other key ends with them."""
    return [next(name for name in _endings(key) if _is_clear(name, key, keys)) for key in keys]


def short_value(value: Any) -> str:
    """Write a value with three significant digits of its numbers; of a path its last part."""
    if isinstance(value, float):
        return f"{float(f'{value:.3g}'):g}"
    if isinstance(value, str):
        return value.rpartition("/")[2]
    if isinstance(value, list):
        return f"[{', '.join(map(short_value, value))}]"
    if isinstance(value, dict):
        return ", ".join(f"{name} {short_value(one)}" for name, one in value.items())
    return json.dumps(value)


def _endings(key: str) -> Iterable[str]:
    """List the ends of a key, the shortest first."""
    parts = key.split(".")
    return (".".join(parts[start:]) for start in reversed(range(len(parts))))


def _is_clear(name: str, key: str, keys: Sequence[str]) -> bool:
    return name == key or not (
        name[0].isdigit() or any(f".{other}".endswith(f".{name}") for other in keys if other != key)
    )


pass  # REMOVED

# Columns of the table that are none.
NO_RESULTS = ("status", "error", "seconds")

# Of so many values at most that are no numbers, each has a label.
MOST_LABELS = 8

# Numbers that span a larger ratio than this are compared by their logarithms.
WIDE_RATIO = 50


class Parameter(NamedTuple):
    """A number that varied, or one of some values."""

    name: str  # the key, with the index of a list's component; as short as is clear
    numbers: NDArray[np.float64]  # for each run; of one of some values its place among them
    is_logarithmic: bool = False
    labels: Sequence[str] = ()  # of the values, if they are few


def parameters(result: SweepResult, runs: Sequence[int]) -> list[Parameter]:
    """Give all parameters that differ between some runs, in the order of the keys."""
    names = short_names(result.sweep.keys)
    every = [
        parameter
        for column, (name, one) in enumerate(zip(names, result.sweep.settings.vary.values(), strict=True))
        for parameter in _parameters(name, one, [result.values[run][column] for run in runs])
    ]
    return [parameter for parameter in every if len(np.unique(parameter.numbers)) > 1]


def results(result: SweepResult, runs: Sequence[int]) -> dict[str, NDArray[np.float64]]:
    """Give the results that differ between some complete runs, for each run; NaN: not complete, or not known."""
    outcomes = [result.outcomes[run] for run in runs]
    columns = {}
    for name, values in result.columns().items():
        if name in NO_RESULTS:
            continue
        numbers = [values[run] if one.status == "complete" else None for run, one in zip(runs, outcomes, strict=True)]
        column = np.array(numbers, dtype=np.float64)
        if len(np.unique(column[np.isfinite(column)])) > 1:
            columns[name] = column
    return columns


def is_wide(numbers: NDArray[np.float64]) -> bool:
    """Tell whether numbers, of which some may be NaN, are better compared by their logarithms."""
    return bool(np.nanmin(numbers) > 0 and np.nanmax(numbers) > WIDE_RATIO * np.nanmin(numbers))


def _parameters(name: str, one: Distribution, values: list[Any]) -> Iterator[Parameter]:
    """Turn the values of a key into parameters: one, or of lists of numbers one for each component."""
    if one.kind not in ("choice", "grid"):
        is_logarithmic = one.kind == "log_uniform"
        for suffix, *components in zip(_suffixes(values[0]), *map(_flat, values), strict=True):
            yield Parameter(name + suffix, np.array(components, dtype=np.float64), is_logarithmic)
        return
    if all(type(value) in (int, float) for value in one.values):
        numbers = np.array(values, dtype=np.float64)
        yield Parameter(name, numbers, is_wide(numbers))
        return
    places = {text: place for place, text in enumerate(dict.fromkeys(map(json.dumps, one.values)))}
    if len(places) <= MOST_LABELS:
        yield Parameter(name, _placed(places, values), labels=[short_value(json.loads(text)) for text in places])
    else:
        yield Parameter(f"{name} ({len(places)} values)", _placed(places, values))


def _placed(places: dict[str, int], values: list[Any]) -> NDArray[np.float64]:
    return np.array([places[json.dumps(value)] for value in values], dtype=np.float64)


def _flat(value: Any) -> Iterator[float]:
    """List the numbers in a value."""
    if isinstance(value, list):
        for item in value:
            yield from _flat(item)
    else:
        yield value


def _suffixes(value: Any) -> Iterator[str]:
    """List what tells these numbers apart, such as [0] and [1]."""
    if isinstance(value, list):
        for index, item in enumerate(value):
            yield from (f"[{index}]{rest}" for rest in _suffixes(item))
    else:
        yield ""


pass  # REMOVED

# Fewer runs do not tell parameters apart.
FEWEST_RUNS = 64

# Neighbours that are shuffled, how often, and the waves over the range of a parameter that its effect is made of.
NEIGHBOURS, SHUFFLES, WAVES = 4, 8, 4

# Of half of the runs, for each shuffle.
RESAMPLES = 25


class Index(NamedTuple):
    """The first-order sensitivity of a result to a parameter."""

    result: str
    parameter: str
    first_order: float  # 0 to 1, about
    confidence: float  # half the width of the 95 % interval


def sensitivity(parameters: Sequence[Parameter], results: Mapping[str, NDArray[np.float64]]) -> list[Index]:
    """Estimate the sensitivity of every result that enough runs have; ImportError: SALib is not installed."""
    indices = []
    for name, column in results.items():
        known = np.isfinite(column)
        if np.count_nonzero(known) >= FEWEST_RUNS:
            indices += [
                Index(name, parameter.name, *first_order(parameter.numbers[known], column[known]))
                for parameter in parameters
            ]
    return indices


def first_order(parameter: NDArray[np.float64], result: NDArray[np.float64]) -> tuple[float, float]:
    """Estimate the index of one parameter, and half the width of its 95 % interval."""
    from SALib.analyze import rbd_fast

    random = np.random.default_rng(0)
    problem = {"num_vars": 1, "names": [""]}
    estimates = []
    for shuffle in range(SHUFFLES):
        shuffled = random.permutation(len(result))
        ranks = np.argsort(np.argsort(parameter[shuffled], kind="stable"), kind="stable")
        ordered = result[shuffled][np.argsort(ranks // NEIGHBOURS, kind="stable")]
        place = np.arange(len(result), dtype=np.float64)[:, np.newaxis]
        found = rbd_fast.analyze(problem, place, ordered, M=WAVES, num_resamples=RESAMPLES, seed=1 + shuffle)
        estimates.append((found["S1"][0], found["S1_conf"][0]))
    estimate, confidence = np.mean(estimates, axis=0)
    return float(estimate), float(confidence)
