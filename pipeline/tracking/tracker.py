"""The tracker: which detection belongs to which tree, and what becomes of the trees (Eq. 10, 12)."""

from __future__ import annotations

import numpy as np

from pipeline.bend import Bend
from pipeline.geometry import Float, Pose2
from pipeline.parameters.stages import Gathering, Tracking
from pipeline.records import Bool, Columns, Detections, Int, Landmarks, Trees, Verdict
from pipeline.tracking.anchor import anchor
from pipeline.tracking.assignment import assign, in_map
from pipeline.tracking.backing import backed
from pipeline.tracking.bending import bent, held
from pipeline.tracking.doubt import beyond_doubt
from pipeline.tracking.judging import assign_verdicts, tree_columns
from pipeline.tracking.kalman import ENGINES
from pipeline.tracking.merge import merge_near
from pipeline.tracking.observation import add_observations, table_figures
from pipeline.tracking.shared import split
from pipeline.tracking.table import TrackTable

SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time
SCORE_STANDING = 5.0  # at least, of a tree that what was gathered stands for
GATHERED_SIGMA = 0.1  # m; the middle of the returns of one side lies so far before the axis
NANOSECONDS = 1e-9
DUE_NS = 5_000_000_000  # after its first sight a trunk so near has a column: a dozen scans were gathered
DUE_REACH = 10.0  # m
GLIMPSE_NS, FORMER_NS = 1_000_000_000, 60_000_000_000  # bounds of being out of sight, see `_out_of_sight`
DUE_SHARE = 0.4  # of how far away returns are gathered: what stands farther may have been seen by few scans
SHARED_SIGMA = 0.01  # m; bark and taper: the views of one trunk share part of their error
SHARED_COVARIANCE = SHARED_SIGMA**2 * np.eye(2)


class Tracker:
    """The trees of the map. A tree's number is given once and never used again."""

    def __init__(self, parameters: Tracking) -> None:
        self.parameters = parameters
        self.tracks = TrackTable.empty()
        self.next_number = 1
        self._at, self._pose_covariance = Pose2(), np.zeros((3, 3))  # of the scan that is processed
        self._relative = np.zeros((3, 3))

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
        p, t = self.parameters, self.tracks
        self._at, self._pose_covariance = T_map_base, pose_covariance
        self._relative = pose_covariance if relative is None else relative
        spared = beyond_doubt(t, T_map_base, pose_covariance, p.distance_max, view_range)
        score = t.score if spared is None else t.score.copy()
        row_of, touched, position, R, B = assign(
            detections.centre,
            detections.covariance,
            T_map_base.as_array(),
            pose_covariance,
            self._relative,
            t.x,
            t.P,
            t.shared,
            t.hits,
            t.stamp_ns,
            t.score,
            clear_range,
            view_range,
            stamp_ns,
            p.acceleration_sigma,
            p.gate,
            p.distance_max,
            1.0 / p.misses_per_hit,
        )
        if spared is not None:
            t.score[spared] = score[spared]
        fresh = np.flatnonzero(row_of < 0)
        if len(fresh):
            old = np.flatnonzero(row_of >= 0)
            self._update(row_of[old], stamp_ns, position[old], R[old], B[old])
            row_of[fresh] = len(t) + np.arange(len(fresh))
            self._begin(stamp_ns, position[fresh], R[fresh], B[fresh])
            touched = np.concatenate([touched, np.ones(len(fresh), np.bool_)])
        else:
            self._update(row_of, stamp_ns, position, R, B)
        unknown = np.full(len(position), np.nan)
        above_breast = unknown if heights is None else heights - p.breast_height
        _gather(self.tracks, row_of, position, T_map_base, detections, above_breast)
        self.tracks = merge_near(self.tracks, touched, p.proximity_radius).with_score()

    def anchor(self, landmarks: Float, covariance: Float, T_map_base: Pose2, reach: float) -> None:
        """Hold the trees in reach to SLAM's landmarks (see `pipeline.tracking.anchor`)."""
        p = self.parameters
        spared = beyond_doubt(self.tracks, T_map_base, self._pose_covariance, p.distance_max, reach)
        score = self.tracks.score if spared is None else self.tracks.score.copy()
        anchor(
            self.tracks, landmarks, covariance, T_map_base, self._pose_covariance, self._relative, reach,
            p.distance_max, 1.0 / p.misses_per_hit,
        )  # fmt: skip
        if spared is not None:
            self.tracks.score[spared] = score[spared]
        touched = np.ones(len(self.tracks), np.bool_)
        self.tracks = merge_near(self.tracks, touched, p.proximity_radius).with_score()

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
        rows = len(self.tracks) + np.arange(len(left))
        self._begin(0, known.position[left], known.covariance[left], known.shared[left])
        t = self.tracks
        t.first_ns[rows] = t.stamp_ns[rows] = stamps_ns[known.scan[left]]
        t.hits[rows] = known.hits[left]
        t.score[rows] = np.minimum(known.hits[left], SCORE_STANDING)

    def judge(self, stamp_ns: int, columns: Columns, parameters: Gathering) -> Columns:
        """Take the verdicts of what was gathered: a track is confirmed by them alone, and a tree that no
        single scan showed begins its track here.

        Args:
            stamp_ns: Of the scan.
            columns: As the votes and rules have them.
            parameters: Of the votes, how many a tree needs; and how far away returns were gathered.

        Returns:
            The columns with those as trees too that the tracks back (see `pipeline.tracking.backing`).
        """
        columns = backed(columns, self.tracks, parameters.tree_share)
        trees = tree_columns(columns)
        place = columns.axis[trees, :2]
        t, at = self.tracks, self._at
        reach = min(DUE_REACH, DUE_SHARE * parameters.range_max)
        near = np.hypot(t.x[:, 0] - at.x, t.x[:, 1] - at.y) < reach
        due = near & (stamp_ns - t.first_ns >= DUE_NS)
        fresh = assign_verdicts(t, columns, trees, due | _out_of_sight(t, stamp_ns))
        own = np.tile(GATHERED_SIGMA**2 * np.eye(2), (len(fresh), 1, 1))
        from_here = self._at.inverse().apply(place[fresh])
        Sigma = self._pose_covariance
        _, _, B, _ = in_map(from_here, own, self._at.as_array(), Sigma, Sigma)
        self._begin(stamp_ns, place[fresh], own, B)
        t = self.tracks
        t.verdict[len(t) - len(fresh) :] = Verdict.TREE
        standing = t.verdict == Verdict.TREE
        t.score[standing] = np.maximum(t.score[standing], SCORE_STANDING)
        return columns

    def _update(self, rows: Int, stamp_ns: int, z: Float, R: Float, B: Float) -> None:
        p, t = self.parameters, self.tracks
        dt = (stamp_ns - t.stamp_ns[rows]).astype(np.float64) * NANOSECONDS
        R = split(t.P, t.shared, rows, R, B, dt, p.acceleration_sigma)
        ENGINES[p.engine](t.x, t.P, rows, dt, p.acceleration_sigma, z, R)
        t.stamp_ns[rows] = stamp_ns
        t.score[rows] = np.minimum(t.score[rows] + 1.0, SCORE_MAX)

    def _begin(self, stamp_ns: int, z: Float, R: Float, B: Float) -> None:
        if len(z) == 0:
            return
        new = TrackTable.empty(len(z))
        new.number[:] = self.next_number + np.arange(len(z))
        self.next_number += len(z)
        new.x[:, :2] = z
        new.P[:, :2, :2] = R + B
        new.shared[:] = B
        new.P[:, [2, 3], [2, 3]] = self.parameters.velocity_sigma**2
        new.stamp_ns[:] = new.first_ns[:] = stamp_ns
        new.score[:] = 1.0
        self.tracks = self.tracks.extended(new)

    def trees(self) -> Trees:
        """The map as it stands (Table 2)."""
        p, t = self.parameters, self.tracks
        coverage, dbh, dbh_sigma, eccentricity, confirmed = table_figures(
            t.sides,
            t.radii,
            t.radius,
            t.radius_weight,
            t.radius_reach,
            t.radius_above,
            t.eccentricity,
            t.eccentricities,
            t.verdict,
            t.hits,
            p.hits_to_confirm,
            float(np.radians(p.dbh_arc_min)),
            p.out_of_round,
            p.taper_sigma,
        )
        return Trees(
            number=t.number.copy(),
            position=t.x[:, :2].copy(),
            covariance=t.P[:, :2, :2] + SHARED_COVARIANCE,
            velocity=t.x[:, 2:].copy(),
            dbh=dbh,
            dbh_sigma=dbh_sigma,
            eccentricity=eccentricity,
            observations=t.hits.copy(),
            coverage=coverage,
            first_seen_ns=t.first_ns.copy(),
            last_seen_ns=t.stamp_ns.copy(),
            confirmed=confirmed,
            sides=t.sides.copy(),
        )


def _out_of_sight(t: TrackTable, stamp_ns: int) -> Bool:
    """Which tracks have not been seen for longer than they had been seen, as who walked on has not, shape
    (T,). At least a second and at most as long as a column takes; what was last seen long ago is of another
    drive, or was put back by a loop, and nobody walked there."""
    unseen = stamp_ns - t.stamp_ns
    gone: Bool = unseen > np.clip(t.stamp_ns - t.first_ns, GLIMPSE_NS, DUE_NS)
    return gone & (unseen < FORMER_NS)


def _gather(
    t: TrackTable, rows: Int, z: Float, T_map_base: Pose2, seen: Detections, above_breast: Float
) -> None:
    """Add what one scan's detections say about their trunks; no two are of the same trunk."""
    add_observations(
        rows,
        z,
        T_map_base.as_array(),
        seen.eccentricity,
        seen.radius,
        seen.radius_sigma,
        seen.arc,
        above_breast,
        t.hits,
        t.eccentricity,
        t.eccentricities,
        t.radius,
        t.radius_weight,
        t.radius_reach,
        t.radius_above,
        t.radii,
        t.sides,
    )
