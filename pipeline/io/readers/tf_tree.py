"""The tree of fixed transforms of a recording, and odometry that is only there as a transform."""

from __future__ import annotations

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.ros_messages import Quaternion, Vector

#: Positions on Earth in any of its frames are smaller [m].
FARTHEST = 1e9


class TransformTree:
    """Fixed transforms between frames; frames are compared without a leading slash."""

    def __init__(self) -> None:
        self._links: dict[str, dict[str, Pose3]] = {}

    def add(self, parent: str, child: str, T_parent_child: Pose3) -> None:
        """Keep a transform; a later one of the same pair replaces it."""
        self._links.setdefault(parent, {})[child] = T_parent_child
        self._links.setdefault(child, {})[parent] = T_parent_child.inverse()

    def knows(self, frame: str) -> bool:
        """Whether any transform names this frame."""
        return frame in self._links

    def find(self, target: str, source: str) -> Pose3 | None:
        """`T_target_source` along the fewest links, None when the frames are not linked."""
        reached = {target: Pose3.identity()}
        border = [target]
        while border and source not in reached:
            ahead = []
            for frame in border:
                for other, T_frame_other in self._links.get(frame, {}).items():
                    if other not in reached:
                        reached[other] = reached[frame] @ T_frame_other
                        ahead.append(other)
            border = ahead
        return reached.get(source)


def frame_name(name: object) -> str:
    """A frame's name without the leading slash that ROS 1 sometimes writes."""
    return str(name).lstrip("/")


def pose_of(position: Vector, orientation: Quaternion) -> Pose3:
    """A Pose3 of the message parts with x, y, z and x, y, z, w.

    Raises:
        ValueError: A number is not finite or the quaternion is zero.
    """
    place = [position.x, position.y, position.z]
    if not all(abs(axis) < FARTHEST for axis in place):
        raise ValueError("a position is not finite")
    return Pose3.from_quaternion(place, [orientation.w, orientation.x, orientation.y, orientation.z])


def is_odometry_link(parent: str, child: str) -> bool:
    """Whether a moving transform says where the robot is: from a frame named odom to its base."""
    return parent.split("/")[-1].startswith("odom") and child.split("/")[-1].startswith("base")
