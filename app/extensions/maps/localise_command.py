"""`stemmap localise`: where a robot is in a stored map, without an initial pose."""

from __future__ import annotations

import argparse
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags

if TYPE_CHECKING:
    from app.extensions.maps.localise import LocalisedRun
    from app.robot.source import LiveSource
    from pipeline.mapper import Mapper
    from pipeline.types.records import Frame

HELP = "find a robot in the map of an earlier run, without an initial pose"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    from app.cli.map import configure as configure_map

    configure_map(parser)
    out = next(action for action in parser._actions if action.dest == "out")
    out.required, out.help = False, "folder for the files of the run and its poses in the map (default: none)"
    parser.add_argument(
        "--map",
        dest="stored",
        metavar="DIR",
        type=Path,
        required=True,
        help="folder of the run whose map is used, or a file of `stemmap pack`",
    )
    parser.add_argument(
        "--grow",
        action="store_true",
        help="add the trees of this run to the map in --map if the exit code is 0 (default: none are added)",
    )
    parser.epilog = (
        "Prints when and where the robot is found. Writes to --out the files of `stemmap map`, and\n"
        "poses.csv and map_odom.csv (in the stored map), trees_in_map.csv (same, missing and new trees,\n"
        "growth) and localisation.json. Exit code 3: not found at the end, a place was withdrawn because\n"
        "the stems contradicted it, the map of this run is doubtful, or messages or points were left\n"
        "out; nothing is added to the map then."
    )


@flags.compilation_notice()
def run(arguments: argparse.Namespace) -> int:
    """Map a run and localise it in the stored map; print what is found.

    Returns:
        Exit code: 3 if the robot is not found at the end, a fix was withdrawn, the map of the run is
        doubtful, or messages or points were left out; else 0.

    Raises:
        StemmapError: The map or the source cannot be read, or the arguments contradict each other.
        OSError: The folder --out cannot be written.
    """
    _, parameters = flags.chosen_parameters(arguments, "forest")

    from app.batch.map_run import WRONG
    from app.batch.summary import exit_code
    from app.cli.map import map_to
    from app.extensions.maps.localise import (
        LocalisedRun,
        changes,
        in_stored_map,
        is_reliable,
        map_odom,
        write_localised,
    )
    from app.extensions.maps.stored_map import read_stored_map
    from pipeline.errors import ParameterError, StemmapError

    stored = read_stored_map(arguments.stored)
    if not len(stored):
        raise StemmapError("the map has no trees", where=str(arguments.stored))
    if arguments.grow:
        from app.batch.saved_run import read_saved_run
        from app.extensions.maps.merge import check_unrepaired

        if arguments.repairs:
            raise ParameterError("a run with repairs cannot be added to a map", remedy="Remove --repairs")
        read_saved_run(arguments.stored)  # a file of `pack`, or a map without its state, cannot grow
        check_unrepaired(arguments.stored)
    localised = LocalisedRun(stored, parameters.relocalisation.slack)

    def on_scan(frame: Frame, mapper: Mapper, live: LiveSource | None) -> None:
        if localised.add(frame):
            _print_event(localised)
        if live is not None:
            there = in_stored_map(frame, mapper.path, localised.localisation)
            if there is not None:
                live.mapped(*there, map_odom(frame, localised.localisation))

    keep = arguments.out is not None
    with ExitStack() as stack:
        if not keep:
            arguments.out = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="stemmap-localise-")))
        outcome, _ = map_to(arguments, None, on_scan)
        found = localised.localiser.end()
        done = None
        if found.T_map_odom is not None:
            done = changes(stored, arguments.stored, arguments.out, found.T_map_odom)
        for line in [*outcome.summary[:1], *_summary(localised), *([] if done is None else done.lines)]:
            print(line)
        if keep:
            write_localised(localised, done, arguments.out)
            print(f"files in {arguments.out}")
        code = exit_code(outcome.warnings, outcome.losses, WRONG) if is_reliable(localised) else 3
        if arguments.grow and not code:
            _grow(arguments, localised)
        elif arguments.grow:
            print("the map stays as it is, because the place or the map of this run is not certain")
    flags.print_warnings(outcome.warnings)
    for reason, number in outcome.losses.items():
        print(f"left out: {reason} ({number:,})", file=sys.stderr)
    return code


def _print_event(run: LocalisedRun) -> None:
    """Print a change of the state with its time, distance and place."""
    t_ns, now = run.events[-1]
    where = ""
    if now.T_map_odom is not None:
        place = now.T_map_odom
        where = f"; this run starts at {place.x:.2f}, {place.y:.2f} m of the map"
    print(f"{t_ns * 1e-9:.1f} s, {now.driven:.1f} m: {now.text}{where}", flush=True)


def _summary(run: LocalisedRun) -> list[str]:
    """Return the result of the localisation for people."""
    import numpy as np

    now = run.localisation
    lines = [
        now.text if now.T_map_odom is None else f"found after {now.found_at:.1f} m; at the end {now.text}"
    ]
    if now.T_map_odom is not None:
        pose, sigma = now.T_map_odom, np.sqrt(np.diag(now.covariance))
        lines.append(
            f"the frame of this run is at {pose.x:.2f}, {pose.y:.2f} m, {np.degrees(pose.yaw):.2f} degrees "
            f"of the map; the robot is known to {sigma[0]:.2f}, {sigma[1]:.2f} m, "
            f"{np.degrees(sigma[2]):.2f} degrees"
        )
        if now.height is not None and (full := now.pose_3d) is not None:
            roll, pitch, _ = np.degrees(full.euler())
            lines.append(
                f"the ground here is {now.height.z:+.2f} m in the map, by roll {roll:+.2f} and pitch "
                f"{pitch:+.2f} degrees"
            )
    elif now.searches:
        lines.append(f"{now.searches} searches over {now.driven:.0f} m; the last: {now.reason}")
    else:
        lines.append(f"too few trees over {now.driven:.0f} m for a search")
    if now.withdrawn:
        lines.append(f"withdrawn {now.withdrawn} times: the stems contradicted the place")
    return lines


def _grow(arguments: argparse.Namespace, localised: LocalisedRun) -> None:
    """Merge the run into the stored map.

    Raises:
        StemmapError: A run cannot be read.
        OSError: The folder of the map cannot be written.
    """
    from app.extensions.maps.merge import merge_runs

    done = merge_runs(
        arguments.stored, arguments.out, arguments.stored, None, force=False, match=localised.localiser.match
    )
    print(f"{arguments.stored} has {done.a + done.b - done.both} trees now, {done.b - done.both} of them new")
