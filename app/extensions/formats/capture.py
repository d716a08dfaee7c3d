"""Captures of packets from the network (.pcap) of Velodyne, Hesai and Ouster; other makers are named."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.extensions.formats import hesai, ouster
from pipeline.errors import SourceError
from pipeline.io.readers import velodyne
from pipeline.io.readers.base import (
    FileSource,
    Source,
    SourceDescription,
    SourceOptions,
    count_loss,
    digest_of,
)
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.message_formats import SweepDecoder
from pipeline.io.readers.mounting import assumed_mounting
from pipeline.io.readers.ros import RosSource
from pipeline.io.readers.scan_columns import sensor_of
from pipeline.io.readers.sensor_families import OUSTER, OUSTER_PACKETS
from pipeline.types.records import Bool, Int, Scan, Sensor

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
#: Of an IP header: version and length, length of the packet, number, fragment, protocol, sender.
_IP, _UDP = struct.Struct(">BxHHHxB2xI"), 17
#: Packets whose fragments are incomplete that are kept: fragments of few packets arrive mixed.
_OPEN_PACKETS = 64
_CUT = "bytes at the end of a capture that was cut"


#: A data packet of a capture: its position and length in the file, time of arrival, azimuth of the first
#: block [0.01 degrees], product number of the sensor (`_product`), address and destination port of the
#: sender.
PACKET = np.dtype(
    [(name, np.int64) for name in ("offset", "length", "stamp_ns", "azimuth", "product", "sender")]
)
Packets = NDArray[np.void]  # of PACKET, in the order of the file


def open_capture(uri: str, path: Path, options: SourceOptions) -> Source:
    """Open a capture: as a recording with the topics of the driver if it is of an Ouster, else as a
    PcapSource.

    Raises:
        SourceError: It is not a capture, has no packets of a known sensor, or metadata are missing.
        OSError: The file cannot be read.
    """
    packets, losses = find_packets(path)
    known = [] if len(packets) else ouster.metadata_beside(path)
    if not known:
        if not len(packets) and f"{_OF}{OUSTER.name}" in losses:
            raise ouster.no_metadata("the capture", uri)
        return PcapSource(uri, path, options)
    container: Container = PacketCapture(path, known)
    try:
        return RosSource(uri, ouster.with_packets_decoded(container, path, options, uri), [path], options)
    except BaseException:
        container.close()
        raise


class PacketCapture(Container):
    """A capture of packets of Ouster as a recording with the topics of its driver. Fragments of a packet are
    put together.

    Args:
        path: The file.
        known: Metadata of the sensors that may have sent them.

    Raises:
        SourceError: The file cannot be read, or has no packets of the size in the metadata.
        OSError: The file cannot be read.
    """

    _TOPICS = ("/ouster/lidar_packets", "/ouster/imu_packets")

    def __init__(self, path: Path, known: list[ouster.Metadata]) -> None:
        """Index the packets by their size: those of the sender with most of them. The file stays open until
        `close`."""
        self.kind, self.damage, self._path = "capture (pcap)", {}, path
        self._pieces = list[tuple[tuple[int, int], ...]]()
        numbers = {int(m.format.imu_packet_size): 2 for m in known}
        numbers |= {int(m.format.lidar_packet_size): 1 for m in known}
        rows, sizes = list[tuple[int, int, int, int]](), Counter[int]()
        for stamp_ns, sender, pieces in _whole_packets(path, self.damage):
            size = sum(length for _, length in pieces)
            sizes[size] += 1
            if size in numbers:
                rows.append((numbers[size], stamp_ns, len(self._pieces), sender))
                self._pieces.append(pieces)
        senders = Counter(sender for number, _, _, sender in rows if number == 1)
        if not senders:
            raise SourceError(
                f"the metadata in {known[0].name} are of another sensor or another setting than the packets: "
                f"most have {sizes.most_common(1)[0][0] if sizes else 0} bytes",
                where=str(path),
                remedy="Use the metadata of the time of the recording.",
            )
        sender = senders.most_common(1)[0][0]
        if len(senders) > 1:
            count_loss(self.damage, "packets of other senders", senders.total() - senders[sender])
        index = np.array([row[:3] for row in rows if row[3] == sender], np.int64)
        index[:, 1] = np.maximum.accumulate(index[:, 1])
        channels = [
            Channel(k, topic, OUSTER_PACKETS[0], "cdr") for k, topic in enumerate(self._TOPICS, start=1)
        ]
        self._set_index(channels, index)
        self._file = path.open("rb")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _message(self, number: int, log_ns: int, place: int) -> Message | None:
        """Return the packet of a row of the index as a PacketMsg; None if the file was shortened."""
        content = b""
        for offset, length in self._pieces[place]:
            self._file.seek(offset)
            content += self._file.read(length)
        return Message(number, log_ns, b"\0\1\0\0" + struct.pack("<I", len(content)) + content)


def _whole_packets(
    path: Path, losses: dict[str, int]
) -> Iterator[tuple[int, int, tuple[tuple[int, int], ...]]]:
    """Yield time of arrival [ns], sender (an IP address), and positions in the file and lengths of the pieces
    of the content of each UDP packet; those of which pieces are missing are counted in `losses`."""
    waiting: dict[tuple[int, int], dict[int, tuple[int, int, bool]]] = {}
    for record in _records(path, losses):
        part = _datagram_of(record)
        if part is None:
            continue
        size = part.end - part.first
        head = 0 if part.position else 8  # the header of UDP
        piece = (record.start + part.first + head, size - head)
        if not part.position and not part.has_more:
            yield record.stamp_ns, part.address, (piece,)
            continue
        pieces = waiting.setdefault((part.address, part.number), {})
        pieces[part.position] = (*piece, part.has_more)
        at, whole = 0, list[tuple[int, int]]()
        while at in pieces:
            offset, length, has_more = pieces[at]
            whole.append((offset, length))
            at += length + (0 if at else 8)
            if not has_more:
                del waiting[part.address, part.number]
                yield record.stamp_ns, part.address, tuple(whole)
                break
        if len(waiting) > _OPEN_PACKETS:
            del waiting[next(iter(waiting))]
            count_loss(losses, "packets of which fragments were lost")
    if waiting:
        count_loss(losses, "packets of which fragments were lost", len(waiting))


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
        product = int(packets["product"][0])
        rotation, columns = velodyne.Rotation(), (packets["azimuth"].tolist(), packets["stamp_ns"].tolist())
        starts = [row for row, each in enumerate(zip(*columns, strict=True)) if rotation.begins(*each)]
        self._first = np.array([0, *starts], np.int64)
        self._last = np.append(self._first[1:], len(packets)) - 1
        self._stamp = packets["stamp_ns"][self._last]
        self._file = path.open("rb", buffering=0)
        first = next(self.records(), Scan(0, np.zeros((0, 3), np.float32)))
        self._losses = {}
        chosen = options.T_base_lidar
        T_base_lidar, warnings = assumed_mounting(first) if chosen is None else (chosen, ())
        self._description = SourceDescription(
            uri=uri,
            kind=f"{'Hesai' if product >= _HESAI else 'Velodyne'} capture (pcap)",
            sensor=sensor_of(first, _sensor_of_product(product)),
            T_base_lidar=T_base_lidar,
            has_odometry=False,
            has_imu=False,
            scans=len(self._first),
            start_ns=int(self._stamp[0]),
            end_ns=int(self._stamp[-1]),
            digest=digest_of([path]),
            warnings=warnings,
        )

    def records(self) -> Iterator[Scan]:
        """Yield the scans. Those without points, or that cannot be decoded, are counted in `losses`.

        Raises:
            SourceError: The file cannot be read any more.
        """
        self._losses = losses = dict[str, int]()
        of_hesai = int(self._packets["product"][0]) >= _HESAI
        decoder: SweepDecoder = hesai.HesaiDecoder() if of_hesai else velodyne.VelodyneDecoder()
        for sweep in range(len(self._first)):
            rows = range(int(self._first[sweep]), int(self._last[sweep]) + 1)
            stamps = self._packets["stamp_ns"][rows.start : rows.stop].tolist()
            stamp_ns, packets = int(self._stamp[sweep]), self._read(rows)
            try:
                scan, _ = decoder.decode(stamp_ns, stamps, packets)
            except (velodyne.PacketError, hesai.HesaiPacketError):
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
        """Return the packets of one sweep, one for each row. If the file was shortened since it was opened,
        the last packets are shorter or empty.

        Args:
            rows: Rows of the packets; not empty.

        Raises:
            SourceError: The file cannot be read.
        """
        offsets, length = (self._packets[name][rows.start : rows.stop] for name in ("offset", "length"))
        start = int(offsets[0])
        try:
            self._file.seek(start)
            block = self._file.read(int(offsets[-1] + length[-1]) - start)
        except OSError as error:
            raise SourceError(f"cannot read on: {error.strerror}", where=str(self._path)) from error
        places = zip((offsets - start).tolist(), length.tolist(), strict=True)
        return [block[at : at + size] for at, size in places]

    def _one_sensor(self, packets: Packets, uri: str) -> Packets:
        """Return the packets of the sender, and of the product number, with most packets, without packets
        with impossible or decreasing times. Packets that are left out are counted.

        Raises:
            SourceError: There are no packets.
        """
        if not len(packets):
            raise _refusal(self._damage, uri)
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
    found: list[tuple[int, ...]] = []
    for record in _records(path, losses):
        first, length, sender = _data_of(record, losses)
        if first:
            packet = record.buffer[first : first + length]
            product, place = _product(packet)
            azimuth = packet[place] + 256 * packet[place + 1]
            found.append((record.start + first, length, record.stamp_ns, azimuth, product, sender))
    return np.array(found, PACKET), losses


class _Record(NamedTuple):
    """A captured packet: the bytes from `at` to `end` of a buffer that begins at `start` in the file; `link`
    bytes stand before the IP header; time of arrival [ns]."""

    buffer: bytes
    at: int
    end: int
    start: int
    link: int
    stamp_ns: int


def _records(path: Path, losses: dict[str, int]) -> Iterator[_Record]:
    """Yield the packets of a capture up to a damaged length; the bytes behind are counted in `losses`.

    Raises:
        SourceError: The file is not a capture that can be read.
        OSError: The file cannot be read.
    """
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
                stamp_ns = seconds * 1_000_000_000 + fraction * unit_ns
                yield _Record(buffer, at + _RECORD, end, start, link, stamp_ns)
                at = end
            start, rest = start + at, buffer[at:]
        cut = path.stat().st_size - start
    if cut > 0:
        count_loss(losses, _CUT, cut)


class _Datagram(NamedTuple):
    """A part of a UDP packet over IPv4: its bytes from `first` to `end` of the buffer, the header of UDP
    included; position in the whole packet, whether more follows, and the number of the packet by its sender
    (an IP address)."""

    first: int
    end: int
    position: int
    has_more: bool
    number: int
    address: int


def _datagram_of(record: _Record) -> _Datagram | None:
    """Return the part of a UDP packet in a captured packet; None for others."""
    buffer, end, ip = record.buffer, record.end, record.at + record.link
    if record.link == _ETHERNET and buffer[record.at + 12 : record.at + 14] == b"\x81\x00":
        ip += 4  # a VLAN tag
    if ip + 20 > end or (record.link and buffer[ip - 2 : ip] != b"\x08\x00"):
        return None
    version, length, number, fragment, protocol, address = _IP.unpack_from(buffer, ip)
    first = ip + 4 * (version & 15)
    if version >> 4 != 4 or protocol != _UDP or first > end:
        return None
    # Short packets are filled up to the least length of Ethernet; some cards leave the length to be 0.
    end = min(end, ip + length) if length else end
    return _Datagram(first, end, 8 * (fragment & 0x1FFF), bool(fragment & 0x2000), number, address)


def _data_of(record: _Record, losses: dict[str, int]) -> tuple[int, int, int]:
    """Return the position in the buffer and the length of a captured data packet, and the IP address of its
    sender and its destination port as one number (address * 2^16 + port); zeros for other packets.

    Args:
        record: A captured packet.
        losses: Dict from reasons to numbers of other packets to the port of the LiDAR, of packets of other
            makers, and of data packets that the capture has cut; increased in place.
    """
    part, buffer, end = _datagram_of(record), record.buffer, record.end
    if part is None or part.position or part.first + 8 > end:
        return 0, 0, 0
    first, address = part.first + 8, part.address
    port, length = struct.unpack_from(">HH", buffer, first - 6)
    length -= 8  # the header of UDP
    packet = buffer[first : min(first + length, end)]
    if _product(packet)[0]:
        return first, length, (address << 16) | port
    maker = _maker(packet, port)
    if length in _LENGTHS and len(packet) < length:
        reason = "packets that the capture has cut"
    elif hesai.other_model(packet):
        reason = f"{_OF}{hesai.other_model(packet)}"
    elif maker:
        reason = f"{_OF}{maker}"
    elif port != DATA_PORT:
        return 0, 0, 0
    elif length in _LENGTHS:
        reason = "packets that are no data packets of a known sensor"
    else:
        reason = "packets to the LiDAR's port of another length"
    count_loss(losses, reason)
    return 0, 0, 0


#: Product numbers from here on are models of Hesai, in the order of `hesai.MODELS`.
_HESAI = 256
_LENGTHS = {velodyne.PACKET_BYTES} | {
    model.body + model.tail + more for model in hesai.MODELS for more in (0, 4)
}


def _product(packet: bytes) -> tuple[int, int]:
    """Return the product number of a data packet, and the position of the azimuth of its first block. It is
    the last byte of a packet of Velodyne, from _HESAI on for Hesai, and 0 for other packets."""
    if velodyne.is_data_packet(packet):
        return packet[velodyne.PRODUCT], 2
    model = hesai.model_of(packet) if len(packet) in _LENGTHS else None
    return (0, 0) if model is None else (_HESAI + hesai.MODELS.index(model), model.head + model.mark)


def _sensor_of_product(product: int) -> Sensor:
    """Return the sensor of a product number, except for its range sigma."""
    return hesai.MODELS[product - _HESAI].sensor if product >= _HESAI else velodyne.SENSORS[product]


_OF = "packets of "
#: Driver of each maker, and the ports of its packets beside DATA_PORT.
_MAKERS: dict[str, tuple[str, tuple[int, ...]]] = {
    "Velodyne": ("velodyne_driver", ()),
    "Ouster": ("ouster_ros", (7502, 7503)),
    "Hesai": ("hesai_ros_driver", ()),
    "RoboSense": ("rslidar_sdk", (6699,)),
    "Livox": ("livox_ros_driver2", (56000, 56001, 56300, 56301, 57000)),
}
#: First bytes of data packets of RoboSense.
_ROBOSENSE = (b"\x55\xaa\x05\x0a", b"\x55\xaa\x05\x5a", b"\x55\xaa\x5a\xa5")


def _maker(packet: bytes, port: int) -> str:
    """Return the maker of a packet, by its first bytes or its port; "" if neither is known."""
    if packet[:4] in _ROBOSENSE:
        return "RoboSense"
    return next((maker for maker, (_, ports) in _MAKERS.items() if port in ports), "")


def _refusal(losses: dict[str, int], uri: str) -> SourceError:
    """Return the error for a capture without packets that can be decoded.

    Args:
        losses: Dict from reasons to numbers of packets, which may name makers.
        uri: The capture.
    """
    makers = [(number, reason) for reason, number in losses.items() if reason.startswith(_OF)]
    if makers:
        reason = max(makers)[1]
        drivers = (driver for maker, (driver, _) in _MAKERS.items() if reason.startswith(_OF + maker))
        driver = next(drivers, "the driver of its maker")
        return SourceError(
            f"the capture has {reason}, which cannot be decoded",
            where=uri,
            remedy=f"Play it through {driver}, and record its sensor_msgs/PointCloud2.",
        )
    models = ", ".join([each.name for each in velodyne.SENSORS.values()] + [m.name for m in hesai.MODELS])
    return SourceError(
        "the capture has no data packets of a known LiDAR", where=uri, remedy=f"Read are {models}."
    )


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
