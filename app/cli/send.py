"""`stemmap send RUN`: sends a recording or a simulated run over Zenoh, to practise a live run."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from app.cli import flags

HELP = "send a recording or a simulated run as a robot does, to practise a live run"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "source",
        metavar="RUN",
        help="an MCAP recording of ROS 2 topics, or a simulated run such as sim:stand?duration=60",
    )
    parser.add_argument(
        "--port",
        type=flags.whole_number(1, 65535),
        default=7447,
        metavar="N",
        help="port of this machine (default: 7447)",
    )


@flags.compilation_notice()
def run(arguments: argparse.Namespace) -> int:
    """Send the run once, as soon as somebody listens; return 0.

    Raises:
        StemmapError: The run cannot be read, or the port cannot be used.
    """
    from app.robot.practice_robot import send
    from app.sources.opening import open_source
    from pipeline.io.recording.mcap_writer import write_recording

    with TemporaryDirectory(prefix="stemmap-send-") as folder:
        file = Path(arguments.source)
        if arguments.source.startswith("sim:"):
            file = Path(folder) / "run.mcap"
            with closing(open_source(arguments.source)) as source:
                known = source.description
                records = flags.with_progress(source.records(), known.scans, f"simulating {arguments.source}")
                write_recording(file, records, sensor=known.sensor, T_base_lidar=known.T_base_lidar)
        print(f"{send(file, arguments.port)} scans were sent")
    return 0
