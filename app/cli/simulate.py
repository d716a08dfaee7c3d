"""`stemmap simulate SCENARIO --out run.mcap`: a simulated run as a recording, with its ground truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.flags import compilation_notice, refuse_to_overwrite, seed, with_progress

if TYPE_CHECKING:
    from pipeline.types.camera import Picture
    from pipeline.types.records import Record

HELP = "write a simulated run as an MCAP of ROS 2 messages, with its ground truth"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="stand, paper, slope, dense, long, crossing or wild, with options as in "
        "'stand?odometry=poor&sigma=0.03' "
        "(seed, sigma, odometry = good, normal, poor or exact, duration, trees, drive)",
    )
    parser.add_argument("--out", required=True, type=_mcap, metavar="RUN.mcap", help="the file to write")
    parser.add_argument("--seed", type=seed, metavar="N", help="random seed (default: 0)")
    parser.add_argument("--duration", type=float, metavar="S", help="length of the run in seconds")
    parser.add_argument(
        "--camera", action="store_true", help="add simple pictures of a front camera, two per second"
    )
    parser.add_argument("--force", action="store_true", help="overwrite existing files")
    parser.epilog = "The ground truth is attached to the recording and written to RUN.trees.csv."


@compilation_notice()
def run(arguments: argparse.Namespace) -> int:
    """Write the recording and a table of its trees next to it; return 0.

    Raises:
        StemmapError: The scenario is invalid, a file exists without --force, or cannot be written.
    """
    from app.common.text import count
    from app.sources.opening import open_source
    from pipeline.errors import UsageError
    from pipeline.io.atomic_files import write_texts
    from pipeline.io.readers.simulated import SimulatedSource
    from pipeline.io.recording.mcap_writer import write_recording
    from pipeline.io.recording.rendering import CAMERA, with_pictures
    from pipeline.io.result_files import csv_text, number_text

    out: Path = arguments.out
    table = out.with_suffix(".trees.csv")
    for file in (out, table):
        refuse_to_overwrite(file, force=arguments.force)
    source = open_source(_uri(arguments))
    if not isinstance(source, SimulatedSource):
        raise UsageError(
            "no simulated run", where=_uri(arguments), remedy="Scenarios: `stemmap simulate --help`"
        )
    description = source.description
    truth = source.truth()
    known = with_progress(source.records(), source.description.scans, "simulating")
    records: Iterator[Record | Picture] = known
    if arguments.camera:
        records = with_pictures(known, source.run.scene.truth, source.run.true_path())
    write_recording(
        out,
        records,
        sensor=description.sensor,
        T_base_lidar=description.T_base_lidar,
        truth=truth,
        camera=CAMERA if arguments.camera else None,
    )
    trees = source.run.scene.truth
    places = zip(trees.x, trees.y, 100.0 * trees.dbh, trees.kind, strict=True)
    cells = [[*map(number_text, (x, y, dbh), (4, 4, 2)), kind] for x, y, dbh, kind in places]
    write_texts(table.parent, {table.name: csv_text(("x_m", "y_m", "dbh_cm", "class"), cells)})
    print(f"{out}: {count(description.scans or 0, 'scan')}; its ground truth is attached, and in {table}")
    return 0


def _mcap(text: str) -> Path:
    """Return the path; raises argparse.ArgumentTypeError unless it ends in .mcap."""
    path = Path(text)
    if path.suffix.lower() != ".mcap":
        raise argparse.ArgumentTypeError(f"{text} must end in .mcap")
    return path


def _uri(arguments: argparse.Namespace) -> str:
    """Return the URI of the scenario with --seed and --duration, where given, as options at its end; sim: is
    added if it is missing."""
    uri: str = arguments.scenario if arguments.scenario.startswith("sim:") else f"sim:{arguments.scenario}"
    for key in ("seed", "duration"):
        value = getattr(arguments, key)
        if value is not None:
            uri += f"{'&' if '?' in uri else '?'}{key}={value}"
    return uri
