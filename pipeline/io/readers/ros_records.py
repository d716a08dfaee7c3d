"""From one ROS message to one record: clouds, Velodyne packets, odometry and IMU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers import ros_messages
from pipeline.io.readers.container import Channel, Message, count_loss
from pipeline.io.readers.gnss import Alignment, Fix
from pipeline.io.readers.laser_scan import decode_laser_scan
from pipeline.io.readers.message_time import SECOND_NS
from pipeline.io.readers.other_slam import NoPoseError, Placed, Relation
from pipeline.io.readers.pointcloud2 import decode_cloud
from pipeline.io.readers.rostypes import IMU, LASER_SCAN, NAV_SAT_FIX, ODOMETRY, POINT_CLOUD, MessageDecoder
from pipeline.io.readers.tf_tree import TransformTree, frame_name, pose_of
from pipeline.io.readers.velodyne import PacketDecoder, is_data_packet
from pipeline.types.records import Imu, Odometry, Record, Scan

_NAMES = {ODOMETRY: "odometry messages", IMU: "IMU messages", NAV_SAT_FIX: "GNSS messages"}


class RecordDecoder:
    """Turns the messages of one recording into records.

    Args:
        channels: Of the recording, by number.
        decoder: Of its messages.
        tree: Its fixed transforms.

    Attributes:
        base: Name of the base frame, "" when there is none.
        alignment: How GNSS fixes lie in the map, None when that is not known: they are not used then.
        relation: Likewise of the poses of another SLAM; poses: numbers of their channels.
    """

    def __init__(self, channels: Mapping[int, Channel], decoder: MessageDecoder, tree: TransformTree) -> None:
        self._channels, self._decoder, self._tree = channels, decoder, tree
        self._packets = PacketDecoder()
        self.base = ""
        self.alignment: Alignment | None = None
        self.relation: Relation | None = None
        self.poses = frozenset[int]()

    def record(self, message: Message, stamp_ns: int, losses: dict[str, int]) -> Record | None:
        """Decode a message; None when it cannot be used, which is counted in `losses`."""
        channel = self._channels[message.channel]
        try:
            # Damaged numbers may be of any size; what comes of them is looked at afterwards.
            with np.errstate(all="ignore"):
                if message.channel in self.poses:
                    return self._placed(message, stamp_ns, losses)
                if channel.msgtype == ODOMETRY:
                    return self._odometry(message, stamp_ns)
                if channel.msgtype == IMU:
                    return self._imu(message, stamp_ns)
                if channel.msgtype == NAV_SAT_FIX:
                    return self._measured(message, stamp_ns, losses)
                scan = self.scan(message, stamp_ns, losses)[0]
        except Exception:  # the one place that catches what the generated decoders of rosbags raise
            named = _NAMES.get(channel.msgtype, "scans")
            if message.channel in self.poses:
                named = "poses of another SLAM"
            count_loss(losses, f"{named} that cannot be read")
            return None
        if len(scan.points):
            return scan
        count_loss(losses, "scans without points")
        return None

    def scan(self, message: Message, stamp_ns: int, losses: dict[str, int]) -> tuple[Scan, str, int]:
        """A scan, the name of its frame, and the product number of the sensor (0 when not known).

        Raises:
            Exception: Of many kinds, when the message is damaged.
        """
        msgtype = self._channels[message.channel].msgtype
        if msgtype == LASER_SCAN:
            laser = cast(ros_messages.LaserScan, self.message(message))
            return decode_laser_scan(laser, stamp_ns), frame_name(laser.header.frame_id), 0
        if msgtype == POINT_CLOUD:
            cloud = cast(ros_messages.PointCloud2, self.message(message))
            return decode_cloud(cloud, stamp_ns), frame_name(cloud.header.frame_id), 0
        decoded = cast(ros_messages.VelodyneScan, self.message(message))
        packets = [(_time_ns(p.stamp), p.data.tobytes()) for p in decoded.packets]
        good = [packet for packet in packets if is_data_packet(packet[1])]
        if len(good) < len(packets):
            count_loss(losses, "packets that are no data packets", len(packets) - len(good))
        shift = stamp_ns - _time_ns(decoded.header.stamp)
        scan = self._packets.decode(stamp_ns, [t + shift for t, _ in good], [p for _, p in good])
        return scan, frame_name(decoded.header.frame_id), good[0][1][-1]

    def message(self, message: Message) -> object:
        """The decoded message.

        Raises:
            Exception: Of many kinds, when it is damaged.
        """
        return self._decoder.decode(self._channels[message.channel], message.payload)

    def fix(self, message: Message, stamp_ns: int) -> tuple[Fix | None, str]:
        """A GNSS fix, None where the receiver had none; and the frame of its antenna.

        Raises:
            Exception: Of many kinds, when the message is damaged.
        """
        decoded = cast(ros_messages.NavSatFix, self.message(message))
        frame = frame_name(decoded.header.frame_id)
        if decoded.status.status < 0:
            return None, frame
        covariance = [float(number) for number in decoded.position_covariance]
        kind = int(decoded.position_covariance_type)
        return Fix.of(stamp_ns, float(decoded.latitude), float(decoded.longitude), covariance, kind), frame

    def placed(self, message: Message, stamp_ns: int) -> tuple[Placed, str]:
        """A pose of another SLAM, and the name of its frame.

        Raises:
            NoPoseError: Its covariance is none.
            Exception: Of many kinds, when the message is damaged.
        """
        decoded = cast(ros_messages.Odometry, self.message(message))  # the other type has the same parts
        frame = frame_name(decoded.header.frame_id)
        child = frame_name(getattr(decoded, "child_frame_id", ""))
        linked = self._tree.find(child, self.base) if child and child != self.base else None
        pose, covariance = decoded.pose.pose, decoded.pose.covariance
        at = pose_of(pose.position, pose.orientation)
        return Placed.of(stamp_ns, at, [float(number) for number in covariance], linked), frame

    def place_of(self, frame: str) -> Pose3 | None:
        """Where a frame stands on the robot, None when no fixed transform says it."""
        return self._tree.find(self.base, frame)

    def _measured(self, message: Message, stamp_ns: int, losses: dict[str, int]) -> Record | None:
        if self.alignment is None:
            return None
        fix, _ = self.fix(message, stamp_ns)
        if fix is None:
            count_loss(losses, "GNSS messages without a fix")
            return None
        return self.alignment.measured(fix)

    def _placed(self, message: Message, stamp_ns: int, losses: dict[str, int]) -> Record | None:
        try:
            placed, _ = self.placed(message, stamp_ns)
        except NoPoseError as error:
            count_loss(losses, f"poses of another SLAM: {error}")
            return None
        return None if self.relation is None else self.relation.measured(placed)

    def _odometry(self, message: Message, stamp_ns: int) -> Odometry:
        pose = cast(ros_messages.Odometry, self.message(message)).pose.pose
        return Odometry(stamp_ns, pose_of(pose.position, pose.orientation))

    def _imu(self, message: Message, stamp_ns: int) -> Imu:
        """A reading, turned into the base frame when the recording says how the IMU stands in it."""
        decoded = cast(ros_messages.Imu, self.message(message))
        linked = self._tree.find(self.base, frame_name(decoded.header.frame_id))
        R_base_imu = np.eye(3) if linked is None else linked.R
        turn, pull, q = decoded.angular_velocity, decoded.linear_acceleration, decoded.orientation
        rates = np.array([[turn.x, turn.y, turn.z], [pull.x, pull.y, pull.z]]) @ R_base_imu.T
        if not (np.abs(rates) < 1e6).all():
            raise ValueError("the reading is not finite")
        # REP 145: a first covariance of -1 says that there is no orientation; some drivers send zeros.
        orientation = None
        if decoded.orientation_covariance[0] >= 0 and abs(q.x) + abs(q.y) + abs(q.z) + abs(q.w) > 0.1:
            R_level_imu = Pose3.from_quaternion(np.zeros(3), [q.w, q.x, q.y, q.z]).R
            orientation = Pose3(R_level_imu @ R_base_imu.T, np.zeros(3)).quaternion()
        return Imu(stamp_ns, rates[0], rates[1], orientation)


def _time_ns(stamp: ros_messages.Stamp) -> int:
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)
