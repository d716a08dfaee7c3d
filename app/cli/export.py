"""`stemmap export`: writes a finished run as files for geographic information systems and other tools."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.flags import positive_number
from app.cli.stored import reviewed
from pipeline.errors import StemmapError, UsageError

if TYPE_CHECKING:
    from app.batch.export import ExportedRun

HELP = "write a finished run as GIS files, as a cloud, or for other tools"
REACH = 30.0
TREE_MANAGER = "tree-manager"
CLOUD_SUFFIXES = (".las", ".laz")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument(
        "--to",
        metavar="FILE",
        default=TREE_MANAGER,
        help="file .gpkg, .geojson or .laz (cloud); or tree-manager",
    )
    parser.add_argument(
        "--out", metavar="FOLDER", type=Path, help="new or empty folder, only for tree-manager"
    )
    parser.add_argument(
        "--reach",
        metavar="M",
        type=positive_number(1e4, "distance in metres"),
        default=REACH,
        help=f"tree-manager: largest distance of a tree from the pose of its frame (default: {REACH:g} m)",
    )
    parser.epilog = (
        "GeoPackage: layers trees and path, with styles for QGIS. Coordinates are those of the reference\n"
        "system of the map, else local. The same run gives the same bytes.\n"
        "tree-manager: TreeManagerState_<i>.csv with the trees around each pose, and trajectory.txt, the\n"
        "exchange format of place recognition by stems. `stemmap map FOLDER` reads it.\n"
        "Exit code 3: some trees are too far from the path to be in any frame."
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the files that --to names, and print them. Existing files are replaced; the folder --out of Tree
    Manager must be new or empty.

    Returns:
        Exit code: 3 if trees far from the path were left out of tree-manager files, else 0.

    Raises:
        StemmapError: A flag is wrong, the run cannot be read, a package is not installed, or a file of Tree
            Manager, .las or .laz cannot be written.
        OSError: A file of another format cannot be written, for example because its folder does not exist.
    """
    with reviewed(arguments.run) as folder:
        return _export(arguments, folder)


def _export(arguments: argparse.Namespace, folder: Path) -> int:
    """Write what --to names for the run in `folder`: the files of the tree manager, its cloud (.las, .laz),
    or its trees and path. --out is only for the tree manager (UsageError). Returns and raises as `run`."""
    if arguments.to == TREE_MANAGER:
        return _tree_manager(arguments, folder)
    from app.batch.export import WRITERS, export_run, read_for_export
    from app.batch.mapped_cloud import write_cloud

    if arguments.out is not None:
        raise UsageError("--out is only for tree-manager", remedy="Name the file with --to")
    file = Path(arguments.to)
    if file.suffix.lower() in CLOUD_SUFFIXES:
        print(f"{write_cloud(folder, file):,} points in {file}")
        return 0
    exported = read_for_export(folder)
    print_written(exported, export_run(exported, file, WRITERS))
    return 0


def print_written(exported: ExportedRun, written: Sequence[Path]) -> None:
    """Print the number of trees, their reference system and the files of an export."""
    frame = exported.frame.title
    print(f"{len(exported.place)} trees in {frame} coordinates: {', '.join(map(str, written))}")


def _tree_manager(arguments: argparse.Namespace, folder: Path) -> int:
    """Write poses and trees of a mapped run as files of Tree Manager to the new or empty folder --out.

    Returns:
        Exit code: 3 if trees far from the path were left out, else 0.

    Raises:
        StemmapError: --out is missing, not empty or cannot be written, the run cannot be read, or it is no
            map of a drive.
    """
    from app.batch.run_folder import read_run
    from app.common.text import count
    from pipeline.io.readers.tree_manager import write_tree_manager

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
