"""A simulated drive of a VLP-16 as its packets, in a capture and in recordings of ROS."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.lidar import SpinningLidar
from pipeline.simulation.run import SimulatedRun
from pipeline.types.records import Float
from tests.pipeline.io.recordings import START_NS, Author, Write

#: A laser fires every 2.304 us, all sixteen every 55.296 us; rings from below in the order of firing.
FIRING_NS, LASER_NS = 55_296, 2_304
ORDER = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
SCAN_TYPE = "velodyne_msgs/msg/VelodyneScan"


@dataclass(frozen=True, slots=True)
class FiringVlp16(SpinningLidar):
    """A VLP-16 whose lasers fire one after the other while it turns, 1,800 times in a turn."""

    period_ns: int = 1800 * FIRING_NS

    def _directions(self) -> Float:
        """Return the directions of all rays, shape (C, K, 3); the sensor turns clockwise, from behind."""
        shot = np.empty(16)
        shot[ORDER] = np.arange(16) * (LASER_NS / FIRING_NS)
        azimuth = np.pi - (np.arange(self.columns)[:, None] + shot) * (2.0 * np.pi / self.columns)
        elevation = self.lowest + np.arange(self.rings) * self.ring_step
        level = np.cos(elevation)
        return np.stack(
            np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=2
        )


def open_drive(uri: str, sigma: float, T_base_lidar: Pose3 | None = None) -> SimulatedRun:
    """A scenario seen by the sensor, with a range noise [m]."""
    return replace(
        open_simulated(uri, SourceOptions(T_base_lidar=T_base_lidar)).run,
        lidar=FiringVlp16(range_sigma=sigma),
    )


def packets_of(run: SimulatedRun, sweep: int, *, dual: bool = False) -> list[tuple[int, bytes]]:
    """Time of arrival [ns] and bytes of the data packets of a sweep: 75, with two echoes per shot 150. Both
    echoes are alike here, as where a beam meets one surface."""
    lidar, scan = run.lidar, run.sweep(sweep).scan
    assert scan.ring is not None
    assert scan.offset_ns is not None
    reach, shade = np.zeros((lidar.columns, 16)), np.zeros((lidar.columns, 16))
    column = np.rint(scan.offset_ns / FIRING_NS).astype(int)
    reach[column, scan.ring] = np.linalg.norm(scan.points.astype(np.float64), axis=1)
    shade[column, scan.ring] = scan.reflectance
    channels = np.zeros((lidar.columns, 16), np.dtype([("distance", "<u2"), ("reflectivity", "u1")]))
    channels["distance"] = np.rint(reach[:, ORDER] / 0.002)
    channels["reflectivity"] = shade[:, ORDER]
    per_packet, copies = (12, 2) if dual else (24, 1)
    start_ns = START_NS + sweep * lidar.period_ns
    found = []
    for first in range(0, lidar.columns, per_packet):
        body = b""
        for shot in range(first, first + per_packet, 2):
            azimuth = (18_000 + 20 * shot) % 36_000
            block = struct.pack("<HH", 0xEEFF, azimuth) + channels[shot : shot + 2].tobytes()
            body += copies * block
        body += struct.pack(
            "<IBB", (start_ns + first * FIRING_NS) // 1000 % 3_600_000_000, 0x37 + 2 * dual, 0x22
        )
        arrived = start_ns + (first + per_packet) * FIRING_NS
        found.append((arrived // 1000 * 1000, body))  # captures have microseconds
    return found


def write_capture(path: Path, sweeps: list[list[tuple[int, bytes]]]) -> None:
    """Write packets to a capture."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for stamp_ns, packet in (each for sweep in sweeps for each in sweep):
            frame = _frame(packet)
            head = (stamp_ns // 10**9, stamp_ns % 10**9 // 1000, len(frame), len(frame))
            file.write(struct.pack("<IIII", *head) + frame)


def _frame(payload: bytes) -> bytes:
    """An Ethernet frame with a UDP packet to port 2368."""
    length = 8 + len(payload)
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + length, 0, 0, 64, 17, 0, bytes(4), bytes(4))
    return bytes(12) + b"\x08\x00" + ip + struct.pack(">HHHH", 2368, 2368, length, 0) + payload


def write_messages(author: Author, write: Write, sweeps: list[list[tuple[int, bytes]]]) -> None:
    """Write the sweeps as velodyne_msgs/VelodyneScan, stamped with their last packet."""
    for sweep in sweeps:
        stamp_ns = sweep[-1][0]
        header = author.header(stamp_ns, "velodyne")
        message = author.store.types[SCAN_TYPE](header, list(_messages(author, sweep)))
        write("/velodyne_packets", SCAN_TYPE, stamp_ns, message)


def _messages(author: Author, sweep: list[tuple[int, bytes]]) -> Iterator[object]:
    """The packets as messages."""
    for stamp_ns, packet in sweep:
        stamp = author.make("Time", stamp_ns // 10**9, stamp_ns % 10**9)
        yield author.store.types["velodyne_msgs/msg/VelodynePacket"](stamp, np.frombuffer(packet, np.uint8))
