"""`stemmap export`: writes a finished run as files for GIS, CAD, spreadsheets and other tools."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from app.cli.flags import positive_number
from app.cli.stand import add_plot_flags, add_stand_flags, chosen_plots, reviewed, stand_parameters
from pipeline.errors import StemmapError, UsageError

HELP = "write a finished run as GIS, CAD or spreadsheet files, or for other tools"
REACH = 30.0
TREE_MANAGER = "tree-manager"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument(
        "--to",
        metavar="FILE",
        default=TREE_MANAGER,
        help="file .gpkg, .shp, .geojson, .dxf, .xlsx, .tif (terrain) or .laz (cloud); or tree-manager",
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
        "GeoPackage: layers trees, path, plots and contours, with styles for QGIS. Coordinates are those of\n"
        "`stemmap georeference`, else local. The same run gives the same bytes.\n"
        "tree-manager: TreeManagerState_<i>.csv with the trees around each pose, and trajectory.txt, the\n"
        "exchange format of place recognition by stems. `stemmap map FOLDER` reads it.\n"
        "Exit code 3: some trees are too far from the path to be in any frame."
    )
    add_plot_flags(parser)
    add_stand_flags(parser, without=("reach",))


def run(arguments: argparse.Namespace) -> int:
    """Write the files that --to names, and print them. Existing files are replaced; the folder --out of Tree
    Manager must be new or empty.

    Returns:
        Exit code: 3 if trees far from the path were left out of tree-manager files, else 0.

    Raises:
        StemmapError: A flag is wrong, the run cannot be read or lacks what the format shows, a package is not
            installed, or a file of Tree Manager, .las or .laz cannot be written.
        OSError: A file of another format cannot be written, for example because its folder does not exist.
    """
    with reviewed(arguments.run) as folder:
        return _export(arguments, folder)


def _export(arguments: argparse.Namespace, folder: Path) -> int:
    """Write what --to names for the run in `folder`: the files of the tree manager, its cloud (.las, .laz),
    or its trees with the figures of the chosen plots, if there are any. --out is only for the tree manager
    (UsageError). Returns and raises as `run`."""
    if arguments.to == TREE_MANAGER:
        return _tree_manager(arguments, folder)
    from app.batch.export import export_run, read_for_export
    from app.batch.mapped_cloud import write_cloud
    from app.batch.stand import stand_of

    if arguments.out is not None:
        raise UsageError("--out is only for tree-manager", remedy="Name the file with --to")
    file = Path(arguments.to)
    if file.suffix.lower() in (".las", ".laz"):
        print(f"{write_cloud(folder, file):,} points in {file}")
        return 0
    plots, parameters = chosen_plots(arguments), stand_parameters(arguments)
    exported = read_for_export(folder, stand_of(folder, parameters, plots) if plots else None)
    written = export_run(exported, file)
    frame = exported.frame.title
    print(f"{len(exported.place)} trees in {frame} coordinates: {', '.join(map(str, written))}")
    return 0


def _tree_manager(arguments: argparse.Namespace, folder: Path) -> int:
    """Write poses and trees of a mapped run as files of Tree Manager to the new or empty folder --out.

    Returns:
        Exit code: 3 if trees far from the path were left out, else 0.

    Raises:
        StemmapError: --out is missing, not empty or cannot be written, the run cannot be read, or it is the
            map of a whole cloud.
    """
    from app.batch.run_folder import read_run
    from app.common.text import count
    from pipeline.io.readers.tree_manager import write_tree_manager

    if arguments.out is None:
        raise UsageError("--out is missing", remedy="Name a folder, or a file with --to trees.gpkg")
    finished = read_run(folder)
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
