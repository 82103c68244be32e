"""docs/performance.md from the results."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks import bounds, gradients, looks, native, terms, whole_run
from benchmarks.drawing.measure import WANTED
from benchmarks.marked import table
from benchmarks.parts import NARROW, REFINE
from benchmarks.process import ROOT
from benchmarks.stepping.measure import TOLERANCE
from taichi_msm import load_scene
from taichi_msm.solver.planning import make_plan
from taichi_msm.study import study
from taichi_msm.study.format import format_duration, format_number, format_timing
from taichi_msm.study.result import Timing
from taichi_msm.system.compiler import COMPILERS, active_compiler
from taichi_msm.system.process import available_threads
from taichi_msm.system.runtime import Device, vector_bits

TEMPLATE = ROOT / "docs" / "performance.template"
NOT_MEASURED = "(not measured yet)"

# Packages whose versions the page names.
PACKAGES = ("numba", "jax", "opencv-python-headless", "moderngl", "vtk", "scikit-image")

Results = dict[str, Any]
Entry = dict[str, Any]


def machine() -> Results:
    """Describe the machine."""
    record = study.machine_record(Device("cpu", available_threads()))
    versions = {active_compiler().title: active_compiler().version, "NumPy": record["versions"]["numpy"]}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    if compiler := native.compiler():
        command = [compiler, "-dumpfullversion", "-dumpversion"]
        versions[compiler] = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    return {
        "cpu": record["cpu"],
        "threads": record["threads"],
        "vectors": vector_bits(),
        "compiler": " ".join([native.compiler(), *native.options()]),
        "caches": _caches(),
        "python": record["versions"]["python"],
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def _caches() -> str:
    """Describe the data caches of the first core."""
    caches = []
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, kind, size = ((folder / name).read_text().strip() for name in ("level", "type", "size"))
        if kind != "Instruction":
            caches.append(f"L{level} {size.removesuffix('K')} KiB")
    return ", ".join(caches) or "not known"


def tables(results: Results) -> dict[str, str]:
    """Return the tables of the page; those of missing parts are `NOT_MEASURED`."""
    makers: dict[str, tuple[str, Callable[[], str]]] = {
        "stepping_table": ("stepping", lambda: stepping_table(results["stepping"])),
        "narrow_table": ("narrow", lambda: narrow_table(results["narrow"])),
        "drawing_table": ("drawing", lambda: drawing_table(results["drawing"])),
        "whole_run_table": ("whole_run", lambda: whole_run_table(results["whole_run"])),
        "terms_table": ("terms", lambda: relative_table("a step", results["terms"], terms.SPRINGS)),
        "gradient_table": ("gradient", lambda: gradient_table(results["gradient"])),
        "looks_table": ("looks", lambda: relative_table("a picture", pictures(results), looks.HEADLIGHT)),
        "rates": ("looks", lambda: rates(results["looks"]["rates"])),
        "compilers_table": ("compilers", lambda: compilers_table(results["compilers"])),
        "threads_table": ("threads", lambda: threads_table(results["threads"])),
        "machine_rates": ("bounds", lambda: machine_rates(results["bounds"])),
        "bound_table": ("bounds", lambda: bound_table(results)),
    }
    texts = {name: make() if part in results else NOT_MEASURED for name, (part, make) in makers.items()}
    wide = f"{results['machine']['cpu']}, {results['machine']['vectors']} bits"
    narrow = f"{results['machine']['cpu']}, {NARROW} bits"
    return {name: _on(narrow if name.startswith("narrow") else wide, text) for name, text in texts.items()}


def _on(processor: str, text: str) -> str:
    """Add the processor and the width of its vectors to the head of a table."""
    return text.replace("| ", f"| {processor}: ", 1) if text.startswith("| ") else text


def page(results: Results) -> str:
    """Fill the template."""
    return TEMPLATE.read_text(encoding="utf-8").format(
        **results["machine"],
        **tables(results),
        rounds=results["rounds"],
        tolerance=f"{TOLERANCE:g}",
        lit_wanted=f"{WANTED[True]:g}",
        flat_wanted=f"{WANTED[False]:g}",
        refine=REFINE,
        step_bytes=bounds.STEP_BYTES,
        step_flops=f"{bounds.STEP_FLOPS:g}",
        step_roots=bounds.STEP_ROOTS,
        pixel_flops=bounds.PIXEL_FLOPS,
        frame_steps=make_plan(load_scene(ROOT / whole_run.SCENE)).grid.steps_per_frame,
        launch_share=launch_share(results),
    )


def launch_share(results: Results) -> str:
    """Format the launch time per step of a frame."""
    rates = results.get("bounds", {})
    if "one_step" not in rates:
        return NOT_MEASURED
    return format_duration(rates["one_step"] / make_plan(load_scene(ROOT / whole_run.SCENE)).grid.steps_per_frame)


def stepping_table(measured: dict[str, list[Entry]]) -> str:
    """Table of the time of a step of every peer."""
    first = next(iter(measured.values()))
    rows = []
    for index, entry in enumerate(first):
        errors = [entries[index]["answer"] for entries in measured.values()]
        worst = max((error for error in errors if error is not None), default=None)
        cells = [_cell(entries[index]) for entries in measured.values()]
        rows.append([entry["name"], *cells, "-" if worst is None else f"{worst:.1g}", _compile(entry)])
    return table(["time of a step", *(f"{n} × {n}" for n in measured), "largest error", "compile"], rows)


def narrow_table(narrow: dict[str, list[Entry]]) -> str:
    """Table of the time of a step of the fastest peers at every size, with vectors of 256 bits."""
    if not narrow:
        return f"(this processor has none wider than {NARROW} bits: the tables above are of these)"
    names = [entry["name"] for entry in next(iter(narrow.values()))]
    return table(["points", *names], [[f"{n} × {n}", *map(_cell, entries)] for n, entries in narrow.items()])


def drawing_table(measured: dict[str, dict[str, list[Entry]]]) -> str:
    """Table of the time of a picture of every peer, lit and flat."""
    rows = []
    for kind, by_pixels in measured.items():
        for index, entry in enumerate(next(iter(by_pixels.values()))):
            agreement = "-" if entry["answer"] is None else f"{entry['answer']:.1f} dB"
            cells = [
                cell
                for entries in by_pixels.values()
                for cell in (_cell(entries[index]), _ratio(entries[index], entries[0]))
            ]
            name = entry["name"] if kind == "lit" else f"{entry['name']}, {kind}"
            rows.append([name, *cells, agreement, _compile(entry)])
    head = [word for n in next(iter(measured.values())) for word in (f"{n} × {n}", "/ ours")]
    return table(["time of a picture", *head, "PSNR", "compile"], rows)


def whole_run_table(measured: dict[str, dict[str, list[float]]]) -> str:
    """Table of the time of every stage of a run, and of a check."""
    stages = list(measured["cold"])
    rows = [
        [kind, *(_seconds(times[stage]) if stage in times else "-" for stage in stages)]
        for kind, times in measured.items()
    ]
    return table(["[s]", *stages], rows)


def compilers_table(measured: dict[str, dict[str, list[float]]]) -> str:
    """Table of the times with each compiler, and of their ratios."""
    if not measured:
        return "(not measured: needs both compilers)"
    names = list(COMPILERS)
    rows = []
    for work, samples in measured.items():
        times = [Timing.of(samples[name]) for name in names]
        rows.append([work, *map(format_timing, times), f"{times[1].median / times[0].median:.2f}"])
    return table(["time", *(COMPILERS[name].title for name in names), "ratio"], rows)


def relative_table(head: str, measured: dict[str, dict[str, list[float]]], base: str) -> str:
    """Table of times at every size, and of their ratios to a base."""
    medians = {
        size: {name: Timing.of(times).median for name, times in variants.items()} for size, variants in measured.items()
    }
    rows = [
        [name, *(f"{format_duration(times[name])} ({times[name] / times[base]:.2f})" for times in medians.values())]
        for name in next(iter(medians.values()))
    ]
    return table([head, *medians], rows)


def gradient_table(measured: dict[str, dict[str, dict[str, list[float]]]]) -> str:
    """Table of the times of forward runs and gradients, and of their ratios to this program's run."""
    rows = []
    for size, peers in measured.items():
        run = Timing.of(peers[gradients.OURS]["forward"]).median
        for name, samples in peers.items():
            forward, gradient = (Timing.of(samples[kind]) for kind in ("forward", "gradient"))
            rows.append(
                [f"{size}, {name}", format_timing(forward), format_timing(gradient), f"{gradient.median / run:.1f}"]
            )
    return table(["a gradient", "forward run", "value and gradient", "in forward runs of taichi_msm"], rows)


def pictures(results: Results) -> dict[str, dict[str, list[float]]]:
    """Return the times of all kinds of pictures, by their size."""
    return {f"{size} × {size}": times for size, times in results["looks"]["pictures"].items()}


def rates(measured: dict[str, list[float]]) -> str:
    """Format the frames per second of runs."""
    return ", ".join(f"{Timing.of(samples).median:.0f} {name}" for name, samples in measured.items()) + " a second"


def threads_table(measured: dict[str, dict[str, list[Entry]]]) -> str:
    """Table of the times of steps and pictures with every number of threads."""
    rows = []
    for work, by_count in measured.items():
        for index, entry in enumerate(next(iter(by_count.values()))):
            rows.append([f"{entry['name']}, {work}", *(_cell(entries[index]) for entries in by_count.values())])
    counts = next(iter(measured.values()))
    return table(["work", *(f"{count} threads" if count != "1" else "1 thread" for count in counts)], rows)


def machine_rates(rates: Results) -> str:
    """Format the machine's rates."""
    if rates["failure"]:
        return f"(not measured: {rates['failure']})"
    bandwidths = [rate / 1e9 for rate in rates["bandwidth"].values()]
    return (
        f"{rates['flops'] / 1e9:.0f} Gflop/s in multiplications with addition, {rates['roots'] / 1e9:.2g} G/s of "
        f"reciprocal square roots, {min(bandwidths):.0f} to {max(bandwidths):.0f} GB/s in a triad over the state "
        f"of a sheet, {format_duration(rates['launch'])} for an empty launch"
    )


def bound_table(results: Results) -> str:
    """Table of the times of steps and pictures against their lower bounds, at every size."""
    rates = results["bounds"]
    if rates["failure"] or "size" not in results or "drawing" not in results:
        return NOT_MEASURED
    works = {}
    for points, entries in results["size"].items():
        if points in rates["bandwidth"]:
            count = int(points) ** 2
            works[f"a step, {points} × {points} points"] = (
                entries[0]["samples"],
                {
                    "bytes": bounds.STEP_BYTES * count / rates["bandwidth"][points],
                    "flops": bounds.STEP_FLOPS * count / rates["flops"],
                    "roots": bounds.STEP_ROOTS * count / rates["roots"],
                },
            )
    # The lowest bandwidth: that of memory.
    bandwidth = min(rates["bandwidth"].values())
    for pixels, entries in results["drawing"]["lit"].items():
        count = int(pixels) ** 2
        works[f"a picture, {pixels} × {pixels} pixels"] = (
            entries[0]["samples"],
            {
                "bytes": bounds.COLOUR_BYTES * 2 * count / bandwidth,
                "flops": bounds.PIXEL_FLOPS * count / rates["flops"],
                "launch": rates["launch"],
            },
        )
    kinds = ("bytes", "flops", "roots", "launch")
    rows = []
    for work, (samples, least) in works.items():
        if samples:
            median = Timing.of(samples).median
            binding = max(least, key=lambda kind: least[kind])
            cells = [format_duration(least[kind]) if kind in least else "-" for kind in kinds]
            rows.append([work, format_duration(median), *cells, binding, f"{100 * least[binding] / median:.0f} %"])
    return table(["work", "time", *kinds, "bound by", "of the bound"], rows)


def _cell(entry: Entry) -> str:
    return format_timing(Timing.of(entry["samples"])) if entry["samples"] else str(entry["failure"])


def _ratio(entry: Entry, ours: Entry) -> str:
    if not (entry["samples"] and ours["samples"]):
        return "-"
    return format_number(Timing.of(entry["samples"]).median / Timing.of(ours["samples"]).median)


def _compile(entry: Entry) -> str:
    return "-" if entry["compile"] is None else format_duration(entry["compile"])


def _seconds(samples: list[float]) -> str:
    timing = Timing.of(samples)
    return f"{timing.median:.2f} ({timing.fastest:.2f} to {timing.slowest:.2f})"
