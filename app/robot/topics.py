"""Topics of a robot: who publishes them, and which of them are read (chosen by type, as in recordings)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from pipeline.errors import SourceError
from pipeline.io.readers.camera import shared_parts
from pipeline.io.readers.container import Channel
from pipeline.io.readers.topics import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMU,
    LASER_SCAN,
    NAV_SAT_FIX,
    ODOMETRY,
    READ_TYPES,
    TRANSFORMS,
    TYPES_BY_ROLE,
    VELODYNE_SCAN,
)

TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::msg::dds_::([A-Za-z][A-Za-z0-9_]*)_")
#: A name of ROS that is also a valid Zenoh key: no empty parts, no wildcards.
NAME = re.compile(r"(?:/[A-Za-z0-9_.~-]+)+")
#: More endpoints than this are not a robot's network; the rest are counted and left out.
MAX_ENDPOINTS = 5000


@dataclass(frozen=True, slots=True)
class Publisher:
    """A published topic.

    Attributes:
        robot: Namespace of the publisher without slashes at its ends, "" for none.
        topic: Name with its leading slash.
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".
    """

    robot: str
    topic: str
    msgtype: str


SCAN_TYPES, PICTURE_TYPES = TYPES_BY_ROLE["scan"], TYPES_BY_ROLE["camera"]
#: Value of `?camera=` that receives no pictures, for a slow radio link.
NO_CAMERA = "none"
#: Namespace of the topics that this program publishes, which are not read.
OWN = "stemmap"
#: Words of topics whose pictures do not show the scene.
_NO_SCENE = ("depth", "disparity", "confidence", "mask", "label")
_DERIVED = ("camera", "depth", "image", "map", "ground", "cluster", "filtered", "voxel")


@dataclass(frozen=True, slots=True)
class Choice:
    """The topics of a robot that are read.

    Attributes:
        robot: Namespace of the robot, "" for none.
        channels: Channels of the topics, numbered from 1; the scan is the first.
        warnings: Other topics and robots that could have been chosen.
        camera: Channels of the pictures and of their CameraInfo if there are any, numbered after the others.
    """

    robot: str
    channels: tuple[Channel, ...]
    warnings: tuple[str, ...]
    camera: tuple[Channel, ...] = ()


def choose(publishers: Iterable[Publisher], robot: str, topics: dict[str, str], where: str) -> Choice | None:
    """Return the topics of one robot that are read; None while no such robot publishes scans. A role without
    a topic has no channel, and "pose" only has one if the user named it; its topic is not used as odometry.
    Topics without a namespace belong to every robot; those below a namespace `stemmap` are ignored.

    Args:
        publishers: Present publishers.
        robot: Namespace of the robot, ROOT for none, "" for the one with the best scan topic, see
            `_scan_rank`.
        topics: Dict from each role for which the user named a topic to this topic.
        where: The address, for errors.

    Raises:
        SourceError: A topic that the user named has another type.
    """
    there = [p for p in publishers if OWN not in p.topic.split("/")[:-1]]
    named = topics.get("scan")
    scans = [p for p in there if p.msgtype in SCAN_TYPES]
    wanted = robot.strip("/")
    fitting = [p for p in scans if (not robot or p.robot == wanted) and (named is None or p.topic == named)]
    if not fitting:
        _refuse_wrong_type(there, topics, "scan", SCAN_TYPES, where)
        return None
    scan = min(fitting, key=_scan_rank)
    mine = [p for p in there if p.robot in (scan.robot, "")]
    wheels = [p for p in mine if p.topic != topics.get("pose")]
    odometry = _of_role(wheels, topics, "odometry", (ODOMETRY,), _odometry_rank, where)
    # Raw topics have no orientation.
    imu = _of_role(mine, topics, "imu", (IMU,), lambda p: ("raw" in p.topic.lower(), p.topic), where)
    gnss = _of_role(mine, topics, "gnss", (NAV_SAT_FIX,), lambda p: (p.topic,), where)
    pose = _pose(mine, topics, where)
    transforms = sorted({p.topic: p for p in mine if p.msgtype == TRANSFORMS}.values(), key=lambda p: p.topic)
    chosen = [p for p in (scan, odometry, imu, gnss, pose, *transforms) if p is not None]
    camera = _camera(mine, topics, where)
    channels = tuple(Channel(k, p.topic, p.msgtype, "cdr") for k, p in enumerate([*chosen, *camera], 1))
    warnings = tuple(_warnings(scans, scan, robot, named))
    return Choice(scan.robot, channels[: len(chosen)], warnings, channels[len(chosen) :])


def _pose(there: list[Publisher], topics: dict[str, str], where: str) -> Publisher | None:
    """Return the topic of the poses of another SLAM if the user named it and it is published, else None.

    Args:
        there: Publishers of the robot.
        topics: Dict from each role for which the user named a topic to this topic.
        where: The address, for errors.

    Raises:
        SourceError: The named topic has another type.
    """
    if "pose" not in topics:
        return None
    return _of_role(there, topics, "pose", TYPES_BY_ROLE["pose"], lambda p: (p.topic,), where)


def _camera(there: list[Publisher], topics: dict[str, str], where: str) -> list[Publisher]:
    """Return the topic of the pictures and, where one exists, the CameraInfo with the most similar name; []
    without a camera or for the topic NO_CAMERA. Compressed pictures are preferred, and those that show no
    scene (depth, masks) count only if named; arguments as in `_pose`, errors as in `_of_role`."""
    if topics.get("camera") == NO_CAMERA:
        return []
    seen = there if "camera" in topics else [p for p in there if not _has_word(p, _NO_SCENE)]
    # Compressed pictures have a tenth of the size.
    pictures = _of_role(
        seen, topics, "camera", PICTURE_TYPES, lambda p: (p.msgtype != COMPRESSED_IMAGE, p.topic), where
    )
    if pictures is None:
        return []
    infos = sorted(
        (p for p in there if p.msgtype == CAMERA_INFO),
        key=lambda p: (-shared_parts(p.topic, pictures.topic), p.topic),
    )
    return [pictures, *infos[:1]]


def _of_role(
    there: list[Publisher],
    topics: dict[str, str],
    role: str,
    types: tuple[str, ...],
    rank: Callable[[Publisher], tuple[object, ...]],
    where: str,
) -> Publisher | None:
    """Return the publisher of a role: that of the topic that the user named, else the first by `rank` of
    those with one of `types`. None if there is no such publisher, also if the named topic is not published.

    Args:
        there: Publishers of the robot.
        topics: Dict from each role for which the user named a topic to this topic.
        role: The role.
        types: Message types of the role.
        rank: Sort key of a publisher; the smallest is chosen.
        where: The address, for errors.

    Raises:
        SourceError: The named topic has another type.
    """
    named = topics.get(role)
    fitting = [p for p in there if p.msgtype in types and (named is None or p.topic == named)]
    if not fitting:
        _refuse_wrong_type(there, topics, role, types, where)
        return None
    return min(fitting, key=rank)


def _refuse_wrong_type(
    there: list[Publisher], topics: dict[str, str], role: str, types: tuple[str, ...], where: str
) -> None:
    """Raise SourceError if the topic that the user named for a role is published with another type; arguments
    as in `_of_role`."""
    wrong = [p for p in there if p.topic == topics.get(role) and p.msgtype not in types]
    if wrong:
        raise SourceError(
            f"the topic {wrong[0].topic} is of the type {wrong[0].msgtype}",
            where=where,
            remedy=f"Name one of the type {' or '.join(types)} with {role}=NAME.",
        )


def _has_word(publisher: Publisher, words: tuple[str, ...]) -> bool:
    """Return whether the name of the topic contains one of some words; case is ignored."""
    return any(word in publisher.topic.lower() for word in words)


def _scan_rank(publisher: Publisher) -> tuple[object, ...]:
    """Return the sort key of a scan topic; the smallest is the best topic. A planar laser (LASER_SCAN) comes
    last. Before it come topics whose name contains a word of `_DERIVED`. Among equals, packets of a Velodyne
    sensor come last; then robot and name decide."""
    kind, is_derived = publisher.msgtype, _has_word(publisher, _DERIVED)
    return kind == LASER_SCAN, is_derived, kind == VELODYNE_SCAN, publisher.robot, publisher.topic


def _odometry_rank(publisher: Publisher) -> tuple[object, ...]:
    """Return the sort key of an odometry topic; the smallest is the best topic. Names that contain gps, map
    or slam come last; of the others, names that end in odom come first; among equals, the name decides. Case
    is ignored."""
    name = publisher.topic.lower()
    return any(word in name for word in ("gps", "map", "slam")), not name.endswith("odom"), publisher.topic


def _warnings(scans: list[Publisher], scan: Publisher, robot: str, named: str | None) -> list[str]:
    """Return messages about what could have been chosen: one about other robots unless the user named one,
    and one about other scan topics of the chosen robot unless the user named the topic; each names at most
    ten.

    Args:
        scans: All scan topics.
        scan: The chosen one.
        robot: Namespace that the user named; "" for none.
        named: Scan topic that the user named, or None.
    """
    warnings = []
    others = sorted({p.robot or "(no namespace)" for p in scans} - {scan.robot or "(no namespace)"})
    if others and not robot:
        warnings.append(
            f"there are more robots: {', '.join(others[:10])}; {scan.robot or 'the one without a namespace'} "
            "is mapped, robot=NAME in the address chooses another"
        )
    more = sorted({p.topic for p in scans if p.robot == scan.robot} - {scan.topic})
    if more and named is None:
        warnings.append(
            f"{scan.topic} is read; there is also {', '.join(more[:10])}; scan=NAME in the address "
            "chooses another"
        )
    return warnings


def countable(publishers: Sequence[Publisher], most: int) -> list[Channel]:
    """Return a channel for each topic whose type is read, numbered by its position in `publishers`. Other
    topics may have messages of any size and are not received.

    Args:
        publishers: Present publishers.
        most: Maximum number of publishers that are considered.
    """
    return [
        Channel(k, each.topic, each.msgtype, "cdr")
        for k, each in enumerate(publishers[:most])
        if each.msgtype in READ_TYPES
    ]
