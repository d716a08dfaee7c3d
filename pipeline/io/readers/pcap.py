"""A capture of a Velodyne sensor's packets as a source. It has no odometry."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.pcap_packets import DATA_PORT, Packets, find_packets
from pipeline.io.readers.velodyne import PACKET_BYTES, SENSORS, PacketDecoder, PacketError
from pipeline.jit import compiled
from pipeline.types.records import Int, Record, Truth

#: A longer silence between packets ends a sweep.
_GAP_NS = 50_000_000
#: A packet whose time lies farther from its neighbours has a damaged time.
_JUMP_NS = 1_000_000_000


class PcapSource:
    """A .pcap file. A scan is one turn of the sensor, stamped with the arrival of its last packet.

    Args:
        uri: As the user wrote it.
        path: The file.
        options: The mounting.

    Raises:
        SourceError: It is no capture or has no packets of a known sensor.
        OSError: It cannot be read.
    """

    def __init__(self, uri: str, path: Path, options: SourceOptions) -> None:
        self._path = path
        packets, self._damage = find_packets(path)
        self._packets = packets = self._one_sensor(packets, uri)
        self._first = _sweep_starts(packets.azimuth, packets.stamp_ns, _GAP_NS)
        self._last = np.append(self._first[1:], len(packets.offset)) - 1
        self._stamp = packets.stamp_ns[self._last]
        self._losses: dict[str, int] = {}
        self._file = path.open("rb", buffering=0)
        self._description = SourceDescription(
            uri=uri,
            kind="Velodyne capture (pcap)",
            sensor=SENSORS[int(packets.product[0])],
            T_base_lidar=options.T_base_lidar or Pose3.identity(),
            has_odometry=False,
            has_imu=False,
            scans=len(self._first),
            start_ns=int(self._stamp[0]),
            end_ns=int(self._stamp[-1]),
            digest=digest_of([path]),
        )

    @property
    def description(self) -> SourceDescription:
        """What is known before reading."""
        return self._description

    @property
    def losses(self) -> dict[str, int]:
        """What was left out when opening and in the latest reading, by reason."""
        return {**self._damage, **self._losses}

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield the scans from `start_ns` on; earlier packets are not decoded."""
        self._losses = losses = dict[str, int]()
        decoder = PacketDecoder()
        begin = 0 if start_ns is None else int(np.searchsorted(self._stamp, start_ns))
        for sweep in range(begin, len(self._first)):
            rows = range(int(self._first[sweep]), int(self._last[sweep]) + 1)
            stamps = self._packets.stamp_ns[rows.start : rows.stop].tolist()
            try:
                scan = decoder.decode(int(self._stamp[sweep]), stamps, self._read(rows))
            except PacketError:
                count_loss(losses, "scans that cannot be decoded")
                continue
            if len(scan.points):
                yield scan
            else:
                count_loss(losses, "scans without points")

    def truth(self) -> Truth | None:
        """A capture has none."""
        return None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, rows: range) -> list[bytes]:
        """The packets of one sweep, read at once."""
        offsets = self._packets.offset[rows.start : rows.stop]
        start = int(offsets[0])
        try:
            self._file.seek(start)
            block = self._file.read(int(offsets[-1]) + PACKET_BYTES - start)
        except OSError as error:
            raise SourceError(f"cannot read on: {error.strerror}", where=str(self._path)) from error
        return [block[at : at + PACKET_BYTES] for at in (offsets - start).tolist()]

    def _one_sensor(self, packets: Packets, uri: str) -> Packets:
        """The packets of the sensor that sent most; sorted out those with impossible times."""
        if not len(packets.offset):
            raise SourceError(
                f"the capture has no data packets of a known Velodyne sensor to port {DATA_PORT}",
                where=uri,
                remedy="HDL-32E, VLP-16, VLP-32, Puck Hi-Res and VLS-128 can be read.",
            )
        for column, reason in (
            ("sender", "packets of other senders"),
            ("product", "packets of other sensors"),
        ):
            numbers, counts = np.unique(getattr(packets, column), return_counts=True)
            main = numbers[int(np.argmax(counts))]
            packets = self._keep(packets, getattr(packets, column) == main, reason)
        if len(packets.offset) >= 3:
            stamp = packets.stamp_ns
            middle = np.median(np.stack([stamp[:-2], stamp[1:-1], stamp[2:]]).astype(np.float64), axis=0)
            middle = np.concatenate([middle[:1], middle, middle[-1:]])
            steady = np.abs(stamp - middle) <= _JUMP_NS
            packets = self._keep(packets, steady, "packets with an impossible time")
        ahead = packets.stamp_ns >= np.maximum.accumulate(packets.stamp_ns)
        return self._keep(packets, ahead, "packets that came before their predecessor")

    def _keep(
        self, packets: Packets, keep: np.ndarray[tuple[int], np.dtype[np.bool_]], reason: str
    ) -> Packets:
        refused = len(keep) - int(np.count_nonzero(keep))
        if refused:
            count_loss(self._damage, reason, refused)
        return packets.only(keep) if refused else packets


@compiled
def _sweep_starts(azimuth: Int, stamp_ns: Int, gap_ns: int) -> Int:
    """Rows at which a sweep begins: after a whole turn, or after a silence."""
    starts = np.empty(len(azimuth), np.int64)
    starts[0] = 0
    count, turned = 1, 0
    for row in range(1, len(azimuth)):
        step = (azimuth[row] - azimuth[row - 1]) % 36000
        # A small step back is jitter of the motor, not most of a turn.
        turned += step if step < 18000 else 0
        if turned >= 36000 or stamp_ns[row] - stamp_ns[row - 1] > gap_ns:
            starts[count] = row
            count += 1
            turned = 0
    return starts[:count].copy()
