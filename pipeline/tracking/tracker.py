"""The tracker: which detection belongs to which tree, and what becomes of the trees (Eq. 10, 12)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.stages import Classification, Tracking
from pipeline.geometry.poses import Float, Pose2
from pipeline.loop_closure.map_correction import Bend
from pipeline.tracking.kalman import ENGINES
from pipeline.tracking.map_correction import bent, held
from pipeline.tracking.track_classification import SCORE_STANDING, judge, learn_between
from pipeline.tracking.track_table import Rows, TrackTable, begin
from pipeline.tracking.track_update import hold, recognise, take
from pipeline.tracking.tracking_inputs import Found, Limits, Sight
from pipeline.tracking.tree_records import trees_of
from pipeline.types.records import Columns, Detections, Int, Landmarks, Trees

_ROOM = 64  # rows more than are needed, at least


class Tracker:
    """The trees of the map. A tree's number is given once and never used again."""

    def __init__(self, parameters: Tracking) -> None:
        self.parameters = parameters
        self.next_number = 1
        self.tracks = TrackTable.empty()
        nothing = np.zeros((3, 3))
        self._sight = Sight(
            0, np.zeros(3), nothing, nothing, np.zeros(0), 0.0
        )  # of the scan that is processed

    @property
    def tracks(self) -> TrackTable:
        """What is known of each tree, as it stands: the columns change with the next scan."""
        return self._rows.first(self._count)

    @tracks.setter
    def tracks(self, tracks: TrackTable) -> None:
        self._rows: Rows = tracks.with_room(len(tracks) + _ROOM)
        self._count = len(tracks)

    def process(
        self,
        stamp_ns: int,
        T_map_base: Pose2,
        pose_covariance: Float,
        detections: Detections,
        clear_range: Float,
        view_range: float,
        heights: Float | None = None,
        relative: Float | None = None,
    ) -> None:
        """Take the detections of one scan.

        Args:
            stamp_ns: Of the scan.
            T_map_base: The pose that SLAM found (Eq. 9); pose_covariance: its covariance, (3, 3).
            detections: In the base frame.
            clear_range: How far the view was free by direction.
            view_range: A tree nearer than this can be missed [m].
            heights: Mean height above the ground at which each detection was seen, shape (D,) [m], NaN
                where it is not known; None where none is.
            relative: Covariance of the pose with respect to the trees around, which decides how far from a
                tree its detection may lie, shape (3, 3); None takes that in the frame of the map.
        """
        p, limits = self.parameters, limits_of(self.parameters)
        near = pose_covariance if relative is None else relative
        self._sight = Sight(
            stamp_ns, T_map_base.as_array(), pose_covariance, near, clear_range, float(view_range)
        )
        found = found_of(detections, heights, p.breast_height)
        self._make_room(len(detections.cluster))
        rows, sight = self._rows, self._sight
        of = recognise(rows, self._count, sight, found, limits)
        ENGINES[p.engine](rows.x, rows.P, of.seen, of.dt, p.acceleration_sigma, of.z, of.R)
        self._count, self.next_number = take(rows, self._count, self.next_number, sight, found, of, limits)

    def anchor(self, landmarks: Float, covariance: Float, T_map_base: Pose2, reach: float) -> None:
        """Hold the trees in reach to SLAM's landmarks (see `pipeline.tracking.landmark_anchoring`)."""
        sight = self._sight._replace(pose=T_map_base.as_array(), view_range=float(reach))
        limits = limits_of(self.parameters)
        self._count = hold(self._rows, self._count, sight, landmarks, covariance, limits)

    def bend(self, bend: Bend, stamps_ns: Int) -> None:
        """Move the trees with a path that was bent; `stamps_ns`: of its scans, ascending."""
        self.tracks = bent(self.tracks, np.searchsorted(stamps_ns, self.tracks.first_ns), bend)

    def hold_to(self, known: Landmarks, bend: Bend, stamps_ns: Int) -> None:
        """After `bend`: trees that were put on the map from a doubtful place stand where SLAM's landmarks do
        or nowhere, and a landmark without a tree, for it was given up meanwhile, begins one.

        Args:
            known: The well known landmarks, after the bend; bend, stamps_ns: as in `bend`.
        """
        first = np.searchsorted(stamps_ns, self.tracks.first_ns)
        self.tracks, left = held(self.tracks, first > bend.first, known, self.parameters.distance_max)
        self._make_room(len(left))
        begin(
            self._rows, self._count, self.next_number, 0, known.position[left], known.covariance[left],
            known.shared[left], self.parameters.velocity_sigma,
        )  # fmt: skip
        rows = slice(self._count, self._count + len(left))
        self._count, self.next_number = rows.stop, self.next_number + len(left)
        t = self.tracks
        t.first_ns[rows] = t.stamp_ns[rows] = stamps_ns[known.scan[left]]
        t.hits[rows] = known.hits[left]
        t.score[rows] = np.minimum(known.hits[left], SCORE_STANDING)

    def judge(self, stamp_ns: int, columns: Columns, parameters: Classification) -> Columns:
        """Take the verdicts of what was gathered (see `pipeline.tracking.track_classification`).

        Args:
            stamp_ns: Of the scan.
            columns: As the votes and rules have them.
            parameters: Of the votes, how many a tree needs; and how far away returns were gathered.

        Returns:
            The columns with those as trees too that the tracks back (see `round_fit_override`).
        """
        verdict = columns.verdict.copy()
        self._make_room(len(verdict))
        self._count, self.next_number = judge(
            self._rows, self._count, self.next_number, self._sight._replace(stamp_ns=stamp_ns), columns.axis,
            columns.share, verdict, parameters.tree_share, parameters.range_max,
            self.parameters.velocity_sigma,
        )  # fmt: skip
        return replace(columns, verdict=verdict)

    def learn_between(self, columns: Columns) -> None:
        """Take the verdicts of columns as `judge` left them, for tracks that came since."""
        learn_between(self._rows, self._count, columns.axis, columns.verdict)

    def trees(self) -> Trees:
        """The map as it stands (Table 2)."""
        return trees_of(self.tracks, self.parameters)

    def _make_room(self, more: int) -> None:
        if self._count + more > len(self._rows.number):
            self._rows = self.tracks.with_room(2 * (self._count + more) + _ROOM)


def limits_of(parameters: Tracking) -> Limits:
    """What compiled loops ask of the parameters."""
    p = parameters
    return Limits(
        p.acceleration_sigma, p.velocity_sigma, p.gate, p.distance_max, p.proximity_radius,
        1.0 / p.misses_per_hit,
    )  # fmt: skip


def found_of(detections: Detections, heights: Float | None, breast_height: float) -> Found:
    """The detections as compiled loops take them; heights: see `Tracker.process`."""
    d = detections
    above = np.full(len(d.cluster), np.nan) if heights is None else heights - breast_height
    return Found(d.centre, d.covariance, d.eccentricity, d.radius, d.radius_sigma, d.arc, above)
