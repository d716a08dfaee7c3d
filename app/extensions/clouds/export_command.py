"""`stemmap export` of the cloud of a run."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.stored import reviewed

SUFFIXES = (".las", ".laz")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a description; the command has the flags."""
    parser.add_argument_group("cloud of --to", ".las and .laz: points with the number of their tree.")


def run(arguments: argparse.Namespace) -> int | None:
    """Write the cloud of a run if --to names a file .las or .laz, which is replaced.

    Returns:
        Exit code: 0; None for another file.

    Raises:
        StemmapError: The run or its source cannot be read, or the file cannot be written.
    """
    if arguments.to is None or Path(arguments.to).suffix.lower() not in SUFFIXES:
        return None
    from app.extensions.clouds.mapped_cloud import write_cloud

    with reviewed(arguments.run) as folder:
        print(f"{write_cloud(folder, Path(arguments.to)):,} points in {arguments.to}")
    return 0
