"""`stemmap compare`: compares two visits of one stand."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from app.cli.flags import add_dbh_unit_flag, positive_number, print_warnings
from app.cli.stored import reviewed

HELP = "compare two runs or surveys of one stand: growth, new, missing and moved trees"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "a", metavar="A", type=Path, help="earlier visit: folder of a run, or a table of trees"
    )
    parser.add_argument("b", metavar="B", type=Path, help="later visit")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the table, the map and the files")
    parser.add_argument(
        "--same-frame", action="store_true", help="both have the same coordinates; no alignment by stems"
    )
    parser.add_argument(
        "--match",
        metavar="M",
        type=positive_number(10.0, "distance in metres"),
        default=1.0,
        help="largest distance of the two positions of a tree (default: 1)",
    )
    parser.add_argument(
        "--dbh-sigma",
        metavar="CM",
        type=positive_number(50.0, "standard deviation in centimetres"),
        default=1.0,
        help="standard deviation of diameters in a table (default: 1 cm)",
    )
    add_dbh_unit_flag(parser)
    parser.epilog = (
        "A table is a CSV with x_m, y_m (or easting, northing), and dbh_cm or dbh_m. The visits are aligned\n"
        "by the distances between their stems. Growth is marked where it is significant: at most 5 % of the\n"
        "marks are expected to be false. A tree is new or missing only where the other visit looked."
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the comparison and write its files to --out; return 0, or 3 with a warning on stderr if the
    diameters of the visits seem to have different units.

    Raises:
        StemmapError: A visit cannot be read or has no trees, the stems do not agree with certainty, or the
            files cannot be written.
        OSError: The folder --out cannot be created.
    """
    from app.extensions.stand.comparison import (
        compare,
        comparison_lines,
        comparison_record,
        read_visit,
        write_comparison,
    )

    visits = []
    for path in (arguments.a, arguments.b):
        with reviewed(path) as folder:
            visits.append(replace(read_visit(folder, dbh_unit=arguments.dbh_unit), name=str(path)))
    a, b = visits
    found = compare(
        a, b, same_frame=arguments.same_frame, reach=arguments.match, dbh_sigma=0.01 * arguments.dbh_sigma
    )
    record = comparison_record(a, b, found)
    print("\n".join(comparison_lines(record)))
    if arguments.out is not None:
        write_comparison(a, b, found, arguments.out)
        print(f"files in {arguments.out}")
    print_warnings(record["warnings"])
    return 3 if record["warnings"] else 0
