"""`stemmap evaluate RUNS... --param-grid`: many sets of parameters on many runs, here or on a cluster."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.choices import (
    add_parameter_flags,
    add_run_flags,
    add_source_flags,
    chosen_parameters,
    plain,
    says_parameters,
)
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.tuning.sweep.comparison import Comparison
    from app.tuning.sweep.jobs import PreparedRun, SweepPlan
    from app.tuning.sweep.sweep import Outcome
    from app.tuning.sweep.workers import Workers
    from pipeline.config import Parameters
    from pipeline.config.model import Value
    from pipeline.types.records import TruthTrees

MOST_JOBS = 20_000


def add_grid_flags(parser: argparse.ArgumentParser) -> None:
    """--param-grid and what belongs to it."""
    group = parser.add_argument_group("many sets of parameters")
    group.add_argument(
        "--param-grid",
        metavar="GRID",
        action="append",
        default=[],
        help="STAGE.NAME=0.1,0.15,0.2 or STAGE.NAME=30..60/4 (so many values, ends included; 0.01..1/5log: "
        "equal ratios), in the units of --set; preset=forest,paper; or a TOML file with lists. Given again, "
        "all are combined",
    )
    group.add_argument(
        "--jobs", metavar="N", type=_jobs, help="processes on this machine (default: one a core)"
    )
    group.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="work on the Dask cluster at tcp://host:port; runs and stemmap must be at the same places there",
    )
    group.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder for report.html, results.csv, means.csv, results.json and times.csv",
    )
    group.add_argument(
        "--keep",
        metavar="DIR",
        type=Path,
        help="folder of results that are known, which are not computed again (default: in STEMMAP_FOLDER)",
    )
    add_parameter_flags(parser)
    add_run_flags(parser)
    add_source_flags(parser)


def refuse_without_grid(arguments: argparse.Namespace) -> None:
    """What only a grid has a use for is not passed over in silence.

    Raises:
        ParameterError: Such a flag was given.
    """
    given = {
        "--jobs": arguments.jobs,
        "--dask": arguments.dask,
        "--out": arguments.out,
        "--keep": arguments.keep,
        "--preset, --config and --set": says_parameters(arguments),
        "--topic and --mount": arguments.topics or arguments.mount,
    }
    for flag, value in given.items():
        if value:
            raise ParameterError(f"{flag}: of many sets of parameters alone", remedy="Add --param-grid GRID")


def distances(arguments: argparse.Namespace) -> list[str]:
    """--match-distance and --reach as assignments."""
    asked = (("match_distance", arguments.match_distance), ("reach", arguments.reach))
    return [f"evaluation.{name}={value}" for name, value in asked if value is not None]


def run_grid(arguments: argparse.Namespace) -> int:
    """Score all sets on all runs and compare."""
    from app.tuning.sweep.grid import combinations, read_axes

    sets = combinations(read_axes(arguments.param_grid))
    arguments.assignments = [*arguments.assignments, *distances(arguments)]
    chosen_parameters(arguments, "forest")  # a mistyped flag is said before anything heavy is loaded
    if len(sets) * len(arguments.runs) > MOST_JOBS:
        raise ParameterError(
            f"{len(sets):,} sets on {len(arguments.runs)} runs are more than {MOST_JOBS:,} results",
            remedy="Ask for fewer values",
        )
    runs, refused = _ready(arguments)
    if not runs:
        return 1

    from app.tuning.sweep.comparison import compare_answers
    from app.tuning.sweep.jobs import plan_jobs

    plan = plan_jobs(runs, sets, lambda run, changes: _base(arguments, run, changes))
    numbers = list(plan.jobs)
    outcome = _swept(arguments, plan)
    comparison = compare_answers(plan, dict(zip(numbers, outcome.answers, strict=True)))
    return _tell(arguments, comparison, outcome, refused=refused)


def _ready(arguments: argparse.Namespace) -> tuple[list[PreparedRun], int]:
    """The runs that can be mapped and judged; the others are said."""
    from app.sources.request import SourceRequest, mount_of_degrees
    from app.tuning.sweep.jobs import prepare_run

    runs, refused = [], 0
    for number, name in enumerate(arguments.runs):
        try:
            truth = _truth(arguments, number)
            source = SourceRequest(
                name,
                arguments.odometry,
                arguments.seed,
                dict(arguments.topics),
                mount_of_degrees(arguments.mount),
            )
            runs.append(prepare_run(source, truth))
        except StemmapError as error:
            print(f"stemmap: left out: {plain(str(error))}", file=sys.stderr)
            refused += 1
    return runs, refused


def _truth(arguments: argparse.Namespace, number: int) -> TruthTrees | None:
    from pipeline.io.ground_truth import read_truth_trees

    if not arguments.truth:
        return None
    file = arguments.truth[number if len(arguments.truth) > 1 else 0]
    return read_truth_trees(file, dbh_unit=arguments.dbh_unit)


def _base(arguments: argparse.Namespace, run: PreparedRun, changes: dict[str, Value]) -> Parameters:
    """What a set is laid over: the preset of the set or that which suits the run, and the flags."""
    from app.tuning.sweep.grid import PRESET
    from pipeline.config import preset

    suits = str(changes.get(PRESET, run.preset))
    present = preset(suits) if PRESET in changes else None
    return chosen_parameters(arguments, suits, present)[1]


def _swept(arguments: argparse.Namespace, plan: SweepPlan) -> Outcome:
    from tqdm import tqdm

    from app.common.settings import from_environment
    from app.tuning.sweep.sweep import KeptAnswers, sweep

    folder = from_environment().folder
    kept = KeptAnswers(arguments.keep or (folder and folder / "results"))
    with (
        _workers(arguments, len(plan.jobs)) as workers,
        tqdm(
            total=len(plan.jobs), unit="set", file=sys.stderr, disable=not sys.stderr.isatty(), leave=False
        ) as bar,
    ):
        return sweep(list(plan.jobs.values()), workers, kept, bar.update)


@contextlib.contextmanager
def _workers(arguments: argparse.Namespace, jobs: int) -> Iterator[Workers]:
    from app.tuning.sweep.workers import DaskWorkers, Processes

    workers: Workers
    if arguments.dask is not None:
        workers = DaskWorkers(arguments.dask)
    else:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = Processes(min(arguments.jobs or cores, jobs))
    try:
        yield workers
    finally:
        workers.close()


def _tell(arguments: argparse.Namespace, comparison: Comparison, outcome: Outcome, *, refused: int) -> int:
    """Print what came of it; the exit code."""
    from app.common.text import count
    from app.tuning.sweep.report import files, json_text, lines

    if arguments.json:
        print(json_text(comparison), end="")
    else:
        for line in lines(comparison):
            print(plain(line))
    if arguments.out is not None:
        try:
            names = files(comparison, arguments.out)
        except OSError as error:
            raise StemmapError(f"cannot write: {error.strerror}", where=str(arguments.out)) from None
        print(f"{', '.join(names)} in {arguments.out}", file=sys.stderr)
    if outcome.known:
        print(f"{count(outcome.known, 'result')} known from before", file=sys.stderr)
    for warning in outcome.warnings:
        print(f"warning: {plain(warning)}", file=sys.stderr)
    for reason, times in sorted(outcome.lost.items()):
        print(
            f"warning: {count(times, 'worker')} lost in the middle of a set: {plain(reason)}", file=sys.stderr
        )
    failed = comparison.failed
    for why, times in Counter(row.error for row in failed).items():
        print(f"left out: {count(times, 'result')}: {plain(why)}", file=sys.stderr)
    if len(failed) == len(comparison.rows):
        return 1
    return 3 if failed or refused else 0


def _jobs(text: str) -> int:
    if text.isascii() and text.isdigit() and 0 < int(text) <= 1024:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 1024")
