"""What is known of the mapped scans of a run: quantities for charts, totals, and the estimates of each tree
over time, in bounded memory."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from app.batch.summary import warning_texts
from app.common.timers import TOTAL
from app.explain.records import History, half_axes
from app.worker.protocol import RunCounts
from pipeline.geometry.columns import GrowingColumns
from pipeline.types.records import Float, Frame, Int, Trees, Verdict
from pipeline.types.units import SECOND_NS


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity that charts show over time.

    Attributes:
        title: Title of its curve.
        unit: Unit; empty for none.
        read: Returns its value from the results of a scan, NaN if unknown; None if it is not among them.
    """

    title: str
    unit: str
    read: Callable[[Frame], float] | None = None


def _trees_among_clusters(frame: Frame) -> float:
    """Return the number of clusters with the verdict tree."""
    return float(np.count_nonzero(frame.clusters.verdict == Verdict.TREE))


def _from_odometry(frame: Frame) -> float:
    """Return the distance between the pose in the map and that of the odometry [m]."""
    mapped, odometry = frame.estimate.T_map_base, frame.T_odom_base
    return math.hypot(mapped.x - odometry.x, mapped.y - odometry.y)


def _filtered(frame: Frame) -> float:
    """Return the number of points after the filters; NaN if unknown. A scan that was segmented before has no
    points, but their numbers."""
    return float(frame.counts.get("clustered", math.nan) + frame.counts.get("noise", math.nan))


def _ahead(frame: Frame) -> float:
    """Return the distance to the nearest obstacle ahead [m]; NaN if unknown, infinite if the way is free."""
    return math.nan if frame.clearance is None else frame.clearance.ahead


QUANTITIES: dict[str, Quantity] = {
    "trees": Quantity("trees", "", lambda f: float(np.count_nonzero(f.trees.confirmed))),
    "clusters": Quantity("clusters", "", lambda f: float(len(f.clusters.size))),
    "stems": Quantity("clusters that are trees", "", _trees_among_clusters),
    "sigma": Quantity("sigma of the position", "cm", lambda f: 100.0 * f.health.sigma_xy),
    "yaw": Quantity("sigma of the heading", "°", lambda f: math.degrees(f.health.sigma_yaw)),
    "n_eff": Quantity("effective particles", "", lambda f: f.estimate.n_eff),
    "detections": Quantity("detections used by SLAM", "", lambda f: float(f.health.detections)),
    "recognised": Quantity("detections associated", "%", lambda f: 100.0 * f.health.recognised),
    "ambiguous": Quantity("detections ambiguous", "%", lambda f: 100.0 * f.health.ambiguous),
    "innovation": Quantity("normalised innovation", "", lambda f: f.health.innovation),
    "odometry": Quantity("deviation from the odometry", "sigma", lambda f: f.health.odometry),
    "drift": Quantity("distance from the odometry", "m", _from_odometry),
    "x": Quantity("x of the robot", "m", lambda f: f.estimate.T_map_base.x),
    "y": Quantity("y of the robot", "m", lambda f: f.estimate.T_map_base.y),
    "heading": Quantity("heading of the robot", "°", lambda f: math.degrees(f.estimate.T_map_base.yaw)),
    "driven": Quantity("driven distance", "m"),
    "clearance": Quantity("distance to an obstacle ahead", "m", _ahead),
    "raw": Quantity("points of the scan", "", lambda f: float(f.counts.get("returns", math.nan))),
    "filtered": Quantity("points after the filters", "", _filtered),
    "mapping": Quantity("mapping time", "ms"),
}


#: Names of the quantities that come from the results of a scan.
READ_QUANTITIES = tuple(name for name, quantity in QUANTITIES.items() if quantity.read is not None)


def read_quantities(frame: Frame) -> dict[str, float]:
    """Return a dict from the names of the quantities that come from the results of a scan (all except
    "driven" and "mapping") to their values in the units of QUANTITIES; NaN if unknown."""
    return {name: quantity.read(frame) for name, quantity in QUANTITIES.items() if quantity.read is not None}


#: Beginning of the names of the times of stages [ms] in a ScanSeries.
STAGE = "stage "


def stage_times(times: Mapping[str, float]) -> dict[str, float]:
    """Return a dict from names in a ScanSeries to the times of mapping a scan [ms]: "mapping", the total, and
    each stage and the total with STAGE before its name.

    Args:
        times: Times by stage, with TOTAL.
    """
    return {"mapping": times[TOTAL], **{f"{STAGE}{name}": spent for name, spent in times.items()}}


MOST_ROWS = 8192  # scans of ten minutes at 10 Hz, and a longer run in larger steps


class ScanSeries:
    """Values of the scans of a run by name. Of more scans than rows every second one is kept, then every
    fourth and so on.

    Args:
        rows: Maximum number of scans, even.
    """

    def __init__(self, rows: int = MOST_ROWS) -> None:
        self._rows = rows
        self._columns: dict[str, Float] = {}  # by name, NaN where unknown
        self._stride = 1

    def record(self, index: int, values: Mapping[str, float]) -> None:
        """Store values of the scan with an index (0 or more), in place of earlier ones of this scan; its
        values of other names stay. If the index is beyond the rows, every second row is removed until it
        fits. A scan that belongs to no row is ignored."""
        while index // self._stride >= self._rows:
            self._stride *= 2
            for column in self._columns.values():
                column[: self._rows // 2] = column[::2]
                column[self._rows // 2 :] = np.nan
        if index % self._stride:
            return
        for name, value in values.items():
            if name not in self._columns:
                self._columns[name] = np.full(self._rows, np.nan)
            self._columns[name][index // self._stride] = value

    def until(self, scans: int, names: Iterable[str]) -> ScanSeries:
        """Return a copy with the values of these names of the first scans."""
        other = ScanSeries(self._rows)
        other._stride = self._stride
        other._columns = {name: self._columns[name].copy() for name in names if name in self._columns}
        other.forget_from(scans)
        return other

    def replace(self, name: str, values: Float) -> None:
        """Replace the values of `name` of the first scans, shape (N,)."""
        rows = values[:: self._stride][: self._rows]
        self._columns.setdefault(name, np.full(self._rows, np.nan))[: len(rows)] = rows

    def forget_from(self, index: int) -> None:
        """Remove the values of the scan with this index and of later ones."""
        for column in self._columns.values():
            column[-(-index // self._stride) :] = np.nan

    @property
    def names(self) -> list[str]:
        """Names of which the value of any scan is known, in the order in which they came first."""
        return [name for name, column in self._columns.items() if not np.isnan(column).all()]

    def scans(self, name: str) -> Int:
        """Return the indices of the scans of which the value of `name` is known, ascending."""
        column = self._columns.get(name)
        if column is None:
            return np.zeros(0, np.int64)
        return self._stride * np.flatnonzero(~np.isnan(column))

    def values(self, name: str, scans: Int) -> Float:
        """Return the values of `name` in the scans with these indices; NaN where unknown."""
        column = self._columns.get(name)
        found = np.full(len(scans), np.nan)
        if column is not None:
            kept = np.flatnonzero((scans % self._stride == 0) & (scans < self._rows * self._stride))
            found[kept] = column[scans[kept] // self._stride]
        return found


_STATES = ("good", "weak", "lost")
_MOST_WARNINGS = 200  # texts, which are sent with each scan


class ScanCounts:
    """Totals of verdicts, pose quality and warnings up to each scan of a map, also after the run went
    back."""

    def __init__(self) -> None:
        # Numbers of clusters by verdict and of scans by state, and the largest known sigma [m].
        self._rows = GrowingColumns(np.zeros((0, len(Verdict) + len(_STATES)), np.int32), np.zeros(0))
        self._warned: list[tuple[int, tuple[str, ...]]] = []  # scans with warnings, ascending
        self._counted, self._warnings = 0, Counter[str]()  # so many of them, and their warnings

    def record(self, frame: Frame) -> None:
        """Add the scan after the last one, or replace the last one; any other scan is ignored, also one that
        is mapped again."""
        if frame.index == len(self._rows) - 1:
            self.forget_from(frame.index)
        known, sigma = len(self._rows), frame.health.sigma_xy
        if frame.index != known:
            return
        totals, largest = (self._rows.column(k)[-1:] for k in range(2))
        verdicts = np.bincount(frame.clusters.verdict, minlength=len(Verdict))
        counted = np.append(verdicts, [frame.health.state == name for name in _STATES])
        self._rows.write(
            known,
            totals.sum(axis=0, keepdims=True) + counted,
            np.array([np.fmax.reduce([*largest, sigma if math.isfinite(sigma) else math.nan])]),
        )
        if frame.warnings:
            self._warned.append((known, tuple(frame.warnings)))

    def until(self, scans: int) -> ScanCounts:
        """Return a copy with the first scans."""
        other = ScanCounts()
        other._rows = GrowingColumns(*(self._rows.column(k)[:scans] for k in range(2)))
        other._warned = self._warned[: bisect_left(self._warned, scans, key=_scan_of)]
        return other

    def forget_from(self, index: int) -> None:
        """Remove the scan with this index and later ones."""
        self._rows.return_to(min(index, len(self._rows)))
        del self._warned[bisect_left(self._warned, index, key=_scan_of) :]
        if self._counted > len(self._warned):
            self._counted, self._warnings = 0, Counter()

    def totals(self, index: int, warnings: Sequence[str], losses: Mapping[str, int]) -> RunCounts:
        """Return the totals up to a scan that was recorded. `health` has all states; `verdicts` and `losses`
        have only entries above 0; `covered` is None. At most 200 different warnings are returned.

        Args:
            index: Index of the scan.
            warnings: Warnings about the source, which come first.
            losses: Dict from reasons to numbers of left-out messages.
        """
        totals, sigma = self._rows.column(0)[index].tolist(), float(self._rows.column(1)[index])
        return RunCounts(
            dict(zip(_STATES, totals[len(Verdict) :], strict=True)),
            round(sigma, 4) if math.isfinite(sigma) else None,
            dict(sorted((verdict.label, n) for verdict, n in zip(Verdict, totals, strict=False) if n)),
            {reason: n for reason, n in losses.items() if n},
            warning_texts(Counter(warnings) + self._warnings_until(index))[:_MOST_WARNINGS],
        )

    def _warnings_until(self, index: int) -> Counter[str]:
        """Return the numbers of the warnings up to a scan. They are counted on from the last call, as a run
        mostly goes forward."""
        end = bisect_right(self._warned, index, key=_scan_of)
        if end < self._counted:
            self._counted, self._warnings = 0, Counter()
        for _, texts in self._warned[self._counted : end]:
            self._warnings.update(texts)
        self._counted = end
        return self._warnings


def _scan_of(warned: tuple[int, tuple[str, ...]]) -> int:
    """Return the index of a scan with warnings."""
    return warned[0]


_WIDTH = 11  # scan, number, observations, time, x, y, var x, cov xy, var y, DBH, its sigma
_SCAN, _NUMBER, _OBSERVATIONS, _TIME = range(4)
_MOST_ROWS = 200_000
_ALL_OF_FIRST = 10  # observations; there the ellipse shrinks fastest
_MOST_RETURNED = 200  # rows


class TreeHistory:
    """The estimate of each tree after every scan that detected it.

    The first ten estimates of each tree are always kept. When more than 200,000 estimates are stored, the
    later ones of every second scan are dropped, repeatedly.
    """

    def __init__(self) -> None:
        self._rows = GrowingColumns(np.zeros((0, _WIDTH)))
        self._spacing = 1

    def record(self, index: int, stamp_ns: int, trees: Trees, start_ns: int) -> None:
        """Add a row for each tree that a scan detected, confirmed or not. Rows of this scan and of later
        ones are removed first, because the run went back. Once rows were dropped, scans between the kept ones
        add only the first ten estimates of a tree.

        Args:
            index: Number of the scan.
            stamp_ns: Time of the scan [ns].
            trees: Trees after the scan.
            start_ns: Time of the first scan of the run [ns].
        """
        known = self._rows.column(0)
        first = int(np.searchsorted(known[:, _SCAN], index))
        self._rows.write(first, self._kept(_rows_of(index, stamp_ns, trees, start_ns)))
        while len(self._rows) > _MOST_ROWS and self._spacing < _MOST_ROWS:
            self._spacing *= 2
            self._rows.write(0, self._kept(self._rows.column(0)))

    def last_places(self) -> dict[int, tuple[float, float]]:
        """Return a dict from the number of each tree, also of trees that ended, to its newest stored position
        (x, y) in the map [m]."""
        known = self._rows.column(0)
        return {int(number): (float(x), float(y)) for number, x, y in known[:, [_NUMBER, 4, 5]]}

    def of(self, number: int, scan: int) -> History:
        """Return the estimates of the tree with this number up to a scan (inclusive), in order of time: at
        most 200 rows, denser at the beginning, the first and the last among them; empty columns for an
        unknown tree."""
        known = self._rows.column(0)
        mine = known[(known[:, _NUMBER] == number) & (known[:, _SCAN] <= scan)]
        if len(mine) > _MOST_RETURNED:  # denser for the first observations, where the ellipse changes fastest
            place = np.unique(np.geomspace(1, len(mine), _MOST_RETURNED).astype(np.int64) - 1)
            mine = mine[place]
        ellipse = half_axes(mine[:, [[6, 7], [7, 8]]])
        return History(
            time_s=mine[:, _TIME].tolist(),
            x=mine[:, 4].tolist(),
            y=mine[:, 5].tolist(),
            major=ellipse[:, 0].tolist(),
            minor=ellipse[:, 1].tolist(),
            angle=ellipse[:, 2].tolist(),
            dbh=mine[:, 9].tolist(),
            dbh_sigma=mine[:, 10].tolist(),
        )

    def _kept(self, rows: Float) -> Float:
        """Return which of the rows, shape (R, _WIDTH), are stored with the present spacing of the scans."""
        kept: Float = rows[(rows[:, _SCAN] % self._spacing == 0) | (rows[:, _OBSERVATIONS] <= _ALL_OF_FIRST)]
        return kept


def _rows_of(index: int, stamp_ns: int, trees: Trees, start_ns: int) -> Float:
    """Return a row for each tree that a scan detected, shape (R, _WIDTH): scan, number, observations,
    time since `start_ns` [s], x, y in the map [m], covariance xx, xy, yy [m^2], DBH [m] and sigma of the
    DBH [m]."""
    # A tree that began as a voxel column has a position before any scan detects it.
    rows = np.flatnonzero((trees.last_seen_ns == stamp_ns) & (trees.observations > 0))
    return np.column_stack(
        [
            np.full(len(rows), index),
            trees.number[rows],
            trees.observations[rows],
            np.full(len(rows), (stamp_ns - start_ns) / SECOND_NS),
            trees.position[rows],
            trees.covariance[rows][:, [0, 0, 1], [0, 1, 1]],
            trees.dbh[rows],
            trees.dbh_sigma[rows],
        ]
    )
