"""`stemmap georeference`: gives a mapped run coordinates of the country."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from app.cli.flags import numbers, positive_number
from app.cli.stored import stored_on_page
from app.extensions.stand import POINT_SIGMA
from pipeline.errors import StemmapError, UsageError

BY_HAND = "EAST,NORTH,TURN[,Z]"
HELP = "give a mapped run coordinates of the country, by control points, GNSS or by hand"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--crs", metavar="CRS", help="projected reference system, such as EPSG:25832")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--control",
        metavar="FILE",
        type=Path,
        help="CSV with easting, northing (or lon, lat), and tree or x_m, y_m; optional name, elevation_m",
    )
    how.add_argument(
        "--gnss", action="store_true", help="fixes of the recording of the run, fitted to its whole path"
    )
    how.add_argument(
        "--by-hand",
        metavar=BY_HAND,
        type=numbers(BY_HAND),
        help="position of the map's origin, angle of its x axis from east to north in degrees, and height",
    )
    how.add_argument(
        "--in-file",
        action="store_true",
        help="the coordinates of the file are already in the system of --crs",
    )
    how.add_argument(
        "--from-page", action="store_true", help="those that the recording got on the page, on the tab Plots"
    )
    how.add_argument("--remove", action="store_true", help="make the map local again")
    parser.add_argument(
        "--point-sigma",
        metavar="M",
        type=positive_number(100.0, "standard deviation in metres"),
        default=POINT_SIGMA,
        help="expected error of a point; contradicting points are refused (default: %(default)s)",
    )
    parser.epilog = (
        "Writes georeference.json to DIR, which `stemmap stand`, `export` and `report` use. Without\n"
        "a method, the present one is printed. Mapping again into DIR removes it."
    )


def run(arguments: argparse.Namespace) -> int:
    """Find the frame of the map by the given method (--from-page, --control, --gnss, --in-file or --by-hand),
    write it and print it, see `frame_lines`. All methods but --from-page need --crs. --remove deletes
    georeference.json, also if there is none; without a method the present frame is printed and nothing is
    written.

    Returns:
        0.

    Raises:
        StemmapError: A flag is wrong, the folder is not that of a run, the frame cannot be found, or the file
            cannot be written.
    """
    from app.batch.map_frame import FILE, read_map_frame, write_map_frame
    from app.batch.run_edits import stored_frame
    from app.batch.run_folder import read_run_record
    from app.extensions.stand import georeference

    folder = arguments.run
    if arguments.remove:
        read_run_record(folder)
        (folder / FILE).unlink(missing_ok=True)
        print("the map is local")
        return 0
    if arguments.from_page:
        record = stored_on_page(folder, stored_frame)
        if record is None:
            raise StemmapError("the recording got no reference system on the page", where=str(folder))
        write_map_frame(folder, record)
        frame = read_map_frame(folder)
    elif not (arguments.control or arguments.gnss or arguments.in_file or arguments.by_hand):
        frame = read_map_frame(folder)
    else:
        if not arguments.crs:
            raise UsageError("--crs is missing", remedy="Name the reference system, such as EPSG:25832")
        crs = georeference.projected(arguments.crs)
        if arguments.control is not None:
            points = georeference.read_control_points(arguments.control, crs)
            frame = georeference.by_control_points(folder, points, crs, arguments.point_sigma)
        elif arguments.gnss:
            frame = georeference.by_gnss(folder, crs)
        else:
            east, north, turn, z = arguments.by_hand or (0.0, 0.0, 0.0, 0.0)
            frame = georeference.by_hand(folder, crs, east, north, math.radians(turn), z)
        write_map_frame(folder, frame.record())
    for line in georeference.frame_lines(frame):
        print(line)
    return 0
