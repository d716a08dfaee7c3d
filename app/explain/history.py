"""Bounded memories for the stories: the estimates of each tree over time, and the scans shown last."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from app.explain.records import History
from pipeline.types.records import Frame

_MOST_SCANS = 60  # at twenty scans per second a click may be three seconds old
_WIDTH = 11  # scan, number, observations, time, x, y, var x, cov xy, var y, DBH, its sigma
_SCAN, _NUMBER, _OBSERVATIONS, _TIME = range(4)
_MOST_ROWS = 200_000
_ALL_OF_FIRST = 10  # observations; there the ellipse shrinks fastest
_MOST_RETURNED = 200  # rows
_NS = 1_000_000_000


class TreeHistory:
    """The estimate of each tree after every scan that detected it.

    The first ten estimates of each tree are always kept. When more than 200,000 estimates are stored, the
    later ones of every second scan are dropped, repeatedly.
    """

    def __init__(self) -> None:
        self._rows = np.zeros((1024, _WIDTH))
        self._count = 0
        self._spacing = 1

    def record(self, frame: Frame, start_ns: int) -> None:
        """Add a row for each tree that the scan detected, confirmed or not. Rows of this scan and of later
        ones are removed first, because the run went back. Once rows were dropped, scans between the kept ones
        add only the first ten estimates of a tree.

        Args:
            frame: Result of the scan.
            start_ns: Time of the first scan of the run [ns].
        """
        rows = _rows_of(frame, start_ns)
        self._count = int(np.searchsorted(self._rows[: self._count, _SCAN], frame.index))
        if self._spacing > 1:
            rows = rows[(rows[:, _SCAN] % self._spacing == 0) | (rows[:, _OBSERVATIONS] <= _ALL_OF_FIRST)]
        self._append(rows)

    def last_places(self) -> dict[int, tuple[float, float]]:
        """Return a dict from the number of each tree, also of trees that ended, to its newest stored position
        (x, y) in the map [m]."""
        known = self._rows[: self._count]
        return {int(number): (float(x), float(y)) for number, x, y in known[:, [_NUMBER, 4, 5]]}

    def of(self, number: int, scan: int) -> History:
        """Return the estimates of the tree with this number up to a scan (inclusive), in order of time: at
        most 200 rows, denser at the beginning, the first and the last among them; empty columns for an
        unknown tree."""
        known = self._rows[: self._count]
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

    def _append(self, rows: NDArray[np.float64]) -> None:
        """Append rows, shape (R, _WIDTH). Above 200,000 rows the later estimates of every second scan are
        dropped, repeatedly."""
        while self._count + len(rows) > len(self._rows):
            grown = np.empty((2 * len(self._rows), _WIDTH))
            grown[: self._count] = self._rows[: self._count]
            self._rows = grown
        self._rows[self._count : self._count + len(rows)] = rows
        self._count += len(rows)
        while self._count > _MOST_ROWS and self._spacing < _MOST_ROWS:
            self._spacing *= 2
            known = self._rows[: self._count]
            keep = (known[:, _OBSERVATIONS] <= _ALL_OF_FIRST) | (known[:, _SCAN] % self._spacing == 0)
            self._count = int(keep.sum())
            self._rows[: self._count] = known[keep]


def half_axes(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return major half axis [m], minor half axis [m] and direction of the major axis [rad] of 1-sigma
    ellipses, shape (T, 3). Either of the two opposite directions may be returned.

    Args:
        covariance: Covariances, shape (T, 2, 2) [m^2].
    """
    values, vectors = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0.0)).T
    return np.stack([major, minor, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])], axis=1)


def _rows_of(frame: Frame, start_ns: int) -> NDArray[np.float64]:
    """Return a row for each tree that the scan detected, shape (R, _WIDTH): scan, number, observations,
    time since `start_ns` [s], x, y in the map [m], covariance xx, xy, yy [m^2], DBH [m] and sigma of the
    DBH [m]."""
    trees = frame.trees
    # A tree that began as a voxel column has a position before any scan detects it.
    rows = np.flatnonzero((trees.last_seen_ns == frame.stamp_ns) & (trees.observations > 0))
    return np.column_stack(
        [
            np.full(len(rows), frame.index),
            trees.number[rows],
            trees.observations[rows],
            np.full(len(rows), (frame.stamp_ns - start_ns) / _NS),
            trees.position[rows],
            trees.covariance[rows][:, [0, 0, 1], [0, 1, 1]],
            trees.dbh[rows],
            trees.dbh_sigma[rows],
        ]
    )


class RecentScans:
    """The 60 scans that were sent to the browsers last, without their raw points. Thread-safe."""

    def __init__(self) -> None:
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, run: int, frame: Frame) -> None:
        """Store a scan without its raw points, in place of an earlier result of the same scan. Beyond
        _MOST_SCANS, the scans that were stored first are removed.

        Args:
            run: Number of the run.
            frame: Results of the scan.
        """
        small = replace(frame, raw=np.zeros((0, 3), np.float32))
        with self._lock:
            self._frames[run, frame.index] = small
            self._frames.move_to_end((run, frame.index))
            while len(self._frames) > _MOST_SCANS:
                self._frames.popitem(last=False)

    def forget(self) -> None:
        """Remove all scans."""
        with self._lock:
            self._frames.clear()

    def find(self, run: int, scan: int) -> Frame | None:
        """Return a scan as it was sent last, but with an empty `raw`; None if it is not stored.

        Args:
            run: Number of the run.
            scan: Index of the scan.
        """
        with self._lock:
            return self._frames.get((run, scan))
