"""`stemmap merge`: two runs of one stand into one map."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.choices import add_force_flag
from app.cli.progress import compiling_is_said
from pipeline.errors import StemmapError

HELP = "merge two mapped runs of one stand into one map"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("a", metavar="DIR_A", type=Path, help="a mapped run; its frame and numbers stay")
    parser.add_argument("b", metavar="DIR_B", type=Path, help="the run that is brought into it")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the files")
    add_force_flag(parser)
    parser.add_argument(
        "--set",
        metavar="STAGE.NAME=VALUE",
        dest="assignments",
        action="append",
        default=[],
        help="one parameter laid over those of DIR_A, e.g. relocalisation.slack=0.3 for bent maps",
    )
    parser.epilog = (
        "The maps are fitted by the distances between their stems; where that is not certain, nothing is\n"
        "written. correspondence.csv says which tree is which; new ones of DIR_B get new numbers."
    )


@compiling_is_said()
def run(arguments: argparse.Namespace) -> int:
    """Merge the runs."""
    import numpy as np

    from app.batch.continue_map import read_saved_run
    from app.batch.merge import merge_runs
    from app.common.text import count
    from pipeline.config import assign

    parameters = None
    if arguments.assignments:
        parameters = assign(read_saved_run(arguments.a).chosen_parameters(), arguments.assignments)
    try:
        done = merge_runs(arguments.a, arguments.b, arguments.out, parameters, force=arguments.force)
    except OSError as error:
        raise StemmapError(
            f"cannot write: {error.strerror}", where=str(error.filename or arguments.out)
        ) from None
    pose = done.match.pose
    assert pose is not None  # noqa: S101 - merge_runs refuses without one
    print(
        f"{arguments.b} lies at {pose.x:.2f}, {pose.y:.2f} m, {np.degrees(pose.yaw):.1f} degrees of "
        f"{arguments.a}: {len(done.match.local)} stems agree, {done.match.second} in the next best pose"
    )
    print(f"{count(done.a, 'tree')} of the first, {done.b} of the second, {done.both} in both")
    print(f"files in {arguments.out}")
    return 0
