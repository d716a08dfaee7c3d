"""`stemmap evaluate`: scores finished maps."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from pipeline.errors import StemmapError

if TYPE_CHECKING:
    from app.batch.run_folder import FinishedRun
    from pipeline.evaluation import MapScores
    from pipeline.types.records import TruthTrees

HELP = "score mapped runs against ground truth trees"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "runs",
        metavar="RUN",
        nargs="+",
        type=flags.source,
        help="folders that `stemmap map` wrote",
    )
    flags.add_truth_flags(parser)
    parser.add_argument(
        "--match-distance", metavar="M", help="largest distance between a tree and its ground truth [m]"
    )
    parser.add_argument("--reach", metavar="M", help="largest distance of ground truth from the path [m]")
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Score the runs and print the scores. A run that cannot be scored is reported on standard error if there
    are several. With --json several runs become one object by their names, without those that could not be
    scored. `arguments` gets `files`, see `truth_files`.

    Returns:
        Exit code: 0; 3 if some runs could not be scored or the ground truth of one is in doubt; 1 if none
        could be scored.

    Raises:
        StemmapError: The arguments contradict each other, or a single run cannot be scored.
    """
    from app.batch.summary import evaluation_lines, truth_in_doubt

    arguments.files = truth_files(arguments)
    several = len(arguments.runs) > 1
    failed, plains, doubts = 0, {}, []
    for number, name in enumerate(arguments.runs):
        try:
            evaluation, whole = _score(arguments, number)
        except StemmapError as error:
            if not several:
                raise
            print(f"stemmap: {flags.plain(name)}: {error}", file=sys.stderr)
            failed += 1
            continue
        plains[name] = asdict(evaluation)
        if doubt := truth_in_doubt(evaluation):
            doubts.append(f"{name}: {doubt}" if several else doubt)
        if not arguments.json:
            lines = evaluation_lines(evaluation, whole=whole)
            print("\n".join([f"{flags.plain(name)}:", *lines] if several else lines))
    if arguments.json:
        print(json.dumps(plains if several else plains[arguments.runs[0]], indent=1))
        flags.print_warnings(doubts)
    return 1 if failed == len(arguments.runs) else 3 if failed or doubts else 0


def truth_files(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the file of true trees by run; a single FILE of --truth serves all runs. Errors as in
    `flags.files_of`."""
    one_for_all = len(arguments.truths) == 1 and not any(
        arguments.truths[0].startswith(f"{uri}=") for uri in arguments.runs
    )
    truths = arguments.truths * len(arguments.runs) if one_for_all else arguments.truths
    return flags.files_of(arguments.runs, truths)


def _score(arguments: argparse.Namespace, number: int) -> tuple[MapScores, bool]:
    """Return the scores of a run, and whether all true trees count, as without a drive.

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
        nothing = far_truth(evaluation.reach) if finished.of_drive else "the ground truth has no trees"
        raise StemmapError(nothing)
    if no_tree := far_map(evaluation, parameters.evaluation.match_distance):
        raise StemmapError(
            no_tree,
            where=str(folder),
            remedy="Check that the ground truth is in the frame of the map: the first pose is its origin",
        )
    return evaluation, not finished.of_drive


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

    from app.batch.run_folder import crs_unit, truth_in_metres
    from app.sources.opening import open_source
    from pipeline.io.ground_truth import read_truth_trees
    from pipeline.io.readers import SourceOptions

    file = arguments.files.get(arguments.runs[number])
    if file is not None:
        trees = read_truth_trees(Path(file), dbh_unit=arguments.dbh_unit)
        if finished.of_drive:
            return trees
        return truth_in_metres(trees, crs_unit(finished.record), finished.record["source"]["offset_m"])
    uri = finished.uri
    if not finished.of_drive:
        raise StemmapError(
            "the source has no true trees",
            where=uri,
            remedy="Give them with --truth trees.csv, in the coordinates of its file",
        )
    with closing(open_source(uri, SourceOptions(seed=finished.seed))) as source:
        truth = source.truth()
    if truth is None or truth.trees is None:
        raise StemmapError(
            "the source has no true trees", where=uri, remedy="Give them with --truth trees.csv"
        )
    return truth.trees


def distances(arguments: argparse.Namespace) -> list[str]:
    """Return --match-distance and --reach, where given, as assignments of parameters in the syntax of --set;
    [] without them."""
    values = (("match_distance", arguments.match_distance), ("reach", arguments.reach))
    return [f"evaluation.{name}={value}" for name, value in values if value is not None]
