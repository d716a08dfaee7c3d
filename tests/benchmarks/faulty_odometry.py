"""Simulated drives with whole scans whose odometry fails: path and map against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from pipeline.config import preset
from pipeline.front_end import SegmentedScan
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Float, Odometry, Record, Truth

SECONDS = 45.0  # duration of a drive; all faults are over or begin before
MATCH = 0.5  # m; largest distance between a mapped tree and its true tree
WRONG = 0.5  # m; a pose with a larger error is wrong

Fault = Callable[[float, Pose3, Pose3], Pose3 | None]


def _frozen(first: float, last: float) -> Fault:
    """Return a fault that repeats the last reading between two times [s]."""
    return lambda t, now, before: before if first <= t < last else now


#: Reading of the odometry by the time since the start [s], the true reading, and the last one that was sent;
#: None for no reading.
FAULTS: dict[str, Fault] = {
    "none": lambda _t, now, _before: now,
    "missing from 15 to 25 s": lambda t, now, _before: None if 15.0 <= t < 25.0 else now,
    "stands still from 15 to 30 s": _frozen(15.0, 30.0),
    "stands still from 15 s": _frozen(15.0, np.inf),
    "falls to zero at 20 s": lambda t, now, _before: Pose3.identity() if t >= 20.0 else now,
}


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Result of one drive.

    Attributes:
        error: Largest error of the reported position [m].
        false: Confirmed trees without a true tree within MATCH.
        missing: Visible true trees without a mapped one.
        silent: Scans whose reported position is wrong (WRONG) while the pose quality is "good".
    """

    error: float
    false: int
    missing: int
    silent: int


class SimulatedDrive:
    """The scans of `sim:stand` of one seed, segmented once for all faults."""

    def __init__(self, seed: int) -> None:
        """Simulate and segment the scans."""
        source = open_source(f"sim:stand?seed={seed}&duration={SECONDS:g}")
        self._description, self._truth, self._seed = source.description, source.truth() or Truth(), seed
        self._records = list(source.records())
        mapper = self._mapper()
        self._scans: list[SegmentedScan] = [mapper.segment(step) for step in steps(self._records)]

    def _mapper(self) -> Mapper:
        known = self._description
        return Mapper(
            preset(known.preset), sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=self._seed
        )

    def mapped(self, fault: Fault) -> DriveResult:
        """Map the drive with a fault of the odometry."""
        mapper, errors, silent, found = self._mapper(), list[float](), 0, np.zeros((0, 2))
        for step in steps(with_fault(self._records, fault)):
            frame = mapper.process(step, self._scans[step.index])
            pose = frame.estimate.T_map_base
            errors.append(float(np.hypot(*(self._true_position(frame.stamp_ns) - [pose.x, pose.y]))))
            silent += bool(errors[-1] > WRONG and frame.health.state == "good")
            found = frame.trees.position[frame.trees.confirmed]
        false, missing = self._compared(found)
        return DriveResult(max(errors), false, missing, silent)

    def _true_position(self, stamp_ns: int) -> Float:
        path = self._truth.path
        assert path is not None
        return np.array(
            [np.interp(stamp_ns, path.stamp_ns, path.x), np.interp(stamp_ns, path.stamp_ns, path.y)]
        )

    def _compared(self, found: Float) -> tuple[int, int]:
        """Return the number of false and of missing trees; hidden true trees may be mapped or not."""
        trees = self._truth.trees
        assert trees is not None
        kind = np.array(trees.kind)
        real = (kind == "tree") | (kind == "hidden")
        true = np.column_stack([trees.x, trees.y])[real]
        away = np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1))
        rows, columns = linear_sum_assignment(np.where(away < MATCH, away, 1e3))
        matched = columns[away[rows, columns] < MATCH]
        visible = np.flatnonzero(kind[real] == "tree")
        return len(found) - len(matched), len(np.setdiff1d(visible, matched))


def with_fault(records: Iterable[Record], fault: Fault) -> Iterator[Record]:
    """Yield the records with a fault of the odometry."""
    start_ns, sent = None, Pose3.identity()
    for record in records:
        if isinstance(record, Odometry):
            start_ns = record.stamp_ns if start_ns is None else start_ns
            read = fault((record.stamp_ns - start_ns) * 1e-9, record.T_odom_base, sent)
            if read is None:
                continue
            sent = read
            record = replace(record, T_odom_base=read)
        yield record
