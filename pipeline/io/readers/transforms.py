"""Fixed transforms of a recording: the tree of frames, and the extrinsics of the sensors."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.message_time import SECOND_NS
from pipeline.io.readers.topics import decode

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_jazzy as ros2

#: Positions in any frame of the Earth are smaller [m].
FARTHEST = 1e9


class TransformTree:
    """Fixed transforms between frames. Names are compared exactly; callers remove leading slashes by
    `frame_name`."""

    def __init__(self) -> None:
        """Create a tree without transforms."""
        self._links: dict[str, dict[str, Pose3]] = {}

    def add(self, parent: str, child: str, T_parent_child: Pose3) -> None:
        """Store the transform T_parent_child between two frames, in both directions; a later one of the same
        pair replaces it."""
        self._links.setdefault(parent, {})[child] = T_parent_child
        self._links.setdefault(child, {})[parent] = T_parent_child.inverse()

    def knows(self, frame: str) -> bool:
        """Return whether any transform names a frame."""
        return frame in self._links

    def find(self, target: str, source: str) -> Pose3 | None:
        """Return `T_target_source` along the fewest links; None if the frames are not linked. For equal names
        it is the identity, also if they are unknown."""
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
    """Return the name of a frame as a string without leading slashes."""
    return str(name).lstrip("/")


def pose_of(
    position: ros2.geometry_msgs__msg__Point | ros2.geometry_msgs__msg__Vector3,
    orientation: ros2.geometry_msgs__msg__Quaternion,
) -> Pose3:
    """Return the pose with the position [m] and the quaternion of a message.

    Raises:
        ValueError: A number is not finite, a position is beyond FARTHEST, or the quaternion is zero.
    """
    place = [position.x, position.y, position.z]
    if not all(abs(axis) < FARTHEST for axis in place):
        raise ValueError("a position is not finite")
    return Pose3.from_quaternion(place, [orientation.w, orientation.x, orientation.y, orientation.z])


def is_odometry_link(parent: str, child: str) -> bool:
    """Return whether a transform is odometry: the last part of the parent's name begins with "odom", that of
    the child with "base"."""
    return parent.split("/")[-1].startswith("odom") and child.split("/")[-1].startswith("base")


#: Messages of fixed and of moving transforms that are read when a recording is opened.
FIXED_MESSAGES = 1000
MOVING_MESSAGES = 300
_WORLD = ("map", "world", "earth", "odom", "utm")

_UNREADABLE = "transforms that cannot be read"

#: Time of the transform, parent frame, child frame, T_parent_child.
Link = tuple[int, str, str, Pose3]


class Extrinsics:
    """Extrinsics of a recording: its fixed transforms, and the transform that carries the odometry.

    Attributes:
        tree: Fixed transforms.
        odometry_link: (parent, child) of the moving transform with the pose of the robot, or None.
    """

    def __init__(self, container: Container) -> None:
        """Begin without transforms; nothing is read."""
        self._container = container
        self._channels: dict[int, Channel] = {c.number: c for c in container.channels}
        self.tree = TransformTree()
        self.odometry_link: tuple[str, str] | None = None

    def read(self, fixed: frozenset[int], moving: frozenset[int]) -> None:
        """Add the transforms of the first messages of some channels to `tree`, and set `odometry_link`. Of
        moving channels, only transforms that do not change and whose parent is not a world frame (_WORLD) are
        added; fixed transforms replace them. Damaged messages are ignored. `odometry_link` stays None if the
        first MOVING_MESSAGES moving messages have no transform of an odometry (`is_odometry_link`).

        Args:
            fixed, moving: Numbers of the channels of fixed and of moving transforms.
        """
        for (parent, child), pose in self._links(moving, MOVING_MESSAGES, steady=True).items():
            self.tree.add(parent, child, pose)
        for (parent, child), pose in self._links(fixed, FIXED_MESSAGES, steady=False).items():
            self.tree.add(parent, child, pose)

    def base_frame(self, by_odometry: str, lidar: str) -> str:
        """Return the base frame: the first one with a fixed transform to the LiDAR, or else the first one, of
        these: `by_odometry`, the child of the moving transform of the odometry, and those of "base_link",
        "base_footprint" and "base" that `tree` knows. Names that are "" are skipped; "" if none is left.

        Args:
            by_odometry: Frame of the robot in the messages of the odometry.
            lidar: Frame of the LiDAR.
        """
        moving = "" if self.odometry_link is None else self.odometry_link[1]
        usual = [name for name in ("base_link", "base_footprint", "base") if self.tree.knows(name)]
        names = [name for name in (by_odometry, moving, *usual) if name]
        linked = (name for name in names if lidar and self.tree.find(name, lidar) is not None)
        return next(linked, next(iter(names), ""))

    def _links(self, numbers: frozenset[int], limit: int, *, steady: bool) -> dict[tuple[str, str], Pose3]:
        """Return a dict from (parent, child) to the first pose T_parent_child in the first messages of some
        channels. With `steady`, set `odometry_link` to the first transform that is odometry, and leave out
        transforms that change or begin at a world frame (_WORLD).

        Args:
            numbers: Numbers of channels with transforms.
            limit: Number of messages that are read.
            steady: Whether the channels have moving transforms.
        """
        seen: dict[tuple[str, str], Pose3] = {}
        moved: set[tuple[str, str]] = set()
        for message in islice(self._container.messages(numbers, None, {}), limit if numbers else 0):
            for _stamp, parent, child, pose in self.decode(message, {}):
                before = seen.setdefault((parent, child), pose)
                if not (
                    np.allclose(before.R, pose.R, atol=1e-9) and np.allclose(before.t, pose.t, atol=1e-9)
                ):
                    moved.add((parent, child))
                if steady and is_odometry_link(parent, child) and self.odometry_link is None:
                    self.odometry_link = (parent, child)
        return {
            link: pose
            for link, pose in seen.items()
            if not steady or (link not in moved and link[0].split("/")[-1] not in _WORLD)
        }

    def decode(self, message: Message, losses: dict[str, int]) -> list[Link]:
        """Return the finite transforms of a message, in its order; [] if it is damaged.

        Args:
            message: The message.
            losses: Dict from reasons to numbers; damaged messages, and transforms of the odometry that are
                not finite, are added in place.
        """
        try:
            channel = self._channels[message.channel]
            decoded: ros2.tf2_msgs__msg__TFMessage = decode(channel, message.payload)
        except Exception:  # the generated decoders of rosbags raise many kinds
            count_loss(losses, _UNREADABLE)
            return []
        links = []
        for stamped in decoded.transforms:
            parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
            try:
                with np.errstate(all="ignore"):
                    pose = pose_of(stamped.transform.translation, stamped.transform.rotation)
            except ValueError:
                if (parent, child) == self.odometry_link:
                    count_loss(losses, _UNREADABLE)
                continue
            stamp_ns = int(stamped.header.stamp.sec) * SECOND_NS + int(stamped.header.stamp.nanosec)
            links.append((stamp_ns, parent, child, pose))
        return links
