"""The tracker: a Kalman filter per tree (Eq. 10), on the data association of SLAM.

Each tree belongs to one landmark of SLAM. SLAM associates detections, counts misses and merges landmarks; the
tracks follow it. If the landmark of a track no longer exists, because SLAM merged or removed it or because
another particle is the best one now, the track takes the landmark at its position, joins the track of that
landmark, or is removed. Of two landmarks of its trunk it takes the better one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.stages import Classification, Tracking
from pipeline.geometry.gaussian import by_pose, in_map, spread_by_pose
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.slam.association import associate
from pipeline.tracking.kalman import ENGINES, split
from pipeline.tracking.observation import FigureLimits, add_observations, table_figures
from pipeline.tracking.track_classification import classify, classify_new
from pipeline.tracking.track_table import NO_LANDMARK, Rows, ScanPose, TrackTable, join
from pipeline.types.records import Bool, Columns, Detections, Int, Landmarks, PoseEstimate, Trees, Verdict

NANOSECONDS = 1e-9
SHARED_SIGMA = 0.01  # m; error that all views of a trunk share, by its bark and its taper
SHARED_COVARIANCE = SHARED_SIGMA**2 * np.eye(2)
COLUMN_SIGMA = 0.1  # m; of the axis of a voxel column that was observed from one side
LOOP_DISTANCE = 1.0  # m; maximum distance of a tree to its landmark after a loop closure


class Tracker:
    """Trees of the map: one Kalman filter each, with the data association of SLAM.

    Attributes:
        parameters: Parameters of the stage.
        next_number: Number of the next new tree; a number is never reused.
        tracks: State of each tree; the next scan changes it in place.
    """

    def __init__(self, parameters: Tracking, spacing: float = 0.0) -> None:
        """Create a tracker without trees; the first tree gets the number 1.

        Args:
            parameters: Parameters of the stage.
            spacing: Angle between neighbouring returns [rad]; 0 for a sensor that resolves all trunks.
        """
        self.parameters = parameters
        self._spacing = spacing
        self.next_number = 1
        self.tracks = TrackTable.empty()
        nothing = np.zeros((3, 3))
        self._scan = ScanPose(0, np.zeros(3), nothing, nothing)  # of the last scan

    def process(
        self,
        stamp_ns: int,
        estimate: PoseEstimate,
        detections: Detections,
        landmarks: Landmarks,
        heights: Float | None = None,
    ) -> None:
        """Update the trees with the detections of one scan, in place.

        The trees are assigned to the landmarks (`follow`, `take_better_landmarks`); trees without a landmark
        and a tree column are removed. Detected trees are updated by the Kalman filter, and their attributes
        by `add_observations`. A tree begins at each detected landmark without a tree that is at least
        `proximity_radius` from all trees. Trees nearer than `proximity_radius` to a detected tree are joined
        with it.

        Args:
            stamp_ns: Time of the scan [ns], not before the last one.
            estimate: Pose by SLAM (Eq. 9), with the landmark of each detection (-1 for none).
            detections: Detections in the base frame; may be empty.
            landmarks: Landmarks of SLAM after the scan.
            heights: Mean height above the ground of each detection, shape (D,) [m], NaN where unknown; None
                where all are unknown.
        """
        p, d = self.parameters, detections
        scan = self._follow(stamp_ns, estimate, landmarks, landmarks.gate, landmarks.distance_max)
        births = estimate.landmark_of
        row = tracks_of(self.tracks.landmark, births)
        position, own, added = in_map(d.centre, d.covariance, scan.pose, scan.covariance)
        take_better_landmarks(
            self.tracks.as_rows(), stamp_ns, row, births, position, landmarks.birth, landmarks.score,
            p.proximity_radius,
        )  # fmt: skip

        # Trees that are seen again: one update of the Kalman filter.
        t, seen = self.tracks, np.flatnonzero(row >= 0)
        rows = row[seen]
        self._restart(rows, position[seen], own[seen], landmarks)
        dt = np.multiply(stamp_ns - t.stamp_ns[rows], NANOSECONDS, dtype=np.float64)
        R = split(t.P, t.shared, rows, own[seen], added[seen], dt, p.acceleration_sigma)
        ENGINES[p.engine](t.x, t.P, rows, dt, p.acceleration_sigma, position[seen], R)
        t.stamp_ns[rows] = stamp_ns

        # New landmarks: new trees. A landmark next to a tree is another part of its trunk.
        new = np.flatnonzero((row < 0) & (births != NO_LANDMARK))
        new = new[are_separate(position[new], t.x, p.proximity_radius)] if len(new) else new
        if len(new):
            row[new] = len(t) + np.arange(len(new))
            self._begin(stamp_ns, births[new], position[new], own[new], added[new])

        known = np.flatnonzero(row >= 0)
        above = np.full(len(row), np.nan) if heights is None else heights - p.breast_height
        add_observations(
            self.tracks.as_rows(), row[known], position[known], scan.pose, d.eccentricity[known],
            d.radius[known], d.radius_sigma[known], d.arc[known], above[known], self._spacing,
        )  # fmt: skip
        kept = merge_near(self.tracks.as_rows(), rows, p.proximity_radius)
        if not kept.all():
            self.tracks = self.tracks.take(kept)

    def correct(
        self,
        correction: PathCorrection,
        stamps_ns: Int,
        estimate: PoseEstimate,
        landmarks: Landmarks,
        of_map: Float,
    ) -> None:
        """Move the trees in place with a corrected path. Trees with a landmark get the position of the
        landmark, and `of_map` in place of the shared part of their covariance. Trees without a landmark
        within LOOP_DISTANCE and without a tree column are removed.

        Trees that share a landmark afterwards are joined. Velocities and covariances are rotated with the
        path.

        Args:
            correction: The correction of the path.
            stamps_ns: Time of each scan of the path [ns], int64, shape (N,).
            estimate: Pose after the correction.
            landmarks: Landmarks after the correction.
            of_map: Covariance of the error of the map at each landmark, shape (L, 2, 2) [m^2].
        """
        t = self.tracks
        t.x[:, :2], turn = correction.moved(t.x[:, :2], np.searchsorted(stamps_ns, t.first_ns))
        c, s = np.cos(turn), np.sin(turn)
        C = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
        t.x[:, 2:] = np.einsum("nij,nj->ni", C, t.x[:, 2:])
        for a in (slice(0, 2), slice(2, 4)):
            for b in (slice(0, 2), slice(2, 4)):
                t.P[:, a, b] = C @ t.P[:, a, b] @ C.transpose(0, 2, 1)
        t.shared[:] = C @ t.shared @ C.transpose(0, 2, 1)
        # The graph estimates the landmarks from all detections, so that trees take their positions.
        order = np.argsort(landmarks.birth)
        at = np.minimum(np.searchsorted(landmarks.birth[order], t.landmark), max(len(order) - 1, 0))
        if len(order):
            known = landmarks.birth[order][at] == t.landmark
            at = order[at[known]]
            t.x[known, :2] = landmarks.position[at]
            t.P[known, :2, :2] += of_map[at] - t.shared[known]
            t.shared[known] = of_map[at]
        self._follow(self._scan.stamp_ns, estimate, landmarks, np.inf, LOOP_DISTANCE)

    def classify(self, stamp_ns: int, columns: Columns, parameters: Classification) -> Columns:
        """Classify the trees by the voxel columns, in place, and begin a tree without detections and landmark
        at each tree column without one. The pose is that of the last scan of `process` or `correct`.

        Args:
            stamp_ns: Time of the scan [ns].
            columns: Columns with the verdicts of votes and rules.
            parameters: Parameters of the classification.

        Returns:
            A copy of the columns with the verdicts after `confirm_round`; the argument is unchanged.
        """
        verdict = columns.verdict.copy()
        scan = self._scan._replace(stamp_ns=stamp_ns)
        new = classify(
            self.tracks.as_rows(), scan, columns.axis, columns.share, verdict, parameters.tree_share,
            parameters.range_max, self.parameters.hits_to_confirm,
        )  # fmt: skip
        if len(new):
            position = columns.axis[new, :2]
            own = np.tile(COLUMN_SIGMA**2 * np.eye(2), (len(new), 1, 1))
            added = spread_by_pose(position, scan.pose, scan.covariance)
            self._begin(stamp_ns, np.full(len(new), NO_LANDMARK), position, own, added)
            self.tracks.verdict[-len(new) :] = Verdict.TREE
        return replace(columns, verdict=verdict)

    def classify_new(self, columns: Columns) -> None:
        """Classify detected trees that have no class yet by columns that `classify` returned, in place; see
        `track_classification.classify_new`."""
        classify_new(self.tracks.as_rows(), columns.axis, columns.verdict)

    def trees(self) -> Trees:
        """Return the attributes of all trees, confirmed or not (Table 2), in ascending order of number; the
        columns are copies. SHARED_COVARIANCE is added to the covariances. Diameters and eccentricities are
        NaN where they are unknown; heights and leans are None."""
        t, p = self.tracks, self.parameters
        limits = FigureLimits(
            p.hits_to_confirm, np.radians(p.dbh_arc_min), p.dbh_sigma_max, p.out_of_round, p.taper_sigma
        )
        coverage, dbh, dbh_sigma, eccentricity, confirmed = table_figures(t.as_rows(), limits)
        return Trees(
            number=t.number.copy(),
            position=t.x[:, :2].copy(),
            covariance=t.P[:, :2, :2] + SHARED_COVARIANCE,
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

    def _follow(
        self, stamp_ns: int, estimate: PoseEstimate, landmarks: Landmarks, gate: float, distance_max: float
    ) -> ScanPose:
        """Assign the trees to the landmarks, and return the pose of the robot, which is stored as that of the
        last scan. Trees whose landmarks were merged are joined: the older tree stays and gets the data of
        both. Trees that have neither a landmark nor a tree column are removed.

        Args:
            stamp_ns: Time of the scan [ns].
            estimate: Pose by SLAM.
            landmarks: Landmarks of SLAM.
            gate, distance_max: Maximum distances between a tree and a new landmark [sigma, m], see `follow`.
        """
        relative = estimate.covariance if estimate.relative is None else estimate.relative
        self._scan = ScanPose(stamp_ns, estimate.T_map_base.as_array(), estimate.covariance, relative)
        kept = follow(
            self.tracks.as_rows(), self._scan, landmarks.birth, landmarks.position, landmarks.covariance,
            landmarks.score, float(gate), float(distance_max),
        )  # fmt: skip
        if not kept.all():
            self.tracks = self.tracks.take(kept)
        return self._scan

    def _restart(self, rows: Int, position: Float, own: Float, landmarks: Landmarks) -> None:
        """Restart the filters of trees at their landmarks, in place, where their detections are beyond the
        gate; the velocity is kept.

        Landmarks of these trees must exist in `landmarks`.

        Args:
            rows: Rows of trees with a detection, shape (K,).
            position: Positions of the detections in the map, shape (K, 2) [m].
            own: Own covariances of the detections, shape (K, 2, 2) [m^2].
            landmarks: The landmarks.
        """
        t, scan = self.tracks, self._scan
        y = position - t.x[rows, :2]
        S = t.P[rows, :2, :2] - t.shared[rows] + spread_by_pose(t.x[rows, :2], scan.pose, scan.relative) + own
        # d^2 > gate^2, for d^2 = y^T S^-1 y written with the adjugate of S
        squared = S[:, 1, 1] * y[:, 0] ** 2 - 2.0 * S[:, 0, 1] * y[:, 0] * y[:, 1] + S[:, 0, 0] * y[:, 1] ** 2
        determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
        rows = rows[squared > landmarks.gate**2 * determinant]
        if not len(rows):
            return
        order = np.argsort(landmarks.birth)
        at = order[np.searchsorted(landmarks.birth[order], t.landmark[rows])]
        added = spread_by_pose(landmarks.position[at], scan.pose, scan.covariance)
        t.x[rows, :2] = landmarks.position[at]
        t.shared[rows] = added
        t.P[rows, :2, :2] = landmarks.covariance[at][:, [0, 1, 1, 2]].reshape(-1, 2, 2) + added
        t.P[rows, :2, 2:] = 0.0  # the position of the landmark is not correlated with the velocity
        t.P[rows, 2:, :2] = 0.0

    def _begin(self, stamp_ns: int, landmark: Int, position: Float, own: Float, added: Float) -> None:
        """Begin trees without observations at positions, with the numbers from `next_number` on, after all
        others in `tracks`.

        Args:
            stamp_ns: Time of the scan [ns].
            landmark: Birth numbers of the landmarks of the trees, shape (K,); -1 for none.
            position: Positions in the map, shape (K, 2) [m].
            own: Covariances of the measurements, shape (K, 2, 2) [m^2].
            added: Covariances that the pose adds, shape (K, 2, 2) [m^2].
        """
        new = TrackTable.begun(
            self.next_number, stamp_ns, position, own, added, self.parameters.velocity_sigma
        )
        new.landmark[:] = landmark
        self.tracks = self.tracks.extended(new)
        self.next_number += len(new)


# ns; in this time a robot that drives 1 m/s drifts by 0.25 m if its odometry errs by 2.5 %, less than the
# distance of two landmarks of one trunk. Later, a landmark next to a tree may be that of another tree.
SAME_VISIT_NS = 10_000_000_000
TREE = int(Verdict.TREE)


@compiled
def follow(
    rows: Rows,
    scan: ScanPose,
    birth: Int,
    position: Float,
    covariance: Float,
    score: Float,
    gate: float,
    distance_max: float,
) -> Bool:
    """Assign the tracks to the landmarks of the present map, in place.

    A track keeps its landmark if that exists; of several tracks with the same landmark, only the lowest row
    does. Any other track gets a free landmark at its position (`associate`). If only a landmark with a track
    is there, both tracks are joined into the lower row, unless the track had the landmark NO_LANDMARK before.
    A track without any of these gets the landmark NO_LANDMARK. The score of a track becomes that of its
    landmark.

    Args:
        rows: Tracks; landmark, score and, for joined tracks, all columns are changed.
        scan: Pose of the robot.
        birth: Birth numbers of the landmarks, int64, shape (L,).
        position: Positions of the landmarks in the map, shape (L, 2) [m].
        covariance: Covariances xx, xy, yy of the landmarks, shape (L, 3) [m^2].
        score: Scores of the landmarks, hits minus misses, shape (L,).
        gate, distance_max: Maximum Mahalanobis [sigma] and Euclidean [m] distance between a track and a new
            landmark.

    Returns:
        Which tracks remain, shape (T,): those with a landmark, and trees by the class of their voxel column.
        The caller removes the others.
    """
    T, L = rows.number.shape[0], birth.shape[0]
    order = np.argsort(birth)
    ordered = birth[order]
    owner, landmark_of, before = np.full(L, -1), np.full(T, -1), rows.landmark.copy()
    for t in range(T):
        k = np.searchsorted(ordered, rows.landmark[t])
        if k < L and ordered[k] == rows.landmark[t] and owner[order[k]] < 0:
            owner[order[k]] = t
            landmark_of[t] = order[k]
    kept = np.ones(T, np.bool_)
    lost = np.flatnonzero(landmark_of < 0)
    spread = np.empty((T, 3))
    _fill_spread(rows, scan, spread)
    if lost.shape[0] > 0 and L > 0:
        free = np.flatnonzero(owner < 0)
        at, _ = associate(
            rows.x[lost][:, :2].copy(), spread[lost], position[free], covariance[free], gate, distance_max
        )
        for k in range(lost.shape[0]):
            if at[k] >= 0:
                j = free[at[k]]
                owner[j], landmark_of[lost[k]] = lost[k], j
                rows.landmark[lost[k]], rows.score[lost[k]] = birth[j], score[j]
        # A landmark that is gone while another track has the one at its position was merged with it.
        merged = lost[(landmark_of[lost] < 0) & (before[lost] != NO_LANDMARK)]
        if merged.shape[0] > 0:
            taken = np.flatnonzero(owner >= 0)
            at, _ = associate(
                rows.x[merged][:, :2].copy(), spread[merged], position[taken], covariance[taken], gate,
                distance_max,
            )  # fmt: skip
            for k in range(merged.shape[0]):
                if at[k] >= 0:
                    j = taken[at[k]]
                    rows.landmark[merged[k]] = NO_LANDMARK
                    old, young = min(owner[j], merged[k]), max(owner[j], merged[k])
                    join(rows, old, young)
                    landmark_of[old], landmark_of[young] = j, -1
                    owner[j] = old
                    kept[young] = False
    for t in range(T):
        j = landmark_of[t]
        rows.landmark[t] = birth[j] if j >= 0 else NO_LANDMARK
        if j >= 0:
            rows.score[t] = score[j]
        kept[t] = kept[t] and (j >= 0 or rows.verdict[t] == TREE)
    return kept


@compiled
def tracks_of(landmark: Int, births: Int) -> Int:
    """Return the row of the track of each detection, int64, shape (D,); -1 for none.

    Args:
        landmark: Birth number of the landmark of each track, shape (T,).
        births: Birth number of the landmark of each detection, shape (D,); -1 for none.
    """
    rows = np.full(births.shape[0], -1)
    order = np.argsort(landmark)
    ordered = landmark[order]
    for d in range(births.shape[0]):
        k = np.searchsorted(ordered, births[d])
        if births[d] != NO_LANDMARK and k < landmark.shape[0] and ordered[k] == births[d]:
            rows[d] = order[k]
    return rows


@compiled
def take_better_landmarks(
    rows: Rows,
    stamp_ns: int,
    row: Int,
    births: Int,
    position: Float,
    birth: Int,
    score: Float,
    radius: float,
) -> None:
    """Assign landmarks of detections without a track to the nearest track within `radius`, in place. The
    track must be without a detection in this scan and have begun at most SAME_VISIT_NS ago. It takes the
    landmark if this has a higher score than its own landmark or it has none.

    Args:
        rows: Tracks; landmark and score are changed.
        stamp_ns: Time of the scan [ns].
        row: Row of the track of each detection, -1 for none, int64, shape (D,); changed.
        births: Birth number of the landmark of each detection, shape (D,); -1 for none.
        position: Positions of the detections in the map, shape (D, 2) [m].
        birth: Birth numbers of the landmarks, int64, shape (L,).
        score: Scores of the landmarks, hits minus misses, shape (L,).
        radius: Distance below which a detection belongs to a track [m].
    """
    detected = np.zeros(rows.number.shape[0], np.bool_)
    for d in range(row.shape[0]):
        if row[d] >= 0:
            detected[row[d]] = True
    for d in range(row.shape[0]):
        if row[d] >= 0 or births[d] == NO_LANDMARK:
            continue
        nearest, least = -1, radius * radius
        for t in range(rows.number.shape[0]):
            dx, dy = rows.x[t, 0] - position[d, 0], rows.x[t, 1] - position[d, 1]
            if dx * dx + dy * dy < least:
                nearest, least = t, dx * dx + dy * dy
        if nearest < 0 or detected[nearest] or stamp_ns - rows.first_ns[nearest] > SAME_VISIT_NS:
            continue
        for j in range(birth.shape[0]):
            if birth[j] == births[d] and (
                rows.landmark[nearest] == NO_LANDMARK or score[j] > rows.score[nearest]
            ):
                rows.landmark[nearest], rows.score[nearest] = births[d], score[j]
                row[d] = nearest
                detected[nearest] = True


@compiled
def merge_near(rows: Rows, seen: Int, radius: float) -> Bool:
    """Join the tracks that are nearer than a radius to a track that moved, in place.

    The lower row, which is the older track, remains; see `join`.

    Args:
        rows: Tracks.
        seen: Rows of the tracks that moved in this scan, shape (K,).
        radius: Distance below which two tracks are one tree [m].

    Returns:
        Which tracks remain, shape (T,); the caller removes the others.
    """
    kept = np.ones(rows.number.shape[0], np.bool_)
    for k in range(seen.shape[0]):
        for t in range(kept.shape[0]):
            s = seen[k]
            dx, dy = rows.x[t, 0] - rows.x[s, 0], rows.x[t, 1] - rows.x[s, 1]
            if t != s and kept[s] and kept[t] and dx * dx + dy * dy < radius * radius:
                join(rows, min(s, t), max(s, t))
                kept[max(s, t)] = False
    return kept


@compiled
def are_separate(position: Float, x: Float, radius: float) -> Bool:
    """Return which positions may begin a tree, shape (K,): those at least a radius from all tracks and from
    accepted positions before them.

    Args:
        position: Positions, shape (K, 2) [m].
        x: States of the tracks, x, y [m] first, shape (T, 4).
        radius: Minimum distance [m].
    """
    apart = np.ones(position.shape[0], np.bool_)
    for k in range(position.shape[0]):
        for t in range(x.shape[0]):
            dx, dy = x[t, 0] - position[k, 0], x[t, 1] - position[k, 1]
            apart[k] = apart[k] and dx * dx + dy * dy >= radius * radius
        for j in range(k):
            dx, dy = position[j, 0] - position[k, 0], position[j, 1] - position[k, 1]
            apart[k] = apart[k] and not (apart[j] and dx * dx + dy * dy < radius * radius)
    return apart


@compiled_borrowing
def _fill_spread(rows: Rows, scan: ScanPose, spread: Float) -> None:
    """Write the covariance xx, xy, yy of the position of each track relative to the landmarks into `spread`,
    shape (T, 3) [m^2]: P without its shared part, plus what the covariance of the present pose relative to
    the landmarks adds at the track."""
    x, P, shared = rows.x, rows.P, rows.shared
    for t in range(spread.shape[0]):
        xx, xy, yy = by_pose(x[t, 0] - scan.pose[0], x[t, 1] - scan.pose[1], scan.relative)
        spread[t, 0] = P[t, 0, 0] - shared[t, 0, 0] + xx
        spread[t, 1] = P[t, 0, 1] - shared[t, 0, 1] + xy
        spread[t, 2] = P[t, 1, 1] - shared[t, 1, 1] + yy
