"""Topics of a recording: the message types that are read with their decoder, and the choice of the topics by
type, and of several the one with the most messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipeline.errors import SourceError
from pipeline.io.readers import MessageFormat, added
from pipeline.io.readers.base import RecordedTopic
from pipeline.io.readers.container import TRANSFORM_TYPES, Channel
from pipeline.io.readers.sensor_families import CUSTOM_TYPES, HESAI_SCANS, OUSTER_PACKETS

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
VELODYNE_SCAN = "velodyne_msgs/msg/VelodyneScan"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS, ROS1_TRANSFORMS = TRANSFORM_TYPES

_EXTRA = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    VELODYNE_SCAN: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n",
    ROS1_TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": ("std_msgs/Header header\nvision_msgs/Detection3D[] detections\n"),
}
for _custom in CUSTOM_TYPES:
    _package = _custom.partition("/")[0]
    _EXTRA[f"{_package}/msg/CustomPoint"] = (
        "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
    )
    _EXTRA[_custom] = (
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
        f"{_package}/CustomPoint[] points\n"
    )
for _packets in HESAI_SCANS:
    _package = _packets.partition("/")[0]
    _EXTRA[f"{_package}/msg/PandarPacket"] = "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size\n"
    _EXTRA[_packets] = f"std_msgs/Header header\n{_package}/PandarPacket[] packets\n"


def decode(channel: Channel, payload: bytes) -> Any:  # noqa: ANN401
    """Return one message decoded as the standard type of its channel; `rosbags.typesys.stores.ros2_jazzy`
    declares the fields. A definition in the recording is not used.

    Raises:
        Exception: Of many kinds, when the bytes do not match the type. Callers count a loss.
    """
    store = standard_types(channel.encoding)
    if channel.encoding == "ros1":
        return store.deserialize_ros1(payload, channel.msgtype)
    return store.deserialize_cdr(payload, channel.msgtype)


#: Robots with rmw_zenoh (Jazzy and later) hear only types with the hashes of their release. The release of
#: rosbags that ouster-sdk asks for may know none after Humble, whose definitions serve recordings.
_ROS2 = getattr(Stores, "ROS2_JAZZY", Stores.ROS2_HUMBLE)


@cache
def standard_types(encoding: str) -> Typestore:
    """Return the definitions of ROS 1 for "ros1" and of ROS 2 for any other encoding, with those of Velodyne,
    Hesai, Livox, tf and vision_msgs 4; the same object at each call."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else _ROS2)
    for name, text in _EXTRA.items():
        if name not in store.types:
            chosen = text.replace("builtin_interfaces/Time", "time") if encoding == "ros1" else text
            store.register({name: get_types_from_msg(chosen, name)[name]})
    return store


#: Packets of a sweep, as they come from the sensor.
PACKET_TYPES = (VELODYNE_SCAN, *HESAI_SCANS)
TYPES_BY_ROLE = {
    "scan": (*CUSTOM_TYPES, POINT_CLOUD, *PACKET_TYPES, LASER_SCAN),
    "odometry": (ODOMETRY,),
    "imu": (IMU,),
    "gnss": (NAV_SAT_FIX,),
    "pose": (POSE_WITH_COVARIANCE, ODOMETRY),
    "camera": (COMPRESSED_IMAGE, IMAGE),
}
#: Types of all messages that are read.
READ_TYPES = (*(kind for kinds in TYPES_BY_ROLE.values() for kind in kinds), CAMERA_INFO, *TRANSFORM_TYPES)
#: What `nearness` compares a topic with: the robot for scans (True), the LiDAR for other roles.
_NEAREST = {False: "LiDAR by its frames or its name", True: "robot by its frame"}
ROLES = "scan, odometry, imu, gnss, pose or camera"
#: A recording that does not name the serialization is read as CDR, the default of ROS 2.
_READABLE = ("cdr", "ros1", "")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of one type.

    Attributes:
        name, msgtype: Name and message type.
        numbers: Numbers of the channels of the topic.
        count: Number of messages of all channels.
    """

    name: str
    msgtype: str
    numbers: frozenset[int]
    count: int


#: Function of a role, a topic and the topic of the scans (None while that is chosen) that returns how surely
#: the topic belongs to the LiDAR; of two topics, the one with the larger numbers does.
Nearness = Callable[[str, "Topic", "Topic | None"], tuple[int, ...]]


def nowhere(role: str, topic: Topic, scans: Topic | None) -> tuple[int, ...]:
    """Return the nearness of a topic when nothing but its type is known."""
    del role, topic, scans
    return ()


@dataclass(frozen=True, slots=True)
class Topics:
    """Topics of a recording.

    Attributes:
        chosen: Dict from roles to the topics that are read; a role without a topic is missing.
        every: All topics.
        nearness: How surely a topic belongs to the LiDAR.
    """

    chosen: dict[str, Topic]
    every: tuple[Topic, ...]
    nearness: Nearness = nowhere

    def numbers(self, role: str) -> frozenset[int]:
        """Return the numbers of the channels that are read in a role; empty if the role has no topic."""
        topic = self.chosen.get(role)
        return frozenset() if topic is None else topic.numbers

    def without(self, role: str) -> Topics:
        """Return the topics with none that is read in a role."""
        return replace(self, chosen={each: topic for each, topic in self.chosen.items() if each != role})

    def transforms(self, *, fixed: bool) -> frozenset[int]:
        """Return the numbers of the channels of fixed or of moving transforms."""
        found = (t.numbers for t in self.every if t.msgtype in TRANSFORM_TYPES and is_fixed(t.name) is fixed)
        return frozenset[int]().union(*found)

    def recorded(self) -> tuple[RecordedTopic, ...]:
        """Return all topics with the role in which each is read, the role that it could have, and the reason
        why it is not read; each is "" if there is none. Topics of transforms are always read; those of
        CameraInfo are read as "camera" if a camera is chosen."""
        reading = {topic: "transforms" for topic in self.every if topic.msgtype in TRANSFORM_TYPES}
        if "camera" in self.chosen:
            reading |= {topic: "camera" for topic in self.every if topic.msgtype == CAMERA_INFO}
        reading |= {topic: role for role, topic in self.chosen.items()}
        found = []
        for topic in self.every:
            role = _role_of(topic)
            taken = self.chosen.get(role)
            why_not = "" if topic in reading else _why_not(topic, taken)
            scans = None if role == "scan" else self.chosen["scan"]
            if why_not and taken is not None and topic.count and taken.msgtype == topic.msgtype:
                nearest, mine = self.nearness(role, taken, scans), self.nearness(role, topic, scans)
                if nearest > mine:
                    why_not = f"{taken.name} is nearer to the {_NEAREST[scans is None]}"
            use = reading.get(topic, "")
            why = self._why(role, topic) if use == role else ""
            found.append(RecordedTopic(topic.name, topic.msgtype, topic.count, use, role, why_not, why))
        return tuple(found)

    def _why(self, role: str, topic: Topic) -> str:
        """Return why a topic is read and not another one of its role; "" if there is no other one."""
        others = [each for each in self.every if each != topic and _role_of(each) == role and each.count]
        if not others:
            return ""
        scans = None if role == "scan" else self.chosen["scan"]
        mine = self.nearness(role, topic, scans)
        if all(mine > self.nearness(role, other, scans) for other in others):
            return f"nearest to the {_NEAREST[scans is None]}"
        return "most messages" if all(topic.count > other.count for other in others) else "first of its kind"


def is_fixed(topic: str) -> bool:
    """Return whether a topic of transforms has the fixed ones: whether its name ends with "tf_static"."""
    return topic.endswith("tf_static")


def choose_topics(
    channels: Iterable[Channel],
    wanted: Mapping[str, str],
    where: str,
    nearness: Nearness = nowhere,
) -> Topics:
    """Return the topic that is read in each role, and all topics.

    Args:
        channels: Channels of the recording.
        wanted: Dict from roles ("scan", "odometry", "imu", "gnss", "pose", "camera") to topics chosen by the
            user. Other roles get the topic of their type that is nearest to the LiDAR, of equal ones that
            with most messages. Exceptions: "pose" is read only
            if it is chosen; its topic is not used as odometry; LaserScan is used only if no other topic of
            scans has messages. A role without messages gets no topic, unless the user chooses one.
        where: Name of the recording in errors.
        nearness: How surely a topic belongs to the LiDAR.

    Raises:
        SourceError: There is no topic with scans, a role is unknown, or a topic chosen by the user does not
            exist or has no type for its role. The message lists the topics; that of an unknown role the
            roles; that of packets which are not decoded the driver.
    """
    topics = group_topics(channels)
    unknown = sorted(wanted.keys() - TYPES_BY_ROLE.keys())
    if unknown:
        raise SourceError(f"there is no role {unknown[0]!r} for a topic", where=where, remedy=f"Use {ROLES}.")
    chosen: dict[str, Topic | None] = {}
    for role in TYPES_BY_ROLE:
        chosen[role] = _choose(topics, role, wanted, where, _beside(nearness, role, chosen.get("scan")))
    if chosen["scan"] is None:
        _refuse_packets(topics, where)
        types = " or ".join(TYPES_BY_ROLE["scan"])
        raise SourceError(
            f"the recording has no scans (messages of {types}); {_listing(topics)}",
            where=where,
            remedy=_remedy_without_scans(topics),
        )
    return Topics(
        {role: topic for role, topic in chosen.items() if topic is not None}, tuple(topics), nearness
    )


def _beside(nearness: Nearness, role: str, scans: Topic | None) -> Callable[[Topic], tuple[int, ...]]:
    """Return the nearness of topics of a role to the topic of the scans."""
    return lambda topic: nearness(role, topic, scans)


def _refuse_packets(topics: list[Topic], where: str) -> None:
    """Raise a SourceError that names maker and driver if a topic has packets that are not decoded; else
    return."""
    for topic in topics:
        kind = next((kind for kind in added(MessageFormat) if topic.msgtype in kind.msgtypes), None)
        if kind is not None and topic.count:
            raise SourceError(
                f"{topic.name} has {kind.words}, which cannot be read ({topic.msgtype})",
                where=where,
                remedy=kind.refusal or f"Play it through {kind.driver}, and record its PointCloud2.",
            )


#: Words in the names and types of topics of LiDARs.
_LIDAR_WORDS = (
    "lidar", "laser", "scan", "cloud", "points", "velodyne", "livox", "ouster", "hesai", "robosense",
)  # fmt: skip


def _remedy_without_scans(topics: list[Topic]) -> str:
    """Return what helps with a recording that has no scans which can be read."""
    silent = next((t for t in topics if _role_of(t) == "scan" and not t.count), None)
    if silent is not None:
        return f"{silent.name} has no message: look whether the driver of the LiDAR ran."
    other = [
        topic
        for topic in topics
        if topic.count
        and not _role_of(topic)
        and any(word in f"{topic.name} {topic.msgtype}".lower() for word in _LIDAR_WORDS)
    ]
    if other:
        return (
            f"{other[0].name} is of the type {other[0].msgtype}, which is not read: play it through the "
            "driver of the LiDAR, or a converter, and record its sensor_msgs/PointCloud2."
        )
    return "No topic of it is of a LiDAR: record its sensor_msgs/PointCloud2."


def _role_of(topic: Topic) -> str:
    """Return the first role that the type of a topic fits, "" if there is none."""
    return next((role for role, types in TYPES_BY_ROLE.items() if topic.msgtype in types), "")


def _why_not(topic: Topic, chosen: Topic | None) -> str:
    """Return the reason why a topic is not read, for the user.

    Args:
        topic: The topic.
        chosen: Topic that is read in its role, or None.
    """
    if chosen is None and topic.count and topic.msgtype == POSE_WITH_COVARIANCE:
        return "it is read when it is named as pose"
    if topic.msgtype in OUSTER_PACKETS and topic.count:
        return "decoded scans are read; --topic scan=NAME decodes its packets"
    if chosen is None:
        return "no message in it" if _role_of(topic) else "nothing is made of this type"
    if topic.count == 0:
        return "no message in it"
    if topic.msgtype in PACKET_TYPES and chosen.msgtype not in PACKET_TYPES:
        return f"{chosen.name} is decoded already"
    if chosen.msgtype != LASER_SCAN and topic.msgtype == LASER_SCAN:
        return f"{chosen.name} sees in space"
    if topic.count == chosen.count:
        return f"{chosen.name} has as many messages, and is taken"
    return f"{chosen.name} has more messages" if chosen.count > topic.count else f"{chosen.name} was named"


def group_topics(channels: Iterable[Channel]) -> list[Topic]:
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


def _choose(
    topics: list[Topic],
    role: str,
    wanted: Mapping[str, str],
    where: str,
    nearness: Callable[[Topic], tuple[int, ...]],
) -> Topic | None:
    """Return the topic of a role that is nearest, then with the most messages, of equal ones that of the type
    named first in TYPES_BY_ROLE, then the first by name; None if there is none with messages. LaserScan is
    chosen only if no other topic of scans has messages, and the topic of the role "pose" is not chosen as
    odometry.

    Args:
        topics: Topics of the recording.
        role: The role.
        wanted: Dict from roles to topics chosen by the user, which may have no messages. If "pose" is
            missing, this role has no topic.
        where: Name of the recording in errors.
        nearness: How surely a topic belongs to the LiDAR.

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
    # With equal counts a CustomMsg is preferred to a cloud, which may be derived from it. A decoded cloud
    # with half as many messages is preferred to the packets, of which a driver may need some to begin. A
    # planar laser of a robot with a 3D LiDAR is its bumper.
    return max(
        filled,
        key=lambda topic: (
            topic.msgtype != LASER_SCAN,
            nearness(topic),
            topic.count / (2 if topic.msgtype in PACKET_TYPES else 1),
            -types.index(topic.msgtype),
        ),
        default=None,
    )


def _listing(topics: list[Topic]) -> str:
    """Return the first 30 topics with types and numbers of messages as text for an error."""
    if not topics:
        return "it has no topics"
    shown = [f"{topic.name[:80]} [{topic.msgtype[:80]}, {topic.count}]" for topic in topics[:30]]
    more = f" and {len(topics) - 30} more" if len(topics) > 30 else ""
    return "it has " + ", ".join(shown) + more
