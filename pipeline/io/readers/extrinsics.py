"""Where the sensors of a recording stand on the robot, from its transforms."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import cast

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.decompression import plain_message
from pipeline.io.readers.ros_messages import Transforms, TransformStamped
from pipeline.io.readers.rostypes import MessageDecoder
from pipeline.io.readers.tf_tree import TransformTree, frame_name, is_odometry_link, pose_of
from pipeline.io.readers.topics import Topic

#: So many messages of fixed and of moving transforms are looked at when a recording is opened.
FIXED_MESSAGES = 1000
MOVING_MESSAGES = 300
_WORLD = ("map", "world", "earth", "odom", "utm")

#: Time of the transform, parent frame, child frame, T_parent_child.
Link = tuple[int, str, str, Pose3]


class Mounting:
    """The fixed transforms of a recording, and the link of its odometry when a transform carries it.

    Attributes:
        tree: Fixed transforms.
        odometry_link: (parent, child) of the moving transform that says where the robot is, or None.
    """

    def __init__(self, container: Container, decoder: MessageDecoder) -> None:
        self._container = container
        self._decoder = decoder
        self._channels: dict[int, Channel] = {c.number: c for c in container.channels}
        self.tree = TransformTree()
        self.odometry_link: tuple[str, str] | None = None

    def read(self, fixed: Iterable[Topic], moving: Iterable[Topic]) -> None:
        """Look at the transforms; what cannot be decoded is passed over here and counted when read."""
        for (parent, child), pose in self._links(moving, MOVING_MESSAGES, steady=True).items():
            self.tree.add(parent, child, pose)
        for (parent, child), pose in self._links(fixed, FIXED_MESSAGES, steady=False).items():
            self.tree.add(parent, child, pose)

    def base_frame(self, said: str) -> str:
        """The frame of the base: what the odometry said, else a frame with a usual name, else ""."""
        if said:
            return said
        if self.odometry_link is not None:
            return self.odometry_link[1]
        usual = ("base_link", "base_footprint", "base")
        return next((name for name in usual if self.tree.knows(name)), "")

    def _links(self, topics: Iterable[Topic], limit: int, *, steady: bool) -> dict[tuple[str, str], Pose3]:
        """Transforms of the first messages; with `steady` only those that do not move."""
        numbers = frozenset[int]().union(*(topic.numbers for topic in topics))
        seen: dict[tuple[str, str], Pose3] = {}
        moved: set[tuple[str, str]] = set()
        for message in islice(self._container.messages(numbers, None, {}), limit if numbers else 0):
            for _stamp, parent, child, pose in self.decode(message):
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

    def decode(self, message: Message) -> list[Link]:
        """The transforms of one message, without those that are not finite; [] when it is damaged."""
        try:
            payload = plain_message(message.payload)
            decoded = cast(Transforms, self._decoder.decode(self._channels[message.channel], payload))
        except Exception:  # whatever the generated decoders of rosbags raise
            return []
        with np.errstate(all="ignore"):
            return [link for link in map(_link, decoded.transforms) if link is not None]


def _link(stamped: TransformStamped) -> Link | None:
    try:
        pose = pose_of(stamped.transform.translation, stamped.transform.rotation)
    except ValueError:
        return None
    stamp_ns = int(stamped.header.stamp.sec) * 1_000_000_000 + int(stamped.header.stamp.nanosec)
    return stamp_ns, frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id), pose
