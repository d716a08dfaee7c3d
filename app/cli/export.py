"""`stemmap export`: writes a finished run in the format of other tools."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from app.cli.flags import positive_number
from pipeline.errors import StemmapError

HELP = "write a finished run in the format of other tools"
REACH = 30.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--to", choices=("tree-manager",), default="tree-manager", help="the format")
    parser.add_argument("--out", metavar="FOLDER", type=Path, required=True, help="new or empty folder")
    parser.add_argument(
        "--reach",
        metavar="M",
        type=positive_number(1e4, "distance in metres"),
        default=REACH,
        help=f"largest distance of a tree from the pose of its frame (default: {REACH:g} m)",
    )
    parser.epilog = (
        "tree-manager: TreeManagerState_<i>.csv with the trees around each pose, and trajectory.txt, the\n"
        "exchange format of place recognition by stems. `stemmap map FOLDER` reads it.\n"
        "Exit code 3: some trees are too far from the path to be in any frame."
    )


def run(arguments: argparse.Namespace) -> int:
    """Write poses and trees of a mapped run as files of Tree Manager.

    Returns:
        Exit code: 3 if trees far from the path were left out, else 0.

    Raises:
        StemmapError: The run cannot be read, or is the map of a whole cloud.
    """
    from app.batch.run_folder import read_run
    from app.common.text import count
    from pipeline.io.readers.tree_manager import write_tree_manager

    finished = read_run(arguments.run)
    if finished.of_cloud:
        raise StemmapError(
            "this is the map of a whole cloud, which has no poses",
            where=str(arguments.run),
            remedy="Use its trees.csv, trees.geojson and slices.csv",
        )
    left_out = write_tree_manager(arguments.out, finished.path, finished.trees, arguments.reach)
    frames, trees = count(len(finished.path.x), "frame"), count(len(finished.trees.number), "tree")
    print(f"{frames} with {trees} in {arguments.out}")
    if left_out:
        left = f"trees farther than {arguments.reach:g} m from the path ({left_out:,})"
        print(f"left out: {left}", file=sys.stderr)
    return 3 if left_out else 0
