"""The course of a run: quantities of each mapped scan for charts, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.types.records import Float, Frame, Int, Verdict


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


def read_quantities(frame: Frame) -> dict[str, float]:
    """Return a dict from the names of the quantities that come from the results of a scan (all except
    "driven" and "mapping") to their values in the units of QUANTITIES; NaN if unknown."""
    return {name: quantity.read(frame) for name, quantity in QUANTITIES.items() if quantity.read is not None}


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
        """Store the values of the scan with an index (0 or more), in place of earlier ones of this scan;
        names that are missing in `values` become NaN. If the index is beyond the rows, `stride` doubles until
        it fits. A scan whose index is no multiple of `stride` is ignored."""
        while index // self._stride >= self._rows:
            self._stride *= 2
            for column in self._columns.values():
                column[: self._rows // 2] = column[::2]
                column[self._rows // 2 :] = np.nan
        if index % self._stride:
            return
        for name in values:
            if name not in self._columns:
                self._columns[name] = np.full(self._rows, np.nan)
        for name, column in self._columns.items():
            column[index // self._stride] = values.get(name, math.nan)

    @property
    def stride(self) -> int:
        """Difference between the indices of successive kept scans, a power of two."""
        return self._stride

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
