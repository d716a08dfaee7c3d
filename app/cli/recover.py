"""`stemmap recover FILE --out REPAIRED`: writes the readable part of a damaged recording."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from app.cli.flags import refuse_to_overwrite

HELP = "repair a recording that was cut or damaged"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", metavar="FILE", type=Path, help="an .mcap file; it is not changed")
    parser.add_argument("--out", metavar="REPAIRED", type=Path, required=True, help="the new .mcap file")
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    parser.epilog = "Exit code 0: nothing is lost; 3: something is lost (see stderr); 1: nothing is readable."


def run(arguments: argparse.Namespace) -> int:
    """Write the readable messages of a damaged recording to a new file, and print what was lost.

    Returns:
        Exit code: 3 if parts are lost, else 0.

    Raises:
        StemmapError: The output is the damaged file, exists and --force is not given, or cannot be written;
            or nothing is readable.
    """
    from pipeline.errors import StemmapError
    from pipeline.io.recording.mcap_writer import repair

    if arguments.out.exists() and arguments.file.exists() and arguments.out.samefile(arguments.file):
        raise StemmapError(
            "this is the damaged file", where=str(arguments.out), remedy="Name another with --out"
        )
    refuse_to_overwrite(arguments.out, force=arguments.force)
    mended = repair(arguments.file, arguments.out)
    print(f"{arguments.out}: {mended.messages} messages")
    for reason, number in mended.losses.items():
        print(f"lost: {number} {reason}", file=sys.stderr)
    return 3 if mended.losses else 0
