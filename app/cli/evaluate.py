"""`stemmap evaluate`: scores finished maps; with `--param-grid` compares parameter sets on runs."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.batch.run_folder import FinishedRun
    from app.tuning.jobs import JobResult
    from app.tuning.report import Comparison, SweepPlan
    from app.tuning.scoring import PreparedRun
    from pipeline.config import Parameters
    from pipeline.config.model import Value
    from pipeline.evaluation import MapScores
    from pipeline.types.records import TruthTrees

HELP = "score mapped runs against ground truth trees, or compare parameter sets on runs"

MOST_JOBS = 20_000


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "runs",
        metavar="RUN",
        nargs="+",
        type=flags.source,
        help="folders that `stemmap map` wrote; with --param-grid recordings and simulated runs too",
    )
    flags.add_truth_flags(parser)
    parser.add_argument(
        "--match-distance", metavar="M", help="largest distance between a tree and its ground truth [m]"
    )
    parser.add_argument("--reach", metavar="M", help="largest distance of ground truth from the path [m]")
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")
    add_grid_flags(parser)


def run(arguments: argparse.Namespace) -> int:
    """Score the runs and print the scores, with one set of parameters or, with --param-grid, with many. A run
    that cannot be scored is reported on standard error if there are several. With --json several runs become
    one object by their names, without those that could not be scored. `arguments` gets `files`, the file of
    true trees by run; a single FILE of --truth serves all runs.

    Returns:
        Exit code: 0; 3 if some runs could not be scored; 1 if none could.

    Raises:
        StemmapError: The arguments contradict each other, or a single run cannot be scored.
    """
    one_for_all = len(arguments.truths) == 1 and not any(
        arguments.truths[0].startswith(f"{uri}=") for uri in arguments.runs
    )
    truths = arguments.truths * len(arguments.runs) if one_for_all else arguments.truths
    arguments.files = flags.files_of(arguments.runs, truths)
    if arguments.param_grid:
        return run_grid(arguments)
    refuse_without_grid(arguments)
    if len(arguments.runs) == 1:
        return _print(arguments, *_score(arguments, 0))
    failed, plains = 0, {}
    for number, name in enumerate(arguments.runs):
        try:
            evaluation, whole = _score(arguments, number)
        except StemmapError as error:  # the other runs are scored all the same
            print(f"stemmap: {flags.plain(name)}: {error}", file=sys.stderr)
            failed += 1
            continue
        if arguments.json:
            plains[name] = asdict(evaluation)
            continue
        print(f"{flags.plain(name)}:")
        _print(arguments, evaluation, whole)
    if arguments.json:
        print(json.dumps(plains, indent=1))
    return 0 if not failed else 1 if failed == len(arguments.runs) else 3


def _print(arguments: argparse.Namespace, evaluation: MapScores, whole: bool) -> int:
    """Print the scores of a run as lines or, with --json, as JSON; return 0.

    Args:
        arguments: Arguments of the command.
        evaluation: The scores.
        whole: Whether the run is a whole cloud.
    """
    from app.batch.summary import evaluation_lines

    if arguments.json:
        print(json.dumps(asdict(evaluation), indent=1))
    else:
        for line in evaluation_lines(evaluation, whole=whole):
            print(line)
    return 0


def _score(arguments: argparse.Namespace, number: int) -> tuple[MapScores, bool]:
    """Return the scores of a run, and whether it is a whole cloud.

    Raises:
        StemmapError: The run or its ground truth cannot be read, the ground truth has no object within reach
            of the path, or all its trees there are far from those of the map.
    """
    from app.batch.run_folder import read_run, score_map
    from app.batch.summary import far_map, far_truth
    from pipeline.config import assign

    folder = Path(arguments.runs[number])
    finished = read_run(folder)
    parameters = assign(finished.parameters, distances(arguments))
    truth = _truth(arguments, finished, number)
    evaluation = score_map(finished.trees, finished.path, truth, parameters)
    if evaluation.TA.of + evaluation.TR.of == 0:
        nothing = "the ground truth has no trees" if finished.of_cloud else far_truth(evaluation.reach)
        raise StemmapError(nothing)
    if no_tree := far_map(evaluation, parameters.evaluation.match_distance):
        raise StemmapError(
            no_tree,
            where=str(folder),
            remedy="Check that the ground truth is in the frame of the map: the first pose is its origin",
        )
    return evaluation, finished.of_cloud


def _truth(arguments: argparse.Namespace, finished: FinishedRun, number: int) -> TruthTrees:
    """Return the true trees of a run: those of --truth, else those of its source, which is opened again.

    Args:
        arguments: Arguments of the command.
        finished: The run.
        number: Its position in the arguments, from 0 on.

    Raises:
        StemmapError: There are no true trees, or the file or the source cannot be read.
    """
    from contextlib import closing

    from pipeline.io.ground_truth import read_truth_trees
    from pipeline.io.readers import SourceOptions, open_source

    file = arguments.files.get(arguments.runs[number])
    if file is not None:
        return read_truth_trees(Path(file), dbh_unit=arguments.dbh_unit)
    uri = finished.uri
    if finished.of_cloud:
        raise StemmapError(
            "a whole cloud has no true trees",
            where=uri,
            remedy="Give them with --truth trees.csv, in the coordinates of the cloud",
        )
    with closing(open_source(uri, SourceOptions(seed=finished.seed))) as source:
        truth = source.truth()
    if truth is None or truth.trees is None:
        raise StemmapError(
            "the source has no true trees", where=uri, remedy="Give them with --truth trees.csv"
        )
    return truth.trees


# --- comparison of parameter sets ------------------------------------------------


def add_grid_flags(parser: argparse.ArgumentParser) -> None:
    """Add --param-grid and its flags."""
    group = parser.add_argument_group("comparison of parameter sets")
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
    flags.add_keep_flag(group)
    flags.add_parameter_flags(parser)
    flags.add_run_flags(parser)
    flags.add_source_flags(parser)


def refuse_without_grid(arguments: argparse.Namespace) -> None:
    """Refuse flags that need --param-grid.

    Raises:
        ParameterError: Such a flag was given.
    """
    given = {
        "--jobs": arguments.jobs,
        "--out": arguments.out,
        "--keep": arguments.keep,
        "--preset, --config and --set": flags.says_parameters(arguments),
        "--topic and --mount": arguments.topics or arguments.mount,
    }
    for flag, value in given.items():
        if value:
            raise ParameterError(f"{flag}: only with --param-grid", remedy="Add --param-grid GRID")


def distances(arguments: argparse.Namespace) -> list[str]:
    """Return --match-distance and --reach, where given, as assignments of parameters in the syntax of --set;
    [] without them."""
    values = (("match_distance", arguments.match_distance), ("reach", arguments.reach))
    return [f"evaluation.{name}={value}" for name, value in values if value is not None]


def run_grid(arguments: argparse.Namespace) -> int:
    """Compare all sets on all runs, print the comparison and write its files.

    Returns:
        Exit code: 0; 3 if results or runs are missing; 1 if no run can be used or all results failed.

    Raises:
        StemmapError: An argument is wrong, every set contradicts itself, more than MOST_JOBS results are
            requested, or a file cannot be written.
    """
    from app.tuning.grid import combinations, read_axes

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

    from app.tuning.report import compare_results, plan_jobs

    plan = plan_jobs(runs, sets, lambda run, changes: _base(arguments, run, changes))
    answers = _swept(arguments, plan)
    comparison = compare_results(plan, dict(zip(plan.jobs, answers, strict=True)))
    return _print_comparison(arguments, comparison, refused=refused)


def _ready(arguments: argparse.Namespace) -> tuple[list[PreparedRun], int]:
    """Return the runs that can be scored, in the order of the arguments, and the number of the others, whose
    errors are printed to standard error and not raised."""
    from app.tuning.scoring import prepare_run

    runs, refused = [], 0
    for name in arguments.runs:
        try:
            runs.append(prepare_run(flags.planned_run(arguments, name, arguments.files.get(name))))
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
    from app.tuning.grid import PRESET
    from pipeline.config import preset

    suits = str(changes.get(PRESET, run.preset))
    present = preset(suits) if PRESET in changes else None
    return flags.chosen_parameters(arguments, suits, present)[1]


def _swept(arguments: argparse.Namespace, plan: SweepPlan) -> list[JobResult]:
    """Compute all jobs of a plan with a progress bar, in --jobs processes (default: one per usable core, at
    most one per job). Return their results in the order of `plan.jobs`; print the number of stored results
    that were used and warnings to standard error."""
    from app.common.text import count
    from app.tuning.jobs import ResultStore, ScoringProcesses
    from app.tuning.report import sweep

    kept = ResultStore(flags.kept_results(arguments))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    processes: ScoringProcesses[int] = ScoringProcesses(
        min(arguments.jobs or cores, len(plan.jobs)), kept=kept
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
    from app.tuning.report import files, json_text, lines

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
