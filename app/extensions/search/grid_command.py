"""`stemmap evaluate --param-grid`: compares parameter sets on runs."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from app.cli.evaluate import distances, truth_files
from app.extensions.search.run_flags import add_keep_flag, kept_results, planned_run
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.extensions.search.jobs import JobResult
    from app.extensions.search.report import Comparison, SweepPlan
    from app.extensions.search.scoring import PreparedRun
    from pipeline.config import Parameters
    from pipeline.config.model import Value

MOST_JOBS = 20_000


def configure(parser: argparse.ArgumentParser) -> None:
    """Add --param-grid and its flags."""
    group = parser.add_argument_group(
        "comparison of parameter sets", "each RUN may then be a recording or a simulated run, too"
    )
    group.add_argument(
        "--param-grid",
        metavar="GRID",
        action="append",
        default=[],
        help="STAGE.NAME=0.1,0.15,0.2 or STAGE.NAME=30..60/4 (4 values, ends included; 0.01..1/5log: "
        "equal ratios), in the units of --set; preset=forest,paper; or a TOML file with lists. "
        "Repeated flags are combined",
    )
    group.add_argument(
        "--jobs",
        metavar="N",
        type=flags.whole_number(1, 1024),
        help="processes on this machine (default: one per core)",
    )
    group.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder for report.html, results.csv, means.csv, results.json and times.csv",
    )
    add_keep_flag(group)
    flags.add_parameter_flags(parser)
    flags.add_run_flags(parser)
    flags.add_source_flags(parser)


def run(arguments: argparse.Namespace) -> int | None:
    """Compare the sets of --param-grid on the runs; None without --param-grid. Returns and raises as
    `run_grid`; ParameterError for a flag that needs --param-grid."""
    if not arguments.param_grid:
        refuse_without_grid(arguments)
        return None
    arguments.files = truth_files(arguments)
    return run_grid(arguments)


def refuse_without_grid(arguments: argparse.Namespace) -> None:
    """Refuse flags that need --param-grid.

    Raises:
        ParameterError: Such a flag was given.
    """
    given = {
        "--jobs": arguments.jobs,
        "a pool of processes": arguments.pool,
        "--out": arguments.out,
        "--keep": arguments.keep,
        "--preset, --config and --set": flags.says_parameters(arguments),
        "--topic and --mount": arguments.topics or arguments.mount,
        "--as, --unit and --up": {arguments.form, arguments.unit, arguments.up} != {"auto"},
    }
    for flag, value in given.items():
        if value:
            raise ParameterError(f"{flag}: only with --param-grid", remedy="Add --param-grid GRID")


def run_grid(arguments: argparse.Namespace) -> int:
    """Compare all sets on all runs, print the comparison and write its files.

    Returns:
        Exit code: 0; 3 if results or runs are missing; 1 if no run can be used or all results failed.

    Raises:
        StemmapError: An argument is wrong, every set contradicts itself, more than MOST_JOBS results are
            requested, or a file cannot be written.
    """
    from app.extensions.search.grid import combinations, read_axes

    sets = combinations(read_axes(arguments.param_grid))
    arguments.assignments = [*arguments.assignments, *distances(arguments)]
    flags.chosen_parameters(arguments, "forest")  # reports a mistyped flag before heavy modules are loaded
    if len(sets) * len(arguments.runs) > MOST_JOBS:
        raise ParameterError(
            f"{len(sets):,} sets on {len(arguments.runs)} runs are more than {MOST_JOBS:,} results",
            remedy="Ask for fewer values",
        )
    runs, refused = _ready(arguments)
    if not runs:
        return 1

    from app.extensions.search.report import compare_results, plan_jobs

    plan = plan_jobs(runs, sets, lambda run, changes: _base(arguments, run, changes))
    answers = _swept(arguments, plan)
    comparison = compare_results(plan, dict(zip(plan.jobs, answers, strict=True)))
    return _print_comparison(arguments, comparison, refused=refused)


def _ready(arguments: argparse.Namespace) -> tuple[list[PreparedRun], int]:
    """Return the runs that can be scored, in the order of the arguments, and the number of the others, whose
    errors are printed to standard error and not raised."""
    from app.extensions.search.scoring import prepare_run

    runs, refused = [], 0
    for name in arguments.runs:
        try:
            runs.append(prepare_run(planned_run(arguments, name, arguments.files.get(name))))
        except StemmapError as error:
            print(f"stemmap: left out: {flags.plain(str(error))}", file=sys.stderr)
            refused += 1
    return runs, refused


def _base(arguments: argparse.Namespace, run: PreparedRun, changes: dict[str, Value]) -> Parameters:
    """Return the parameters that a set changes: the preset that the set names, else --preset, else that of
    the run, with --config and --set applied.

    Args:
        arguments: Arguments of the command.
        run: The run.
        changes: Values of the set by name, perhaps with PRESET.

    Raises:
        StemmapError: A flag is invalid for this preset.
    """
    from app.extensions.search.grid import PRESET
    from pipeline.config import preset

    suits = str(changes.get(PRESET, run.preset))
    present = preset(suits) if PRESET in changes else None
    return flags.chosen_parameters(arguments, suits, present)[1]


def _swept(arguments: argparse.Namespace, plan: SweepPlan) -> list[JobResult]:
    """Compute all jobs of a plan with a progress bar, in the pool of the command, else in --jobs processes
    (default: one per usable core, at most one per job). Return their results in the order of `plan.jobs`;
    print the number of stored results that were used and warnings to standard error."""
    from app.common.child_process import usable_cores
    from app.common.text import count
    from app.extensions.search.jobs import ResultStore, ScoringProcesses
    from app.extensions.search.report import sweep

    kept = ResultStore(kept_results(arguments))
    processes: ScoringProcesses[int] = ScoringProcesses(
        min(arguments.jobs or usable_cores(), len(plan.jobs)), kept=kept, pool=arguments.pool
    )
    with (
        contextlib.closing(processes),
        flags.progress_bar(len(plan.jobs), "set") as bar,
    ):
        answers = sweep(list(plan.jobs.values()), processes, bar.update)
    if kept.used:
        print(f"{count(kept.used, 'stored result')} used", file=sys.stderr)
    flags.print_warnings(processes.warnings())
    return answers


def _print_comparison(arguments: argparse.Namespace, comparison: Comparison, *, refused: int) -> int:
    """Print the comparison, as JSON with --json, and write its files with --out.

    Args:
        arguments: Arguments of the command.
        comparison: The comparison.
        refused: Number of runs that could not be used.

    Returns:
        Exit code: 0; 3 if results or runs are missing; 1 if all results are.

    Raises:
        StemmapError: The files cannot be written.
    """
    from app.common.text import count
    from app.extensions.search.report import files, json_text, lines

    if arguments.json:
        print(json_text(comparison), end="")
    else:
        for line in lines(comparison):
            print(flags.plain(line))
    if arguments.out is not None:
        names = files(comparison, arguments.out)
        print(f"{', '.join(names)} in {arguments.out}", file=sys.stderr)
    failed = comparison.failed
    for why, times in Counter(row.error for row in failed).items():
        print(f"left out: {count(times, 'result')}: {flags.plain(why)}", file=sys.stderr)
    if len(failed) == len(comparison.rows):
        return 1
    return 3 if failed or refused else 0
