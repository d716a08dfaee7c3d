"""Recorded scans tracked again in one compiled loop: what a `Tracker` makes of them one by one, to the byte,
without the interpreter in between."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.config import Parameters
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.tracking.kalman import update_rows
from pipeline.tracking.observation import WIDTH, Telling, diameter, is_confirmed, sides_of
from pipeline.tracking.track_classification import judge, learn_between
from pipeline.tracking.track_table import Rows, TrackTable
from pipeline.tracking.track_update import hold, recognise, take
from pipeline.tracking.tracker import limits_of
from pipeline.tracking.tracking_inputs import Found, Limits, Sight
from pipeline.tracking.tree_records import SHARED_COVARIANCE, telling_of, trees_of
from pipeline.types.records import Bool, Int, Int32, Trees

_ROOM = 1024  # rows more than are needed


class Recorded(NamedTuple):
    """What the tracking is told of T scans; the rows of scan t are start[t] to start[t + 1].

    Attributes:
        stamp_ns: int64, shape (T,); pose, covariance, relative, clear_range: see `Sight`, shape (T, ...).
        detections: Start of their rows, shape (T + 1,); centre to height: see `Detections` and
            `Tracker.process`, NaN for an unknown height, shape (D, ...).
        landmarks: Start of their rows; place, place_covariance: see `anchor`, shape (L, ...).
        gathered: Whether a scan was, shape (T,); columns: start of their rows; axis, votes: see `judge`,
            shape (C, ...).
    """

    stamp_ns: Int
    pose: Float
    covariance: Float
    relative: Float
    clear_range: Float
    detections: Int
    centre: Float
    spread: Float
    eccentricity: Float
    radius: Float
    radius_sigma: Float
    arc: Float
    height: Float
    landmarks: Int
    place: Float
    place_covariance: Float
    gathered: Bool
    columns: Int
    axis: Float
    votes: Float


class Seen(NamedTuple):
    """The trees that scans detected, as each of them left them; columns of length R.

    Attributes:
        scan: int64, ascending; number, observations: of the tree.
        position: shape (R, 2) [m]; covariance: shape (R, 2, 2), as `Trees` tells them; dbh, dbh_sigma: [m].
    """

    scan: Int
    number: Int
    observations: Int
    position: Float
    covariance: Float
    dbh: Float
    dbh_sigma: Float

    def first(self, count: int) -> Seen:
        """So many rows."""
        return Seen._make(column[:count] for column in self)


class _Rules(NamedTuple):
    """All that the parameters say."""

    limits: Limits
    telling: Telling
    view_range: float
    breast_height: float
    tree_share: float
    range_max: float


class Tracking:
    """Trees tracked over recorded scans from the first one on, with the compiled engine.

    Args:
        parameters: Of the tracking, the share of votes, and how far SLAM looks.

    Attributes:
        next_number: Of the next new tree.
        verdict: Of the columns that were judged last, those that the tracks back among the trees.
    """

    def __init__(self, parameters: Parameters) -> None:
        p = parameters
        self._parameters = p.tracking
        self._rules = _Rules(
            limits_of(p.tracking), telling_of(p.tracking), p.slam.view_range, p.tracking.breast_height,
            p.classification.tree_share, p.classification.range_max,
        )  # fmt: skip
        self._rows, self._count, self.next_number = TrackTable.empty().with_room(_ROOM), 0, 1
        self._since: Int = np.full(_ROOM, -1, np.int64)  # scan at which a tree was first confirmed, by number
        self.verdict: Int32 = np.zeros(0, np.int32)
        self._place: Float = np.zeros((0, 2))  # of the same columns

    def track(self, recorded: Recorded, verdict: Int32, first: int, last: int, index: int) -> Seen:
        """Take some of the recorded scans.

        Args:
            verdict: Of the columns by votes and rules, shape (C,); those that the tracks back become trees.
            first, last: Which: the last one is not among them.
            index: Number of the run's scan that the first of the recorded ones is.
        """
        at, rows = first, recorded.detections[last] - recorded.detections[first]
        seen = Seen(
            np.empty(rows, np.int64), np.empty(rows, np.int64), np.empty(rows, np.int64),
            np.empty((rows, 2)), np.empty((rows, 2, 2)), np.empty(rows), np.empty(rows),
        )  # fmt: skip
        told = 0
        while True:
            at, self._count, self.next_number, told = _track(
                self._rows, self._count, self.next_number, self._since, recorded, verdict, at, last, index,
                self._rules, seen, told, self._place, self.verdict,
            )  # fmt: skip
            if at == last:
                break
            self._make_room(recorded, at)
        gathered = np.flatnonzero(recorded.gathered[first:last])
        if len(gathered):
            newest = first + int(gathered[-1])
            columns = slice(recorded.columns[newest], recorded.columns[newest + 1])
            self.verdict, self._place = verdict[columns].copy(), recorded.axis[columns].copy()
        return seen.first(told)

    def confirmed_since(self, index: int) -> tuple[Int, Int]:
        """Numbers of the trees that were first confirmed at this scan or later, and at which."""
        number = np.flatnonzero(self._since >= index)
        return number, self._since[number]

    @property
    def tracks(self) -> TrackTable:
        """What is known of each tree, as it stands: the columns change with the next scan."""
        return self._rows.first(self._count)

    def trees(self) -> Trees:
        """The map as it stands."""
        return trees_of(self.tracks, self._parameters)

    def _make_room(self, recorded: Recorded, at: int) -> None:
        more = _most_new(recorded, at) + _ROOM
        self._rows = self.tracks.with_room(2 * self._count + more)
        since = np.full(2 * self.next_number + more, -1, np.int64)
        since[: len(self._since)] = self._since[: len(since)]
        self._since = since


@compiled_borrowing
def _most_new(recorded: Recorded, at: int) -> int:
    """So many trees may begin at a scan."""
    found = recorded.detections[at + 1] - recorded.detections[at]
    return int(found + recorded.columns[at + 1] - recorded.columns[at])


@compiled
def _track(
    rows: Rows,
    count: int,
    number: int,
    since: Int,
    recorded: Recorded,
    verdict: Int32,
    at: int,
    last: int,
    index: int,
    rules: _Rules,
    seen: Seen,
    told: int,
    place_before: Float,
    verdict_before: Int32,
) -> tuple[int, int, int, int]:
    """Returns the first scan for which there is no room, or `last`; the number of trees and that of the next
    new one; and the rows of `seen` that are filled. `place_before`, `verdict_before`: of the columns before
    the first recorded scan that was gathered."""
    known = -1  # the newest scan that was gathered
    for t in range(at):
        known = t if recorded.gathered[t] else known
    for t in range(at, last):
        new = _most_new(recorded, t)
        if count + new > rows.number.shape[0] or number + new > since.shape[0]:
            return t, count, number, told
        sight = Sight(
            recorded.stamp_ns[t], recorded.pose[t], recorded.covariance[t], recorded.relative[t],
            recorded.clear_range[t], rules.view_range,
        )  # fmt: skip
        d = slice(recorded.detections[t], recorded.detections[t + 1])
        found = Found(
            recorded.centre[d], recorded.spread[d], recorded.eccentricity[d], recorded.radius[d],
            recorded.radius_sigma[d], recorded.arc[d], recorded.height[d] - rules.breast_height,
        )  # fmt: skip
        of = recognise(rows, count, sight, found, rules.limits)
        update_rows(rows.x, rows.P, of.seen, of.dt, rules.limits.acceleration_sigma, of.z, of.R)
        count, number = take(rows, count, number, sight, found, of, rules.limits)
        m = slice(recorded.landmarks[t], recorded.landmarks[t + 1])
        count = hold(rows, count, sight, recorded.place[m], recorded.place_covariance[m], rules.limits)
        if recorded.gathered[t]:
            c = slice(recorded.columns[t], recorded.columns[t + 1])
            count, number = judge(
                rows, count, number, sight, recorded.axis[c], recorded.votes[c], verdict[c], rules.tree_share,
                rules.range_max, rules.limits.velocity_sigma,
            )  # fmt: skip
            known = t
        elif known >= 0:
            c = slice(recorded.columns[known], recorded.columns[known + 1])
            learn_between(rows, count, recorded.axis[c], verdict[c])
        else:
            learn_between(rows, count, place_before, verdict_before)
        told = _tell(rows, count, sight.stamp_ns, index + t, rules.telling, since, seen, told)
    return last, count, number, told


@compiled_borrowing
def _tell(
    rows: Rows, count: int, stamp_ns: int, scan: int, telling: Telling, since: Int, seen: Seen, told: int
) -> int:
    """Note what a scan made of the trees that it detected, and which trees it is the first to confirm."""
    for t in range(count):
        number = rows.number[t]
        if since[number] < 0 and is_confirmed(rows.verdict[t], rows.hits[t], telling):
            since[number] = scan
        if rows.stamp_ns[t] != stamp_ns or rows.hits[t] == 0:
            continue
        seen.scan[told], seen.number[told], seen.observations[told] = scan, number, rows.hits[t]
        for a in range(2):
            seen.position[told, a] = rows.x[t, a]
            for b in range(2):
                seen.covariance[told, a, b] = rows.P[t, a, b] + SHARED_COVARIANCE[a, b]
        coverage = sides_of(rows.sides[t]) * WIDTH
        seen.dbh[told], seen.dbh_sigma[told] = diameter(rows, t, coverage, telling)
        told += 1
    return told
