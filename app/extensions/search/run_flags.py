"""Flags of the commands that score runs many times."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.flags import source_request

if TYPE_CHECKING:
    from app.extensions.search.plan import PlannedRun


def add_keep_flag(parser: argparse._ActionsContainer) -> None:
    """Add --keep."""
    parser.add_argument(
        "--keep",
        metavar="DIR",
        type=Path,
        help="folder that stores results, so that they are computed once (default: in STEMMAP_FOLDER)",
    )


def kept_results(arguments: argparse.Namespace) -> Path | None:
    """Return the folder of stored results: --keep, else that in the data folder; None without both. Raises
    StemmapError if an environment variable of `app.common.settings` is invalid, also with --keep."""
    from app.common.settings import from_environment
    from app.extensions.search import results_in

    folder = results_in(from_environment().folder)
    kept: Path | None = arguments.keep
    return kept or folder


def planned_run(
    arguments: argparse.Namespace, uri: str, truth: str | None, *, held_out: bool = False
) -> PlannedRun:
    """Return a run that is mapped and scored as the flags of `add_run_flags`, `add_source_flags` and
    `add_truth_flags` give.

    Args:
        arguments: Parsed arguments.
        uri: The run.
        truth: File of its true trees; None for those of the source.
        held_out: See `PlannedRun`.

    Raises:
        StemmapError: The file of true trees cannot be read.
    """
    from app.extensions.search.plan import PlannedRun
    from app.store.records import contents_of
    from pipeline.io.ground_truth import read_truth_trees

    source = source_request(arguments, uri)
    if truth is None:
        return PlannedRun(source, held_out=held_out)
    trees = read_truth_trees(Path(truth), dbh_unit=arguments.dbh_unit)
    return PlannedRun(source, tuple(contents_of(trees)), truth, held_out)
