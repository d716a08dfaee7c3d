"""`stemmap info`: describes a source and shows the commands for it."""

from __future__ import annotations

import argparse
import json
import shlex
from contextlib import closing
from typing import TYPE_CHECKING, Any

from app.cli.flags import (
    SOURCE_HELP,
    add_source_flags,
    plain,
    program,
    refuse_one_step,
    seed,
    source,
    source_request,
)

if TYPE_CHECKING:
    from pipeline.io.readers import Source, SourceDescription
    from pipeline.io.readers.base import RecordedTopic
    from pipeline.types.records import Sensor, Truth

HELP = "describe a source and show the commands for it"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("source", metavar="SOURCE", type=source, help=SOURCE_HELP)
    add_source_flags(parser)
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="random seed of a simulated run (default: 0)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Print the description as lines or, with --json, as JSON; return 0.

    Raises:
        StemmapError: The source cannot be read.
    """
    from app.sources.opening import open_source

    refuse_one_step(arguments)
    options = source_request(arguments, arguments.source).options()
    with closing(open_source(arguments.source, options)) as opened:
        if arguments.json:
            print(json.dumps(_record(opened), indent=1, allow_nan=False))
        else:
            print("\n".join(_lines(opened)))
    return 0


def _record(opened: Source) -> dict[str, Any]:
    """Return the description of a source as JSON values: `uri`, `kind`, `digest`, `scans`, `start_ns`,
    `end_ns`, `times` (whether they are known or a rate is assumed), `sensor`, `T_base_lidar` (`R` and `t`
    [m]), `odometry` and `imu` (whether there is one), `preset`, `topics`, `truth` (numbers of `trees` and
    `others`, and whether there is a `path`), `losses`, `warnings` and `missing`. Unknown values are None."""
    from dataclasses import asdict

    d, truth = opened.description, opened.truth()
    trees, others = _truth_counts(truth)
    return {
        "uri": d.uri,
        "kind": d.kind,
        "digest": d.digest,
        "scans": d.scans,
        "start_ns": d.start_ns,
        "end_ns": d.end_ns,
        "times": d.has_times,
        "sensor": asdict(d.sensor),
        "T_base_lidar": {"R": d.T_base_lidar.R.tolist(), "t": d.T_base_lidar.t.tolist()},
        "odometry": d.has_odometry,
        "imu": d.has_imu,
        "preset": d.preset,
        "topics": [asdict(topic) for topic in d.topics],
        "truth": {"trees": trees, "others": others, "path": truth is not None and truth.path is not None},
        "losses": opened.losses,
        "warnings": list(d.warnings),
        "missing": list(d.missing),
    }


def _lines(opened: Source) -> list[str]:
    """Return the description of a source as lines: a table, warnings and losses, topics, commands."""
    from math import degrees

    from app.common.text import count
    from app.sources.request import choose_odometry

    d, truth = opened.description, opened.truth()
    x, y, z = d.T_base_lidar.t
    roll, pitch, yaw = (round(degrees(angle), 1) + 0.0 for angle in d.T_base_lidar.euler())
    trees, others = _truth_counts(truth)
    known = [f"{count(trees, 'tree')}, {count(others, 'other object')}"] if trees + others else []
    known += ["the path"] if truth is not None and truth.path is not None else []
    rows = [
        ("kind", d.kind),
        ("scans", _scans(d)),
        ("LiDAR", _sensor(d.sensor)),
        (
            "mounted",
            f"x {x:.2f} m, y {y:.2f} m, z {z:.2f} m on the robot; roll {roll:g}, pitch {pitch:g}, yaw "
            f"{yaw:g} degrees",
        ),
        (
            "odometry",
            f"yes{_read_from(d, 'odometry')}"
            if d.has_odometry
            else f"no; used: {choose_odometry(d, 'auto').words}",
        ),
        ("IMU", f"yes{_read_from(d, 'imu')}" if d.has_imu else "no"),
        *([("camera", f"yes{_read_from(d, 'camera')}")] if _read_from(d, "camera") else []),
        *([("GNSS", d.gnss)] if d.gnss else []),
        *([("SLAM pose", d.other_slam)] if d.other_slam else []),
        ("truth", ", ".join(known) or "none; give true trees with --truth trees.csv"),
        ("preset", d.preset),
        ("SHA-256", d.digest),
    ]
    lines = [f"{name:10}{text}" for name, text in rows]
    lines += [f"warning: {text}" for text in d.warnings]
    lines += [f"left out: {reason} ({n:,})" for reason, n in opened.losses.items() if n]
    return lines + _topic_lines(d) + _missing_lines(d) + _commands(d)


def _read_from(d: SourceDescription, role: str) -> str:
    """Return ", " and the names of the topics that are read in a role; ", a moving transform" for odometry
    without a topic; "" for a source without topics."""
    names = [plain(topic.name) for topic in d.topics if topic.read_as == role]
    if role == "odometry" and d.topics and not names:
        return ", a moving transform"
    return f", {', '.join(names)}" if names else ""


def _topic_lines(d: SourceDescription) -> list[str]:
    """Return a table of the topics with messages, mean rates and what they hold; [] for a source without
    topics."""
    from app.sources.topic_details import topic_details

    if not d.topics:
        return []
    lines = ["", "topics (* is used; --topic ROLE=NAME selects another)"]
    width = max(len(plain(topic.name)) for topic in d.topics)
    for topic in d.topics:
        why = f" ({plain(topic.why)})" if topic.why else ""
        mark, use = ("*", f"used as {topic.read_as}{why}") if topic.read_as else (" ", _not_read(topic))
        name, kind = plain(topic.name), plain(topic.type)
        rate = " " * 10 if topic.rate_hz is None else f"{topic.rate_hz:7.1f} Hz"
        lines.append(f" {mark} {name:{width}}  {topic.messages:>8,}  {rate}  {kind}  {use}".rstrip())
        lines += [f"     {word:8}{plain(text)}" for word, text in topic_details(topic)]
    return lines


def _missing_lines(d: SourceDescription) -> list[str]:
    """Return lines with what a recording lacks, what this costs and what helps; [] if it lacks nothing."""
    return ["", "missing", *(f" - {plain(text)}" for text in d.missing)] if d.missing else []


def _not_read(topic: RecordedTopic) -> str:
    """Return why a topic is not used, and the role that it could have."""
    could = f", could be {topic.fits}" if topic.fits and topic.messages else ""
    return f"not used: {plain(topic.why_not)}{could}"


def _commands(d: SourceDescription) -> list[str]:
    """Return lines with the commands that show and map the source."""
    uri, command = shlex.quote(d.uri), program()
    return ["", f"watch it:  {command} {uri}", f"map it:    {command} map {uri} --out out"]


def _scans(d: SourceDescription) -> str:
    """Return number, duration and rate of the scans as text: only the number if the times are unknown, and
    "unknown number" without it."""
    if d.scans is None:
        return "unknown number"
    if d.start_ns is None or d.end_ns is None or d.end_ns <= d.start_ns:
        return f"{d.scans:,}"
    seconds = (d.end_ns - d.start_ns) * 1e-9
    assumed = "" if d.has_times else ", assumed: times.txt gives the times"
    return f"{d.scans:,} in {seconds:.1f} s, {(d.scans - 1) / seconds:.1f} Hz{assumed}"


def _sensor(sensor: Sensor) -> str:
    """Return name, rings and range error of a LiDAR as text."""
    from math import degrees

    rings = f", {sensor.rings} ring{'s' * (sensor.rings != 1)}" if sensor.rings else ""
    step = f" {degrees(sensor.ring_step):.2f} degrees apart" if sensor.ring_step else ""
    return f"{sensor.name}{rings}{step}, range error {100.0 * sensor.range_sigma:.1f} cm"


def _truth_counts(truth: Truth | None) -> tuple[int, int]:
    """Return the numbers of true trees and of other known objects; 0, 0 for None."""
    kinds = () if truth is None or truth.trees is None else truth.trees.kind
    trees = sum(kind == "tree" for kind in kinds)
    return trees, len(kinds) - trees
