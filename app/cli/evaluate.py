"""`stemmap evaluate`: finished maps against the ground truth; with `--param-grid` runs under many sets."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.choices import plain, source
from app.cli.grid import add_grid_flags, distances, refuse_without_grid, run_grid
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.batch.run_folder import FinishedRun
    from pipeline.evaluation import Evaluation
    from pipeline.types.records import TruthTrees

HELP = "judge mapped runs by ground truth trees, or compare many sets of parameters on runs"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "runs",
        metavar="RUN",
        nargs="+",
        type=source,
        help="folders that `stemmap map` wrote; with --param-grid recordings and simulated runs too",
    )
    parser.add_argument(
        "--truth",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="trees (CSV) in the frame of the map, for all runs or one FILE each; default: the source's own",
    )
    parser.add_argument(
        "--dbh-unit", choices=("m", "cm", "mm"), help="of a truth column that does not say it"
    )
    parser.add_argument("--match-distance", metavar="M", help="a tree farther from its truth is no match [m]")
    parser.add_argument(
        "--reach", metavar="M", help="truth farther than this from the path is not asked for [m]"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")
    add_grid_flags(parser)


def run(arguments: argparse.Namespace) -> int:
    """Judge them and print the scores."""
    if len(arguments.truth) not in (0, 1, len(arguments.runs)):
        raise ParameterError(
            f"{len(arguments.truth)} tables of true trees for {len(arguments.runs)} runs",
            remedy="Give --truth once for all of them, or once for each in their order",
        )
    if arguments.param_grid:
        return run_grid(arguments)
    refuse_without_grid(arguments)
    if len(arguments.runs) == 1:
        return _print(arguments, *_judged(arguments, 0))
    failed, plains = 0, {}
    for number, name in enumerate(arguments.runs):
        try:
            evaluation, whole = _judged(arguments, number)
        except StemmapError as error:  # one that cannot be judged does not end the others
            print(f"stemmap: {plain(name)}: {error}", file=sys.stderr)
            failed += 1
            continue
        if arguments.json:
            plains[name] = asdict(evaluation)
            continue
        print(f"{plain(name)}:")
        _print(arguments, evaluation, whole)
    if arguments.json:
        print(json.dumps(plains, indent=1))
    return 0 if not failed else 1 if failed == len(arguments.runs) else 3


def _print(arguments: argparse.Namespace, evaluation: Evaluation, whole: bool) -> int:
    from app.batch.summary import evaluation_lines

    if arguments.json:
        print(json.dumps(asdict(evaluation), indent=1))
    else:
        for line in evaluation_lines(evaluation, whole=whole):
            print(line)
    return 0


def _judged(arguments: argparse.Namespace, number: int) -> tuple[Evaluation, bool]:
    """The scores of a run, and whether all of the truth was asked for."""
    import numpy as np

    from app.batch.run_folder import read_run
    from app.batch.summary import far_truth
    from app.common.text import count
    from pipeline.config import assign
    from pipeline.evaluation import evaluate

    folder = Path(arguments.runs[number])
    finished = read_run(folder)
    parameters = assign(finished.parameters, distances(arguments))
    truth = _truth(arguments, finished, number)
    # A whole cloud was mapped without a path: all of the truth is asked for.
    path = None if finished.of_cloud else np.stack([finished.path.x, finished.path.y], axis=1)
    evaluation = evaluate(finished.trees, truth, parameters.evaluation, path)
    if evaluation.TA.of + evaluation.TR.of == 0:
        raise StemmapError("the ground truth has no trees" if path is None else far_truth(evaluation.reach))
    if evaluation.TA.of and not evaluation.TA.count:
        raise StemmapError(
            f"none of {count(evaluation.TA.of, 'true tree')} has a mapped tree within "
            f"{parameters.evaluation.match_distance:g} m",
            where=str(folder),
            remedy="Check that the ground truth stands in the frame of the map: the first pose is its origin",
        )
    return evaluation, path is None


def _truth(arguments: argparse.Namespace, finished: FinishedRun, number: int) -> TruthTrees:
    from contextlib import closing

    from pipeline.io.ground_truth import read_truth_trees
    from pipeline.io.readers import SourceOptions, open_source

    if arguments.truth:
        file = arguments.truth[number if len(arguments.truth) > 1 else 0]
        return read_truth_trees(file, dbh_unit=arguments.dbh_unit)
    uri = finished.uri
    if finished.of_cloud:
        raise StemmapError(
            "a whole cloud brings no true trees",
            where=uri,
            remedy="Give them with --truth trees.csv, in the coordinates of the cloud",
        )
    with closing(open_source(uri, SourceOptions(seed=finished.seed))) as source:
        truth = source.truth()
    if truth is None or truth.trees is None:
        raise StemmapError(
            "the source knows no true trees", where=uri, remedy="Give them with --truth trees.csv"
        )
    return truth.trees
