"""Whether the levelled scans of a ROS recording stand upright: the fixed transforms and the orientation of
the IMU are checked against the ground and the trunks of some scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.ros_messages import TimedMessages
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.types.records import Float, Imu, Scan

#: Scans that are checked, from all over the recording, and fewest of them that show trunks: a slope changes
#: on the way, the axes of a sensor do not.
_SCANS, _FEWEST = 8, 5
#: Largest age of the reading of an IMU [ns].
_STALE_NS = 500_000_000
#: Least tilt that shows wrong axes, and largest angle of single scans to the mean, and of ground to trunks
#: [rad]. Trunks of a scan lean by 1 to 4 degrees on average, also on a slope.
_TILTED, _ALIKE = np.radians(8.0), np.radians(6.0)
#: Trunks are upright within this [rad].
_UPRIGHT = np.radians(4.0)
#: Largest distance of points of the ground, side of cells of which the lowest points are taken [m], fewest
#: cells, distance from the plane up to which a lowest point is ground [m], and number of fits.
_NEAR, _CELL, _CELLS, _EVEN, _FITS = 8.0, 1.0, 20, 0.15, 5


@dataclass(frozen=True, slots=True)
class TiltCheck:
    """What ground and trunks say about the levelling of the scans.

    Attributes:
        scans: Number of scans of the recording, if ground and trunks contradict their levelling; else 0.
        reason: How they do, and what helps; "" without contradiction.
        uses_imu: Whether the orientation of the IMU can be used.
        warnings: Messages for the user.
    """

    scans: int = 0
    reason: str = ""
    uses_imu: bool = True
    warnings: tuple[str, ...] = ()


def spread_scans(
    messages: TimedMessages, decoder: RecordDecoder, lidar: str, T_base_lidar: Pose3
) -> list[tuple[int, Float]]:
    """Return times of recording [ns] and points of about _SCANS scans from all over the recording, about the
    sensor with the axes of the base, shape (N, 3) each [m]. SourceError if the file cannot be read.

    Args:
        messages, decoder: The messages and their decoder.
        lidar: Frame of the LiDAR; scans of others are left out.
        T_base_lidar: Mounting of the LiDAR.
    """
    # Twice as many, for a topic that two LiDARs share; an odd number, since they may take turns.
    found = messages.container.spread(messages.odometry.topics.numbers("scan"), 2 * _SCANS + 1)
    own = [message for message in found if messages.frame_of(message) == lidar]
    records = [(m.log_ns, decoder.record(m, 0, {})) for m in own[:: max(round(len(own) / _SCANS), 1)]]
    return [
        (log_ns, scan.points.astype(np.float64) @ T_base_lidar.R.T)
        for log_ns, scan in records
        if isinstance(scan, Scan) and len(scan.points)
    ]


def check_tilt(
    messages: TimedMessages, decoder: RecordDecoder, scans: list[tuple[int, Float]], blamed: str
) -> TiltCheck:
    """Check whether scans are level by the fixed transforms and the orientation of the IMU.

    The levelling is contradicted if ground and trunks are tilted alike in the same direction throughout the
    drive. On a slope only the trunks lean in the frame of the robot, on a road along a hillside only the
    ground does, and in a stand whose stems lean only these.

    Args:
        messages, decoder: The messages and their decoder, with the base frame.
        scans: From `spread_scans`.
        blamed: What is wrong if a mounting by fixed transforms, or without any, is not level; "" if the user
            states the mounting, or the odometry is that of the LiDAR.
    """
    numbers = messages.odometry.topics.numbers("imu")
    levelling = [_levelling_near(messages, decoder, numbers, log_ns) for log_ns, _ in scans]
    has_imu = any(R is not None for R in levelling)
    seen = [
        (np.eye(3) if R is None else R, points, up)
        for (_, points), R in zip(scans, levelling, strict=True)
        if (R is not None or not has_imu) and (up := _up_of(points)) is not None
    ]
    unlevelled, trunks = [up for _, _, up in seen], [R @ up for R, _, up in seen]
    lean = _common_tilt(trunks)
    if not lean:
        return TiltCheck()
    imu = messages.odometry.topics.chosen["imu"].name if has_imu else ""
    if has_imu and _mean_of(unlevelled)[2] > np.cos(_UPRIGHT):
        return TiltCheck(
            uses_imu=False,
            warnings=(
                f"by the orientation in {imu} all trunks would lean by {np.degrees(lean):.0f} degrees, which "
                "they do not without it: the orientation is not used",
            ),
        )
    grounds = [R @ normal for R, points, up in seen if (normal := _ground_of(points, up)) is not None]
    tilt = _common_tilt(grounds)
    if not (blamed or has_imu) or not tilt or _mean_of(grounds) @ _mean_of(trunks) < np.cos(_ALIKE):
        return TiltCheck()
    wrong = ", or ".join(filter(None, (f"the orientation in {imu} is wrong" if imu else "", blamed)))
    return TiltCheck(
        messages.odometry.topics.chosen["scan"].count,
        f"tilts of scans whose ground and trunks are tilted by {np.degrees(tilt):.0f} degrees in the same "
        f"direction throughout the drive: {wrong}; give the pose of the LiDAR with --mount",
    )


def _levelling_near(
    messages: TimedMessages, decoder: RecordDecoder, numbers: frozenset[int], log_ns: int
) -> Float | None:
    """Return R_level_base by the first orientation of the IMU that is recorded after a time [ns]; None if
    there is none within _STALE_NS."""
    for message in messages.container.messages(numbers, log_ns, {}):
        if message.log_ns > log_ns + _STALE_NS:
            return None
        reading = decoder.record(message, 0, {})
        if isinstance(reading, Imu) and reading.orientation is not None:
            roll, pitch, _ = Pose3.from_quaternion(np.zeros(3), reading.orientation).euler()
            return Pose3.from_euler(np.zeros(3), roll, pitch, 0.0).R
    return None


def _up_of(points: Float) -> Float | None:
    """Return the vertical by the trunks in a scan, shape (3,), None if they do not show it.

    Args:
        points: Points about the sensor, z within 30 degrees of the vertical, shape (N, 3) [m].
    """
    from pipeline.odometry.lidar_odometry import BARK, vertical_of
    from pipeline.odometry.mounting_yaw import standing_height

    near, height = standing_height(points)
    up = vertical_of(near[(height > BARK[0]) & (height < BARK[1])])
    return up if up is not None and up.any() else None


def _ground_of(points: Float, up: Float) -> Float | None:
    """Return the normal of the ground about the sensor, upwards, shape (3,), None without ground.

    The ground is the plane through the lowest points of cells that are level by the trunks.

    Args:
        points: As in `_up_of`.
        up: The vertical by the trunks, shape (3,).
    """
    from pipeline.odometry.lidar_odometry import levelling

    near = points[np.linalg.norm(points, axis=1) < _NEAR]
    if len(near) < _CELLS:
        return None
    R = levelling(up)
    level = near @ R.T
    cell = np.floor(level[:, :2] / _CELL).astype(np.int64)
    order = np.lexsort((level[:, 2], cell[:, 1], cell[:, 0]))
    cell, lowest = cell[order], level[order]
    lowest = lowest[np.concatenate(([True], (np.diff(cell, axis=0) != 0).any(axis=1)))]
    kept, plane = np.ones(len(lowest), np.bool_), np.zeros(3)
    A = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    for _ in range(_FITS):  # cells without ground have higher lowest points, those beside a road lower ones
        if np.count_nonzero(kept) < _CELLS:
            return None
        plane = np.linalg.lstsq(A[kept], lowest[kept, 2], rcond=None)[0]
        off = lowest[:, 2] - A @ plane
        kept = np.abs(off - np.median(off[kept])) < _EVEN
    normal = np.array([-plane[0], -plane[1], 1.0]) @ R
    return normal / np.linalg.norm(normal)


def _common_tilt(ups: list[Float]) -> float:
    """Return the angle between the z axis and the mean of unit vectors [rad]; 0 if it is less than _TILTED,
    the vectors are fewer than _FEWEST, or one of them is farther than _ALIKE from the mean."""
    if len(ups) < _FEWEST:
        return 0.0
    mean = _mean_of(ups)
    tilt = float(np.arccos(np.clip(mean[2], -1.0, 1.0)))
    is_alike = bool((np.array(ups) @ mean > np.cos(_ALIKE)).all())
    return tilt if tilt >= _TILTED and is_alike else 0.0


def _mean_of(ups: list[Float]) -> Float:
    """Return the mean of unit vectors, of length 1, shape (3,)."""
    mean: Float = np.mean(ups, axis=0)
    return mean / max(float(np.linalg.norm(mean)), 1e-9)
