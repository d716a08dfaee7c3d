"""From ROS messages to records: clouds, laser scans, Velodyne packets, odometry, IMU, poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import MessageFormat, added
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.message_formats import (
    MeasuredFrame,
    ReadingFormat,
    SweepDecoder,
    UnusableReadingError,
)
from pipeline.io.readers.message_time import header_stamp
from pipeline.io.readers.point_times import (
    LONGEST_NS,
    PointTimes,
    TimedScan,
    decide_point_times,
    time_fields,
)
from pipeline.io.readers.scan_columns import (
    POINT_LIMIT,
    REFLECTANCE,
    RETURNED,
    RING,
    clean_scan,
    has_times,
    scan_of,
    timed_scan,
)
from pipeline.io.readers.sensor_families import CUSTOM_TYPES
from pipeline.io.readers.topics import (
    IMU,
    LASER_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    VELODYNE_SCAN,
    decode,
)
from pipeline.io.readers.transforms import TransformTree, frame_name, pose_of
from pipeline.io.readers.velodyne import VelodyneDecoder
from pipeline.types.records import Imu, Odometry, Record, Scan, Sensor
from pipeline.types.units import SECOND_NS

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_jazzy as ros2

STEP_LIMIT = 64 << 10
#: NumPy's code by the number of a PointField's datatype.
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class LayoutError(Exception):
    """The header of a cloud or laser scan contradicts itself or its data."""


def cloud_columns(cloud: ros2.sensor_msgs__msg__PointCloud2) -> dict[str, NDArray[np.generic]]:
    """Return a dict from names to the columns of a PointCloud2 of any layout that are read, shape (N,).

    Raises:
        LayoutError: Width, height, steps, fields and length of the data do not fit together, x, y or z is
            missing or not a floating number, or there are more than POINT_LIMIT points.
    """
    table = _table(cloud)
    return {name: table[name] for name in table.dtype.names or ()}


def _table(cloud: ros2.sensor_msgs__msg__PointCloud2) -> NDArray[np.void]:
    """Return the points as a structured array of shape (N,), after a check of its size. Padding of rows is
    removed.

    Raises:
        LayoutError: The header contradicts itself or the size of the data, or claims too many points.
    """
    width, height = int(cloud.width), int(cloud.height)
    step, row_step, length = int(cloud.point_step), int(cloud.row_step), len(cloud.data)
    count = width * height
    if count > POINT_LIMIT or step > STEP_LIMIT:
        raise LayoutError(f"the header claims {count} points of {step} bytes")
    dtype = _dtype(cloud, step)
    row = row_step if height > 1 else width * step
    if row < width * step:
        raise LayoutError(f"a row of {row} bytes cannot hold {width} points of {step} bytes")
    needed = row * (height - 1) + width * step if count else 0
    if not needed <= length <= max(row, row_step) * height:
        raise LayoutError(f"{count} points of {step} bytes need {needed} bytes, the data has {length}")
    raw = np.ascontiguousarray(cloud.data).view(np.uint8)
    if row == width * step or not count:
        return raw[: count * step].view(dtype)
    rows = [raw[k * row : k * row + width * step].view(dtype) for k in range(height)]
    return np.concatenate(rows)


def _dtype(cloud: ros2.sensor_msgs__msg__PointCloud2, step: int) -> np.dtype[np.void]:
    """Return the structured type of a point of `step` bytes with the fields that are read; of several fields
    with one name, the first one.

    Raises:
        LayoutError: A field is outside of the point, or x, y or z is missing or not a floating number.
    """
    order = ">" if cloud.is_bigendian else "<"
    used = {*"xyz", *REFLECTANCE, *RING, *RETURNED, *time_fields([str(field.name) for field in cloud.fields])}
    names, formats, offsets = [], [], []
    for field in cloud.fields:
        name, offset, count = str(field.name), int(field.offset), int(field.count)
        if name not in used or name in names or int(field.datatype) not in TYPES:
            continue
        code = TYPES[int(field.datatype)]
        if offset + int(code[1]) * max(count, 1) > step:
            raise LayoutError(f"the field {name} is outside of the {step} bytes of a point")
        names.append(name)
        formats.append(order + code)
        offsets.append(offset)
    lacking = [name for name in "xyz" if name not in names or formats[names.index(name)][1] != "f"]
    if lacking:
        raise LayoutError(f"the cloud has no field {', '.join(lacking)} of floating numbers")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def decode_laser_scan(laser: ros2.sensor_msgs__msg__LaserScan, stamp_ns: int) -> Scan:
    """Decode a LaserScan into a planar scan (z = 0, ring 0) in the sensor frame.

    Beams whose range is not finite, or outside of range_min and range_max of the message, are left out and
    count in `dropped`, as do the returns that `clean_scan` refuses. Intensities are ignored if their number
    differs from that of the ranges. Beam times are None if the time increment is not positive or the sweep
    takes 2 s or more.

    Args:
        laser: The message.
        stamp_ns: Time of the first beam [ns].

    Raises:
        LayoutError: The angles are impossible, or there are too many beams.
    """
    ranges = np.asarray(laser.ranges, dtype=np.float64)
    first, step = float(laser.angle_min), float(laser.angle_increment)
    if len(ranges) > POINT_LIMIT or not abs(first) < 100.0 or not 1e-6 < abs(step) < 1.0:
        raise LayoutError(f"{len(ranges)} beams from {first} rad in steps of {step} rad")
    if abs(step) * len(ranges) > 13.0:
        raise LayoutError("the beams go around more than twice")
    angle = first + step * np.arange(len(ranges))
    seen = np.isfinite(ranges) & (ranges >= float(laser.range_min)) & (ranges <= float(laser.range_max))
    far, angle = ranges[seen], angle[seen]
    points = np.stack([far * np.cos(angle), far * np.sin(angle), np.zeros(len(far))], axis=1)
    each_ns = float(laser.time_increment) * 1e9
    timed = 0.0 < each_ns * len(ranges) < 2 * LONGEST_NS
    strength = laser.intensities if len(laser.intensities) == len(ranges) else None
    return clean_scan(
        stamp_ns,
        points,
        reflectance=None if strength is None else np.asarray(strength)[seen],
        ring=np.zeros(len(points), np.int32),
        offset_ns=np.rint(each_ns * np.flatnonzero(seen)).astype(np.int64) if timed else None,
        dropped=len(ranges) - len(points),
    )


_NAMES = {ODOMETRY: "odometry messages", IMU: "IMU messages"}


class RecordDecoder:
    """Decodes the messages of one recording into records.

    Args:
        channels: Dict from numbers to channels of the recording.
        tree: Fixed transforms.
        readings: Dict from numbers of channels to the kind of the readings in them.

    Attributes:
        tree: As given.
        base: Name of the base frame; "" if there is none.
        frames: Dict from roles to the frames of their readings. Readings of a role that is missing are not
            used.
        levels: Whether the orientations of the IMU are used.
        times: Dict from frames to how the times of the points of their clouds are read; None for no times.
            That of a new frame is decided by its first cloud.
    """

    def __init__(
        self,
        channels: Mapping[int, Channel],
        tree: TransformTree,
        readings: Mapping[int, ReadingFormat] | None = None,
    ) -> None:
        """Create a decoder without a base frame and frames of measured poses."""
        self._channels, self.tree = channels, tree
        self._decoders: dict[str, SweepDecoder] = {VELODYNE_SCAN: VelodyneDecoder()}
        self._columns: dict[str, Callable[..., tuple[str, dict[str, NDArray[np.generic]]]]] = {}
        self.base = ""
        self.frames: dict[str, MeasuredFrame] = {}
        self._readings = readings or {}
        self.levels = True
        self.times: dict[str, PointTimes | None] = {}

    def record(self, message: Message, stamp_ns: int, losses: dict[str, int]) -> Record | None:
        """Return the record in a message; None if it cannot be used.

        Args:
            message: The message.
            stamp_ns: Time of the message [ns].
            losses: Dict from reasons to numbers of messages that cannot be used, and of packets that are not
                data packets; increased in place. Not counted are readings whose frame is unknown, and those
                that do not count.
        """
        channel, kind = self._channels[message.channel], self._readings.get(message.channel)
        try:
            # Damaged numbers may be of any size; the records are checked afterwards.
            with np.errstate(all="ignore"):
                if kind is not None:
                    return self._measurement(kind, message, stamp_ns, losses)
                if channel.msgtype == ODOMETRY:
                    return self._odometry(message, stamp_ns)
                if channel.msgtype == IMU:
                    return self._imu(message, stamp_ns)
                scan = self.scan(message, stamp_ns, losses)[0]
        except Exception:  # the one place that catches what the generated decoders of rosbags raise
            named = _NAMES.get(channel.msgtype, "scans") if kind is None else kind.messages
            count_loss(losses, f"{named} that cannot be read")
            return None
        if len(scan.points):
            return scan
        count_loss(losses, "scans without points")
        return None

    def scan(
        self, message: Message, stamp_ns: int, losses: dict[str, int]
    ) -> tuple[Scan, str, Sensor | None]:
        """Return a scan, which may have no points, the name of its frame, and the sensor except for its range
        sigma (None if unknown).

        Args:
            message: PointCloud2, LaserScan, CustomMsg, or the packets of a sweep.
            stamp_ns: Time of the scan [ns].
            losses: Dict from reasons to numbers; the number of packets that are not data packets is added in
                place.

        Raises:
            SourceError: The packets are of a model that cannot be decoded.
            Exception: Of many kinds, when the message is damaged, or has no data packet.
        """
        msgtype = self._channels[message.channel].msgtype
        if msgtype == LASER_SCAN:
            laser: ros2.sensor_msgs__msg__LaserScan = self.message(message)
            return decode_laser_scan(laser, stamp_ns), frame_name(laser.header.frame_id), None
        if msgtype in (POINT_CLOUD, *CUSTOM_TYPES):
            frame, columns = self._table(message)
            return self._timed_scan(message, frame, columns, stamp_ns, losses), frame, None
        decoded = self.message(message)
        frame, shift = frame_name(decoded.header.frame_id), stamp_ns - _time_ns(decoded.header.stamp)
        decoder = self._decoder_of(msgtype)
        packets = [
            (_time_ns(p.stamp) + shift, p.data[: getattr(p, "size", None)].tobytes()) for p in decoded.packets
        ]
        good = [each for each in packets if decoder.is_data(each[1])]
        if packets and not good:
            decoder.refuse(packets[0][1])
        if len(good) < len(packets):
            count_loss(losses, "packets that are no data packets", len(packets) - len(good))
        times, data = [stamp for stamp, _ in good], [packet for _, packet in good]
        scan, sensor = decoder.decode(stamp_ns, times, data)
        return scan, frame, sensor

    def _decoder_of(self, msgtype: str) -> SweepDecoder:
        """Return the decoder of messages of packets; SourceError if there is none for this type."""
        if msgtype not in self._decoders:
            self._decoders[msgtype] = self._of_format(msgtype, "sweeps")()
        return self._decoders[msgtype]

    def _of_format(self, msgtype: str, part: str) -> Any:  # noqa: ANN401
        """Return a part of the format of messages of a maker, see `MessageFormat`; SourceError if no format
        that can be used has it."""
        kind = next((kind for kind in added(MessageFormat) if msgtype in kind.msgtypes), None)
        if kind is None or kind.refusal or getattr(kind, part) is None:
            remedy = "" if kind is None else kind.refusal
            raise SourceError(f"messages of the type {msgtype} need an extension", remedy=remedy)
        return getattr(kind, part)

    def timed(self, message: Message) -> tuple[str, TimedScan] | None:
        """Return the frame of a cloud and what its times are decided by; None for another type, or a cloud
        without valid returns.

        Raises:
            Exception: Of many kinds, when the message is damaged.
        """
        if self._channels[message.channel].msgtype not in (POINT_CLOUD, *CUSTOM_TYPES):
            return None
        frame, columns = self._table(message)
        if not len(scan_of(0, columns).points):
            return None
        return frame, timed_scan(self._header_ns(message), columns)

    def _table(self, message: Message) -> tuple[str, dict[str, NDArray[np.generic]]]:
        """Return the frame and the columns of a cloud or a CustomMsg, shape (N,) each.

        Raises:
            Exception: Of many kinds, when the message is damaged.
        """
        channel = self._channels[message.channel]
        if channel.msgtype == POINT_CLOUD:
            cloud: ros2.sensor_msgs__msg__PointCloud2 = self.message(message)
            return frame_name(cloud.header.frame_id), cloud_columns(cloud)
        if channel.msgtype not in self._columns:
            self._columns[channel.msgtype] = self._of_format(channel.msgtype, "columns")
        decoder = self._columns[channel.msgtype]
        frame, columns = decoder(message.payload, channel.encoding, self._header_ns(message))
        return frame_name(frame), columns

    def _timed_scan(
        self,
        message: Message,
        frame: str,
        columns: dict[str, NDArray[np.generic]],
        stamp_ns: int,
        losses: dict[str, int],
    ) -> Scan:
        """Return the scan of some columns with the times of its points, as decided for its frame; a scan
        whose times do not fit this is counted in `losses`."""
        header_ns = self._header_ns(message)
        if frame not in self.times and len(columns["x"]):
            self.times[frame], _ = decide_point_times([timed_scan(header_ns, columns)])
        times = self.times.get(frame)
        scan = scan_of(stamp_ns, columns, times, header_ns)
        if times is not None and len(scan.points) and not has_times(scan):
            count_loss(losses, "times of points of scans, which are not de-skewed")
        return scan

    def _header_ns(self, message: Message) -> int:
        """Return the stamp in the header of a message [ns]; 0 if it is impossible."""
        return header_stamp(self._channels[message.channel], message.payload) or 0

    def message(self, message: Message) -> Any:  # noqa: ANN401
        """Decode a message as the type of its channel.

        Raises:
            Exception: Of many kinds, when the message is damaged.
        """
        return decode(self._channels[message.channel], message.payload)

    def place_of(self, frame: str) -> Pose3 | None:
        """Return the pose of a frame on the robot, T_base_frame; None if no fixed transforms link it to the
        base."""
        return self.tree.find(self.base, frame)

    def _measurement(
        self, kind: ReadingFormat, message: Message, stamp_ns: int, losses: dict[str, int]
    ) -> Record | None:
        """Return the measurement of a reading; None if the frame of its kind is unknown, if it does not
        count, or if the message has none or an unusable one, which is counted in `losses`.

        Raises:
            Exception: Of many kinds, when the message is damaged.
        """
        if kind.role not in self.frames:
            return None
        try:
            reading, _ = kind.read(self, message, stamp_ns)
        except UnusableReadingError as error:
            count_loss(losses, f"{kind.messages}: {error}")
            return None
        if reading is None:
            count_loss(losses, f"{kind.messages} without a fix")
            return None
        return self.frames[kind.role].measurement(reading)

    def _odometry(self, message: Message, stamp_ns: int) -> Odometry:
        """Return the odometry in a message, with the time `stamp_ns` [ns].

        Raises:
            ValueError: The pose is not finite or its quaternion is zero.
            Exception: Of many kinds, when the message is damaged.
        """
        pose = self.message(message).pose.pose
        return Odometry(stamp_ns, pose_of(pose.position, pose.orientation))

    def _imu(self, message: Message, stamp_ns: int) -> Imu:
        """Decode an IMU reading, rotated into the base frame if the pose of the IMU is known. Its orientation
        is None if the message has none, or if orientations are not used.

        Raises:
            ValueError: A number is not finite, or a rate or an acceleration is 1e6 or more.
            Exception: Of many kinds, when the message is damaged.
        """
        decoded: ros2.sensor_msgs__msg__Imu = self.message(message)
        linked = self.tree.find(self.base, frame_name(decoded.header.frame_id))
        R_base_imu = np.eye(3) if linked is None else linked.R
        turn, pull, q = decoded.angular_velocity, decoded.linear_acceleration, decoded.orientation
        rates = np.array([[turn.x, turn.y, turn.z], [pull.x, pull.y, pull.z]]) @ R_base_imu.T
        if not (np.abs(rates) < 1e6).all():
            raise ValueError("the reading is not finite")
        # REP 145: a first covariance of -1 means no orientation; some drivers send a zero quaternion instead.
        orientation = None
        if (
            self.levels
            and decoded.orientation_covariance[0] >= 0
            and abs(q.x) + abs(q.y) + abs(q.z) + abs(q.w) > 0.1
        ):
            R_level_imu = Pose3.from_quaternion(np.zeros(3), [q.w, q.x, q.y, q.z]).R
            orientation = Pose3(R_level_imu @ R_base_imu.T, np.zeros(3)).quaternion()
        return Imu(stamp_ns, rates[0], rates[1], orientation)


def _time_ns(stamp: ros2.builtin_interfaces__msg__Time) -> int:
    """Return a ROS time [ns]."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)
