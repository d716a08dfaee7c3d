"""Identity of the trees: each tree belongs to one landmark of SLAM.

SLAM associates detections, counts misses and merges landmarks; the tracks follow it. If the landmark of a
track no longer exists, because SLAM merged or removed it or because another particle is the best one now, the
track takes the landmark at its position, joins the track of that landmark, or is removed. Of two landmarks of
its trunk it takes the better one.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.gaussian import by_pose
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.slam.association import associate
from pipeline.tracking.track_table import NO_LANDMARK, Rows, ScanPose, join
from pipeline.types.records import Bool, Int, Verdict

AGREE = 3.0  # sigma; maximum distance between a track and its landmark
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

    A track keeps its landmark if that exists. Otherwise it gets a free landmark at its position
    (`associate`); if the landmark there has a track, both are joined. A track without any of these gets the
    landmark NO_LANDMARK.

    Args:
        rows: Tracks; landmark, score and, for joined tracks, all columns are changed.
        scan: Pose of the robot.
        birth: Birth numbers of the landmarks, int64, shape (L,).
        position: Their positions, shape (L, 2) [m].
        covariance: Their covariances xx, xy, yy, shape (L, 3) [m^2].
        score: Their hits less misses, shape (L,).
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
                owner[free[at[k]]] = lost[k]
                landmark_of[lost[k]] = free[at[k]]
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
    """Give a tree that is not detected, and began within SAME_VISIT_NS, the landmark of a detection without
    tree next to it, in place, if this landmark has the higher score. Both landmarks are of one trunk: the
    first views of a distant trunk can be wrong by more than the gate of later ones.

    Args:
        rows: Tracks; landmark and score are changed.
        stamp_ns: Time of the scan.
        row: Row of the track of each detection, -1 for none, int64, shape (D,); changed.
        births: Birth number of the landmark of each detection, shape (D,); -1 for none.
        position: Positions of the detections in the map, shape (D, 2) [m].
        birth: Birth numbers of the landmarks, int64, shape (L,).
        score: Their hits less misses, shape (L,).
        radius: Distance below which a detection is of a tree [m].
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

    The lower row, which is the older track, keeps its number and its landmark.

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
