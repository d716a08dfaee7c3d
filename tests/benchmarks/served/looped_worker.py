"""A mapping process whose robot drives one lap again and again:
`python -m tests.benchmarks.served.looped_worker`.

The lap is simulated once, so that a scan costs no ray casting. Its wheels drift by the same amount in each
lap, and the robot stands for a while after every fifth lap. STEMMAP_BENCH_SCANS is the number of scans.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from app.worker.process import new_session, run_as_worker
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import FileSource, SourceOptions
from pipeline.io.readers.simulated import open_simulated
from pipeline.types.records import Imu, Odometry, Record, Scan

VARIABLE = "STEMMAP_BENCH_SCANS"
LAP = "sim:stand?duration=110&odometry=poor"
FIRST = 100  # scan at which the lap begins: the robot drives at its full speed then
LAPS_BETWEEN_BREAKS, BREAK_SCANS = 5, 200


class LoopedSource(FileSource):
    """One lap of a simulated drive, repeated.

    Args:
        uri: URI as requested.
        scans: Number of scans.
    """

    def __init__(self, uri: str, scans: int) -> None:
        super().__init__()
        lap = open_simulated(LAP)
        known = lap.description
        path = lap.run.true_path()
        apart = np.hypot(path.x - path.x[FIRST], path.y - path.y[FIRST])
        last = 600 + int(np.argmin(apart[600:]))
        self._period_ns = lap.run.lidar.period_ns
        start_ns = (known.start_ns or 0) + FIRST * self._period_ns
        self._lap_ns = (last - FIRST) * self._period_ns
        self._records: list[Record] = []
        for record in lap.records():
            if start_ns <= record.stamp_ns <= start_ns + self._lap_ns:
                self._records.append(record)
        self._start_ns, self._scans = start_ns, scans
        self._description = replace(
            known, uri=uri, scans=scans, start_ns=start_ns, end_ns=start_ns + (scans - 1) * self._period_ns
        )

    def records(self) -> Iterator[Record]:
        """Yield the records of all laps and breaks in the order of time."""
        of_wheels = [record.T_odom_base for record in self._records if isinstance(record, Odometry)]
        before_lap, lap_begins = Pose3.identity(), of_wheels[0].inverse()
        step, end = lap_begins @ of_wheels[-1], self._start_ns + self._scans * self._period_ns
        shift_ns, lap = 0, 0
        while True:
            for record in self._records:
                if record.stamp_ns == self._start_ns + self._lap_ns:
                    break  # the first of the next lap
                moved = replace(record, stamp_ns=record.stamp_ns + shift_ns)
                if isinstance(moved, Odometry):
                    moved = replace(moved, T_odom_base=before_lap @ lap_begins @ moved.T_odom_base)
                if moved.stamp_ns >= end:
                    return
                yield moved
            before_lap, shift_ns, lap = before_lap @ step, shift_ns + self._lap_ns, lap + 1
            if lap % LAPS_BETWEEN_BREAKS == 0:
                for moved in self._standing(before_lap, shift_ns):
                    if moved.stamp_ns >= end:
                        return
                    yield moved
                shift_ns += BREAK_SCANS * self._period_ns

    def _standing(self, pose: Pose3, shift_ns: int) -> Iterator[Record]:
        """Yield the records of a robot that does not move: the same scan, the same pose, no rotation."""
        imu = next(record for record in self._records if isinstance(record, Imu))
        scan = next(record for record in self._records if isinstance(record, Scan))
        for k in range(BREAK_SCANS):
            stamp_ns = self._start_ns + shift_ns + k * self._period_ns
            yield replace(imu, stamp_ns=stamp_ns, angular_velocity=np.zeros(3))
            yield Odometry(stamp_ns, pose)
            yield replace(scan, stamp_ns=stamp_ns)


def _open(uri: str, _options: SourceOptions) -> LoopedSource:
    return LoopedSource(uri, int(os.environ[VARIABLE]))


if __name__ == "__main__":
    run_as_worker(new_session(_open))
