"""What every particle learns from the detections of one scan: pose, landmarks, weight (Eq. 7)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.detection.free_space import BEHIND
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.gaussian import draw, rotated
from pipeline.geometry.hash_grid import Cells, cells_for, clear, fill, per_metre
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within
from pipeline.slam.candidate_pairs import Room
from pipeline.slam.landmarks import kalman_update, merge_duplicates
from pipeline.slam.particle_maps import ROOM, Maps, own_block, widen
from pipeline.slam.proposal import recognise
from pipeline.slam.scan_statistics import MISSED, MOST_HITS, SHIFT
from pipeline.slam.shared_errors import MeasuredPose, correct_by_measured, update_shared_errors
from pipeline.types.records import Bool, Float32, Int, Int32

SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time
SHIFT_X, SHIFT_Y, SHIFT_YAW = range(SHIFT.start, SHIFT.stop)


class Rules(NamedTuple):
    """The numbers by which a scan is judged.

    Attributes:
        use_proposal: FastSLAM 2.0; else the pose was drawn before the scan is looked at.
        gate: Largest Mahalanobis distance of an association [sigma].
        distance_max: Largest distance of an association [m].
        hits_to_weigh: Landmarks seen fewer times do not weigh.
        view_range: Landmarks nearer than this can be missed [m].
        miss: What one miss takes from the score; miss_weight: from the log weight.
        weight_power: Power of a scan's likelihood in the weights.
        looks: A landmark is never known better than by so many independent looks.
        merge_gate: Two landmarks nearer than this are one [sigma].
    """

    use_proposal: bool
    gate: float
    distance_max: float
    hits_to_weigh: int
    view_range: float
    miss: float
    miss_weight: float
    weight_power: float
    looks: float
    merge_gate: float


class Near(NamedTuple):
    """The landmarks of one particle in reach, as columns of its own that are written back when changed.

    Attributes:
        block, place: int32, shape (L,): where each one is kept.
        mean, covariance, hits, score, birth: As in Maps, shape (L, ...).
        seen, changed: shape (L,).
        free: int32, shape (L, 2): block and place of places without a landmark.
        cells: Those known before the scan, by where they stood then.
    """

    block: Int32
    place: Int32
    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int
    seen: Bool
    changed: Bool
    free: Int32
    cells: Cells


@compiled
def near_for(landmarks: int) -> Near:
    """Columns with room for so many landmarks."""
    n = landmarks
    return Near(
        np.empty(n, np.int32),
        np.empty(n, np.int32),
        np.empty((n, 2)),
        np.empty((n, 3)),
        np.empty(n, np.int32),
        np.empty(n, np.float32),
        np.empty(n, np.int64),
        np.empty(n, np.bool_),
        np.empty(n, np.bool_),
        np.empty((n, 2), np.int32),
        cells_for(n),
    )


@compiled
def predict(pose: Float, motion: Float, covariance: Float, noise: Float, use_proposal: bool) -> Float:
    """The poses after the motion, shape (P, 3); drawn from its covariance where there is no proposal."""
    P = np.empty((3, 3))
    mu = np.empty(3)
    moved = np.empty_like(pose)
    for p in range(pose.shape[0]):
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        mu[0] = pose[p, 0] + c * motion[0] - s * motion[1]
        mu[1] = pose[p, 1] + s * motion[0] + c * motion[1]
        mu[2] = pose[p, 2] + motion[2]
        moved[p, 0], moved[p, 1], moved[p, 2] = mu[0], mu[1], mu[2]
        if not use_proposal:
            _turned_covariance(covariance, c, s, P)
            draw(mu, P, noise, p, moved)
    return moved


@compiled_borrowing
def observe(
    pose: Float,
    moved: Float,
    log_weight: Float,
    maps: Maps,
    near_blocks: Int32,
    near_lengths: Int32,
    motion: Float,
    motion_covariance: Float,
    noise: Float,
    centre: Float,
    R: Float,
    clear_range: Float,
    reach: float,
    first_birth: int,
    rules: Rules,
    near: Near,
    room: Room,
    told: Float,
    measured: MeasuredPose,
    births: Int,
    mu: Float,
    P: Float,
) -> None:
    """Update every particle in place.

    Args:
        pose: Before the motion, shape (P, 3), becomes the pose after the scan; moved: see `predict`.
        near_blocks, near_lengths: See `blocks_in_reach`; the pool has the rows that it asked for.
        motion, motion_covariance: Since the last observation, in the frame of each particle.
        noise: Standard normal numbers, shape (P, 3).
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariance xx, xy, yy, (D, 3).
        clear_range: See FastSlam.process.
        reach: Landmarks farther than this are left alone [m].
        first_birth: Serial number of the first of the detections.
        near, room: Memory for the landmarks in reach and for pairs.
        told: shape (P, STATISTICS), filled: what each particle tells of the scan (see health).
        measured: The pose by another source; what its poses err by alike is learned.
        births: shape (P, D), filled: birth of the landmark that each particle associates with each detection.
        mu, P: Memory for a pose, shape (3,), and its covariance, shape (3, 3), zeros.
    """
    scale = per_metre(rules.distance_max)
    farthest = _farthest_missed(clear_range, rules.view_range)
    for p in range(pose.shape[0]):
        before_c, before_s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        x, y, yaw = pose[p, 0], pose[p, 1], pose[p, 2]
        mu[0], mu[1], mu[2] = moved[p, 0], moved[p, 1], moved[p, 2]
        if rules.use_proposal:
            _turned_covariance(motion_covariance, before_c, before_s, P)
        if measured.z.shape[0] > 0:
            log_weight[p] += correct_by_measured(mu, P, measured, p)
        known, free = _gather(maps, p, near_blocks, near_lengths[p], mu, reach, near)
        fill(near.cells, near.mean, known, scale)
        likelihood = recognise(
            mu, P, centre, R, near.mean, near.covariance, near.hits, near.cells, scale,
            rules.gate, rules.distance_max, rules.hits_to_weigh, room, told, p,
        )  # fmt: skip
        _shift(x, y, yaw, before_c, before_s, motion, mu, told, p)
        if rules.use_proposal:
            draw(mu, P, noise, p, pose)
        else:
            pose[p, 0], pose[p, 1], pose[p, 2] = mu[0], mu[1], mu[2]
        if measured.mean.shape[0] > 0:
            update_shared_errors(pose, measured, p)
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        all_near = _learn(
            pose, p, c, s, maps, near, known, free, room.landmark_of, centre, R, first_birth, rules
        )
        missed = _miss(pose, p, c, s, near, known, clear_range, farthest, rules, told)
        log_weight[p] += rules.weight_power * (likelihood - rules.miss_weight * missed)
        merge_duplicates(
            near.mean, near.covariance, near.hits, near.score, near.birth, known, near.seen,
            rules.merge_gate, near.cells, scale,
        )  # fmt: skip
        for d in range(centre.shape[0]):
            j = room.landmark_of[d]
            births[p, d] = near.birth[j] if j >= 0 else first_birth + d
        clear(near.cells, known)
        _write_back(maps, p, near, all_near)


@compiled_within
def _gather(
    maps: Maps, p: int, near_blocks: Int32, blocks: int, mu: Float, reach: float, near: Near
) -> tuple[int, int]:
    """Fill `near` with the landmarks of a particle in reach; how many, and how many free places."""
    n, free = 0, 0
    count = maps.places[p]
    for i in range(blocks):
        k = near_blocks[p, i]
        b = maps.block[p, k]
        for o in range(min(ROOM, count - k * ROOM)):
            if maps.hits[b, o] == 0:
                near.free[free, 0], near.free[free, 1] = k, o
                free += 1
                continue
            x, y = maps.mean[b, o, 0], maps.mean[b, o, 1]
            dx, dy = x - mu[0], y - mu[1]
            if dx * dx + dy * dy > reach * reach:
                continue
            near.block[n], near.place[n] = k, o
            near.mean[n, 0], near.mean[n, 1] = x, y
            for a in range(3):
                near.covariance[n, a] = maps.covariance[b, o, a]
            near.hits[n], near.score[n], near.birth[n] = (
                maps.hits[b, o],
                maps.score[b, o],
                maps.birth[b, o],
            )
            near.seen[n] = near.changed[n] = False
            n += 1
    return n, free


@compiled_within
def _learn(
    pose: Float,
    p: int,
    c: float,
    s: float,
    maps: Maps,
    near: Near,
    known: int,
    free: int,
    landmark_of: Int,
    centre: Float,
    R: Float,
    first_birth: int,
    rules: Rules,
) -> int:
    """Sharpen the landmarks of one particle that were seen, marking them, and begin new ones behind them;
    returns how many rows of `near` there are then. c, s: cosine and sine of the particle's yaw."""
    n = known
    for d in range(centre.shape[0]):
        z0 = pose[p, 0] + c * centre[d, 0] - s * centre[d, 1]
        z1 = pose[p, 1] + s * centre[d, 0] + c * centre[d, 1]
        R0, R1, R2 = rotated(R, d, c, s)
        j = landmark_of[d]
        if j >= 0:
            kalman_update(near.mean, near.covariance, j, z0, z1, R0, R1, R2, rules.looks)
            near.hits[j] += 1
            near.score[j] = min(near.score[j] + 1.0, SCORE_MAX)
            near.seen[j] = near.changed[j] = True
            continue
        if n - known < free:
            near.block[n], near.place[n] = near.free[n - known, 0], near.free[n - known, 1]
        else:
            near.block[n], near.place[n] = maps.places[p] // ROOM, maps.places[p] % ROOM
            maps.places[p] += 1
        near.mean[n, 0], near.mean[n, 1] = z0, z1
        near.covariance[n, 0], near.covariance[n, 1], near.covariance[n, 2] = R0, R1, R2
        near.hits[n], near.score[n], near.birth[n] = 1, 1.0, first_birth + d
        near.changed[n] = True
        n += 1
    return n


@compiled_borrowing
def _farthest_missed(clear_range: Float, view_range: float) -> float:
    """Square of the distance beyond which no landmark can be missed in any direction [m^2]."""
    free = 0.0
    for k in range(clear_range.shape[0]):
        if clear_range[k] - BEHIND > free:
            free = clear_range[k] - BEHIND
    return min(free * free, view_range * view_range)


@compiled_within
def _miss(
    pose: Float,
    p: int,
    c: float,
    s: float,
    near: Near,
    known: int,
    clear_range: Float,
    farthest: float,
    rules: Rules,
    told: Float,
) -> float:
    """Take from the score of landmarks in free view that were not seen; returns how many well known ones
    there are. c, s: cosine and sine of the particle's yaw; farthest: see `_farthest_missed`."""
    missed = 0.0
    if farthest == 0.0:
        return missed
    for j in range(known):
        if near.seen[j]:
            continue
        dx, dy = near.mean[j, 0] - pose[p, 0], near.mean[j, 1] - pose[p, 1]
        square = dx * dx + dy * dy
        if square > farthest:
            continue
        free = clear_range[direction_bin(c * dx + s * dy, c * dy - s * dx, clear_range.shape[0])] - BEHIND
        if free > 0.0 and free * free > square:
            near.score[j] -= rules.miss
            near.changed[j] = True
            if near.hits[j] >= rules.hits_to_weigh:
                told[p, MISSED] += min(float(near.hits[j]), MOST_HITS)
                missed += 1.0
    return missed


@compiled_within
def _write_back(maps: Maps, p: int, near: Near, all_near: int) -> None:
    """Keep what changed; a landmark without score leaves its place free."""
    k, b = -1, 0
    x_min = y_min = np.inf
    x_max = y_max = -np.inf
    for j in range(all_near):
        gone = near.score[j] <= 0.0
        if not (near.changed[j] or gone):
            continue
        if near.block[j] != k:  # rows of one block stand together
            if k >= 0:
                widen(maps, b, x_min, y_min, x_max, y_max)
                x_min = y_min = np.inf
                x_max = y_max = -np.inf
            k = near.block[j]
            b = own_block(maps, p, k)
        o = near.place[j]
        if gone:
            maps.hits[b, o] = 0
            continue
        x, y = near.mean[j, 0], near.mean[j, 1]
        maps.mean[b, o, 0], maps.mean[b, o, 1] = x, y
        for a in range(3):
            maps.covariance[b, o, a] = near.covariance[j, a]
        maps.hits[b, o], maps.score[b, o], maps.birth[b, o] = near.hits[j], near.score[j], near.birth[j]
        x_min, y_min, x_max, y_max = min(x_min, x), min(y_min, y), max(x_max, x), max(y_max, y)
    if k >= 0:
        widen(maps, b, x_min, y_min, x_max, y_max)


@compiled_within
def _turned_covariance(covariance: Float, c: float, s: float, P: Float) -> None:
    """P = C covariance C^T with the rotation C about z; written out, for the library's product of such
    small matrices costs more than all else here."""
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    P[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    P[0, 1] = P[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    P[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    P[0, 2] = P[2, 0] = c * covariance[0, 2] - s * covariance[1, 2]
    P[1, 2] = P[2, 1] = s * covariance[0, 2] + c * covariance[1, 2]
    P[2, 2] = covariance[2, 2]


@compiled_within
def _shift(
    x: float, y: float, yaw: float, c: float, s: float, motion: Float, mu: Float, told: Float, p: int
) -> None:
    """How far the scan moved a pose from where the odometry had it, in the frame of its covariance."""
    dx, dy = mu[0] - x, mu[1] - y
    told[p, SHIFT_X] = c * dx + s * dy - motion[0]
    told[p, SHIFT_Y] = c * dy - s * dx - motion[1]
    turn = mu[2] - yaw - motion[2]
    told[p, SHIFT_YAW] = turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
