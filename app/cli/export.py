"""`stemmap export`: writes a finished run as files for geographic information systems."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.stored import reviewed
from pipeline.errors import UsageError

if TYPE_CHECKING:
    from app.batch.export import ExportedRun

HELP = "write a finished run as GIS files or as a cloud"
CLOUD_SUFFIXES = (".las", ".laz")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--to", metavar="FILE", help="file .gpkg, .geojson or .laz (cloud)")
    parser.epilog = (
        "GeoPackage: layers trees and path, with styles for QGIS. Coordinates are those of the reference\n"
        "system of the map, else local. The same run gives the same bytes."
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the files that --to names, and print them. Existing files are replaced.

    Returns:
        Exit code: 0.

    Raises:
        StemmapError: A flag is wrong, the run cannot be read, a package is not installed, or a file .las or
            .laz cannot be written.
        OSError: A file of another format cannot be written, for example because its folder does not exist.
    """
    if arguments.to is None:
        raise UsageError("--to is missing", remedy="Name a file, such as trees.gpkg")
    with reviewed(arguments.run) as folder:
        return _export(arguments, folder)


def _export(arguments: argparse.Namespace, folder: Path) -> int:
    """Write what --to names for the run in `folder`: its cloud (.las, .laz), or its trees and path. Returns
    and raises as `run`."""
    from app.batch.export import WRITERS, export_run, read_for_export
    from app.batch.mapped_cloud import write_cloud

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
