"""The tracker: which detection belongs to which tree, and what becomes of the trees (Eq. 10, 12)."""

from __future__ import annotations

import numpy as np

from pipeline.association import associate
from pipeline.geometry import Float, Pose2
from pipeline.parameters.stages import Tracking
from pipeline.records import Bool, Columns, Detections, Int, Trees, Verdict
from pipeline.tracking.judging import assign_verdicts, tree_columns
from pipeline.tracking.kalman import ENGINES
from pipeline.tracking.merge import merge_near
from pipeline.tracking.table import SECTORS, TrackTable, seen_sides
from pipeline.visibility import in_free_view

SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time
SCORE_STANDING = 5.0  # at least, of a tree that what was gathered stands for
GATHERED_SIGMA = 0.1  # m; the middle of the returns of one side lies so far before the axis
NANOSECONDS = 1e-9
DBH_OBSERVATIONS = 3  # fewer radii are no diameter yet
SHARED_RADIUS_SIGMA = 0.01  # m; bark and taper, which more scans of one side do not average out
SHARED_SIGMA = 0.01  # m; likewise of the position: the views of one trunk share part of their error


class Tracker:
    """The trees of the map. A tree's number is given once and never used again."""

    def __init__(self, parameters: Tracking) -> None:
        self.parameters = parameters
        self.tracks = TrackTable.empty()
        self.next_number = 1

    def process(
        self,
        stamp_ns: int,
        T_map_base: Pose2,
        pose_covariance: Float,
        detections: Detections,
        clear_range: Float,
        view_range: float,
    ) -> None:
        """Take the detections of one scan.

        Args:
            stamp_ns: Of the scan.
            T_map_base: The pose that SLAM found (Eq. 9); pose_covariance: its covariance, (3, 3).
            detections: In the base frame.
            clear_range: How far the view was free by direction.
            view_range: A tree nearer than this can be missed [m].
        """
        p = self.parameters
        position = T_map_base.apply(detections.centre)
        R = _in_map(detections, T_map_base, pose_covariance)
        expected, spread = self._predicted(stamp_ns)
        row_of, _ = associate(
            position,
            R[:, [0, 0, 1], [0, 1, 1]],
            expected,
            spread,
            p.gate,
            p.distance_max,
        )
        old, fresh = np.flatnonzero(row_of >= 0), np.flatnonzero(row_of < 0)
        touched = np.zeros(len(self.tracks), np.bool_)
        touched[row_of[old]] = True
        self._miss(~touched, T_map_base, clear_range, view_range)
        self._update(row_of[old], stamp_ns, position[old], R[old])
        row_of[fresh] = len(self.tracks) + np.arange(len(fresh))
        self._begin(stamp_ns, position[fresh], R[fresh])
        _gather(self.tracks, row_of, position, T_map_base, detections)
        touched = np.concatenate([touched, np.ones(len(fresh), np.bool_)])
        self.tracks = merge_near(self.tracks, touched, p.proximity_radius)
        self.tracks = self.tracks.take(self.tracks.score > 0.0)

    def judge(self, stamp_ns: int, columns: Columns) -> None:
        """Take the verdicts of what was gathered: a track is confirmed by them alone, and a tree that no
        single scan showed begins its track here."""
        trees = tree_columns(columns)
        place = columns.axis[trees, :2]
        fresh = assign_verdicts(self.tracks, columns, trees)
        self._begin(
            stamp_ns, place[fresh], np.broadcast_to(GATHERED_SIGMA**2 * np.eye(2), (len(fresh), 2, 2))
        )
        t = self.tracks
        t.verdict[len(t) - len(fresh) :] = Verdict.TREE
        standing = t.verdict == Verdict.TREE
        t.score[standing] = np.maximum(t.score[standing], SCORE_STANDING)

    def _predicted(self, stamp_ns: int) -> tuple[Float, Float]:
        """Where each tree is expected now, shape (T, 2), and its covariance xx, xy, yy, shape (T, 3)."""
        t = self.tracks
        dt = ((stamp_ns - t.stamp_ns) * NANOSECONDS)[:, None, None]
        noise = 0.25 * dt**4 * self.parameters.acceleration_sigma**2 * np.eye(2)
        P = t.P
        cross = P[:, :2, 2:] + P[:, 2:, :2]
        spread = P[:, :2, :2] + dt * cross + dt**2 * P[:, 2:, 2:] + noise
        expected: Float = t.x[:, :2] + dt[:, :, 0] * t.x[:, 2:]
        return expected, spread[:, [0, 0, 1], [0, 1, 1]]

    def _update(self, rows: Int, stamp_ns: int, z: Float, R: Float) -> None:
        p, t = self.parameters, self.tracks
        dt = (stamp_ns - t.stamp_ns[rows]).astype(np.float64) * NANOSECONDS
        ENGINES[p.engine](t.x, t.P, rows, dt, p.acceleration_sigma, z, R)
        t.stamp_ns[rows] = stamp_ns
        t.score[rows] = np.minimum(t.score[rows] + 1.0, SCORE_MAX)

    def _begin(self, stamp_ns: int, z: Float, R: Float) -> None:
        new = TrackTable.empty(len(z))
        new.number[:] = self.next_number + np.arange(len(z))
        self.next_number += len(z)
        new.x[:, :2] = z
        new.P[:, :2, :2] = R
        new.P[:, [2, 3], [2, 3]] = self.parameters.velocity_sigma**2
        new.stamp_ns[:] = new.first_ns[:] = stamp_ns
        new.score[:] = 1.0
        self.tracks = self.tracks.extended(new)

    def _miss(self, unseen: Bool, T_map_base: Pose2, clear_range: Float, view_range: float) -> None:
        missed = unseen & in_free_view(self.tracks.x[:, :2], T_map_base.as_array(), clear_range, view_range)
        self.tracks.score[missed] -= 1.0 / self.parameters.misses_per_hit

    def trees(self) -> Trees:
        """The map as it stands (Table 2)."""
        t = self.tracks
        coverage = np.bitwise_count(t.sides) * (2.0 * np.pi / SECTORS)
        carried = coverage >= np.radians(self.parameters.dbh_arc_min) - 1e-9
        enough = (t.radii >= DBH_OBSERVATIONS) & carried
        weight = np.where(enough, t.radius_weight, 1.0)
        radius_sigma = np.sqrt(1.0 / weight + SHARED_RADIUS_SIGMA**2)
        return Trees(
            number=t.number.copy(),
            position=t.x[:, :2].copy(),
            covariance=t.P[:, :2, :2] + SHARED_SIGMA**2 * np.eye(2),
            velocity=t.x[:, 2:].copy(),
            dbh=np.where(enough, 2.0 * t.radius / weight, np.nan),
            dbh_sigma=np.where(enough, 2.0 * radius_sigma, np.nan),
            eccentricity=np.where(
                t.eccentricities > 0, t.eccentricity / np.maximum(t.eccentricities, 1), np.nan
            ),
            observations=t.hits.copy(),
            coverage=coverage,
            first_seen_ns=t.first_ns.copy(),
            last_seen_ns=t.stamp_ns.copy(),
            confirmed=np.where(
                t.verdict >= 0, t.verdict == Verdict.TREE, t.hits >= self.parameters.hits_to_confirm
            ),
        )


def _gather(t: TrackTable, rows: Int, z: Float, T_map_base: Pose2, seen: Detections) -> None:
    """Add what one scan's detections say about their trunks; no two are of the same trunk."""
    t.hits[rows] += 1
    finite = np.isfinite(seen.eccentricity)
    t.eccentricity[rows[finite]] += seen.eccentricity[finite]
    t.eccentricities[rows[finite]] += 1
    round_ones = np.isfinite(seen.radius)
    weight = 1.0 / seen.radius_sigma[round_ones] ** 2
    t.radius[rows[round_ones]] += weight * seen.radius[round_ones]
    t.radius_weight[rows[round_ones]] += weight
    t.radii[rows[round_ones]] += 1
    bearing = np.arctan2(T_map_base.y - z[:, 1], T_map_base.x - z[:, 0])
    t.sides[rows] |= seen_sides(bearing, seen.arc)


def _in_map(detections: Detections, T_map_base: Pose2, pose_covariance: Float) -> Float:
    """Covariance of the detections in the frame of the map, shape (D, 2, 2): their own, turned, and
    the pose's, J Sigma J^T with J = d(position) / d(x, y, yaw)."""
    C = T_map_base.rotation()
    turned: Float = C @ detections.covariance @ C.T
    arm = detections.centre @ C.T
    J = np.zeros((len(arm), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -arm[:, 1], arm[:, 0]
    return turned + J @ pose_covariance @ J.transpose(0, 2, 1)
