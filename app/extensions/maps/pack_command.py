"""`stemmap pack`: writes the stems of a run as a small file for `stemmap localise`."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.flags import add_force_flag, refuse_to_overwrite

HELP = "write the stems and the terrain of a run as a small map file for localise"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder of a mapped run")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, required=True, help="the file, such as plot.stems"
    )
    add_force_flag(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the file and print its size; return 0.

    Raises:
        StemmapError: The run cannot be read, or the file exists or cannot be written.
    """
    from app.common.text import count
    from app.extensions.maps.stored_map import read_stored_map, write_stored_map

    refuse_to_overwrite(arguments.out, force=arguments.force)
    stored = read_stored_map(arguments.run)
    size = write_stored_map(stored, arguments.out)
    print(f"{arguments.out}: {count(len(stored), 'stem')}, {size / 1000:.1f} kB")
    return 0
