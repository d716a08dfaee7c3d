"""Selects where the motion of a source comes from: its own odometry, LiDAR odometry, a file, or none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.errors import SourceError
from pipeline.io.readers import Source
from pipeline.io.readers.base import SourceDescription
from pipeline.odometry.odometry_override import OdometryEstimator, OdometryOverride
from pipeline.odometry.synchroniser import OdometryChoice

FILE = "file:"
Method = Literal["source", "kiss-icp", "static", "file"]


@dataclass(frozen=True, slots=True)
class ChosenOdometry:
    """Selected source of motion.

    Attributes:
        method: "source" uses the odometry of the source itself.
        words: Description and reason for people.
        warning: Warning for people, or "".
    """

    method: Method
    words: str
    warning: str = ""

    @property
    def steps(self) -> OdometryChoice:
        """The choice in the form that the synchroniser needs."""
        return "static" if self.method == "static" else "auto"


def choose_odometry(known: SourceDescription, choice: str) -> ChosenOdometry:
    """Return the source of motion for a choice of the user.

    Args:
        known: Description of the source.
        choice: "auto", "wheels", "kiss-icp", "static", or "file:" and a path.

    Raises:
        SourceError: The choice is not available for this source.
    """
    if choice.startswith(FILE):
        return ChosenOdometry("file", f"poses from {choice.removeprefix(FILE)}, as requested")
    if choice == "static":
        warning = "the odometry is ignored (static): the robot is mapped without motion"
        return ChosenOdometry("static", "none, as requested: the robot is mapped without motion", warning)
    if choice == "wheels" and not known.has_odometry:
        raise SourceError(
            "the source has no odometry",
            where=known.uri,
            remedy="--odometry kiss-icp computes the motion from the scans; --odometry static assumes none",
        )
    obstacle = _no_matching(known)
    if choice == "kiss-icp":
        if obstacle:
            raise SourceError(f"LiDAR odometry is not possible: {obstacle}", where=known.uri)
        wheels = ", started from the wheel odometry" if known.has_odometry else ""
        return ChosenOdometry("kiss-icp", f"registration of the scans (kiss-icp){wheels}, as requested")
    if known.has_odometry:
        gnss = f"; GNSS {known.gnss}" if known.gnss else ""
        gnss += f"; other SLAM: {known.other_slam}" if known.other_slam else ""
        return ChosenOdometry(
            "source", f"the source's own{', as requested' if choice == 'wheels' else ''}{gnss}"
        )
    if obstacle:
        warning = f"the source has no odometry, and {obstacle}: the robot is mapped without motion"
        return ChosenOdometry("static", f"none: {obstacle}", warning)
    return ChosenOdometry(
        "kiss-icp", "registration of the scans (kiss-icp), because the source has no odometry"
    )


def _no_matching(known: SourceDescription) -> str:
    """Return why LiDAR odometry is not available for a source, or ""."""
    if known.preset == "stems":
        return "detected stems are not scans"
    if known.sensor.rings == 1:
        return "scans of a planar laser cannot be registered"
    return "there is only one scan" if known.scans == 1 else ""


def motion_of(known: SourceDescription, choice: str, chosen: ChosenOdometry) -> OdometryEstimator | None:
    """Return the estimator of the motion; None if the source provides the motion or there is none.

    Args:
        known: Description of the source.
        choice: As in `choose_odometry`.
        chosen: Result of `choose_odometry`.

    Raises:
        SourceError: A pose file cannot be read.
    """
    if chosen.method == "kiss-icp":
        from pipeline.odometry.lidar_odometry import LidarOdometry

        return LidarOdometry(known.T_base_lidar)
    if chosen.method == "file":
        from pipeline.odometry.odometry_override import FileOdometry

        return FileOdometry(Path(choice.removeprefix(FILE)).expanduser(), known.T_base_lidar)
    return None


def with_odometry(source: Source, choice: str) -> tuple[Source, ChosenOdometry]:
    """Return the source with the selected motion, and the selection.

    Args:
        source: The source.
        choice: As in `choose_odometry`.

    Raises:
        SourceError: The choice is not available for this source.
    """
    from pipeline.io.readers.base import digest_of

    known = source.description
    chosen = choose_odometry(known, choice)
    motion = motion_of(known, choice, chosen)
    if motion is None:
        return source, chosen
    digest = digest_of([Path(choice.removeprefix(FILE)).expanduser()]) if chosen.method == "file" else ""
    return OdometryOverride(source, motion, digest), chosen
