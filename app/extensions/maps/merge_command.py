"""`stemmap merge`: merges two runs of one stand into one map."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.flags import add_force_flag, add_set_flag, compilation_notice

HELP = "merge two mapped runs of one stand into one map"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("a", metavar="DIR_A", type=Path, help="a mapped run; its frame and tree numbers stay")
    parser.add_argument("b", metavar="DIR_B", type=Path, help="the run that is merged into it")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the files")
    add_force_flag(parser)
    add_set_flag(
        parser, "value that replaces a parameter of DIR_A, e.g. relocalisation.slack=0.3 for distorted maps"
    )
    parser.epilog = (
        "The maps are aligned by the distances between their stems; without a certain match nothing is\n"
        "written. correspondence.csv has the numbers of each tree in both maps; trees only in DIR_B\n"
        "get new numbers."
    )


@compilation_notice()
def run(arguments: argparse.Namespace) -> int:
    """Merge the runs, write the files to --out and print a summary; return 0.

    Raises:
        StemmapError: A run cannot be read, the maps do not match with confidence, or the folder has the map
            of another source.
        OSError: The folder cannot be written; it is unchanged then.
    """
    import numpy as np

    from app.batch.saved_run import read_saved_run
    from app.common.text import count
    from app.extensions.maps.merge import merge_runs
    from pipeline.config import assign

    parameters = None
    if arguments.assignments:
        parameters = assign(read_saved_run(arguments.a).chosen_parameters(), arguments.assignments)
    done = merge_runs(arguments.a, arguments.b, arguments.out, parameters, force=arguments.force)
    pose = done.match.pose
    assert pose is not None  # noqa: S101 - merge_runs refuses without one
    print(
        f"{arguments.b} is at {pose.x:.2f}, {pose.y:.2f} m, {np.degrees(pose.yaw):.1f} degrees of "
        f"{arguments.a}: {len(done.match.local)} stems agree, {done.match.second} in the second best pose"
    )
    print(f"{count(done.a, 'tree')} of the first, {done.b} of the second, {done.both} in both")
    print(f"files in {arguments.out}")
    return 0
