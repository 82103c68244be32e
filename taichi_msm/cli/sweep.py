"""The command `sweep`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from taichi_msm.cli import common, options
from taichi_msm.errors import LostExecutorError
from taichi_msm.system.process import write_stderr

if TYPE_CHECKING:
    from taichi_msm.sweeps.spec import Sweep
    from taichi_msm.sweeps.tables import SweepCost

# Largest number of runs that needs no --yes.
MAX_UNCONFIRMED_RUNS = 10_000


@options.program.command()
@click.argument("file", metavar="SWEEP")
@options.out_option("Directory for the runs.", "output/<name of the sweep file>")
@options.workers_option(help="Number of worker processes.  [default: one per core, limited by the memory]")
@click.option("--dask", metavar="ADDRESS", help="Execute the runs in the workers of the dask scheduler at ADDRESS.")
@click.option(
    "--shard", type=options.parse_shard, metavar="I/N", help="Execute shard I of N of the runs, without a table."
)
@click.option("--dry-run", is_flag=True, help="Print the values of all runs and their cost; run nothing.")
@click.option("--yes", is_flag=True, help=f"Permit more than {MAX_UNCONFIRMED_RUNS} runs, or more than a day.")
@options.json_option
def sweep(
    file: str,
    out: str | None,
    workers: int | None,
    dask: str | None,
    shard: tuple[int, int] | None,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> int:
    """Run a scene with every set of values of SWEEP, and write a table of the results."""
    from taichi_msm.sweeps.runs import begin_sweep, run_missing
    from taichi_msm.sweeps.spec import load_sweep
    from taichi_msm.sweeps.sweep import finish_sweep, open_executor
    from taichi_msm.sweeps.tables import choose_worker_count, cost_line, count_statuses, estimate_cost, summary_lines

    if workers is not None and dask is not None:
        raise click.UsageError(
            "--workers starts processes on this machine, and --dask uses those of a cluster; leave out one of them"
        )
    loaded = load_sweep(file)
    directory = common.result_directory(out, Path(file).stem)
    cost = estimate_cost(loaded)
    if dry_run:
        _print_dry_run(loaded, cost, shard or (1, 1), workers, as_json)
        return common.DONE
    if not yes and (loaded.runs > MAX_UNCONFIRMED_RUNS or cost.seconds > 86400):
        worker_count = choose_worker_count(cost, loaded.runs, workers)
        raise click.UsageError(f"{cost_line(loaded.runs, cost, worker_count)}; add --yes to start them")
    state = begin_sweep(loaded, directory, shard or (1, 1))
    outcomes, missing = state.outcomes, len(state.missing)
    total = len(outcomes) + missing
    worker_count = choose_worker_count(cost, missing, workers)
    if not as_json:
        write_stderr([f"{len(outcomes)} of {total} runs are finished already"] if outcomes else [])
        local_workers = worker_count if dask is None else None
        write_stderr([cost_line(missing, cost.scaled(missing / loaded.runs), local_workers)] if missing else [])
    files: list[str] = []
    notes: list[str] = []
    try:
        with (
            common.interruptible(as_json, rest=lambda: f"; {_progress_message(len(outcomes), total)}") as progress,
            # Without missing runs, no cluster is needed.
            open_executor(dask if missing else None, worker_count.number, state, progress) as executor,
        ):
            for _ in run_missing(state, executor, progress):
                pass
            if shard is None:
                files, notes = finish_sweep(state, executor, progress)
    except LostExecutorError as error:
        common.report_failure("error", [f"{error}; {_progress_message(len(outcomes), total)}"], as_json)
        return common.FILES
    record = {"directory": str(directory), "runs": len(outcomes), **count_statuses(outcomes)}
    lines = summary_lines(directory, outcomes, shard, files, notes)
    common.print_result(as_json, {**record, "outputs": files, "notes": notes}, lines)
    return common.DONE


def _print_dry_run(loaded: Sweep, cost: SweepCost, shard: tuple[int, int], workers: int | None, as_json: bool) -> None:
    """Print the values and the cost of the runs of a shard, as a table or as JSON."""
    from taichi_msm.sweeps.tables import choose_worker_count, cost_line, csv_line, format_cell

    (part, parts), values = shard, loaded.values()
    runs = range(part - 1, len(values), parts)
    cost = cost.scaled(len(runs) / len(values))
    worker_count = choose_worker_count(cost, len(runs), workers)
    record = {"keys": loaded.keys, "runs": list(runs), "values": [values[run] for run in runs]}
    rows = (csv_line([run, *map(format_cell, values[run])]) for run in runs)
    lines = (csv_line(["run", *loaded.keys]), *rows, cost_line(len(runs), cost, worker_count))
    common.print_result(as_json, {**record, **cost._asdict(), "workers": worker_count.number}, lines)


def _progress_message(done: int, total: int) -> str:
    """Format the progress of an unfinished sweep, and the remedy."""
    return f"{done} of {total} runs are finished; the same command continues the sweep"
