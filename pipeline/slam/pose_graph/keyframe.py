"""What one keyframe adds to the pose graph: recognise, extend, solve, and judge the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.stages import Slam
from pipeline.detection.free_space import in_free_view
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.slam.motion import Motion
from pipeline.slam.particle_update import SCORE_MAX
from pipeline.slam.pose_graph.joint import correct_by_pose, moved_joint, recognise_jointly
from pipeline.slam.pose_graph.landmarks import Landmarks, Sightings, sharpened, turned
from pipeline.slam.pose_graph.smoother import Additions
from pipeline.slam.pose_graph.state import GraphState
from pipeline.slam.scan_statistics import MISSED, MOST_HITS, SHIFT, TOLD, ScanTold, scan_told
from pipeline.types.records import Bool, Detections, Int


def observe(
    s: GraphState, p: Slam, motion: Motion, detections: Detections, clear_range: Float
) -> tuple[ScanTold, Int]:
    """Add a keyframe: associate, extend the graph, solve it, and remove landmarks without score.

    Returns:
        The statistics of the scan, and the birth of the landmark of each detection, shape (D,).
    """
    centre, R = detections.centre, detections.covariance
    near = _near(s, p, centre)
    m, Sigma = _joint(s, p, near)
    told = np.zeros(TOLD)
    moved_joint(m, Sigma, s.motion, s.motion_covariance)
    if motion.measured is not None:
        correct_by_pose(m, Sigma, motion.measured.T_map_base.as_array(), motion.measured.covariance)
    hits = s.landmarks.hits[near]
    matched = recognise_jointly(m, Sigma, centre, R, hits, p.gate, p.distance_max, p.hits_to_weigh, told)
    m[2] = float(wrap_angle(m[2]))
    told[SHIFT] = (Pose2(*s.pose).inverse() @ Pose2(*m[:3])).as_array() - s.motion
    told[SHIFT][2] = wrap_angle(told[SHIFT][2])
    row_of = np.where(matched >= 0, near[matched] if len(near) else -1, -1)
    seen = np.zeros(len(s.landmarks.hits), np.bool_)
    seen[row_of[row_of >= 0]] = True
    told[MISSED] = _miss(s, p, m[:3], seen, clear_range)
    scan_covariance = s.motion_covariance
    births = _extend(s, p, motion, m[:3], row_of, centre, R, _one_tree(s, p, m, Sigma, near, seen))
    s.covariance = Sigma[:3, :3]
    scan = scan_told(told[None], np.ones(1), len(centre), scan_covariance)
    s.motion, s.motion_covariance, s.since_update = np.zeros(3), np.zeros((3, 3)), 0.0
    return scan, births


def _near(s: GraphState, p: Slam, centre: Float) -> Int:
    """Rows of the landmarks that a detection may be."""
    at = (Pose2(*s.pose) @ Pose2(*s.motion)).apply(centre)
    away = s.landmarks.mean[:, None] - at[None]
    reach = p.distance_max
    return np.flatnonzero(np.any(np.hypot(away[..., 0], away[..., 1]) <= reach, axis=1))


def _joint(s: GraphState, p: Slam, near: Int) -> tuple[Float, Float]:
    """Mean and covariance of the last keyframe and landmarks. One that is in no graph is taken to hang
    on the last keyframe, the looser the farther the robot drove since it saw it."""
    known = s.landmarks.take(near)
    inside = known.node >= 0
    fixed = s.smoother.joint_covariance(s.keyframes - 1, s.pose[2], known.node[inside])
    n = 3 + 2 * len(near)
    A = np.zeros((n, len(fixed)))  # errors of all from those in the graph
    A[:3, :3] = np.eye(3)
    rows = 3 + 2 * np.flatnonzero(inside)
    columns = 3 + 2 * np.arange(len(rows))
    A[rows, columns] = A[rows + 1, columns + 1] = 1.0
    loose = np.flatnonzero(~inside)
    rows = 3 + 2 * loose
    away = known.mean[loose] - s.pose[:2]
    A[rows, 0] = A[rows + 1, 1] = 1.0
    A[rows, 2], A[rows + 1, 2] = -away[:, 1], away[:, 0]
    Sigma = A @ fixed @ A.T
    drift = p.noise_distance**2 * (s.driven - known.seen_at[loose])
    own = known.covariance[loose] + drift[:, None, None] * np.eye(2)
    for a in range(2):
        for b in range(2):
            Sigma[rows + a, rows + b] += own[:, a, b]
    return np.concatenate([s.pose, known.mean.ravel()]), Sigma


def _miss(s: GraphState, p: Slam, pose: Float, seen: Bool, free: Float) -> float:
    """Take from the score of landmarks in free view that were not seen; returns the hits of the well
    known ones among them."""
    known = s.landmarks
    missed = in_free_view(known.mean, pose, free, p.view_range) & ~seen
    score = known.score - missed / p.misses_per_hit
    s.landmarks = replace(known, score=score)
    well = missed & (known.hits >= p.hits_to_weigh)
    return float(np.minimum(known.hits[well], MOST_HITS).sum())


def _one_tree(
    s: GraphState,
    p: Slam,
    m: Float,
    Sigma: Float,
    near: Int,
    seen: Bool,
) -> Int:
    """Pairs of landmarks, shape (N, 2), of which this scan saw the first alone and which may be one
    tree. Two that one scan sees are two."""
    gate = p.merge_gate
    a, b = np.flatnonzero(seen[near]), np.flatnonzero(~seen[near])
    if gate == 0.0 or not len(a) or not len(b):
        return np.zeros((0, 2), np.int64)
    a, b = (pairs.ravel() for pairs in np.meshgrid(a, b, indexing="ij"))
    i, j, axes = 3 + 2 * a, 3 + 2 * b, np.arange(2)
    y = m[i[:, None] + axes] - m[j[:, None] + axes]
    ii, jj = (k[:, None, None] + axes[:, None] for k in (i, j))
    it, jt = (k[:, None, None] + axes[None, :] for k in (i, j))
    S = Sigma[ii, it] + Sigma[jj, jt] - Sigma[ii, jt] - Sigma[jj, it] + np.eye(2) * 1e-6
    d2 = np.einsum("ni,nij,nj->n", y, np.linalg.inv(S), y)
    near_enough = np.hypot(y[:, 0], y[:, 1]) <= p.distance_max
    pairs = np.column_stack([near[a], near[b]])[(d2 <= gate * gate) & near_enough]
    node = s.landmarks.node[pairs]
    turn = (node[:, 0] < 0) & (node[:, 1] >= 0)  # the one in the graph stays
    pairs[turn] = pairs[turn][:, ::-1]
    _, first = np.unique(pairs[:, 1], return_index=True)
    chosen: Int = pairs[np.sort(first)]
    return chosen


def _extend(
    s: GraphState,
    p: Slam,
    motion: Motion,
    pose: Float,
    row_of: Int,
    centre: Float,
    R: Float,
    one_tree: Int,
) -> Int:
    """Add the keyframe, its detections and the landmarks that are well known now, and solve the graph.

    Returns:
        The birth of the landmark of each detection, shape (D,).
    """
    k = s.keyframes
    additions = Additions()
    additions.pose(k, pose)
    additions.odometry(k, s.motion, s.motion_covariance)
    if motion.measured is not None:
        z = motion.measured
        additions.pose_prior(k, z.T_map_base.as_array(), z.covariance, robust=True)
    _count(s, p, k, pose, row_of, centre, R, one_tree)
    known = s.landmarks
    row_of = np.where(row_of < 0, np.cumsum(row_of < 0) - 1 + len(known.hits) - (row_of < 0).sum(), row_of)
    new = np.flatnonzero((known.node < 0) & (known.hits >= p.hits_to_weigh))
    old = known.node[row_of] >= 0
    additions.sights(np.full(old.sum(), k), known.node[row_of[old]], centre[old], R[old])
    first = s.smoother.landmarks
    node = known.node.copy()
    node[new] = first + np.arange(len(new))
    for j, place in zip(node[new], known.mean[new], strict=True):
        additions.point(int(j), place)
    entering = np.isin(s.sightings.birth, known.birth[new])
    told = s.sightings.take(entering)
    by_birth = new[np.argsort(known.birth[new])]
    rows = by_birth[np.searchsorted(known.birth[by_birth], told.birth)]
    additions.sights(told.keyframe, node[rows], told.centre, told.covariance)
    both = (node[one_tree] >= 0).all(axis=1)
    for i, j in node[one_tree[both]]:
        additions.one_tree(int(i), int(j))
    poses, points = s.smoother.update(additions)
    s.keyframe_motion.append(s.motion)
    s.pose = poses[-1]
    alive = known.score > 0.0
    alive[one_tree[:, 1]] = False
    stays = np.arange(len(known.birth))
    stays[one_tree[:, 1]] = one_tree[:, 0]
    births: Int = known.birth[stays[row_of]]
    s.landmarks = placed(replace(known, node=node), poses, points).take(alive)
    waiting = s.landmarks.birth[s.landmarks.node < 0]
    s.sightings = s.sightings.take(np.isin(s.sightings.birth, waiting))
    return births


def _count(
    s: GraphState,
    p: Slam,
    k: int,
    pose: Float,
    row_of: Int,
    centre: Float,
    R: Float,
    one_tree: Int,
) -> None:
    """Hits of what was seen, new landmarks behind them, and what waits to enter the graph."""
    known = s.landmarks
    at, C = Pose2(*pose).apply(centre), turned(R, pose[2])
    old, rows = row_of >= 0, row_of[row_of >= 0]
    hits, score, seen_at = known.hits.copy(), known.score.copy(), known.seen_at.copy()
    hits[rows] += 1
    score[rows] = np.minimum(score[rows] + 1.0, SCORE_MAX)
    seen_at[rows] = s.driven
    hits[one_tree[:, 0]] += hits[one_tree[:, 1]]
    mean, covariance, local, anchor = (
        known.mean.copy(), known.covariance.copy(), known.local.copy(), known.anchor.copy(),
    )  # fmt: skip
    mean[rows], covariance[rows] = sharpened(
        mean[rows], covariance[rows], at[old], C[old], p.independent_views_max
    )
    local[rows], anchor[rows] = Pose2(*pose).inverse().apply(mean[rows]), k
    n = int((~old).sum())
    birth = s.detections + np.flatnonzero(~old)
    fresh = Landmarks(
        np.full(n, -1), np.full(n, k), centre[~old], at[~old], C[~old],
        np.ones(n, np.int32), np.ones(n), birth, np.full(n, s.driven), np.full(n, k),
    )  # fmt: skip
    grown = replace(
        known, anchor=anchor, local=local, mean=mean, covariance=covariance, hits=hits, score=score,
        seen_at=seen_at,
    )  # fmt: skip
    s.landmarks = grown.with_more(fresh)
    births = np.empty(len(centre), np.int64)
    births[old], births[~old] = known.birth[rows], birth
    waits = np.ones(len(centre), np.bool_)
    waits[old] = known.node[rows] < 0
    more = Sightings(births, np.full(len(centre), k), centre, R).take(waits)
    s.sightings = s.sightings.with_more(more)
    s.detections += len(centre)


def placed(known: Landmarks, poses: Float, points: Float) -> Landmarks:
    """Where the graph has its landmarks now, and the anchors of the others."""
    mean, inside = known.mean.copy(), known.node >= 0
    mean[inside] = points[known.node[inside]]
    anchor, local = poses[known.anchor[~inside]], known.local[~inside]
    c, s = np.cos(anchor[:, 2]), np.sin(anchor[:, 2])
    mean[~inside] = anchor[:, :2] + np.column_stack(
        [c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1]]
    )
    return replace(known, mean=mean)
