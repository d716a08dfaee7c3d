"""Velodyne data packets (1206 bytes): decoding of packets into a Scan, for captures, ROS messages and UDP."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import velodyne_decoder
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import FileSource, SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.scan_columns import clean_scan
from pipeline.types.records import Bool, Int, Record, Scan, Sensor

PACKET_BYTES = 1206
PRODUCT = 1205
#: Two flags and the azimuth of each of the twelve blocks of a packet.
_HEADS = struct.Struct("<" + 12 * "BBH96x" + "6x")
_TURN = 36_000  # 0.01 degrees
#: A longer silence between packets ends a sweep.
GAP_NS = 50_000_000
#: VLP-32A and VLP-32B share a product number; the later one is assumed.
VLP_32 = 0x23


def _sensor(name: str, rings: int, ring_step: float, range_max: float) -> Sensor:
    """Return a sensor with an azimuth step of 0.2 degrees and a range sigma of 0.03 m.

    Args:
        name: Name.
        rings: Number of rings.
        ring_step: Step in elevation [degrees].
        range_max: Maximum range [m].
    """
    return Sensor(name, rings, float(np.radians(ring_step)), float(np.radians(0.2)), 0.03, range_max)


#: Sensors by product number, the last byte of a packet. An HDL-64 does not send it.
SENSORS = {
    0x21: _sensor("HDL-32E", 32, 1.33, 100.0),
    0x22: _sensor("VLP-16", 16, 2.0, 100.0),
    VLP_32: _sensor("VLP-32", 32, 0.33, 200.0),
    0x24: _sensor("Puck Hi-Res", 16, 1.33, 100.0),
    0x28: _sensor("VLP-32C", 32, 0.33, 200.0),
    0xA1: _sensor("VLS-128", 128, 0.11, 245.0),
}


class PacketError(Exception):
    """There are no packets, or the decoder refuses them."""


def is_data_packet(packet: bytes) -> bool:
    """Return whether the bytes are a data packet of a known sensor.

    The length, the flags and azimuths of the twelve blocks, and the product number are checked.
    """
    if len(packet) != PACKET_BYTES or packet[PRODUCT] not in SENSORS:
        return False
    heads = _HEADS.unpack(packet)
    return set(heads[::3]) == {0xFF} and min(heads[1::3]) >= 0xBB and max(heads[2::3]) < _TURN


class Rotation:
    """Finds the packets of one sensor with which a sweep begins: after a full revolution, or after a pause of
    more than GAP_NS."""

    def __init__(self) -> None:
        """Begin before the first packet."""
        self._azimuth: int | None = None
        self._stamp_ns = self._turned = 0

    def begins(self, azimuth: int, stamp_ns: int) -> bool:
        """Process the next packet; return whether a sweep begins with it: after a full revolution, or a pause
        of more than GAP_NS. The result is False for the first packet.

        Args:
            azimuth: Azimuth of the first block of the packet [0.01 degrees].
            stamp_ns: Time of arrival of the packet [ns].
        """
        before = self._azimuth
        step = 0 if before is None else (azimuth - before) % _TURN
        self._turned += step if step < _TURN // 2 else 0  # a small step back is jitter of the motor
        paused = before is not None and stamp_ns - self._stamp_ns > GAP_NS
        self._azimuth, self._stamp_ns = azimuth, stamp_ns
        if self._turned < _TURN and not paused:
            return False
        self._turned = 0
        return True


class PacketDecoder:
    """Decodes the packets of one sensor, one sweep at a time."""

    def __init__(self) -> None:
        """Begin without decoders; each product number gets its own."""
        self._decoders: dict[int, velodyne_decoder.ScanDecoder] = {}

    def decode(self, stamp_ns: int, stamps_ns: Sequence[int], packets: Sequence[bytes]) -> Scan:
        """Return the scan of the packets of one sweep, which may have no points; each packet must pass
        `is_data_packet`, and all are of one sensor.

        Args:
            stamp_ns: Stamp of the scan [ns].
            stamps_ns: Time of arrival of each packet [ns]. The times of the points are derived from that of
                the last packet and clipped to 2 s before and after the stamp.
            packets: Packets in the order of time.

        Raises:
            PacketError: There are no packets, the numbers of stamps and packets differ, or the decoder
                refuses the packets.
        """
        if not packets:
            raise PacketError("no packets")
        vector = velodyne_decoder.PacketVector()
        try:
            for arrived, packet in zip(stamps_ns, packets, strict=True):
                vector.append(velodyne_decoder.VelodynePacket(arrived * 1e-9, packet))
            _stamp, table = self._decoder_of(packets[0][PRODUCT]).decode(vector, True)
        except Exception as error:  # the decoder raises whatever its C++ library throws
            raise PacketError(str(error)) from error
        return self._scan(stamp_ns, stamps_ns[-1] - stamp_ns, table)

    def _decoder_of(self, product: int) -> velodyne_decoder.ScanDecoder:
        """Return the decoder of a product number; it finds the model itself, except for VLP-32."""
        if product not in self._decoders:
            model = velodyne_decoder.Model.VLP32B if product == VLP_32 else None
            self._decoders[product] = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(model=model))
        return self._decoders[product]

    def _scan(self, stamp_ns: int, late: int, table: NDArray[np.void]) -> Scan:
        """Return the scan of a decoded table.

        Args:
            stamp_ns: Stamp of the scan [ns].
            late: Time of arrival of the last packet after the stamp [ns].
            table: Columns x, y, z [m], intensity, ring and time [s] relative to the last packet.
        """
        points = np.stack([table["x"], table["y"], table["z"]], axis=1)
        with np.errstate(invalid="ignore"):
            offset = np.clip(np.nan_to_num(table["time"].astype(np.float64)) * 1e9 + late, -2e9, 2e9)
        return clean_scan(
            stamp_ns, points, reflectance=table["intensity"], ring=table["ring"], offset_ns=offset
        )


DATA_PORT = 2368
#: A packet whose time differs more from that of its neighbours has a damaged time.
_JUMP_NS = 1_000_000_000
#: Bytes before the IP header by link type: Ethernet, raw IP, Linux cooked capture.
_LINKS = {1: 14, 101: 0, 113: 16}
_ETHERNET = 14
_BLOCK = 8 << 20  # bytes
#: Longer packets do not occur: the length is damaged.
_PACKET_LIMIT = 1 << 18
_RECORD = 16  # bytes of the header of a packet
#: Of an IP header: version and length, fragment, protocol, sender.
_IP, _UDP = struct.Struct(">B5xHxB2xI"), 17
_CUT = "bytes at the end of a capture that was cut"


#: A data packet of a capture: position of its 1206 bytes in the file, time of arrival, azimuth of the first
#: block [0.01 degrees], product number of the sensor, and address with destination port of the sender.
PACKET = np.dtype([(name, np.int64) for name in ("offset", "stamp_ns", "azimuth", "product", "sender")])
Packets = NDArray[np.void]  # of PACKET, in the order of the file


class PcapSource(FileSource):
    """Source of the scans of a .pcap file. A scan is one revolution; its stamp is the time of arrival of its
    last packet.

    Args:
        uri: Path as the user wrote it.
        path: The file.
        options: Choices of the user, of which the extrinsics are used.

    Raises:
        SourceError: The file is not a capture, or has no packets of a known sensor.
        OSError: The file cannot be read.
    """

    def __init__(self, uri: str, path: Path, options: SourceOptions) -> None:
        """Index the packets of the file and group them to sweeps. Only packets of the sender and model with
        the most packets are used; the others are counted in `losses`. The file stays open until `close`.

        Raises:
            SourceError: The file is not a capture, or has no packets of a known sensor.
            OSError: The file cannot be read.
        """
        super().__init__()
        self._path = path
        packets, self._damage = find_packets(path)
        self._packets = packets = self._one_sensor(packets, uri)
        rotation, columns = Rotation(), (packets["azimuth"].tolist(), packets["stamp_ns"].tolist())
        starts = [row for row, each in enumerate(zip(*columns, strict=True)) if rotation.begins(*each)]
        self._first = np.array([0, *starts], np.int64)
        self._last = np.append(self._first[1:], len(packets)) - 1
        self._stamp = packets["stamp_ns"][self._last]
        self._file = path.open("rb", buffering=0)
        self._description = SourceDescription(
            uri=uri,
            kind="Velodyne capture (pcap)",
            sensor=SENSORS[int(packets["product"][0])],
            T_base_lidar=options.T_base_lidar or Pose3.identity(),
            has_odometry=False,
            has_imu=False,
            scans=len(self._first),
            start_ns=int(self._stamp[0]),
            end_ns=int(self._stamp[-1]),
            digest=digest_of([path]),
        )

    def records(self) -> Iterator[Record]:
        """Yield the scans. Those without points, or that cannot be decoded, are counted in `losses`.

        Raises:
            SourceError: The file cannot be read any more.
        """
        self._losses = losses = dict[str, int]()
        decoder = PacketDecoder()
        for sweep in range(len(self._first)):
            rows = range(int(self._first[sweep]), int(self._last[sweep]) + 1)
            stamps = self._packets["stamp_ns"][rows.start : rows.stop].tolist()
            try:
                scan = decoder.decode(int(self._stamp[sweep]), stamps, self._read(rows))
            except PacketError:
                count_loss(losses, "scans that cannot be decoded")
                continue
            if len(scan.points):
                yield scan
            else:
                count_loss(losses, "scans without points")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, rows: range) -> list[bytes]:
        """Return the packets of one sweep, one for each row, of PACKET_BYTES bytes each. If the file was
        shortened since it was opened, the last packets are shorter or empty.

        Args:
            rows: Rows of the packets; not empty.

        Raises:
            SourceError: The file cannot be read.
        """
        offsets = self._packets["offset"][rows.start : rows.stop]
        start = int(offsets[0])
        try:
            self._file.seek(start)
            block = self._file.read(int(offsets[-1]) + PACKET_BYTES - start)
        except OSError as error:
            raise SourceError(f"cannot read on: {error.strerror}", where=str(self._path)) from error
        return [block[at : at + PACKET_BYTES] for at in (offsets - start).tolist()]

    def _one_sensor(self, packets: Packets, uri: str) -> Packets:
        """Return the packets of the sender, and of the product number, with most packets, without packets
        with impossible or decreasing times. Packets that are left out are counted.

        Raises:
            SourceError: There are no packets.
        """
        if not len(packets):
            raise SourceError(
                "the capture has no data packets of a known Velodyne sensor",
                where=uri,
                remedy="HDL-32E, VLP-16, VLP-32, Puck Hi-Res and VLS-128 can be read.",
            )
        for name, reason in (("sender", "packets of other senders"), ("product", "packets of other sensors")):
            column: Int = packets[name]
            numbers, counts = np.unique(column, return_counts=True)
            packets = self._keep(packets, column == numbers[int(np.argmax(counts))], reason)
        if len(packets) >= 3:
            stamp = packets["stamp_ns"]
            middle = np.median(np.stack([stamp[:-2], stamp[1:-1], stamp[2:]]).astype(np.float64), axis=0)
            middle = np.concatenate([middle[:1], middle, middle[-1:]])
            steady = np.abs(stamp - middle) <= _JUMP_NS
            packets = self._keep(packets, steady, "packets with an impossible time")
        ahead = packets["stamp_ns"] >= np.maximum.accumulate(packets["stamp_ns"])
        return self._keep(packets, ahead, "packets that came before their predecessor")

    def _keep(self, packets: Packets, keep: Bool, reason: str) -> Packets:
        """Return the packets where a mask, shape (N,), is true; the others are counted in the losses under a
        reason."""
        refused = len(keep) - int(np.count_nonzero(keep))
        if refused:
            count_loss(self._damage, reason, refused)
        return packets[keep]


def find_packets(path: Path) -> tuple[Packets, dict[str, int]]:
    """Return the data packets of a capture, and a dict from reasons to the numbers of other packets to the
    port of the LiDAR and of cut bytes. Reading ends at a damaged length.

    Raises:
        SourceError: The file is not a capture that can be read.
        OSError: The file cannot be read.
    """
    losses: dict[str, int] = {}
    found: list[tuple[int, int, int, int, int]] = []
    with path.open("rb", buffering=0) as file:
        order, unit_ns, link = _file_header(file.read(24), path)
        record = struct.Struct(order + "III4x")
        start, rest, broken = 24, b"", False
        while not broken and (block := file.read(_BLOCK)):
            buffer, at = rest + block, 0
            while at + _RECORD <= len(buffer):
                seconds, fraction, length = record.unpack_from(buffer, at)
                end = at + _RECORD + length
                broken = length > _PACKET_LIMIT
                if broken or end > len(buffer):
                    break
                first, sender = _data_of(buffer, at + _RECORD, end, link, losses)
                if first:
                    stamp_ns = seconds * 1_000_000_000 + fraction * unit_ns
                    azimuth = buffer[first + 2] + 256 * buffer[first + 3]
                    found.append((start + first, stamp_ns, azimuth, buffer[first + PRODUCT], sender))
                at = end
            start, rest = start + at, buffer[at:]
        cut = path.stat().st_size - start
    if cut > 0:
        count_loss(losses, _CUT, cut)
    return np.array(found, PACKET), losses


def _data_of(buffer: bytes, at: int, end: int, link: int, losses: dict[str, int]) -> tuple[int, int]:
    """Return the position in `buffer` of the 1206 bytes of a captured data packet, and the IP address of its
    sender and its destination port as one number (address * 2^16 + port); (0, 0) for other packets.

    Args:
        buffer: Bytes of the file.
        at, end: First position of the captured bytes, and one past the last.
        link: Number of bytes before the IP header.
        losses: Dict from reasons to numbers of other packets to the port of the LiDAR, and of data packets
            that the capture has cut; increased in place.
    """
    ip = at + link
    if link == _ETHERNET and buffer[at + 12 : at + 14] == b"\x81\x00":
        ip += 4  # a VLAN tag
    if ip + 20 > end or (link and buffer[ip - 2 : ip] != b"\x08\x00"):
        return 0, 0
    version, fragment, protocol, address = _IP.unpack_from(buffer, ip)
    first = ip + 4 * (version & 15) + 8
    if version >> 4 != 4 or fragment & 0x1FFF or protocol != _UDP or first > end:
        return 0, 0
    port, length = struct.unpack_from(">HH", buffer, first - 6)
    if length - 8 != PACKET_BYTES:
        reason = "packets to the LiDAR's port of another length" if port == DATA_PORT else ""
    elif first + PACKET_BYTES > end:
        reason = "packets that the capture has cut"
    elif is_data_packet(buffer[first : first + PACKET_BYTES]):
        return first, (address << 16) | port
    else:
        reason = "packets that are no data packets of a known sensor" if port == DATA_PORT else ""
    if reason:
        count_loss(losses, reason)
    return 0, 0


def _file_header(header: bytes, path: Path) -> tuple[str, int, int]:
    """Return the byte order for `struct` (">" or "<"), the nanoseconds per unit of fractions of a second, and
    the number of bytes before the IP header.

    Raises:
        SourceError: The file is not a capture in the pcap format, is cut in its header, or has a link type
            that cannot be read.
    """
    if header.startswith(b"\x0a\x0d\x0d\x0a"):
        raise SourceError(
            "a capture of the newer kind pcapng",
            where=str(path),
            remedy="Convert it: editcap -F pcap IN OUT.",
        )
    if len(header) < 24:
        raise SourceError("the capture has no whole header", where=str(path), remedy="Record it again.")
    order = ">" if header[0] == 0xA1 else "<"
    magic, link = struct.unpack(order + "I16xI", header)
    if magic not in (0xA1B2C3D4, 0xA1B23C4D):
        raise SourceError("not a capture in the pcap format", where=str(path))
    if link & 0xFFFF not in _LINKS:
        raise SourceError(
            f"the capture's link type {link & 0xFFFF} cannot be read", where=str(path), remedy="Use Ethernet."
        )
    return order, 1 if magic == 0xA1B23C4D else 1000, _LINKS[link & 0xFFFF]
