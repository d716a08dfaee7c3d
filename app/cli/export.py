"""`stemmap export`: writes the trees and the path of a finished run for geographic information systems."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.stored import reviewed
from pipeline.errors import UsageError

if TYPE_CHECKING:
    from app.batch.export import ExportedRun

HELP = "write a finished run as GIS files"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--to", metavar="FILE", help="file .gpkg or .geojson, or a further format below")
    parser.epilog = (
        "GeoPackage: layers trees and path, with styles for QGIS. Coordinates are those of the reference\n"
        "system of the map, else local. The same run gives the same bytes."
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the files that --to names, and print them. Existing files are replaced.

    Returns:
        Exit code: 0.

    Raises:
        StemmapError: --to is missing or has an unknown format, the run cannot be read, or a package is not
            installed.
        OSError: The file cannot be written, for example because its folder does not exist.
    """
    if arguments.to is None:
        raise UsageError("--to is missing", remedy="Name a file, such as trees.gpkg")
    from app.batch.export import WRITERS, export_run, read_for_export

    with reviewed(arguments.run) as folder:
        exported = read_for_export(folder)
        print_written(exported, export_run(exported, Path(arguments.to), WRITERS))
    return 0


def print_written(exported: ExportedRun, written: Sequence[Path]) -> None:
    """Print the number of trees, their reference system and the files of an export."""
    frame = exported.frame.title
    print(f"{len(exported.place)} trees in {frame} coordinates: {', '.join(map(str, written))}")
