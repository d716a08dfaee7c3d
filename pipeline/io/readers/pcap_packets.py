"""The UDP packets of a classic .pcap file: where each LiDAR packet lies, found in one compiled pass."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.io.readers.velodyne import BLOCK_BYTES, BLOCKS, PACKET_BYTES, PRODUCT, SENSORS
from pipeline.jit import compiled
from pipeline.types.records import Int

DATA_PORT = 2368
Whole = int | np.int64
#: Bytes before the IP header by link type: Ethernet, raw IP, Linux cooked capture.
_LINKS = {1: 14, 101: 0, 113: 16}
_BLOCK = 8 << 20
#: No capture has longer packets; a longer one is a damaged length.
_PACKET_LIMIT = 1 << 18
_NO_DATAGRAM = (np.int64(0), np.int64(-1), np.int64(0), np.int64(0))
#: Number of packets passed over by the kernel, by reason.
LOSSES = (
    "packets to the LiDAR's port of another length",
    "packets that are no data packets of a known sensor",
    "packets that the capture has cut",
)


@dataclass(frozen=True, slots=True, eq=False)
class Packets:
    """The LiDAR packets of a capture as columns of length N, in the order of the file.

    Attributes:
        offset: int64, where the 1206 bytes begin in the file.
        stamp_ns: int64, when they came.
        azimuth: int64, of the first block [0.01 degrees].
        product: int64, the sensor's product number.
        sender: int64, address and port.
    """

    offset: Int
    stamp_ns: Int
    azimuth: Int
    product: Int
    sender: Int

    def only(self, keep: NDArray[np.bool_]) -> Packets:
        """The packets of these rows."""
        return Packets(
            self.offset[keep], self.stamp_ns[keep], self.azimuth[keep], self.product[keep], self.sender[keep]
        )


def find_packets(path: Path) -> tuple[Packets, dict[str, int]]:
    """Find the packets, and count what is no LiDAR packet or cannot be read.

    Raises:
        SourceError: The file is no capture that can be read.
        OSError: It cannot be read.
    """
    known = np.zeros(256, dtype=np.bool_)
    known[list(SENSORS)] = True
    losses = np.zeros(len(LOSSES), dtype=np.int64)
    tables = [np.zeros((0, 5), dtype=np.int64)]
    with path.open("rb", buffering=0) as file:
        swapped, unit_ns, link = _file_header(file.read(24), path)
        start, rest = 24, b""
        while block := file.read(_BLOCK):
            buffer = np.frombuffer(rest + block, dtype=np.uint8)
            rows = np.empty((len(buffer) // (PACKET_BYTES + 16) + 1, 5), dtype=np.int64)
            used, found, broken = _walk(buffer, swapped, unit_ns, link, known, rows, losses)
            rows[:found, 0] += start
            tables.append(rows[:found])
            start += int(used)
            rest = buffer[used:].tobytes()
            if broken:
                break
        cut = path.stat().st_size - start
    counted = {reason: int(count) for reason, count in zip(LOSSES, losses, strict=True) if count}
    if cut > 0:
        counted["bytes at the end of a capture that was cut"] = cut
    table = np.concatenate(tables)
    return Packets(*(np.ascontiguousarray(table[:, column]) for column in range(5))), counted


def _file_header(header: bytes, path: Path) -> tuple[bool, int, int]:
    """Whether the numbers are big endian, nanoseconds in the unit of fractions, bytes before IP."""
    if header.startswith(b"\x0a\x0d\x0d\x0a"):
        raise SourceError(
            "a capture of the newer kind pcapng",
            where=str(path),
            remedy="Convert it: editcap -F pcap IN OUT.",
        )
    if len(header) < 24:
        raise SourceError("the capture has no whole header", where=str(path), remedy="Record it again.")
    big = header[0] == 0xA1
    order: Literal["big", "little"] = "big" if big else "little"
    magic = int.from_bytes(header[:4], order)
    link = int.from_bytes(header[20:24], order) & 0xFFFF
    if magic not in (0xA1B2C3D4, 0xA1B23C4D):
        raise SourceError("not a capture in the pcap format", where=str(path))
    if link not in _LINKS:
        raise SourceError(
            f"the capture's link type {link} cannot be read", where=str(path), remedy="Use Ethernet."
        )
    return big, 1 if magic == 0xA1B23C4D else 1000, _LINKS[link]


@compiled
def _number(buffer: NDArray[np.uint8], at: Whole, big: bool) -> np.int64:
    if big:
        order = (buffer[at], buffer[at + 1], buffer[at + 2], buffer[at + 3])
    else:
        order = (buffer[at + 3], buffer[at + 2], buffer[at + 1], buffer[at])
    return (
        (np.int64(order[0]) << 24)
        | (np.int64(order[1]) << 16)
        | (np.int64(order[2]) << 8)
        | np.int64(order[3])
    )


@compiled
def _payload(
    buffer: NDArray[np.uint8], start: Whole, end: Whole, link: int
) -> tuple[np.int64, np.int64, np.int64, np.int64]:
    """First byte, length, port and sender of a UDP datagram; length -1 for anything else."""
    ip = np.int64(start + link)
    if link == 14 and ip + 4 <= end and buffer[start + 12] == 0x81 and buffer[start + 13] == 0x00:
        ip += 4  # a VLAN tag
    if link > 0 and (ip > end or buffer[ip - 2] != 0x08 or buffer[ip - 1] != 0x00):
        return _NO_DATAGRAM
    if ip + 20 > end or buffer[ip] >> 4 != 4 or buffer[ip + 9] != 17:
        return _NO_DATAGRAM
    fragment = (np.int64(buffer[ip + 6] & 0x1F) << 8) | np.int64(buffer[ip + 7])
    udp = ip + 4 * np.int64(buffer[ip] & 15)
    if fragment != 0 or udp + 8 > end:
        return _NO_DATAGRAM
    port = (np.int64(buffer[udp + 2]) << 8) | np.int64(buffer[udp + 3])
    length = ((np.int64(buffer[udp + 4]) << 8) | np.int64(buffer[udp + 5])) - 8
    sender = (_number(buffer, ip + 12, True) << 16) | port
    return udp + 8, length, port, sender


@compiled
def _is_data(buffer: NDArray[np.uint8], at: Whole, known: NDArray[np.bool_]) -> bool:
    """The same test as `pipeline.io.readers.velodyne.is_data_packet`."""
    for block in range(BLOCKS):
        head = at + block * BLOCK_BYTES
        azimuth = np.int64(buffer[head + 2]) + 256 * np.int64(buffer[head + 3])
        if buffer[head] != 0xFF or buffer[head + 1] < 0xBB or azimuth >= 36000:
            return False
    return bool(known[buffer[at + PRODUCT]])


@compiled
def _walk(
    buffer: NDArray[np.uint8],
    big: bool,
    unit_ns: int,
    link: int,
    known: NDArray[np.bool_],
    rows: Int,
    losses: Int,
) -> tuple[Whole, int, bool]:
    """Fill rows (offset, stamp, azimuth, product, sender): bytes used, rows filled, whether it broke off."""
    at: Whole = 0
    found, size = 0, len(buffer)
    while at + 16 <= size:
        length = _number(buffer, at + 8, big)
        if length > _PACKET_LIMIT:
            return at, found, True
        start, end = at + 16, at + 16 + length
        if end > size:
            return at, found, False
        first, payload, port, sender = _payload(buffer, start, end, link)
        if payload == PACKET_BYTES and first + payload > end:
            losses[2] += 1
        elif payload == PACKET_BYTES and _is_data(buffer, first, known):
            rows[found, 0] = first
            rows[found, 1] = _number(buffer, at, big) * 1_000_000_000 + _number(buffer, at + 4, big) * unit_ns
            rows[found, 2] = np.int64(buffer[first + 2]) + 256 * np.int64(buffer[first + 3])
            rows[found, 3] = buffer[first + PRODUCT]
            rows[found, 4] = sender
            found += 1
        elif payload >= 0 and port == DATA_PORT:
            losses[0 if payload != PACKET_BYTES else 1] += 1
        at = end
    return at, found, False
