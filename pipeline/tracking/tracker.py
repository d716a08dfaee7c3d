"""The tracker: a Kalman filter per tree (Eq. 10), on the data association of SLAM."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.stages import Classification, Tracking
from pipeline.geometry.gaussian import in_map, spread_by_pose
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float
from pipeline.tracking.identity import are_separate, follow, merge_near, take_better_landmarks, tracks_of
from pipeline.tracking.kalman import ENGINES, split
from pipeline.tracking.observation import FigureLimits, add_observations, table_figures
from pipeline.tracking.track_classification import classify, classify_new
from pipeline.tracking.track_table import NO_LANDMARK, ScanPose, TrackTable
from pipeline.types.records import Columns, Detections, Int, Landmarks, PoseEstimate, Trees, Verdict

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

    def __init__(self, parameters: Tracking) -> None:
        """Create a tracker without trees; the first tree gets the number 1."""
        self.parameters = parameters
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

        They are assigned to the landmarks; those without landmark and voxel column are removed, and one whose
        trunk has two landmarks may take the other one. Detected trees are filtered and described. A tree
        begins at each new landmark farther than `proximity_radius` from all trees, and trees nearer than that
        to a detected one are joined.

        Args:
            stamp_ns: Time of the scan, not before the last one.
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
            d.radius[known], d.radius_sigma[known], d.arc[known], above[known],
        )  # fmt: skip
        kept = merge_near(self.tracks.as_rows(), rows, p.proximity_radius)
        if not kept.all():
            self.tracks = self.tracks.take(kept)

    def correct(
        self, correction: PathCorrection, stamps_ns: Int, estimate: PoseEstimate, landmarks: Landmarks
    ) -> None:
        """Move the trees in place with a corrected path, and those with a landmark to its corrected position.
        Trees without a landmark within LOOP_DISTANCE and without a tree column are removed.

        Trees that share a landmark afterwards are joined. Velocities and covariances are rotated with the
        path.

        Args:
            correction: The correction of the path.
            stamps_ns: Time of each scan of the path [ns], int64, shape (N,).
            estimate: Pose after the correction.
            landmarks: Landmarks after the correction.
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
            t.x[known, :2] = landmarks.position[order[at[known]]]
        self._follow(self._scan.stamp_ns, estimate, landmarks, np.inf, LOOP_DISTANCE)

    def classify(self, stamp_ns: int, columns: Columns, parameters: Classification) -> Columns:
        """Classify the trees by the voxel columns, in place, and begin a tree without detections and landmark
        at each tree column without one. The pose is that of the last scan of `process` or `correct`.

        Args:
            stamp_ns: Time of the scan.
            columns: Columns with the verdicts of votes and rules.
            parameters: Parameters of the classification.

        Returns:
            The columns, of which those that `confirm_round` changes are trees; the argument is unchanged.
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
        """Return the attributes of all trees, confirmed or not (Table 2), by number; the columns are copies.
        SHARED_COVARIANCE is added to the covariances. Diameters are NaN where they are unknown."""
        t, p = self.tracks, self.parameters
        limits = FigureLimits(p.hits_to_confirm, np.radians(p.dbh_arc_min), p.out_of_round, p.taper_sigma)
        coverage, dbh, dbh_sigma, eccentricity, confirmed = table_figures(t.as_rows(), limits)
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

    def _follow(
        self, stamp_ns: int, estimate: PoseEstimate, landmarks: Landmarks, gate: float, distance_max: float
    ) -> ScanPose:
        """Assign the trees to the landmarks, and return the pose of the robot, which is stored as that of the
        last scan. Trees whose landmarks were merged are joined: the older one stays and gets the data of
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

        That happens when SLAM corrects its map, or when another particle with another map is the best one.

        Args:
            rows: Rows of trees with a detection, shape (K,).
            position: Positions of the detections in the map, shape (K, 2) [m].
            own: Their own covariances, shape (K, 2, 2).
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
            stamp_ns: Time of the scan.
            landmark: Birth numbers of their landmarks, shape (K,); -1 for none.
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
