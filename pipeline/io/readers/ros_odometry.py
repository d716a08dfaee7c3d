"""Frames of the topics of a recording, and the odometry that is read by them: a topic, a moving transform, or
none."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.container import Container
from pipeline.io.readers.message_time import header_frame
from pipeline.io.readers.topics import ODOMETRY, TYPES_BY_ROLE, Topic, Topics, decode
from pipeline.io.readers.transforms import USUAL_BASES, Extrinsics, Link, TransformTree, frame_name

#: Number of scans among which a frame is looked for that the fixed transforms know.
_TRIES = 20
#: Cosine of the largest angle between the z axis of an upright LiDAR and the vertical.
_UPRIGHT = math.cos(math.radians(45.0))

#: Dict from names of topics to `frame_id` and `child_frame_id` of their first messages.
Frames = Mapping[str, tuple[str, str]]


def first_frames(container: Container, topics: Sequence[Topic], tree: TransformTree) -> Frames:
    """Return `frame_id` in the header of the first message of each topic, and for odometry `child_frame_id`;
    "" for what is missing or damaged, and for topics that are not read. Of several LiDARs on a topic of
    scans, the first one whose frame the fixed transforms know counts.

    Args:
        container: The recording.
        topics: Its topics.
        tree: Fixed transforms.
    """
    return {topic.name: _frames_of(container, topic, tree) for topic in topics}


def _frames_of(container: Container, topic: Topic, tree: TransformTree) -> tuple[str, str]:
    """Return the frames of a topic, see `first_frames`."""
    role = next((role for role, types in TYPES_BY_ROLE.items() if topic.msgtype in types), "camera")
    if role == "camera":
        return "", ""
    channels = container.by_number
    first = list(container.first(topic.numbers, _TRIES if role == "scan" else 1))
    if not first:
        return "", ""
    frames = [frame_name(header_frame(channels[m.channel], m.payload)) for m in first]
    if topic.msgtype != ODOMETRY:
        return next(filter(tree.knows, frames), frames[0]), ""
    try:
        decoded = decode(channels[first[0].channel], first[0].payload)
    except Exception:  # as in RecordDecoder.record
        return frames[0], ""
    return frames[0], frame_name(decoded.child_frame_id)


def nearness(
    tree: TransformTree, frames: Frames, role: str, topic: Topic, scans: Topic | None
) -> tuple[int, ...]:
    """Return how surely a topic belongs to the LiDAR, see `choose_topics`: for scans, whether they are in a
    frame of the robot, whether fixed transforms have that frame, and whether its z axis is nearer to the
    vertical than to the horizontal: a LiDAR that turns about a horizontal axis, and the optical frame of a
    depth camera, see few trunks again in the next scan. For others, whether fixed transforms link them to
    the LiDAR, and the number of parts that their names, and those of their frames, have in common with those
    of the scans.

    Args:
        tree: Fixed transforms.
        frames: Frames of all topics.
        role, topic, scans: As in `Nearness`.
    """
    del role
    frame, child = frames[topic.name]
    if scans is None:
        maps = {parent for name, (parent, robot) in frames.items() if robot and name != topic.name}
        robots = (*USUAL_BASES, *(child for _, child in frames.values() if child))
        placed = (T for robot in robots if robot != frame and (T := tree.find(robot, frame)) is not None)
        T_base_lidar = next(placed, Pose3.identity())
        is_upright = abs(T_base_lidar.R[2, 2]) > _UPRIGHT
        return int(frame not in maps), int(tree.knows(frame)), int(is_upright)
    lidar, place = frames[scans.name][0], child or frame
    linked = bool(lidar and place) and (tree.find(place, lidar) is not None or lidar == frame)
    return int(linked), _in_common(topic.name, scans.name), _in_common(place, lidar)


def _in_common(name: str, other: str) -> int:
    """Return the number of leading parts before a slash that two names have in common."""
    parts = zip(name.strip("/").split("/")[:-1], other.strip("/").split("/")[:-1], strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts))


@dataclass(frozen=True, slots=True)
class OdometryChoice:
    """The odometry of a recording.

    Attributes:
        topics: Topics that are read; none of odometry if a transform is read in its place.
        base: Frame of the robot in the messages of the topic of odometry; "" for a transform.
        link: Moving transform that carries the robot, or None; it is the odometry if no topic is.
        moving: Numbers of all channels of moving transforms.
        world: Chain of frames from that of a map, in which the clouds are, to that of the odometry; () if the
            clouds are in a frame of the robot.
        warnings: Messages for the user.
    """

    topics: Topics
    base: str
    link: Link | None
    moving: frozenset[int]
    world: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def transforms(self) -> frozenset[int]:
        """Numbers of the channels of transforms that are read as odometry; empty if a topic is."""
        is_link = self.link is not None and "odometry" not in self.topics.chosen
        return self.moving if is_link else frozenset()

    @property
    def numbers(self) -> frozenset[int]:
        """Numbers of the channels that are read as odometry; empty without odometry."""
        return self.topics.numbers("odometry") or self.transforms

    @property
    def is_known(self) -> bool:
        """Whether there is odometry."""
        return bool(self.numbers)

    @property
    def world_links(self) -> frozenset[Link]:
        """Links of `world`."""
        return frozenset(pairwise(self.world))

    @property
    def decoded_transforms(self) -> frozenset[int]:
        """Numbers of the channels of transforms that are read, as odometry or for `world_links`."""
        return self.transforms | (self.moving if self.world_links else frozenset())

    @property
    def wanted(self) -> frozenset[int]:
        """Numbers of the channels of scans, odometry, IMU, and transforms that are read."""
        roles = (self.topics.numbers(role) for role in ("scan", "odometry", "imu"))
        return self.decoded_transforms.union(*roles)

    def base_frame(self, extrinsics: Extrinsics, lidar: str) -> str:
        """Return the base frame, see `Extrinsics.base_frame`."""
        return extrinsics.base_frame((self.base, "" if self.link is None else self.link[1]), lidar)

    def none(self) -> OdometryChoice:
        """Return the choice of no odometry in place of a topic, whose robot is then unknown."""
        return replace(self, topics=self.topics.without("odometry"), base="", moving=frozenset())


def choose_odometry(
    extrinsics: Extrinsics, topics: Topics, frames: Frames, named: Collection[str], *, live: bool
) -> OdometryChoice:
    """Choose between the topic of odometry and a moving transform, and find whether the scans are in the
    frame of a map.

    Args:
        extrinsics: Transforms of the recording.
        topics: Topics that are chosen.
        frames: Frames of all topics.
        named: Roles whose topics the user chose: a topic of odometry then remains.
        live: Whether the run is live.
    """
    tree, lidar, warnings = extrinsics.tree, frames[topics.chosen["scan"].name][0], list[str]()
    link, unmoved = extrinsics.odometry_link(lidar, live=live)
    if "odometry" in topics.chosen and "odometry" not in named and link is not None:
        name = topics.chosen["odometry"].name
        frame, child = frames[name]
        is_stranger = lidar != frame and tree.find(child, lidar) is None
        if lidar and is_stranger and tree.find(link[1], lidar) is not None:
            warnings.append(
                f"the odometry is that of the transform from {link[0]} to {link[1]}, which carries the "
                f"LiDAR: no fixed transform links {child} of {name} to it"
            )
            topics = topics.without("odometry")
    topic = topics.chosen.get("odometry")
    if unmoved and topic is None:
        warnings.append(unmoved)
    if topic is not None:
        odom, base = frames[topic.name]
    else:
        odom, base = "" if link is None else link[0], ""
    chosen = OdometryChoice(topics, base, link, topics.transforms(fixed=False), warnings=tuple(warnings))
    if lidar and odom and tree.find(chosen.base_frame(extrinsics, lidar), lidar) is None:
        return replace(chosen, world=extrinsics.world_chain(lidar, odom, link))
    return chosen
