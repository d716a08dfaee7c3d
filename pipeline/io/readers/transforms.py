"""Fixed transforms of a recording: the tree of frames, and the extrinsics of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.topics import decode
from pipeline.types.units import SECOND_NS

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_jazzy as ros2

#: Positions in any frame of the Earth are smaller [m].
FARTHEST = 1e9


#: Usual names of the frame of a robot.
USUAL_BASES = ("base_link", "base_footprint", "base")


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

    def links(self) -> list[tuple[str, str]]:
        """Return the pairs of frames with a transform, in both orders."""
        return [(a, b) for a, others in self._links.items() for b in others]

    def frames(self) -> list[str]:
        """Return the names of all frames."""
        return list(self._links)

    def find(self, target: str, source: str) -> Pose3 | None:
        """Return `T_target_source` along the fewest links; None if the frames are not linked. For equal names
        it is the identity, also if they are unknown."""
        T = Pose3.identity()
        frames = self.chain(target, source)
        for frame, other in pairwise(frames):
            T = T @ self._links[frame][other]
        return T if frames else None

    def chain(self, target: str, source: str) -> tuple[str, ...]:
        """Return the frames from one to another along the fewest links, both included; () if they are not
        linked. For equal names it is this one name."""
        reached: dict[str, tuple[str, ...]] = {target: (target,)}
        border = [target]
        while border and source not in reached:
            ahead = []
            for frame in border:
                for other in self._links.get(frame, {}):
                    if other not in reached:
                        reached[other] = (*reached[frame], other)
                        ahead.append(other)
            border = ahead
        return reached.get(source, ())


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
_LAST_MESSAGES = 100
_WORLD = ("map", "world", "earth", "odom", "utm")

_UNREADABLE = "transforms that cannot be read"

#: Parent and child frame of a transform.
Link = tuple[str, str]


class Extrinsics:
    """Extrinsics of a recording: the transforms in its first messages. Of moving channels, only transforms
    that do not change and whose parent is not a world frame (_WORLD) are fixed, and the last messages are
    read too; those of fixed channels replace them. Damaged messages are ignored.

    Args:
        container: The recording.
        fixed, moving: Numbers of the channels of fixed and of moving transforms.

    Attributes:
        tree: Fixed transforms.
    """

    def __init__(
        self, container: Container, fixed: frozenset[int], moving: frozenset[int] = frozenset()
    ) -> None:
        """Read the transforms. SourceError if the recording cannot be read."""
        self._container, self._channels = container, container.by_number
        self.tree = TransformTree()
        seen, self._moved = self._links(moving, MOVING_MESSAGES)  # those that change
        self._moving = list(seen)
        for (parent, child), pose in seen.items():
            if (parent, child) not in self._moved and parent.split("/")[-1] not in _WORLD:
                self.tree.add(parent, child, pose)
        for (parent, child), pose in self._links(fixed, FIXED_MESSAGES)[0].items():
            self.tree.add(parent, child, pose)

    def odometry_link(self, lidar: str, *, live: bool) -> tuple[Link | None, str]:
        """Return the moving transform that carries the robot and "", or None and a message for the user if
        the only one never changes ("" if there is none). Its child is linked to the LiDAR by fixed
        transforms, or its frames are named as usual. In a recording it changes.

        Args:
            lidar: Frame of the LiDAR.
            live: Whether the run is live, so that the robot may stand still yet.
        """
        named = [link for link in self._moving if is_odometry_link(*link)]
        linked = [
            link
            for link in self._moved
            if lidar and self.tree.find(link[1], lidar) is not None and self.tree.find(link[0], lidar) is None
        ]
        found = [link for link in named if link in linked] + [link for link in named if link in self._moved]
        found += linked + (named if live else [])
        if not found and named:
            parent, child = named[0]
            return None, f"the transform from {parent} to {child} never changes: it is not used as odometry"
        return next(iter(found), None), ""

    def world_chain(self, frame: str, odometry: str, link: Link | None) -> tuple[str, ...]:
        """Return the frames from that of a map to that of the odometry along fixed and moving transforms,
        both included, without the one that carries the robot, `link`; () if they are not linked. For equal
        names it is this one name."""
        links = [*self._moving, *self.tree.links()]
        chains: dict[str, tuple[str, ...]] = {frame: (frame,)}
        border = [frame]
        while border and odometry not in chains:
            ahead = [
                (child, (*chains[parent], child))
                for parent, child in links
                if parent in border and child not in chains and (parent, child) != link
            ]
            chains.update(ahead)
            border = [child for child, _ in ahead]
        return chains.get(odometry, ())

    def base_frame(self, by_odometry: Sequence[str], lidar: str) -> str:
        """Return the base frame: the first one with a fixed transform to the LiDAR, or else the first one, of
        these: `by_odometry`, and those of "base_link", "base_footprint" and "base" that `tree` knows. Names
        that are "" are skipped; "" if none is left.

        Args:
            by_odometry: Frames of the robot by the odometry.
            lidar: Frame of the LiDAR.
        """
        usual = [name for name in USUAL_BASES if self.tree.knows(name)]
        names = [name for name in (*by_odometry, *usual) if name]
        linked = (name for name in names if lidar and self.tree.find(name, lidar) is not None)
        return next(linked, next(iter(names), ""))

    def _links(self, numbers: frozenset[int], limit: int) -> tuple[dict[Link, Pose3], list[Link]]:
        """Return a dict from links to the first pose T_parent_child in the first `limit` messages
        of some channels and the last ones, and the list of those that change."""
        seen: dict[Link, Pose3] = {}
        moved: dict[Link, None] = {}
        if not numbers:
            return seen, []
        first, last = self._container.first(numbers, limit), self._container.last(numbers, _LAST_MESSAGES)
        for message in chain(first, last):
            for _stamp, link, pose in self.decode(message, {}):
                before = seen.setdefault(link, pose)
                same = np.allclose(before.R, pose.R, atol=1e-9) and np.allclose(before.t, pose.t, atol=1e-9)
                if not same:
                    moved[link] = None
        return seen, list(moved)

    def decode(
        self, message: Message, losses: dict[str, int], counted: Link | None = None
    ) -> list[tuple[int, Link, Pose3]]:
        """Return the times [ns], links and poses T_parent_child of the finite transforms of a message, in its
        order; [] if it is damaged.

        Args:
            message: The message.
            losses: Dict from reasons to numbers; damaged messages, and transforms of the link `counted` that
                are not finite, are added in place.
            counted: The link, None for none.
        """
        try:
            channel = self._channels[message.channel]
            decoded: ros2.tf2_msgs__msg__TFMessage = decode(channel, message.payload)
        except Exception:  # the generated decoders of rosbags raise many kinds
            count_loss(losses, _UNREADABLE)
            return []
        links = []
        for stamped in decoded.transforms:
            link = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
            try:
                with np.errstate(all="ignore"):
                    pose = pose_of(stamped.transform.translation, stamped.transform.rotation)
            except ValueError:
                if link == counted:
                    count_loss(losses, _UNREADABLE)
                continue
            stamp_ns = int(stamped.header.stamp.sec) * SECOND_NS + int(stamped.header.stamp.nanosec)
            links.append((stamp_ns, link, pose))
        return links
