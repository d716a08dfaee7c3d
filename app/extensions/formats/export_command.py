"""`stemmap export` to a folder of stems for programs of place recognition."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from app.cli.flags import positive_number
from app.cli.stored import reviewed
from pipeline.errors import StemmapError, UsageError

REACH = 30.0
TREE_MANAGER = "tree-manager"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the folder."""
    group = parser.add_argument_group(
        "--to tree-manager (default)",
        "TreeManagerState_<i>.csv with the trees around each pose, and trajectory.txt, the exchange\n"
        "format of place recognition by stems. `stemmap map FOLDER` reads it.\n"
        "Exit code 3: some trees are too far from the path to be in any frame.",
    )
    group.add_argument(
        "--out", metavar="FOLDER", type=Path, help="new or empty folder, only for tree-manager"
    )
    group.add_argument(
        "--reach",
        metavar="M",
        type=positive_number(1e4, "distance in metres"),
        default=REACH,
        help=f"largest distance of a tree from the pose of its frame (default: {REACH:g} m)",
    )


def check(arguments: argparse.Namespace) -> None:
    """Raise UsageError if --out is given beside a file that --to names."""
    if arguments.to not in (None, TREE_MANAGER) and arguments.out is not None:
        raise UsageError("--out is only for tree-manager", remedy="Name the file with --to")


def run(arguments: argparse.Namespace) -> int | None:
    """Write poses and trees of a mapped run to the new or empty folder --out.

    Returns:
        Exit code: 3 if trees far from the path were left out, else 0; None for a file that --to names.

    Raises:
        StemmapError: --out is missing, not empty or cannot be written, the run cannot be read, or it is no
            map of a drive.
    """
    if arguments.to not in (None, TREE_MANAGER):
        return None
    with reviewed(arguments.run) as folder:
        return _write(arguments, folder)


def _write(arguments: argparse.Namespace, folder: Path) -> int:
    """Write the run in `folder`; returns and raises as `run`."""
    from app.batch.run_folder import read_run
    from app.common.text import count
    from app.extensions.formats.tree_manager import write_tree_manager

    if arguments.out is None:
        raise UsageError("--out is missing", remedy="Name a folder, or a file with --to trees.gpkg")
    finished = read_run(folder)
    if not finished.of_drive:
        raise StemmapError(
            "this is no map of a drive: it has no poses",
            where=str(arguments.run),
            remedy="Use its trees.csv and trees.geojson",
        )
    left_out = write_tree_manager(arguments.out, finished.path, finished.trees, arguments.reach)
    frames, trees = count(len(finished.path.x), "frame"), count(len(finished.trees.number), "tree")
    print(f"{frames} with {trees} in {arguments.out}")
    if left_out:
        left = f"trees farther than {arguments.reach:g} m from the path ({left_out:,})"
        print(f"left out: {left}", file=sys.stderr)
    return 3 if left_out else 0
