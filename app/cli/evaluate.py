"""`stemmap evaluate`: a finished map against the ground truth."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import StemmapError

if TYPE_CHECKING:
    from app.finished import FinishedRun
    from pipeline.records import TruthTrees

HELP = "judge a mapped run by ground truth trees"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="what `stemmap map` wrote")
    parser.add_argument(
        "--truth",
        metavar="FILE",
        type=Path,
        help="trees (CSV) in the frame of the map; default: the source's own",
    )
    parser.add_argument(
        "--dbh-unit", choices=("m", "cm", "mm"), help="of a truth column that does not say it"
    )
    parser.add_argument("--match-distance", metavar="M", help="a tree farther from its truth is no match [m]")
    parser.add_argument(
        "--reach", metavar="M", help="truth farther than this from the path is not asked for [m]"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Judge it and print the scores."""
    from dataclasses import asdict

    import numpy as np

    from app.finished import read_run
    from app.summary import evaluation_lines
    from app.tally import far_truth
    from pipeline.evaluation import evaluate
    from pipeline.parameters import assign

    finished = read_run(arguments.run)
    changes = [
        f"evaluation.{name}={value}"
        for name, value in (("match_distance", arguments.match_distance), ("reach", arguments.reach))
        if value is not None
    ]
    parameters = assign(finished.parameters, changes)
    truth = _truth(arguments, finished)
    # A whole cloud was mapped without a path: all of the truth is asked for.
    path = None if finished.of_cloud else np.stack([finished.path.x, finished.path.y], axis=1)
    evaluation = evaluate(finished.trees, truth, parameters.evaluation, path)
    if path is not None and evaluation.TA.of + evaluation.TR.of == 0:
        print(f"warning: {far_truth(evaluation.reach)}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(asdict(evaluation), indent=1))
    else:
        for line in evaluation_lines(evaluation, whole=path is None):
            print(line)
    return 0


def _truth(arguments: argparse.Namespace, finished: FinishedRun) -> TruthTrees:
    from contextlib import closing

    from pipeline.sources import SourceOptions, open_source
    from pipeline.truth_table import read_truth_trees

    if arguments.truth is not None:
        return read_truth_trees(arguments.truth, dbh_unit=arguments.dbh_unit)
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
