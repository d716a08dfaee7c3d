"""What the choice of odometry means for a source."""

from __future__ import annotations

from pipeline.errors import SourceError
from pipeline.sources.base import SourceDescription
from pipeline.steps import OdometryChoice


def odometry_used(description: SourceDescription, choice: OdometryChoice) -> OdometryChoice:
    """The choice as the synchroniser needs it: live, no scan waits for an odometry that nobody sends."""
    waits_in_vain = description.in_order_of_arrival and not description.has_odometry
    return "static" if waits_in_vain else choice


def odometry_warnings(description: SourceDescription, choice: str) -> list[str]:
    """What a person should know of the choice.

    Args:
        description: Of the source.
        choice: "auto", "wheels" or "static".

    Raises:
        SourceError: Wheels are asked for and the source has none.
    """
    if choice == "static":
        return ["the odometry is left aside (static): the robot is mapped as standing still"]
    if description.has_odometry:
        return []
    if choice == "wheels":
        raise SourceError(
            "the source has no odometry",
            where=description.uri,
            remedy="--odometry static maps it as standing still",
        )
    return ["the source has no odometry: the robot is mapped as standing still"]
