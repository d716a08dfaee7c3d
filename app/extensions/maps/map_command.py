"""`stemmap map --continue`: a run that continues the map of an earlier one."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.extensions.maps.continue_map import Start


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the flags."""
    parser.add_argument(
        "--continue",
        dest="continued",
        metavar="DIR",
        type=Path,
        help="continue the map of an earlier run in this folder; trees keep their numbers",
    )
    parser.add_argument(
        "--start",
        metavar="WHERE",
        type=_start,
        help="start in a continued map: auto (found by the stems, default); X,Y,YAW in m and degrees; "
        "last (end of the earlier run); resume (the same drive continues)",
    )


def check(arguments: argparse.Namespace) -> None:
    """Refuse --start without --continue, and --continue for a source that is mapped in one step.

    Raises:
        StemmapError: The arguments contradict each other.
    """
    if arguments.continued is None:
        if arguments.start is not None:
            raise ParameterError("--start needs a continued map", remedy="Add --continue DIR")
        return
    from app.sources.one_step import is_one_step

    if is_one_step(arguments.source, flags.source_request(arguments, arguments.source).options()):
        raise ParameterError("the source has no scans", remedy="Remove --continue")


@flags.compilation_notice()
def run(arguments: argparse.Namespace) -> int | None:
    """Map a run that continues a map and return the exit code; None without --continue.

    Raises:
        StemmapError: As for `stemmap map`; the saved run cannot be read, or the start of a live source is not
            given.
        OSError: The folder cannot be written.
    """
    if arguments.continued is None:
        return None
    flags.chosen_parameters(arguments, "forest")  # reports a mistyped flag before heavy modules are loaded

    from app.batch.saved_run import read_saved_run
    from app.cli.map import map_scans
    from app.extensions.maps.continue_map import ContinuedMap
    from app.sources.live_address import is_live

    saved = read_saved_run(arguments.continued)
    start: Start = arguments.start or "auto"
    if start == "auto" and is_live(arguments.source):
        raise StemmapError(
            "a robot that is driving cannot be located in a saved map by its stems",
            where=arguments.source,
            remedy="Give its pose with --start X,Y,YAW (m, m, degrees) or --start last, or record the drive "
            "and continue the map with the file",
        )
    return map_scans(arguments, ContinuedMap(arguments.continued, saved, start))


def _start(text: str) -> Start:
    """Parse --start: auto, last, resume, or x, y [m], yaw [deg], which is returned as a pose; raises
    argparse.ArgumentTypeError for other texts and for numbers beyond 1e6."""
    named: dict[str, Start] = {"auto": "auto", "last": "last", "resume": "resume"}
    if text in named:
        return named[text]
    try:
        x, y, yaw = flags.numbers("X,Y,YAW", 1e6)(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is not auto, last, resume or X,Y,YAW") from None
    from pipeline.geometry.poses import Pose2

    return Pose2(x, y, math.radians(yaw))
