"""Corrections of the map: the decisions of loop closure and relocalisation, which the mapper applies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.geometry.poses import Float, Pose2
from pipeline.slam import Loop, Motion

S = TypeVar("S")

LOOP = "loop closed: path and map are corrected since this place was left"
LOST = (
    "the robot is lost: the map returns to the scan before the known trees disappeared, and the stems around "
    "the robot are searched for in it"
)
DOUBLED = (
    "the map contradicts itself: the path has drifted since this place was left, and its trees stand twice"
)
DRIFT = "the path had drifted: path and map are corrected"
NOT_FOUND = "the stems around the robot were not found in the map; mapping continues from the odometry"


@dataclass(frozen=True, slots=True, eq=False)
class Restart(Generic[S]):
    """The robot is lost. The map returns to an earlier state; the odometry leads from there.

    Attributes:
        state: State of the mapper before the robot was lost.
        motions: Scan number and motion of each scan after `state`, in the order of time.
    """

    state: S
    motions: tuple[tuple[int, Motion], ...]

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings of the scan: that the robot is lost."""
        return (LOST,)


@dataclass(frozen=True, slots=True, eq=False)
class RelocalisedPose:
    """A lost robot is located in the map, at a position to which it was carried.

    Attributes:
        T_map_base: Pose of the base in the map.
        covariance: Covariance of x, y [m], yaw [rad], shape (3, 3).
        stems: Number of trees that agree.
    """

    T_map_base: Pose2
    covariance: Float
    stems: int

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings of the scan: that the robot was located, with the number of stems."""
        return (_located(self.stems),)


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """The path returned to known trees: it is corrected to end there.

    Attributes:
        loop: The constraints of the path.
        stems: Number of trees by which a lost robot was located; None if it was not lost.
        is_doubled: Whether the known trees are mapped a second time, next to the first ones.
    """

    loop: Loop
    stems: int | None = None
    is_doubled: bool = False

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings of the scan: that a loop was closed; for a robot that was lost, that it was located and
        that the path had drifted."""
        return (LOOP,) if self.stems is None else (_located(self.stems), DRIFT)


@dataclass(frozen=True, slots=True)
class DoubledTrees:
    """Trees of a known place were mapped a second time beside it, and no correction of the path was found."""

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings of the scan: that the map contradicts itself."""
        return (DOUBLED,)


@dataclass(frozen=True, slots=True)
class Smoothing:
    """Known trees were seen again: path and map are corrected by the graph of keyframes."""

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings of the scan: none, because the correction is small."""
        return ()


@dataclass(frozen=True, slots=True)
class SearchFailure:
    """A lost robot was not found in the map. Mapping continues at the pose by odometry."""

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings of the scan: that the robot was not found in the map."""
        return (NOT_FOUND,)


def _located(stems: int) -> str:
    """Return the warning that a lost robot was located by a number of stems."""
    return f"robot located in the map by {stems} stems"
