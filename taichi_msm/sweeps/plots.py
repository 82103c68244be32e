"""Plots of a sweep: results against parameters, a contact sheet of frames, and first-order sensitivities.

The first-order sensitivity index is the share of a result's variance that one parameter alone explains.

Source: Plischke, "An effective algorithm for computing global sensitivity indices (EASI)", 2010, and Tissot and Prieur,
"Bias correction for the estimation of sensitivity indices based on random balance designs", 2012; both as RBD-FAST of
SALib. The method sorts the results by one parameter, and assumes that the others then have random order. At Sobol
points and on grids they alternate between low and high values. So neighbours in the order are shuffled, and the index
is the mean over several shuffles: for the parameter y of the result 3 x + y at 64 Sobol points, its root-mean-square
error is 0.07, and 0.3 without shuffles.

Matplotlib and SALib are optional; functions import them.
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
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from taichi_msm.errors import FilesError, StageProgressCallback, printable
from taichi_msm.plot_style import BLUE, DPI, GREY, INK, ONE_COLUMN_WIDTH, ORANGE, PALE, STYLE, VERMILION
from taichi_msm.runs.directory import replacing
from taichi_msm.runs.finished import read_run, reading
from taichi_msm.sweeps.distribution import Distribution
from taichi_msm.sweeps.runs import POLL_INTERVAL_S, SweepState
from taichi_msm.sweeps.spec import spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL_WIDTH_IN, CHARACTERS_PER_INCH = 1.75, 17

UNITS = {"max_displacement": " [m]", "force": " [N]", "greatest": " [N]"}


class PlotData(NamedTuple):
    """Data of sweep.png; arrays have shape (runs,)."""

    title: str
    parameters: Sequence[VariedParameter]
    results: Mapping[str, NDArray[np.float64]]
    failed: NDArray[np.bool_]
    indices: Sequence[SensitivityIndex]


def plot(data: PlotData, file: BinaryIO) -> None:
    """Plot sweep.png: a panel for each result and each of the most sensitive parameters."""
    from matplotlib import style

    with style.context(STYLE, after_reset=True), warnings.catch_warnings():
        # A name may contain characters that the font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        # The default metadata contains the version of Matplotlib.
        _figure(data).savefig(file, format="png", metadata={"Software": None})


def _figure(data: PlotData) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    indices = {(index.result, index.parameter): index for index in data.indices}
    parameters = _most_sensitive(data)
    width = max(0.9 + PANEL_WIDTH_IN * len(parameters), ONE_COLUMN_WIDTH)
    height = 1.3 + 1.55 * len(data.results)
    figure = Figure(figsize=(width, height), dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06))
    figure.suptitle(printable(data.title), x=0.01, ha="left", parse_math=False)
    legend = textwrap.fill(" ".join(_legend(data, parameters)), round(CHARACTERS_PER_INCH * width))
    figure.supxlabel(legend, x=0.01, ha="left", size=8, parse_math=False)
    panels = figure.subplots(len(data.results), len(parameters), sharex="col", sharey="row", squeeze=False)
    for row, (name, numbers) in zip(panels, data.results.items(), strict=True):
        row[0].set_ylabel(name + UNITS.get(name.rsplit(".", 1)[-1], ""))
        if is_wide_range(numbers):
            row[0].set_yscale("log")
        else:
            row[0].yaxis.set_major_formatter(_tick_label)
        for axes, parameter in zip(row, parameters, strict=True):
            _plot_runs(axes, parameter, numbers, data.failed)
            if index := indices.get((name, parameter.name)):
                _plot_index(axes, index)
    for axes, parameter in zip(panels[-1], parameters, strict=True):
        _format_axis(axes, parameter)
    return figure


def _most_sensitive(data: PlotData) -> list[VariedParameter]:
    """Return the eight parameters with the largest indices, in their original order."""
    largest = dict.fromkeys((parameter.name for parameter in data.parameters), -math.inf)
    for index in data.indices:
        largest[index.parameter] = max(index.first_order, largest[index.parameter])
    chosen = sorted(largest, key=lambda name: -largest[name])[:8]
    return [parameter for parameter in data.parameters if parameter.name in chosen]


def _legend(data: PlotData, drawn: Sequence[VariedParameter]) -> Iterator[str]:
    if data.indices:
        yield "Above a panel: first-order sensitivity, the share of the result's variance that follows from this"
        yield "parameter alone, with its 95 % interval (RBD-FAST)."
    if data.failed.any():
        yield "x: a run that failed."
    shown = {parameter.name for parameter in drawn}
    if rest := [parameter.name for parameter in data.parameters if parameter.name not in shown]:
        yield f"Not shown{', as less sensitive' if data.indices else ''}: {', '.join(rest)}."


def _plot_runs(axes: Axes, parameter: VariedParameter, numbers: NDArray[np.float64], failed: NDArray[np.bool_]) -> None:
    """Plot a dot for each run, and a cross at the bottom edge for each failed run."""
    x = parameter.numbers
    if parameter.labels:
        # Random offsets separate the dots at a label.
        x = x + 0.3 * (np.random.default_rng(0).random(len(x)) - 0.5)
    area_pt2 = float(np.clip(900 / len(x), 1.5, 12))
    axes.scatter(x, numbers, area_pt2, color=BLUE, alpha=0.6, linewidths=0)
    crosses: dict[str, Any] = {"marker": "x", "color": VERMILION, "linewidths": 0.8, "clip_on": False, "zorder": 3}
    axes.scatter(x[failed], np.full(failed.sum(), 0.0), 12, transform=axes.get_xaxis_transform(), **crosses)


def _plot_index(axes: Axes, index: SensitivityIndex) -> None:
    """Plot an index as a bar above a panel, as wide as the panel for an index of 1."""
    low, middle, high = np.clip(index.first_order + index.confidence * np.array([-1, 0, 1]), 0, 1)
    line_style: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False, "solid_capstyle": "butt"}
    for left, right, colour, width in ((0, 1, PALE, 5), (0, middle, ORANGE, 5), (low, high, INK, 0.8)):
        axes.plot([left, right], [1.06, 1.06], color=colour, linewidth=width, **line_style)
    text = f"{max(index.first_order, 0.0):.2f} ± {index.confidence:.2f}"
    axes.set_title(text, loc="right", fontsize=7.5, fontweight="normal", pad=10)


def _format_axis(axes: Axes, parameter: VariedParameter) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    name = textwrap.fill(printable(parameter.name), round(CHARACTERS_PER_INCH * PANEL_WIDTH_IN))
    axes.set_xlabel(name, parse_math=False)
    if parameter.labels:
        labels = [textwrap.shorten(printable(label), 12, placeholder="…") for label in parameter.labels]
        # A panel has space for 20 characters.
        is_long = sum(map(len, labels)) > 20
        rotated: dict[str, Any] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if is_long else {}
        axes.set_xticks(range(len(labels)), labels, parse_math=False, **rotated)
        return
    if parameter.is_logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=5))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.xaxis.set_major_formatter(_tick_label)
    # The limits of the axis include failed runs.
    axes.update_datalim([(number, 1) for number in parameter.numbers], updatey=False)
    axes.autoscale(axis="x")


def _tick_label(number: float, _: float) -> str:
    """Format a number with its own exponent, as a common one above the axis would overlap the bar of the index."""
    if number == 0 or 1e-3 <= abs(number) < 1e5:
        return f"{number:.10g}"
    digits, exponent = f"{number:.10e}".split("e")
    return f"{float(digits):g}e{int(exponent)}"


GAP_PX, LINE_HEIGHT_PX, MAX_CAPTION_LINES = 20, 23, 8


class Tile(NamedTuple):
    """Run in the contact sheet."""

    frame: Image.Image | None  # frame with the largest displacement
    status: str  # text in place of a missing frame
    caption: list[str]  # parts that line breaks may separate


def write_contact_sheet(
    state: SweepState, written: list[str], executor: Executor, progress: StageProgressCallback
) -> list[str]:
    """Write contact.jpg if a run has a picture, and append it to the written reports; return warnings.

    The executor draws the frames of runs without pictures.
    """
    runs = spread(len(state.outcomes), 36)
    complete = [run for run in runs if state.outcomes[run].status == "complete"]
    frames, errors = _largest_frames({run: state.run_directory(run) for run in complete}, executor, progress)
    if not frames:
        reason = "contact.jpg needs a complete run"
        if complete:
            reason = "contact.jpg needs pictures of the runs; take set: {output: [png]}, or trajectory, and an image"
        return [f"no contact.jpg: {errors[0]}" if errors else reason]
    names = abbreviate_keys(state.sweep.keys)
    tiles = []
    for run in runs:
        outcome = state.outcomes[run]
        caption = [f"run {run}"]
        if outcome.max_displacement is not None:
            caption.append(f"max_displacement = {format_short(outcome.max_displacement)}")
        for name, value in zip(names, state.values[run], strict=True):
            caption.append(printable(f"{name} = {format_short(value)}"))
        tiles.append(Tile(frames.get(run), outcome.status, caption))
    total = len(state.outcomes)
    subset = f"{total} runs" if len(runs) == total else f"{len(runs)} of {total} runs, evenly spread"
    heading = printable(f"{state.sweep.scene.name}: the frames with the largest displacement of {subset}")
    sheet = _draw_tiles(tiles, _column_count(state, len(runs)), heading)
    with replacing(state.directory / "contact.jpg") as file:
        sheet.save(file, "JPEG", quality=90)
    written.append("contact.jpg")
    return [f"contact.jpg lacks the frames of {len(errors)} runs, for example: {errors[0]}"] if errors else []


def draw_largest_frame(directory: Path) -> NDArray[np.uint8]:
    """Draw the frame with the largest displacement of a run on one thread, shape (height, width, 3)."""
    from taichi_msm.runs.playback import Playback

    with Playback(directory, threads=1) as run:
        return run.draw(read_run(directory).largest_frame)


def _largest_frames(
    directories: dict[int, Path], executor: Executor, progress: StageProgressCallback
) -> tuple[dict[int, Image.Image], list[str]]:
    """Read or draw the frame with the largest displacement of each run; return the frames by run, and the errors."""
    frames: dict[int, Image.Image] = {}
    futures: dict[int, Future[NDArray[np.uint8]]] = {}
    errors = []
    for run, directory in directories.items():
        try:
            finished = read_run(directory)
            if finished.has_output("png"):
                frames[run] = Image.fromarray(finished.read_picture("png", finished.largest_frame))
            elif finished.has_output("gif"):
                # The middle of the frame, as a GIF rounds the beginning.
                time = (finished.largest_frame + 0.5) / finished.scene.time.frames_per_second
                frames[run] = read_gif_frame(finished.result_path("gif"), time)
            elif finished.has_output("trajectory") and finished.scene.image is not None:
                futures[run] = executor.submit(draw_largest_frame, directory.absolute())
        except FilesError as error:
            errors.append(str(error))
    pending = set(futures.values())
    while pending:
        progress("contact", len(futures) - len(pending), len(futures))
        pending = wait(pending, POLL_INTERVAL_S).not_done
    for run, future in futures.items():
        try:
            frames[run] = Image.fromarray(future.result())
        except Exception as error:
            errors.append(f"{directories[run]}: {error}")
    return frames, errors


def read_gif_frame(path: Path, time: float) -> Image.Image:
    """Read the RGB picture of an animated GIF at a time from its start [s]; after the end, the last one."""
    with reading(path), Image.open(path, formats=["GIF"]) as film:
        for number in range(film.n_frames):
            film.seek(number)
            time -= film.info["duration"] / 1000
            if time < 0:
                break
        return film.convert("RGB")


def _column_count(state: SweepState, tiles: int) -> int:
    """Choose the number of columns: of a grid, the number of values of its last key; otherwise about that of rows."""
    settings = state.sweep.settings
    if tiles == len(state.outcomes) and settings.samples is None and 1 < len(settings.grids[-1]) <= 8:
        return len(settings.grids[-1])
    square = math.ceil(math.sqrt(tiles))
    return min(square, square + 1, key=lambda columns: -tiles % columns)


def _draw_tiles(tiles: Sequence[Tile], columns: int, heading: str) -> Image.Image:
    frames = [tile.frame for tile in tiles if tile.frame]
    # The contact sheet is at most 2200 px wide, and a tile at least 330 px.
    max_width = (2200 - GAP_PX) // columns - GAP_PX
    width = min(max(330, *(frame.width for frame in frames)), max_width)
    height = round(width * min(2, median(frame.height / frame.width for frame in frames)))
    font = ImageFont.load_default(17)
    captions = [_wrap(tile.caption, lambda text: font.getlength(text) <= width) for tile in tiles]
    caption_height = LINE_HEIGHT_PX * max(map(len, captions)) + GAP_PX
    rows = math.ceil(len(tiles) / columns)
    size = GAP_PX + columns * (width + GAP_PX), 2 * GAP_PX + LINE_HEIGHT_PX + rows * (height + caption_height)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP_PX, GAP_PX // 2), heading, INK, font)
    for number, (tile, caption) in enumerate(zip(tiles, captions, strict=True)):
        x = GAP_PX + number % columns * (width + GAP_PX)
        y = GAP_PX + LINE_HEIGHT_PX + number // columns * (height + caption_height)
        if tile.frame:
            frame = ImageOps.contain(tile.frame, (width, height), Image.Resampling.LANCZOS)
            sheet.paste(frame, (x + (width - frame.width) // 2, y + height - frame.height))
        else:
            draw.rectangle((x, y, x + width - 1, y + height - 1), PALE)
            draw.text((x + width // 2, y + height // 2), tile.status, GREY, font, anchor="mm")
        for line, text in enumerate(caption):
            draw.text((x, y + height + 4 + LINE_HEIGHT_PX * line), text, INK, font)
    return sheet


def _wrap(parts: Iterable[str], fits: Callable[[str], bool]) -> list[str]:
    """Join parts to lines that fit; truncate parts that are too long, and lines after `MAX_CAPTION_LINES`."""
    lines = [""]
    for part in parts:
        longer = f"{lines[-1]}   {part}".lstrip()
        if fits(longer):
            lines[-1] = longer
            continue
        # No line has space for 300 characters; the limit bounds the loop.
        cut = part[:300]
        while not fits(cut):
            cut = f"{cut[:-2]}…"
        lines.append(cut)
    return lines if len(lines) <= MAX_CAPTION_LINES else [*lines[: MAX_CAPTION_LINES - 1], "…"]


def abbreviate_keys(keys: Sequence[str]) -> list[str]:
    """Abbreviate dotted keys to their shortest unambiguous ends that begin with a word."""
    names = []
    for key in keys:
        parts = key.split(".")
        suffixes = (".".join(parts[start:]) for start in reversed(range(1, len(parts))))
        rivals = [f".{rival}" for rival in keys if rival != key]
        unambiguous = (
            name
            for name in suffixes
            if not name[0].isdigit() and not any(rival.endswith(f".{name}") for rival in rivals)
        )
        names.append(next(unambiguous, key))
    return names


def format_short(value: Any) -> str:
    """Format a value for a caption: numbers with three significant digits, paths without folders."""
    if isinstance(value, float):
        return f"{float(f'{value:.3g}'):g}"
    if isinstance(value, str):
        return value.rpartition("/")[2]
    if isinstance(value, list):
        return f"[{', '.join(map(format_short, value))}]"
    if isinstance(value, dict):
        return ", ".join(f"{name} {format_short(item)}" for name, item in value.items())
    return json.dumps(value)


class VariedParameter(NamedTuple):
    """Parameter that differs between runs."""

    name: str  # abbreviated key, with the index of a list's component
    numbers: NDArray[np.float64]  # values, or indices of non-numeric values; shape (runs,)
    is_logarithmic: bool = False
    labels: Sequence[str] = ()  # of non-numeric values, if at most eight


def varied_parameters(state: SweepState, runs: Sequence[int]) -> list[VariedParameter]:
    """Return the parameters that differ between runs, in the order of the keys."""
    names = abbreviate_keys(state.sweep.keys)
    columns = zip(*(state.values[run] for run in runs), strict=True)
    return [
        parameter
        for key in zip(names, state.sweep.settings.distributions.values(), columns, strict=True)
        for parameter in _parameters(*key)
        if len(np.unique(parameter.numbers)) > 1
    ]


def varied_results(state: SweepState, runs: Sequence[int]) -> dict[str, NDArray[np.float64]]:
    """Return the columns of the table that differ between runs, by name.

    Columns have shape (runs,), NaN where a run is incomplete or lacks the result.
    """
    complete = [state.outcomes[run].status == "complete" for run in runs]
    columns = {}
    for name, values in state.columns().items():
        if name in ("status", "error", "seconds"):
            continue
        numbers = [values[run] if is_complete else None for run, is_complete in zip(runs, complete, strict=True)]
        column = np.array(numbers, dtype=np.float64)
        if len(np.unique(column[np.isfinite(column)])) > 1:
            columns[name] = column
    return columns


def is_wide_range(numbers: NDArray[np.float64]) -> bool:
    """Return whether numbers, except NaN, need a logarithmic axis: all positive, largest over smallest above 50."""
    return bool(np.nanmin(numbers) > 0 and np.nanmax(numbers) > 50 * np.nanmin(numbers))


def _parameters(name: str, distribution: Distribution, values: Sequence[Any]) -> Iterator[VariedParameter]:
    """Yield the parameters of a key, one for each component of a list of numbers."""
    if distribution.continuous:
        components = np.array(values, dtype=np.float64)
        columns = components.reshape(len(values), -1).T
        for index, numbers in zip(np.ndindex(components.shape[1:]), columns, strict=True):
            suffix = "".join(f"[{n}]" for n in index)
            yield VariedParameter(name + suffix, numbers, distribution.continuous.logarithmic)
        return
    if all(type(value) in (int, float) for value in distribution.values):
        numbers = np.array(values, dtype=np.float64)
        yield VariedParameter(name, numbers, is_wide_range(numbers))
        return
    ranks = {text: rank for rank, text in enumerate(dict.fromkeys(map(json.dumps, distribution.values)))}
    numbers = np.array([ranks[json.dumps(value)] for value in values], dtype=np.float64)
    if len(ranks) <= 8:
        yield VariedParameter(name, numbers, labels=[format_short(json.loads(text)) for text in ranks])
    else:
        yield VariedParameter(f"{name} ({len(ranks)} values)", numbers)


class SensitivityIndex(NamedTuple):
    """First-order sensitivity of a result to a parameter."""

    result: str
    parameter: str
    first_order: float  # 0 to 1, up to estimation errors
    confidence: float  # half-width of the 95 % interval


def estimate_sensitivity(
    parameters: Sequence[VariedParameter], results: Mapping[str, NDArray[np.float64]]
) -> list[SensitivityIndex]:
    """Estimate the first-order sensitivity to every parameter, of every result that at least 64 runs have.

    Results have shape (runs,), NaN where a run lacks the result. An ImportError shows that SALib is not installed.
    """
    indices = []
    for name, column in results.items():
        is_finite = np.isfinite(column)
        if np.count_nonzero(is_finite) >= 64:  # Fewer are too inaccurate to rank parameters.
            for parameter in parameters:
                estimate = first_order_index(parameter.numbers[is_finite], column[is_finite])
                indices.append(SensitivityIndex(name, parameter.name, *estimate))
    return indices


def first_order_index(parameter: NDArray[np.float64], result: NDArray[np.float64]) -> tuple[float, float]:
    """Estimate the first-order index of a parameter by RBD-FAST, as the mean over shuffles; both of shape (runs,).

    Return the index, and the half-width of its 95 % interval.
    """
    from SALib.analyze import rbd_fast

    random = np.random.default_rng(0)
    problem = {"num_vars": 1, "names": [""]}
    estimates = []
    for shuffle in range(8):
        shuffled = random.permutation(len(result))
        ranks = np.argsort(np.argsort(parameter[shuffled], kind="stable"), kind="stable")
        # Groups of four successive ranks keep their random order.
        ordered = result[shuffled][np.argsort(ranks // 4, kind="stable")]
        positions = np.arange(len(result), dtype=np.float64)[:, np.newaxis]
        analysis = rbd_fast.analyze(problem, positions, ordered, M=4, num_resamples=25, seed=1 + shuffle)
        estimates.append((analysis["S1"][0], analysis["S1_conf"][0]))
    estimate, confidence = np.mean(estimates, axis=0)
    return float(estimate), float(confidence)
