"""The tracker: a Kalman filter per tree (Eq. 10), on the data association of SLAM.

Each tree belongs to one landmark of SLAM. SLAM associates detections, counts misses and merges landmarks; the
tracks follow it. If the landmark of a track no longer exists, because SLAM merged or removed it or because
another particle is the best one now, the track takes the landmark at its position, joins the track of that
landmark, or is removed. Of two landmarks of its trunk it takes the better one.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from pipeline.config.stages import Classification, Tracking
from pipeline.geometry.gaussian import in_map, rows_of, spread_by_pose
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.association import associate
from pipeline.tracking.kalman import ENGINES, split
from pipeline.tracking.observation import add_observations, limits_of, table_figures
from pipeline.tracking.track_classification import classify, classify_new
from pipeline.tracking.track_table import NO_LANDMARK, ScanPose, TrackTable, join
from pipeline.types.records import Bool, Columns, Detections, Int, Landmarks, PoseEstimate, Trees, Verdict

NANOSECONDS = 1e-9
# m; error that all views of a trunk share, by its bark, taper and lean: with it the 95 % intervals of
# sim:wild, seeds 100 to 111, cover 95 % (docs/results.md has other seeds).
SHARED_SIGMA = 0.018
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

    def copy(self) -> Tracker:
        """Return an independent copy."""
        other = copy.copy(self)
        other.tracks = self.tracks.copy()
        return other

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
            self.tracks, stamp_ns, row, births, position, landmarks.birth, landmarks.score,
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
        kept = merge_near(self.tracks, rows, p.proximity_radius)
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
        columns are copies. The errors that all views of a trunk share, by its bark (SHARED_SIGMA) and its
        shape (`shape_sigma`), are added to the covariances. Diameters and eccentricities are NaN where they
        are unknown; heights and leans are None."""
        t, limits = self.tracks, limits_of(self.parameters)
        coverage, dbh, dbh_sigma, by_shape, eccentricity, confirmed = table_figures(t.as_rows(), limits)
        shared = SHARED_SIGMA**2 + np.square(by_shape)
        return Trees(
            number=t.number.copy(),
            position=t.x[:, :2].copy(),
            covariance=t.P[:, :2, :2] + shared[:, None, None] * np.eye(2),
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
            self.tracks, self._scan, landmarks.birth, landmarks.position, landmarks.covariance,
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
        # Few are beyond the gate by their own covariance alone, which is a part of the whole one.
        far = _are_beyond(y, own, landmarks.gate)
        if not far.any():
            return
        rows, y, own = rows[far], y[far], own[far]
        S = t.P[rows, :2, :2] - t.shared[rows] + spread_by_pose(t.x[rows, :2], scan.pose, scan.relative) + own
        rows = rows[_are_beyond(y, S, landmarks.gate)]
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


def _are_beyond(y: Float, S: Float, gate: float) -> Bool:
    """Return which innovations, shape (K, 2) [m], with covariances of shape (K, 2, 2) are beyond a gate
    [sigma], shape (K,): d^2 > gate^2, for d^2 = y^T S^-1 y written with the adjugate of S."""
    y0, y1, xx, xy, yy = y[:, 0], y[:, 1], S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    beyond: Bool = yy * y0**2 - 2.0 * xy * y0 * y1 + xx * y1**2 > gate**2 * (xx * yy - xy**2)
    return beyond


# ns; in this time a robot that drives 1 m/s drifts by 0.25 m if its odometry errs by 2.5 %, less than the
# distance of two landmarks of one trunk. Later, a landmark next to a tree may be that of another tree.
SAME_VISIT_NS = 10_000_000_000
TREE = int(Verdict.TREE)


def follow(
    tracks: TrackTable,
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
        tracks: Tracks; landmark, score and, for joined tracks, all columns are changed.
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
    T, L = len(tracks), len(birth)
    order = np.argsort(birth)
    at = np.minimum(np.searchsorted(birth[order], tracks.landmark), L - 1)
    found = birth[order[at]] == tracks.landmark if L else np.zeros(T, np.bool_)
    owner, landmark_of, before = np.full(L, -1), np.full(T, -1), tracks.landmark.copy()
    rows = np.flatnonzero(found)[::-1]  # the lowest row last, which remains
    owner[order[at[rows]]] = rows
    held = np.flatnonzero(owner >= 0)
    landmark_of[owner[held]] = held
    kept = np.ones(T, np.bool_)
    lost = np.flatnonzero(landmark_of < 0)
    if len(lost) and L:
        spread = rows_of(
            tracks.P[:, :2, :2] - tracks.shared + spread_by_pose(tracks.x[:, :2], scan.pose, scan.relative)
        )
        at = _partners(tracks, lost, spread, owner < 0, position, covariance, gate, distance_max)
        for t, j in zip(lost[at >= 0].tolist(), at[at >= 0].tolist(), strict=True):
            owner[j], landmark_of[t] = t, j
            tracks.landmark[t], tracks.score[t] = birth[j], score[j]
        # A landmark that is gone while another track has the one at its position was merged with it.
        merged = lost[(landmark_of[lost] < 0) & (before[lost] != NO_LANDMARK)]
        at = _partners(tracks, merged, spread, owner >= 0, position, covariance, gate, distance_max)
        for t, j in zip(merged[at >= 0].tolist(), at[at >= 0].tolist(), strict=True):
            tracks.landmark[t] = NO_LANDMARK
            old, young = sorted((int(owner[j]), t))
            join(tracks, old, young)
            landmark_of[old], landmark_of[young] = j, -1
            owner[j] = old
            kept[young] = False
    has_landmark = landmark_of >= 0
    tracks.landmark[:] = NO_LANDMARK
    tracks.landmark[has_landmark] = birth[landmark_of[has_landmark]]
    tracks.score[has_landmark] = score[landmark_of[has_landmark]]
    kept &= has_landmark | (tracks.verdict == TREE)
    return kept


def _partners(
    tracks: TrackTable,
    rows: Int,
    spread: Float,
    among: Bool,
    position: Float,
    covariance: Float,
    gate: float,
    distance_max: float,
) -> Int:
    """Return the landmark of the tracks `rows` by `associate`, of those `among` them, int64, shape (R,); -1
    for none. The other arguments are those of `follow`; `spread` is the covariance xx, xy, yy of each track
    relative to the landmarks, shape (T, 3) [m^2]."""
    if not len(rows) or not among.any():
        return np.full(len(rows), -1)
    landmarks = np.flatnonzero(among)
    at, _ = associate(
        tracks.x[rows, :2], spread[rows], position[among], covariance[among], gate, distance_max
    )
    return np.where(at >= 0, landmarks[at], -1)


def tracks_of(landmark: Int, births: Int) -> Int:
    """Return the row of the track of each detection, int64, shape (D,); -1 for none.

    Args:
        landmark: Birth number of the landmark of each track, shape (T,).
        births: Birth number of the landmark of each detection, shape (D,); -1 for none.
    """
    order = np.argsort(landmark)
    at = np.minimum(np.searchsorted(landmark[order], births), max(len(order) - 1, 0))
    if not len(order):
        return np.full(len(births), -1)
    row = order[at]
    return np.where((births != NO_LANDMARK) & (landmark[row] == births), row, -1)


def take_better_landmarks(
    tracks: TrackTable,
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
        tracks: Tracks; landmark and score are changed.
        stamp_ns: Time of the scan [ns].
        row: Row of the track of each detection, -1 for none, int64, shape (D,); changed.
        births: Birth number of the landmark of each detection, shape (D,); -1 for none.
        position: Positions of the detections in the map, shape (D, 2) [m].
        birth: Birth numbers of the landmarks, int64, shape (L,).
        score: Scores of the landmarks, hits minus misses, shape (L,).
        radius: Distance below which a detection belongs to a track [m].
    """
    free = np.flatnonzero((row < 0) & (births != NO_LANDMARK)).tolist()
    if not free:
        return
    detected = np.zeros(len(tracks), np.bool_)
    detected[row[row >= 0]] = True
    for d in free:
        away = ((tracks.x[:, :2] - position[d]) ** 2).sum(axis=1)
        nearest = int(away.argmin()) if len(tracks) else -1
        if nearest < 0 or away[nearest] >= radius * radius or detected[nearest]:
            continue
        (j,) = np.flatnonzero(birth == births[d])[:1] if (birth == births[d]).any() else (-1,)
        if stamp_ns - tracks.first_ns[nearest] > SAME_VISIT_NS or j < 0:
            continue
        if tracks.landmark[nearest] == NO_LANDMARK or score[j] > tracks.score[nearest]:
            tracks.landmark[nearest], tracks.score[nearest] = births[d], score[j]
            row[d], detected[nearest] = nearest, True


def merge_near(tracks: TrackTable, seen: Int, radius: float) -> Bool:
    """Join the tracks that are nearer than a radius to a track that moved, in place.

    The lower row, which is the older track, remains; see `join`.

    Args:
        tracks: Tracks.
        seen: Rows of the tracks that moved in this scan, shape (K,).
        radius: Distance below which two tracks are one tree [m].

    Returns:
        Which tracks remain, shape (T,); the caller removes the others.
    """
    kept = np.ones(len(tracks), np.bool_)
    x = tracks.x
    if (_count_near(x[seen], x, radius) == 1).all():
        return kept  # each track is near itself only
    for s in seen.tolist():
        t = 0
        while kept[s]:
            near = np.flatnonzero(kept[t:] & _is_near(x[s, :2], x[t:], radius)) + t
            near = near[near != s]
            if not len(near):
                break
            t = int(near[0])
            join(tracks, min(s, t), max(s, t))  # may move the track
            kept[max(s, t)] = False
            t += 1
    return kept


def are_separate(position: Float, x: Float, radius: float) -> Bool:
    """Return which positions may begin a tree, shape (K,): those at least a radius from all tracks and from
    accepted positions before them.

    Args:
        position: Positions, shape (K, 2) [m].
        x: States of the tracks, x, y [m] first, shape (T, 4).
        radius: Minimum distance [m].
    """
    apart: Bool = _count_near(position, x, radius) == 0
    for k in range(1, len(position)):
        apart[k] &= not (apart[:k] & _is_near(position[k], position[:k], radius)).any()
    return apart


@compiled
def _count_near(place: Float, other: Float, radius: float) -> Int:
    """Return for each row of `place` the number of rows of `other` that are nearer than a radius [m], int64,
    shape (K,); x, y [m] are the first two columns of both."""
    counts = np.zeros(place.shape[0], np.int64)
    for i in range(place.shape[0]):
        for j in range(other.shape[0]):
            dx, dy = place[i, 0] - other[j, 0], place[i, 1] - other[j, 1]
            counts[i] += dx * dx + dy * dy < radius * radius
    return counts


def _is_near(place: Float, other: Float, radius: float) -> Bool:
    """Return which rows of `other` are nearer than a radius [m] to a position x, y [m], shape (M,)."""
    away = other[:, :2] - place
    near: Bool = away[:, 0] ** 2 + away[:, 1] ** 2 < radius * radius
    return near
