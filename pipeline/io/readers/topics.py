"""Choice of the topics of a recording: by type, and of several the one with the most messages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pipeline.errors import SourceError
from pipeline.io.readers.base import RecordedTopic
from pipeline.io.readers.container import Channel
from pipeline.io.readers.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    LASER_SCAN,
    NAV_SAT_FIX,
    ODOMETRY,
    POINT_CLOUD,
    POSE_WITH_COVARIANCE,
    ROS1_TRANSFORMS,
    TRANSFORMS,
    VELODYNE_SCAN,
)

TYPES_BY_ROLE = {
    "scan": (POINT_CLOUD, VELODYNE_SCAN, LASER_SCAN),
    "odometry": (ODOMETRY,),
    "imu": (IMU,),
    "gnss": (NAV_SAT_FIX,),
    "pose": (POSE_WITH_COVARIANCE, ODOMETRY),
    "camera": (COMPRESSED_IMAGE, IMAGE),
}
TRANSFORM_TYPES = (TRANSFORMS, ROS1_TRANSFORMS)
ROLES = "scan, odometry, imu, gnss, pose or camera"
#: A recording that does not name the serialization is read as CDR, the default of ROS 2.
_READABLE = ("cdr", "ros1", "")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of one type.

    Attributes:
        name, msgtype: Name and message type.
        numbers: Numbers of its channels.
        count: Number of messages of all channels.
    """

    name: str
    msgtype: str
    numbers: frozenset[int]
    count: int


@dataclass(frozen=True, slots=True)
class Topics:
    """Topics of a recording.

    Attributes:
        chosen: Topic that is read by role; a role without a topic is missing.
        every: All topics.
    """

    chosen: dict[str, Topic]
    every: tuple[Topic, ...]

    def numbers(self, role: str) -> frozenset[int]:
        """Return the numbers of the channels that are read in a role; empty without a topic."""
        topic = self.chosen.get(role)
        return frozenset() if topic is None else topic.numbers

    def transforms(self, *, fixed: bool) -> frozenset[int]:
        """Return the numbers of the channels of fixed or of moving transforms."""
        found = (t.numbers for t in self.every if t.msgtype in TRANSFORM_TYPES and is_fixed(t.name) is fixed)
        return frozenset[int]().union(*found)

    def recorded(self) -> tuple[RecordedTopic, ...]:
        """Return all topics with the role in which each is read, the role that it could have, and the reason
        why it is not read."""
        reading = {topic: "transforms" for topic in self.every if topic.msgtype in TRANSFORM_TYPES}
        if "camera" in self.chosen:
            reading |= {topic: "camera" for topic in self.every if topic.msgtype == CAMERA_INFO}
        reading |= {topic: role for role, topic in self.chosen.items()}
        found = []
        for topic in self.every:
            role = _role_of(topic)
            why_not = "" if topic in reading else _why_not(topic, self.chosen.get(role))
            use = reading.get(topic, "")
            found.append(RecordedTopic(topic.name, topic.msgtype, topic.count, use, role, why_not))
        return tuple(found)


def is_fixed(topic: str) -> bool:
    """Return whether a topic of transforms has the fixed ones: whether its name ends with "tf_static"."""
    return topic.endswith("tf_static")


def choose_topics(channels: Iterable[Channel], wanted: Mapping[str, str], where: str) -> Topics:
    """Choose the topics by role.

    Args:
        channels: Channels of the recording.
        wanted: Topic by role ("scan", "odometry", "imu", "gnss", "pose", "camera") chosen by the user; other
            roles get the topic of their type with most messages, except "pose", which is read only if it is
            chosen.
        where: Name of the recording in errors.

    Raises:
        SourceError: There is no topic with scans, a role is unknown, or a topic chosen by the user does not
            exist or has no type for its role. The message lists the topics.
    """
    topics = _group(channels)
    unknown = sorted(wanted.keys() - TYPES_BY_ROLE.keys())
    if unknown:
        raise SourceError(f"there is no role {unknown[0]!r} for a topic", where=where, remedy=f"Use {ROLES}.")
    chosen = {role: _choose(topics, role, wanted, where) for role in TYPES_BY_ROLE}
    if chosen["scan"] is None:
        types = " or ".join(TYPES_BY_ROLE["scan"])
        raise SourceError(
            f"the recording has no scans (messages of {types}); {_listing(topics)}",
            where=where,
            remedy="Record the topic of the LiDAR.",
        )
    return Topics({role: topic for role, topic in chosen.items() if topic is not None}, tuple(topics))


def _role_of(topic: Topic) -> str:
    """Return the first role that the type of a topic fits, "" without one."""
    return next((role for role, types in TYPES_BY_ROLE.items() if topic.msgtype in types), "")


def _why_not(topic: Topic, chosen: Topic | None) -> str:
    """Return the reason why a topic is not read, for the user.

    Args:
        topic: The topic.
        chosen: Topic that is read in its role, or None.
    """
    if chosen is None and topic.count and topic.msgtype == POSE_WITH_COVARIANCE:
        return "it is read when it is named as pose"
    if chosen is None:
        return "no message in it" if _role_of(topic) else "nothing is made of this type"
    if topic.count == 0:
        return "no message in it"
    if chosen.msgtype != LASER_SCAN and topic.msgtype == LASER_SCAN:
        return f"{chosen.name} sees in space"
    if topic.count == chosen.count:
        return f"{chosen.name} has as many messages, and is taken"
    return f"{chosen.name} has more messages" if chosen.count > topic.count else f"{chosen.name} was named"


def _group(channels: Iterable[Channel]) -> list[Topic]:
    """Return the topics of channels, sorted by name and type. Channels in another serialization than CDR or
    ROS 1 get a type name that fits no role."""
    groups: dict[tuple[str, str], list[Channel]] = {}
    for channel in channels:
        if channel.encoding in _READABLE:
            groups.setdefault((channel.topic, channel.msgtype), []).append(channel)
        else:
            named = f"{channel.msgtype or 'unknown type'} as {channel.encoding[:20]}"
            groups.setdefault((channel.topic, named), []).append(channel)
    return [
        Topic(name, msgtype, frozenset(c.number for c in members), sum(c.count for c in members))
        for (name, msgtype), members in sorted(groups.items())
    ]


def _choose(topics: list[Topic], role: str, wanted: Mapping[str, str], where: str) -> Topic | None:
    """Return the topic of a role; None if there is none with messages. A planar laser is chosen only without
    another scan topic, and the pose of another SLAM is not odometry.

    Args:
        topics: Topics of the recording.
        role: The role.
        wanted: Topic by role chosen by the user, which may have no messages. Without a choice the role "pose"
            has no topic.
        where: Name of the recording in errors.

    Raises:
        SourceError: The topic chosen by the user does not exist or has another type.
    """
    types, name = TYPES_BY_ROLE[role], wanted.get(role)
    taken = wanted.get("pose") if role == "odometry" else None
    topics = [topic for topic in topics if topic.name != taken]
    fitting = [topic for topic in topics if topic.msgtype in types and (name is None or topic.name == name)]
    if name is not None and not fitting:
        there = any(topic.name == name for topic in topics)
        reason = f"the topic {name} is not of the type {' or '.join(types)}" if there else f"no topic {name}"
        raise SourceError(
            f"{reason}; {_listing(topics)}", where=where, remedy=f"Name one with --topic {role}=NAME."
        )
    if role == "pose" and name is None:  # only used when the user chooses it
        return None
    filled = [topic for topic in fitting if topic.count > 0] or (fitting if name is not None else [])
    # With equal counts a decoded cloud is preferred to the raw packets. A planar laser of a robot with a 3D
    # LiDAR is its bumper.
    return max(
        filled,
        key=lambda topic: (topic.msgtype != LASER_SCAN, topic.count, -types.index(topic.msgtype)),
        default=None,
    )


def _listing(topics: list[Topic]) -> str:
    """Return the first 30 topics with types and numbers of messages as text for an error."""
    if not topics:
        return "it has no topics"
    shown = [f"{topic.name[:80]} [{topic.msgtype[:80]}, {topic.count}]" for topic in topics[:30]]
    more = f" and {len(topics) - 30} more" if len(topics) > 30 else ""
    return "it has " + ", ".join(shown) + more
