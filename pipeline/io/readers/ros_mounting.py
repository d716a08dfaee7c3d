"""Mounting of the LiDAR of a ROS recording: by the user, the fixed transforms, the ground, and the motion of
the scans beside the odometry."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.geometry.poses import Float, Pose3, wrap_angle
from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.container import Message
from pipeline.io.readers.mounting import mounting_by_ground, mounting_by_grounds, tilt_text
from pipeline.io.readers.ros_first_scans import FirstScan
from pipeline.io.readers.ros_messages import TimedMessages
from pipeline.io.readers.ros_odometry import OdometryChoice
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.topics import Topics
from pipeline.io.readers.transforms import USUAL_BASES, Extrinsics, TransformTree
from pipeline.types.records import Int, Odometry, Scan

if TYPE_CHECKING:
    from pipeline.odometry.mounting_yaw import MountingYaw

#: Path by which the yaw of a mounting is found, and how far the robot is from its start when it begins [m].
_MOTION, _BEGUN = 5.0, 0.2
#: Most readings and scans that are read for it.
_MOST_READINGS, _MOST_SCANS = 60_000, 400
#: Number of scans by which the tilt of a LiDAR is found, and least share of points that must fit to the map
#: of the scans before, for their motion to be known.
_LEVELS, _SAME_WORLD = 5, 0.5
#: A yaw by the motion that differs less from a stated one may be the error of the registration [rad].
_OTHER_YAW = np.radians(15.0)
#: Words in usual names of frames of LiDARs.
_LIDAR_WORDS = ("lidar", "velodyne", "livox", "laser", "hesai", "pandar", "os_sensor", "ouster", "rslidar")


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Where the LiDAR stands on the robot.

    Attributes:
        base, lidar: Frames of the robot and of the LiDAR; "" if unknown.
        odometry: Odometry that is read: none if it proves to be of another robot.
        T_base_lidar: Extrinsics of the LiDAR; None if they are unknown: it is taken to be at the base.
        is_measured: Whether they were found by the ground or the motion.
        is_assumed: Whether the robot has odometry, and neither a fixed transform nor the user tells them.
        is_stated: Whether the user tells them.
        shows_yaw: Whether the motion of the scans beside the odometry shows the yaw.
        contradicting: Number of scans whose motion contradicts that of the odometry.
        warnings: Messages for the user about what is assumed.
    """

    base: str
    lidar: str
    odometry: OdometryChoice
    T_base_lidar: Pose3 | None = None
    is_measured: bool = False
    is_assumed: bool = False
    is_stated: bool = False
    shows_yaw: bool = False
    contradicting: int = 0
    warnings: tuple[str, ...] = ()


def find_mounting(
    first: FirstScan,
    odometry: OdometryChoice,
    extrinsics: Extrinsics,
    messages: TimedMessages,
    decoder: RecordDecoder,
    options: SourceOptions,
    *,
    live: bool,
) -> Mounting:
    """Find the mounting of the LiDAR: by the user, the transforms, or the ground and the motion.

    Args:
        first: First scan with points.
        odometry: The odometry.
        extrinsics: Transforms of the recording.
        messages: Messages of the recording, with the odometry if there is any.
        decoder: Their decoder.
        options: Choices of the user. Odometry that contradicts the scans, and is of another robot by the name
            of its topic, is left out unless they name this topic.
        live: Whether the run is live, so that the motion is not known yet.

    Raises:
        SourceError: The recording cannot be read.
    """
    by_frames = _mounting_by_frames(first.frame, odometry, extrinsics, options)
    if by_frames.T_base_lidar is not None:
        return by_frames
    missing = f"no fixed transform from {first.frame or 'the LiDAR'} to {by_frames.base or 'the base'}"
    is_assumed = by_frames.base != first.frame and odometry.is_known
    motion, warnings = _Motion(mounting_by_ground(first.scan)), [*by_frames.warnings]
    if motion.T_base_lidar is not None:
        warnings.append(f"{missing}: {tilt_text(motion.T_base_lidar)}")
    if odometry.is_known and not live:
        motion = _mounting_by_motion(messages, decoder, first.frame, motion.T_base_lidar)
        warnings += motion.warnings
    if motion.contradicting and "odometry" not in options.topics and _is_of_another_robot(odometry.topics):
        warnings.append(
            f"{odometry.topics.chosen['odometry'].name} is not used: by its name and its motion it is of "
            "another robot than the scans; --topic odometry=NAME overrides this"
        )
        alone = find_mounting(first, odometry.none(), extrinsics, messages, decoder, options, live=live)
        return replace(alone, warnings=(*warnings, *alone.warnings))
    if motion.T_base_lidar is None and is_assumed:
        warnings.append(f"{missing}: the LiDAR is assumed to be at the base")
    return replace(
        by_frames,
        T_base_lidar=motion.T_base_lidar,
        is_measured=motion.T_base_lidar is not None,
        is_assumed=is_assumed,
        shows_yaw=motion.shows_yaw,
        contradicting=motion.contradicting,
        warnings=tuple(warnings),
    )


def _mounting_by_frames(
    frame: str, odometry: OdometryChoice, extrinsics: Extrinsics, options: SourceOptions
) -> Mounting:
    """Return the mounting by the user or the fixed transforms; its T_base_lidar is None if neither tells it.
    Clouds in the frame of a map do not tell where the LiDAR is: it is at the only frame on the robot with a
    usual name, else at the base."""
    tree, base, warnings = extrinsics.tree, odometry.base_frame(extrinsics, frame), list[str]()
    if odometry.base and tree.find(odometry.base, base) is None:
        warnings.append(
            f"no fixed transform from {odometry.base} to {base}: both are taken as the same frame"
        )
    if odometry.world:
        usual = _usual_lidar(tree, base)
        warnings.append(
            f"the clouds are in the frame {frame} of the odometry: each is moved back by its pose at its "
            f"time, and not de-skewed again; the LiDAR is taken to be at {usual or base or 'the base'}; "
            "--mount overrides this"
        )
        linked = tree.find(base, usual) if usual else Pose3.identity()
    else:
        # A frame without a name has no place on the robot, not even that of a base without a name.
        linked = tree.find(base, frame) if frame else None
    stated = options.T_base_lidar
    return Mounting(
        base, frame, odometry, stated or linked, is_stated=stated is not None, warnings=tuple(warnings)
    )


class LateTransforms:
    """Finds fixed transforms of a live run that tell another mounting of the LiDAR than the one that is used.
    They are not used: the map would go on with another LiDAR than it began with.

    Args:
        extrinsics: Transforms that are known when the mounting is found, before the measured one is added.
        mounting: The mounting that is used.
        fixed: Numbers of the channels of fixed transforms.
    """

    def __init__(self, extrinsics: Extrinsics, mounting: Mounting, fixed: frozenset[int]) -> None:
        """Copy the known transforms."""
        self._extrinsics, self._mounting, self._fixed = extrinsics, mounting, fixed
        self._tree = deepcopy(extrinsics.tree)
        self._known = mounting.T_base_lidar or Pose3.identity()

    def notice(self, message: Message) -> str:
        """Return a message for the user if a message has such a transform, once for each mounting; "" if not,
        and where the user states the mounting or the clouds are in the frame of a map."""
        lidar, base = self._mounting.lidar, self._mounting.base
        is_fixed = message.channel in self._fixed
        if not is_fixed or not lidar or self._mounting.is_stated or self._mounting.odometry.world:
            return ""
        for _, link, pose in self._extrinsics.decode(message, {}):
            self._tree.add(*link, pose)
        for name in (base,) if base not in ("", lidar) else USUAL_BASES:
            T = self._tree.find(name, lidar)
            if name == lidar or T is None or _is_same(T, self._known):
                continue
            self._known = T
            return (
                f"the fixed transform from {lidar} to {name} arrived after the first scans and is not used: "
                "the LiDAR stays where it was taken to be, and trees and poses may be wrong. Open the run "
                "again, or state the mounting"
            )
        return ""


def _is_same(a: Pose3, b: Pose3) -> bool:
    """Return whether two poses are the same up to rounding."""
    return np.allclose(a.R, b.R, atol=1e-6) and np.allclose(a.t, b.t, atol=1e-6)


def _usual_lidar(tree: TransformTree, base: str) -> str:
    """Return the only frame on the robot with a usual name of a LiDAR, "" if there is none or several."""
    usual = [
        name
        for name in tree.frames()
        if any(word in name.lower() for word in _LIDAR_WORDS) and tree.find(base, name) is not None
    ]
    return usual[0] if len(usual) == 1 else ""


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """T_base_lidar by ground and motion (None if unknown, or the LiDAR is upright and looks ahead), number of
    scans that contradict the odometry, messages for the user, and whether the motion shows the yaw."""

    T_base_lidar: Pose3 | None
    contradicting: int = 0
    warnings: tuple[str, ...] = ()
    shows_yaw: bool = False


def _mounting_by_motion(
    messages: TimedMessages, decoder: RecordDecoder, lidar: str, level: Pose3 | None
) -> _Motion:
    """Return the mounting of a LiDAR without a fixed transform: its tilt by the ground, and its yaw by its
    motion beside the odometry.

    Args:
        messages, decoder: The messages and their decoder.
        lidar: Frame of the LiDAR.
        level: T_base_lidar by the ground in the first scan, None for an upright LiDAR.
    """
    # Compiled kernels and SciPy, which a process that only records or serves does not need.
    from pipeline.odometry.mounting_yaw import better_yaw

    times_ns, path = _odometry_path(messages, decoder)
    if len(times_ns) < 2:
        return _Motion(level)
    scans = _scans_between(messages, decoder, lidar, int(times_ns[0]), int(times_ns[-1]))
    if len(scans) < _LEVELS:
        return _Motion(level)
    warnings: tuple[str, ...] = ()
    if level is None:
        level = mounting_by_grounds(scans[:: len(scans) // _LEVELS])
        warnings = () if level is None else (tilt_text(level),)
    at = _poses_at(scans, times_ns, path)
    found, points = _yaw_by_motion(scans, at, level or Pose3.identity())
    if found is None:
        return _Motion(level, 0, warnings)
    yaw = better_yaw(found.yaw, at, points)
    degrees = round(float(np.degrees(yaw))) % 360
    if found.contradicts:
        return _Motion(level, len(scans), warnings)
    if not degrees:
        return _Motion(level, 0, warnings, shows_yaw=True)
    text = (
        f"by the motion of the scans beside the odometry over {found.length:.0f} m, the yaw of the mounting "
        f"is {degrees} degrees; --mount overrides this"
    )
    T_base_lidar = Pose3.from_euler(np.zeros(3), 0.0, 0.0, yaw) @ (level or Pose3.identity())
    return _Motion(T_base_lidar, 0, (*warnings, text), shows_yaw=True)


def _poses_at(scans: list[Scan], times_ns: Int, path: Float) -> Float:
    """Return the poses of the odometry at the times of scans, shape (N, 3), see `_odometry_path`."""
    stamps = np.array([scan.stamp_ns for scan in scans], np.int64)
    return np.column_stack([np.interp(stamps - times_ns[0], times_ns - times_ns[0], c) for c in path.T])


def _yaw_by_motion(scans: list[Scan], at: Float, level: Pose3) -> tuple[MountingYaw | None, list[Float]]:
    """Return the yaw of the LiDAR (None if the scans do not show it) and the registered points.

    Args:
        scans: Consecutive scans.
        at: From `_poses_at`.
        level: Tilt of the LiDAR.
    """
    from pipeline.odometry.mounting_yaw import lidar_path, overlap, yaw_of_mounting

    by_scans, points = lidar_path(scans, level)
    found = yaw_of_mounting(by_scans, at)
    return (None if found is None or overlap(by_scans, points) < _SAME_WORLD else found), points


def contradiction_of_yaw(mounting: Mounting, messages: TimedMessages, decoder: RecordDecoder) -> str:
    """Return a message if the motion of the scans beside the odometry contradicts the yaw of the mounting by
    the fixed transforms or the user; "" if it does not, or does not show the yaw. It takes about a second.

    Args:
        mounting: The mounting.
        messages, decoder: The messages and their decoder.

    Raises:
        SourceError: The recording cannot be read.
    """
    if mounting.T_base_lidar is None or mounting.is_measured or not mounting.odometry.is_known:
        return ""
    stated = float(mounting.T_base_lidar.euler()[2])
    level = Pose3.from_euler(np.zeros(3), 0.0, 0.0, -stated) @ mounting.T_base_lidar
    times_ns, path = _odometry_path(messages, decoder)
    if len(times_ns) < 2:
        return ""
    scans = _scans_between(messages, decoder, mounting.lidar, int(times_ns[0]), int(times_ns[-1]))
    if len(scans) < _LEVELS:
        return ""
    found, _ = _yaw_by_motion(scans, _poses_at(scans, times_ns, path), level)
    if found is None or found.contradicts or abs(float(wrap_angle(found.yaw - stated))) < _OTHER_YAW:
        return ""
    degrees = [round(float(np.degrees(yaw))) for yaw in (found.yaw, stated)]
    frames = f"{mounting.base or 'the base'} to {mounting.lidar or 'the LiDAR'}"
    wrong = f"the transform from {frames} has a wrong yaw, or is inverted"
    remedy = "give the pose of the LiDAR with --mount"
    if mounting.is_stated:
        wrong, remedy = "the yaw given with --mount is wrong", "correct it"
    return (
        f"{wrong}: by the motion of the scans beside the odometry over {found.length:.0f} m it is "
        f"{degrees[0]} degrees, and not {degrees[1]}; {remedy}"
    )


def _is_of_another_robot(topics: Topics) -> bool:
    """Return whether the names of the topics of scans and odometry begin with different parts."""
    if "odometry" not in topics.chosen:
        return False
    scans, wheels = (topics.chosen[role].name.strip("/").split("/") for role in ("scan", "odometry"))
    return len(scans) > 1 and len(wheels) > 1 and scans[0] != wheels[0]


def _odometry_path(messages: TimedMessages, decoder: RecordDecoder) -> tuple[Int, Float]:
    """Return times [ns], shape (N,), and poses x, y [m], unwrapped yaw [rad], shape (N, 3), of the first
    _MOTION of the drive by the odometry."""
    times, poses = list[int](), list[Float]()
    begun: int | None = None
    for stamped in messages.read(messages.odometry.numbers, {}, most=_MOST_READINGS):
        content = stamped.content
        record = decoder.record(content, stamped.stamp_ns, {}) if isinstance(content, Message) else content
        if not isinstance(record, Odometry) or (times and record.stamp_ns <= times[-1]):
            continue
        pose = record.T_odom_base.planar().as_array()
        if begun is None and poses and _distance(poses[0], pose) > _BEGUN:
            begun = len(times)
        times.append(record.stamp_ns)
        poses.append(pose)
        if begun is not None and _distance(poses[begun], pose) > _MOTION:
            break
    start = max((begun or 0) - 1, 0)
    found = np.array(poses).reshape(-1, 3)[start:]
    found[:, 2] = np.unwrap(found[:, 2])
    return np.array(times, np.int64)[start:], found


def _distance(pose: Float, other: Float) -> float:
    """Return the distance of two poses, x, y [m] and yaw [rad]."""
    return float(np.hypot(*(other - pose)[:2]))


def _scans_between(
    messages: TimedMessages, decoder: RecordDecoder, lidar: str, start_ns: int, end_ns: int
) -> list[Scan]:
    """Return at most _MOST_SCANS scans of the LiDAR, by its frame, from one time to another [ns]."""
    found: list[Scan] = []
    for arrival in messages.messages(messages.odometry.topics.numbers("scan")):
        if arrival.stamp_ns > end_ns or len(found) == _MOST_SCANS:
            break
        if arrival.stamp_ns >= start_ns and messages.frame_of(arrival.content) == lidar:
            record = decoder.record(arrival.content, arrival.stamp_ns, {})
            if isinstance(record, Scan):
                found.append(record)
    return found
