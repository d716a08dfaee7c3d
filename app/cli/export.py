"""`stemmap export`: a finished run in the files of other tools."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pipeline.errors import StemmapError

HELP = "write a finished run in the files of other tools"
REACH = 30.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--to", choices=("tree-manager",), default="tree-manager", help="the format")
    parser.add_argument("--out", metavar="FOLDER", type=Path, required=True, help="new or empty folder")
    parser.add_argument(
        "--reach",
        metavar="M",
        type=_metres,
        default=REACH,
        help=f"trees farther from a pose are not in its frame (default: {REACH:g} m)",
    )
    parser.epilog = (
        "tree-manager: TreeManagerState_<i>.csv with the trees around each pose, and trajectory.txt, as\n"
        "tools that find a place again by its stems exchange them. `stemmap map FOLDER` reads them back.\n"
        "Exit code 3 says that trees stand too far from the path to be in any frame."
    )


def run(arguments: argparse.Namespace) -> int:
    """Write it."""
    from app.batch.run_folder import read_run
    from app.common.text import count
    from pipeline.io.tree_manager_writer import write_tree_manager

    finished = read_run(arguments.run)
    if finished.of_cloud:
        raise StemmapError(
            "this is the map of a whole cloud: nobody drove, so there are no frames to write",
            where=str(arguments.run),
            remedy="Use its trees.csv, trees.geojson and slices.csv as they are",
        )
    left_out = write_tree_manager(arguments.out, finished.path, finished.trees, arguments.reach)
    frames, trees = count(len(finished.path.x), "frame"), count(len(finished.trees.number), "tree")
    print(f"{frames} with {trees} in {arguments.out}")
    if left_out:
        told = f"trees farther than {arguments.reach:g} m from the path ({left_out:,})"
        print(f"left out: {told}", file=sys.stderr)
    return 3 if left_out else 0


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e4:
        raise argparse.ArgumentTypeError(f"{text!r} is no distance in metres")
    return value
