"""Raw packets of Ouster as the messages of its driver: packets are gathered into clouds, and those of the IMU
become readings. The library ouster-sdk (the extra `ouster`) decodes them.

A packet holds 16 columns of a turn or fewer, without the angles and the clock of the sensor: these are in its
metadata, a JSON that the driver records as a message and that stands beside a capture.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.extensions.formats.hesai import ONE_SURFACE
from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceOptions, count_loss
from pipeline.io.readers.container import TRANSFORM_TYPES, Channel, Container, Message
from pipeline.io.readers.sensor_families import OUSTER, OUSTER_PACKETS
from pipeline.io.readers.topics import IMU, POINT_CLOUD, TRANSFORMS, TYPES_BY_ROLE, decode, standard_types
from pipeline.types.records import Bool, Int
from pipeline.types.units import SECOND_NS

_STRING = "std_msgs/msg/String"
#: Words that only the metadata of an Ouster have, and their largest size [bytes].
_METADATA_WORD, _METADATA_LIMIT = "beam_altitude_angles", 1 << 20
#: Messages of a topic by which its packets, and metadata among texts, are known.
_TRIES = 20
#: Older drivers send a byte more than the packet.
_MORE = (0, 1)
#: Frames of packets that may arrive mixed; the library keeps as many. A larger step back is a restart.
_MIXED_FRAMES = 4
#: Columns of one turn are nearer to each other in time; a turn takes up to 0.2 s [ns].
_TURN_NS = 1_000_000_000
#: A stamp of ROS 2 has 31 bits of seconds.
_LATEST_NS = (1 << 31) * SECOND_NS - 1
_MILLIMETRE = 1e-3
_STRANGE = "packets of another sensor, or damaged"
_LOST = "packets of the LiDAR that were lost: its scans have gaps"
_WITH_METADATA = (
    "Record the topic metadata of the driver, or put the JSON beside the recording under its name: "
    "ouster-cli source HOST metadata > NAME.json."
)
_CLOUD_FIELDS = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")]
)


@dataclass(frozen=True, slots=True)
class Metadata:
    """Metadata of a sensor.

    Attributes:
        name: Topic or file from which they are.
        info: SensorInfo of the library.
        format: PacketFormat of the library.
    """

    name: str
    info: Any
    format: Any

    def fits(self, packet: bytes, size: int) -> bool:
        """Return whether a packet has a size, one of the driver's bytes more included, and is of this sensor
        as far as it is known. A sensor that was set up again since has the same number."""
        if len(packet) - size not in _MORE:
            return False
        if size != self.format.lidar_packet_size:  # packets of an older IMU have no number
            return True
        number = int(self.format.prod_sn(np.frombuffer(packet, np.uint8, size)))
        return not number or not self.info.sn or number == self.info.sn


def library() -> Any:  # noqa: ANN401
    """Return the module of ouster-sdk.

    Raises:
        SourceError: It is not installed.
    """
    try:
        from ouster.sdk import core
    except ImportError as error:
        raise SourceError(
            "raw packets of Ouster need the library ouster-sdk",
            where="the extra ouster",
            remedy="pip install 'stemmap[ouster]', or record the PointCloud2 of the driver ouster_ros.",
        ) from error
    return core


def metadata_of(name: str, text: str) -> Metadata | None:
    """Return the metadata in a text, None for another text.

    Raises:
        SourceError: The text is metadata, but incomplete, or the library is not installed.
    """
    if _METADATA_WORD not in text:
        return None
    core = library()
    try:
        info = core.SensorInfo(text)
        return Metadata(name, info, core.PacketFormat(info))
    except Exception as error:  # the library raises whatever its C++ code throws
        reason = str(error).replace("\n", " ")[:200]
        raise SourceError(
            f"the metadata of the Ouster cannot be read: {reason}", where=name, remedy=_WITH_METADATA
        ) from error


def metadata_beside(path: Path) -> list[Metadata]:
    """Return the metadata in the JSON file of the same name as a recording, else in all of its folder.

    Raises:
        SourceError: They are incomplete, or the library is not installed.
    """
    folder = path if path.is_dir() else path.parent
    named = [path.with_suffix(".json"), path.parent / f"{path.name}.json"]
    files = [each for each in named if each.is_file()] or sorted(folder.glob("*.json"))
    found = []
    for file in files:
        with suppress(OSError):
            if file.stat().st_size <= _METADATA_LIMIT:
                found.append(metadata_of(str(file), file.read_text(errors="replace")))
    return [each for each in found if each is not None]


def with_packets_decoded(container: Container, path: Path, options: SourceOptions, uri: str) -> Container:
    """Return a recording whose packets of Ouster are read as clouds; the recording itself if it has none, or
    if it has other scans and the user names no packets.

    Args:
        container: The recording.
        path: Its file or folder, beside which metadata may be.
        options: Choices of the user, of which the topic of scans is used.
        uri: Recording as the user wrote it.

    Raises:
        SourceError: The library or the metadata are missing, or they do not fit to the packets.
    """
    packets = [c for c in container.channels if c.msgtype in OUSTER_PACKETS and c.count]
    scans = any(c.msgtype in TYPES_BY_ROLE["scan"] and c.count for c in container.channels)
    if not packets or (scans and options.topics.get("scan") not in {c.topic for c in packets}):
        return container
    library()
    known = _recorded_metadata(container) or metadata_beside(path)
    if not known:
        raise no_metadata(packets[0].topic, uri)
    return PacketRecording(container, packets, known, uri)


def no_metadata(what: str, uri: str) -> SourceError:
    """Return the error for packets of Ouster without metadata: what holds them, and the recording."""
    return SourceError(
        f"{what} has raw packets of {OUSTER.name}, and the metadata of the sensor are missing",
        where=uri,
        remedy=_WITH_METADATA,
    )


def _recorded_metadata(container: Container) -> list[Metadata]:
    """Return the metadata in the first texts of a recording, at whatever time they were recorded.

    Raises:
        SourceError: All are incomplete.
    """
    found, failure = list[Metadata](), None
    for channel in container.channels:
        if channel.msgtype != _STRING:
            continue
        for message in islice(container.messages({channel.number}, None, {}), _TRIES):
            with suppress(Exception):  # texts of others, and damaged ones
                text = str(decode(channel, message.payload).data)
                try:
                    each = metadata_of(channel.topic, text)
                except SourceError as error:
                    failure = error
                    continue
                if each is not None:
                    found.append(each)
                    break
    if failure is not None and not found:
        raise failure
    return found


class PacketRecording(Container):
    """A recording whose topics of packets of Ouster hold clouds (PointCloud2), IMU readings (Imu), and the
    fixed transforms that the driver sends. Clouds are one turn each, in the frame of the sensor, stamped with
    the time of its first column; beams without a return are left out.

    Args:
        container: The recording.
        packets: Its channels of packets.
        known: Metadata, one of which fits to each channel.
        uri: Recording as the user wrote it.

    Raises:
        SourceError: No metadata fit to any packets.
    """

    def __init__(self, container: Container, packets: list[Channel], known: list[Metadata], uri: str) -> None:
        """Find the metadata of each channel by the size and the sensor of its packets."""
        self._inner = container
        self.kind, self.damage = f"{container.kind} with packets of Ouster", container.damage
        self.clock_steps = container.clock_steps
        self._clouds, self._readings = dict[int, Metadata](), dict[int, Metadata]()
        sizes = list[int]()
        for channel in packets:
            first = [
                _packet_of(channel, message.payload)
                for message in islice(container.messages({channel.number}, None, {}), _TRIES)
            ]
            sizes += [len(packet) for packet in first]
            ordered = sorted(known, key=lambda each: -_in_common(each.name, channel.topic))
            for role, size in ((self._clouds, "lidar_packet_size"), (self._readings, "imu_packet_size")):
                fit = [m for m in ordered if any(m.fits(packet, getattr(m.format, size)) for packet in first)]
                if fit:
                    role[channel.number] = fit[0]
                    break
        if not self._clouds:
            wanted = ", ".join(str(m.format.lidar_packet_size) for m in known)
            raise SourceError(
                f"the metadata in {known[0].name} are of another sensor or another setting than the packets: "
                f"those have {', '.join(str(n) for n in sorted(set(sizes)))} bytes, not {wanted}",
                where=uri,
                remedy="Use the metadata of the time of the recording.",
            )
        topics = {channel.number: channel.topic for channel in packets}
        frames = self._recorded_frames()
        self._prefix = {
            number: _prefix(topic, frames, len(self._clouds) > 1) for number, topic in topics.items()
        }
        self._set_packets(container)

    def _set_packets(self, container: Container) -> None:
        """Set channels and index: of the packets of a turn one counts."""
        channels = []
        for channel in container.channels:
            role = (self._clouds, POINT_CLOUD), (self._readings, IMU)
            kind = next((each for numbers, each in role if channel.number in numbers), channel.msgtype)
            encoding = "cdr" if kind != channel.msgtype else channel.encoding
            channels.append(replace(channel, msgtype=kind, encoding=encoding))
        self._recorded = container.by_number
        self._fixed = max(self._recorded) + 1
        channels.append(Channel(self._fixed, "/tf_static", TRANSFORMS, "cdr"))
        rows = container.index
        keep = np.ones(len(rows), np.bool_)
        for number, metadata in self._clouds.items():
            own = np.flatnonzero(rows[:, 0] == number)
            keep[own] = np.arange(len(own)) % metadata.info.format.lidar_packets_per_frame() == 0
        start_ns = int(rows[0, 1])
        fixed: Int = np.array([[self._fixed, start_ns, 0]], np.int64)
        self._start_ns = start_ns
        self._set_index(channels, np.concatenate([fixed, rows[keep]]))

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages as `Container.messages` does: a cloud after its last packet. Packets of another
        sensor, and those that are missing within a turn, are counted. The turns with which a recording begins
        and ends may be incomplete."""
        if self._fixed in numbers and (start_ns is None or start_ns <= self._start_ns):
            yield Message(self._fixed, self._start_ns, self._transforms())
        gathering = {n: _Turns(m) for n, m in self._clouds.items() if n in numbers}
        begin_ns = start_ns
        if start_ns is not None and gathering:  # from the packets of the turn before
            slowest = min(int(self._clouds[n].info.format.fps) or 10 for n in gathering)
            begin_ns = start_ns - 2 * SECOND_NS // slowest
        last_ns = 0
        for message in self._inner.messages(set(numbers) - {self._fixed}, begin_ns, losses):
            last_ns = message.log_ns
            for each in self._decoded(message, gathering, losses):
                if start_ns is None or each.log_ns >= start_ns:
                    yield each
        for number, turns in gathering.items():
            for cloud in turns.end():
                yield Message(number, last_ns, _cloud_message(cloud, self._frame(number, "sensor")))

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the attachment of the recording."""
        return self._inner.attachment(name, limit)

    def close(self) -> None:
        """Close the recording."""
        self._inner.close()

    def _decoded(
        self, message: Message, gathering: Mapping[int, _Turns], losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield a message without a packet as it is, and of one with a packet the messages that are
        complete with it."""
        number = message.channel
        metadata = self._clouds.get(number) or self._readings.get(number)
        if metadata is None:
            yield message
            return
        layout = metadata.format
        size = layout.lidar_packet_size if number in self._clouds else layout.imu_packet_size
        packet = _packet_of(self._recorded[number], message.payload)
        if not metadata.fits(packet, size):
            count_loss(losses, _STRANGE)
        elif number in gathering:
            for cloud in gathering[number].add(packet[:size], losses):
                payload = _cloud_message(cloud, self._frame(number, "sensor"))
                yield Message(number, message.log_ns, payload)
        else:
            for payload in _imu_messages(layout, packet[:size], self._frame(number, "imu")):
                yield Message(number, message.log_ns, payload)

    def _frame(self, number: int, part: str) -> str:
        """Return the name of the frame of a part of the sensor of a channel, e.g. "os_lidar"."""
        return f"{self._prefix[number]}os_{part}"

    def _recorded_frames(self) -> list[str]:
        """Return the names of the frames of Ousters in the fixed transforms of the recording."""
        fixed = {
            channel.number: channel
            for channel in self._inner.channels
            if channel.msgtype in TRANSFORM_TYPES and channel.topic.endswith("tf_static")
        }
        names = dict[str, None]()
        for message in islice(self._inner.messages(fixed, None, {}), _TRIES):
            with suppress(Exception):
                for link in decode(fixed[message.channel], message.payload).transforms:
                    names |= dict.fromkeys((str(link.header.frame_id), str(link.child_frame_id)))
        return [name.lstrip("/") for name in names if name.endswith(("os_sensor", "os_lidar"))]

    def _transforms(self) -> bytes:
        """Return the message of the fixed transforms of the sensors."""
        store = standard_types("cdr")
        header, links = _header(store, self._start_ns, ""), []
        for number, metadata in self._clouds.items():
            for part in ("lidar", "imu"):
                matrix = np.array(getattr(metadata.info, f"{part}_to_sensor_transform"), np.float64)
                pose = Pose3(matrix[:3, :3], matrix[:3, 3] * _MILLIMETRE)
                w, x, y, z = (float(each) for each in pose.quaternion())
                turn = store.types["geometry_msgs/msg/Quaternion"](x, y, z, w)
                place = store.types["geometry_msgs/msg/Vector3"](*pose.t.tolist())
                links.append(
                    store.types["geometry_msgs/msg/TransformStamped"](
                        replace(header, frame_id=self._frame(number, "sensor")),
                        self._frame(number, part),
                        store.types["geometry_msgs/msg/Transform"](place, turn),
                    )
                )
        return bytes(store.serialize_cdr(store.types[TRANSFORMS](links), TRANSFORMS))


def _packet_of(channel: Channel, payload: bytes) -> bytes:
    """Return the packet in a PacketMsg; b"" if it is damaged."""
    order, at = ("<", 0)
    if channel.encoding != "ros1":
        if len(payload) < 4:
            return b""
        order, at = "<" if payload[1] & 1 else ">", 4
    if len(payload) < at + 4:
        return b""
    (length,) = struct.unpack_from(order + "I", payload, at)
    packet = payload[at + 4 : at + 4 + length]
    return packet if len(packet) == length else b""


def _in_common(name: str, other: str) -> int:
    """Return the number of parts between slashes that two names have in common."""
    return len(set(name.strip("/").split("/")) & set(other.strip("/").split("/")))


def _prefix(topic: str, frames: list[str], several: bool) -> str:
    """Return what stands before "os_sensor" in the frames of the sensor of a topic.

    Args:
        topic: The topic.
        frames: Recorded frames of Ousters.
        several: Whether the recording has several Ousters; without recorded frames, each gets its own.
    """
    if frames:
        nearest = max(frames, key=lambda frame: _in_common(frame.replace("_", "/"), topic.replace("_", "/")))
        return nearest[: -len("os_sensor")]
    return f"{topic.strip('/').rpartition('/')[0]}/" if several else ""


class _Turns:
    """Gathers the packets of one sensor into turns."""

    def __init__(self, metadata: Metadata) -> None:
        """Begin without packets."""
        core = library()
        self._metadata, self._frame_type = metadata, core.LidarFrame
        self._packet = core.LidarPacket(metadata.format)
        self._batcher = core.FrameBatcher(metadata.info)
        self._lut = core.XYZLut(metadata.info)
        self._turn = core.LidarFrame(metadata.info)
        self._number: int | None = None  # of the turn that is gathered
        self._is_given = False  # whether it was complete
        self._turns = self._given_late = 0

    def add(self, packet: bytes, losses: dict[str, int]) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Yield the clouds that are complete with a packet: stamp [ns] and points (_CLOUD_FIELDS). Columns
        that are missing in a turn, except for the first one, are counted in `losses`."""
        content = np.frombuffer(packet, np.uint8)
        number = int(self._metadata.format.frame_id(content))
        if self._number is not None:
            turns = int(self._metadata.format.max_frame_id) + 1
            step = (number - self._number + turns // 2) % turns - turns // 2
            if step < -_MIXED_FRAMES:  # the sensor began again
                yield from self._give(losses)
                self._batcher.reset()
                self._begin(None)
        self._packet.buf[:] = content
        if self._batcher.batch(self._packet, self._turn):
            yield from self._give(losses)
            self._begin(number)
        elif self._number is None:
            self._number = number
        late = int(self._batcher.dropped_packets())
        if late > self._given_late:
            count_loss(losses, "packets of the LiDAR that came too late", late - self._given_late)
        self._given_late = late
        if not self._is_given and self._turn.complete():
            yield from self._give(losses)
            self._is_given = True

    def end(self) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Yield the cloud of the last turn, which may be incomplete."""
        yield from self._give({})

    def _begin(self, number: int | None) -> None:
        """Begin a turn."""
        self._turn = self._frame_type(self._metadata.info)
        self._number, self._is_given = number, False

    def _give(self, losses: dict[str, int]) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Yield the cloud of the turn that is gathered, nothing if it was given or has no column."""
        if self._is_given:
            return
        layout = self._metadata.info.format
        seen = int(np.count_nonzero(self._turn.status & 1))
        lost = (layout.valid_columns_per_frame() - seen) // layout.columns_per_packet
        self._turns += 1
        if lost > 0 and self._turns > 1:
            count_loss(losses, _LOST, lost)
        if seen:
            yield self._cloud()

    def _cloud(self) -> tuple[int, NDArray[np.void]]:
        """Return the stamp [ns] and the points of the turn, column by column."""
        times = self._turn.timestamp.astype(np.int64)
        valid: Bool = (self._turn.status & 1).astype(np.bool_)
        middle = int(np.median(times[valid]))
        valid &= np.abs(times - middle) < _TURN_NS
        stamp_ns = int(times[valid].min()) if valid.any() else 0
        parts, before = list[NDArray[np.void]](), None
        for echo in ("", "2"):
            if f"RANGE{echo}" not in self._turn.fields:
                continue
            reach = self._turn.field(f"RANGE{echo}")
            sound = (reach > 0) & valid
            if before is not None:  # of two echoes of one surface one is taken
                sound &= np.abs(reach.astype(np.int64) - before) * _MILLIMETRE >= ONE_SURFACE
            before = reach.astype(np.int64)
            column, ring = np.nonzero(sound.T)
            points = np.zeros(len(column), _CLOUD_FIELDS)
            xyz = self._lut(reach)[ring, column]
            for axis, name in enumerate("xyz"):
                points[name] = xyz[:, axis]
            strength = f"SIGNAL{echo}" if f"SIGNAL{echo}" in self._turn.fields else f"REFLECTIVITY{echo}"
            if strength in self._turn.fields:
                points["intensity"] = self._turn.field(strength)[ring, column]
            points["t"], points["ring"] = times[column] - stamp_ns, ring
            parts.append(points)
        return min(max(stamp_ns, 0), _LATEST_NS), np.concatenate(parts)


def _header(store: Any, stamp_ns: int, frame: str) -> Any:  # noqa: ANN401
    """Return a std_msgs/Header."""
    stamp = store.types["builtin_interfaces/msg/Time"](stamp_ns // SECOND_NS, stamp_ns % SECOND_NS)
    return store.types["std_msgs/msg/Header"](stamp, frame)


def _cloud_message(cloud: tuple[int, NDArray[np.void]], frame: str) -> bytes:
    """Return a PointCloud2 of a stamp [ns] and points (_CLOUD_FIELDS)."""
    store, (stamp_ns, points) = standard_types("cdr"), cloud
    codes = {"<f4": 7, "<u4": 6, "<u2": 4}
    fields = [
        store.types["sensor_msgs/msg/PointField"](name, offset, codes[kind.str], 1)
        for name, (kind, offset, *_) in (_CLOUD_FIELDS.fields or {}).items()
    ]
    step = _CLOUD_FIELDS.itemsize
    data = np.frombuffer(points.tobytes(), np.uint8)
    made = store.types[POINT_CLOUD](
        _header(store, stamp_ns, frame), 1, len(points), fields, False, step, step * len(points), data, True
    )
    return bytes(store.serialize_cdr(made, POINT_CLOUD))


def _imu_messages(layout: Any, packet: bytes, frame: str) -> Iterator[bytes]:  # noqa: ANN401
    """Yield an Imu without orientation for each measurement of a packet."""
    store, each = standard_types("cdr"), library().ImuPacket(layout)
    each.buf[:] = np.frombuffer(packet, np.uint8)
    vector, unknown = store.types["geometry_msgs/msg/Vector3"], np.array([-1.0] + 8 * [0.0])
    level = store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    for stamp, pull, turn in zip(each.timestamp().tolist(), each.accel(), each.gyro(), strict=True):
        made = store.types[IMU](
            _header(store, min(int(stamp), _LATEST_NS), frame),
            level,
            unknown,
            vector(*(float(v) for v in turn)),
            np.zeros(9),
            vector(*(float(v) for v in pull)),
            np.zeros(9),
        )
        yield bytes(store.serialize_cdr(made, IMU))
