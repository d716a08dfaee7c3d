"""Opens any source, recorded, simulated or live, and selects where its motion comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from app.robot.address import is_live
from app.robot.source import LiveSource, open_live
from pipeline.errors import SourceError
from pipeline.io.readers import Source, SourceOptions, open_source
from pipeline.io.readers.base import SourceDescription
from pipeline.odometry.odometry_override import OdometryEstimator, OdometryOverride
from pipeline.odometry.synchroniser import OdometryChoice

FILE = "file:"
Method = Literal["source", "kiss-icp", "static", "file"]


@dataclass(frozen=True, slots=True)
class Chosen:
    """What tells the motion of a source.

    Attributes:
        method: "source" is what the source itself tells.
        words: For people: what it is, and why.
        warning: What a person should know of it, "" for nothing.
    """

    method: Method
    words: str
    warning: str = ""

    @property
    def steps(self) -> OdometryChoice:
        """The choice as the synchroniser needs it."""
        return "static" if self.method == "static" else "auto"


def choose_odometry(known: SourceDescription, choice: str) -> Chosen:
    """What a choice means for a source.

    Args:
        known: Of the source.
        choice: "auto", "wheels", "kiss-icp", "static", or "file:" and a path.

    Raises:
        SourceError: What is asked for cannot be had of this source.
    """
    if choice.startswith(FILE):
        return Chosen("file", f"poses from {choice.removeprefix(FILE)}, as asked")
    if choice == "static":
        asked = "the odometry is left aside (static): the robot is mapped as standing still"
        return Chosen("static", "none, as asked: the robot is mapped as standing still", asked)
    if choice == "wheels" and not known.has_odometry:
        raise SourceError(
            "the source has no odometry",
            where=known.uri,
            remedy="--odometry kiss-icp finds it from the scans, static maps it as standing still",
        )
    obstacle = _no_matching(known)
    if choice == "kiss-icp":
        if obstacle:
            raise SourceError(f"LiDAR odometry is not possible: {obstacle}", where=known.uri)
        wheels = ", begun at the wheels' step" if known.has_odometry else ""
        return Chosen("kiss-icp", f"scans laid over one another (kiss-icp){wheels}, as asked")
    if known.has_odometry:
        gnss = f"; GNSS {known.gnss}" if known.gnss else ""
        gnss += f"; other SLAM: {known.other_slam}" if known.other_slam else ""
        return Chosen("source", f"the source's own{', as asked' if choice == 'wheels' else ''}{gnss}")
    if obstacle:
        told = f"the source has no odometry, and {obstacle}: the robot is mapped as standing still"
        return Chosen("static", f"none: {obstacle}", told)
    return Chosen("kiss-icp", "scans laid over one another (kiss-icp), as the source has no odometry")


def _no_matching(known: SourceDescription) -> str:
    """Why scans of a source cannot be laid over one another, "" when they can."""
    if known.preset == "stems":
        return "stems are no scans"
    if known.sensor.rings == 1:
        return "a laser that sees in one plane alone is not laid over itself"
    return "there is one scan alone" if known.scans == 1 else ""


def motion_of(known: SourceDescription, choice: str, chosen: Chosen) -> OdometryEstimator | None:
    """What makes the motion; None where the source tells it, or nobody does.

    Raises:
        SourceError: A file of poses cannot be read.
    """
    if chosen.method == "kiss-icp":
        from pipeline.odometry.lidar_odometry import LidarOdometry

        return LidarOdometry(known.T_base_lidar)
    if chosen.method == "file":
        from pipeline.odometry.odometry_override import FileOdometry

        return FileOdometry(Path(choice.removeprefix(FILE)).expanduser(), known.T_base_lidar)
    return None


def with_odometry(source: Source, choice: str) -> tuple[Source, Chosen]:
    """The source with the motion that is chosen, and what that is.

    Raises:
        SourceError: What is asked for cannot be had of this source.
    """
    from pipeline.io.readers.base import digest_of

    known = source.description
    chosen = choose_odometry(known, choice)
    motion = motion_of(known, choice, chosen)
    if motion is None:
        return source, chosen
    digest = digest_of([Path(choice.removeprefix(FILE)).expanduser()]) if chosen.method == "file" else ""
    return OdometryOverride(source, motion, digest), chosen


def open_any(uri: str, options: SourceOptions) -> Source | LiveSource:
    """Open what a user named.

    Raises:
        SourceError: It is not there, of a kind that cannot be read, or damaged.
    """
    return open_live(uri, options) if is_live(uri) else open_source(uri, options)
