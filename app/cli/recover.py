"""`stemmap recover FILE --out MENDED`: all that is whole of a recording that was cut or damaged."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = "mend a recording that was cut or damaged"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("file", metavar="FILE", type=Path, help="an .mcap; it is not changed")
    parser.add_argument("--out", metavar="MENDED", type=Path, required=True, help="the new .mcap")
    parser.add_argument("--force", action="store_true", help="overwrite a file that is there already")
    parser.epilog = "Exit code 0: it was whole; 3: something is lost (said on stderr); 1: nothing is whole."


def run(arguments: argparse.Namespace) -> int:
    """Mend it."""
    from pipeline.errors import StemmapError
    from pipeline.io.recording.recovery import mend

    if arguments.out.exists() and arguments.file.exists() and arguments.out.samefile(arguments.file):
        raise StemmapError(
            "this is the damaged file itself", where=str(arguments.out), remedy="Name another with --out"
        )
    if arguments.out.exists() and not arguments.force:
        raise StemmapError(
            "the file is there already", where=str(arguments.out), remedy="Name another, or add --force"
        )
    mended = mend(arguments.file, arguments.out)
    print(f"{arguments.out}: {mended.messages} messages")
    for reason, number in mended.losses.items():
        print(f"lost: {number} {reason}", file=sys.stderr)
    return 3 if mended.losses else 0
