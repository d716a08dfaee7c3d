"""From single Velodyne packets, as they come, to messages of whole sweeps."""

from __future__ import annotations

from typing import Any

from pipeline.io.readers.ros_messages import VELODYNE_SCAN, standard_types
from pipeline.io.readers.velodyne import PACKET_BYTES

#: A longer silence between packets ends a sweep.
GAP_NS = 50_000_000
#: The fastest sensor (VLS-128, dual return) sends fewer packets in the slowest turn.
MOST_PACKETS = 4000
FRAME = "velodyne"
_SECOND = 1_000_000_000
_TURN, _HALF = 36_000, 18_000


class Sweeps:
    """Gathers packets of one sensor until it has turned once; a message is stamped with its last packet."""

    def __init__(self) -> None:
        self._packets: list[tuple[int, bytes]] = []
        self._azimuth = 0
        self._turned = 0

    def add(self, stamp_ns: int, packet: bytes) -> bytes | None:
        """Take a data packet; the sweep before it as velodyne_msgs/VelodyneScan in CDR when it is over.

        Args:
            stamp_ns: When it came; never before the one before.
            packet: 1206 bytes that pass `is_data_packet`.
        """
        azimuth = packet[2] + 256 * packet[3]
        step = (azimuth - self._azimuth) % _TURN if self._packets else 0
        # A small step back is jitter of the motor, not most of a turn.
        self._turned += step if step < _HALF else 0
        over = self._turned >= _TURN or len(self._packets) >= MOST_PACKETS or self.is_stale(stamp_ns)
        ended = self.end() if over else None
        self._azimuth = azimuth
        self._packets.append((stamp_ns, packet))
        return ended

    def is_stale(self, now_ns: int) -> bool:
        """Whether no packet came for so long that the sweep is over."""
        return bool(self._packets) and now_ns - self._packets[-1][0] > GAP_NS

    def end(self) -> bytes | None:
        """The sweep so far as a message; None when there is none."""
        packets, self._packets, self._turned = self._packets, [], 0
        return _message(packets) if packets else None


def _message(packets: list[tuple[int, bytes]]) -> bytes:
    import numpy as np

    store: Any = standard_types("cdr")
    packet_type = store.types["velodyne_msgs/msg/VelodynePacket"]
    header = store.types["std_msgs/msg/Header"](stamp=_time(store, packets[-1][0]), frame_id=FRAME)
    scan = store.types[VELODYNE_SCAN](
        header=header,
        packets=[
            packet_type(stamp=_time(store, stamp_ns), data=np.frombuffer(data, np.uint8, PACKET_BYTES))
            for stamp_ns, data in packets
        ],
    )
    return bytes(store.serialize_cdr(scan, VELODYNE_SCAN))


def _time(store: Any, stamp_ns: int) -> Any:  # noqa: ANN401
    return store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // _SECOND, nanosec=stamp_ns % _SECOND)
