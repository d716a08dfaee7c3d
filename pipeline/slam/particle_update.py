"""Update of pose, landmarks and weight (Eq. 7) of each particle with the detections of one scan, and the
estimate of the pose from all particles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.detection.free_space import BEHIND
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.gaussian import draw, rotated
from pipeline.geometry.hash_grid import Cells, cells_for, clear, fill, per_metre
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.slam.measured_pose import MeasuredPose, correct_by_measured, update_shared_errors
from pipeline.slam.motion import OdometryTrust, moved_pose, moved_poses, weighted_pose
from pipeline.slam.particle_ancestry import normalised
from pipeline.slam.particle_maps import (
    ROOM,
    Maps,
    blocks_in_reach,
    kalman_update,
    known_near,
    merge_duplicates,
    own_block,
    widen,
    with_room,
)
from pipeline.slam.places import ACTIVE, INACTIVE, PlaceStates, state_of, states_of
from pipeline.slam.pose_quality import MISSED, MOST_HITS, SHIFT, STATISTICS, mean_statistics
from pipeline.slam.proposal import Room, recognise, room_for
from pipeline.slam.rigid_shift_test import FEWEST as FEWEST_PAIRS
from pipeline.slam.slip_detection import SEARCH, TreeMotion, motion_by_trees
from pipeline.types.records import Bool, Float32, Int, Int32

SCORE_MAX = 20.0  # upper limit of a score, so that a felled tree is removed after finitely many misses
SHIFT_X, SHIFT_Y, SHIFT_YAW = range(SHIFT.start, SHIFT.stop)


class Rules(NamedTuple):
    """Parameters of the measurement update, see `Slam`.

    Attributes:
        use_proposal: Whether detections correct the pose before it is sampled (FastSLAM 2.0); otherwise it is
            sampled from the odometry (FastSLAM 1.0).
        gate: Maximum Mahalanobis distance of an association [sigma].
        distance_max: Maximum distance of an association [m].
        hits_to_weigh: Minimum number of hits of a landmark that affects pose and weight.
        view_range: Maximum distance of a landmark that can be missed [m].
        miss: Decrease of the score of a landmark by one miss.
        miss_weight: Decrease of the log weight by one miss.
        weight_power: Exponent of the likelihood of a scan in the weights.
        merge_gate: Maximum Mahalanobis distance of two landmarks that are merged [sigma].
    """

    use_proposal: bool
    gate: float
    distance_max: float
    hits_to_weigh: int
    view_range: float
    miss: float
    miss_weight: float
    weight_power: float
    merge_gate: float


class Near(NamedTuple):
    """Work arrays with copies of the landmarks of one particle in reach; changed rows are written back.

    Attributes:
        block, place: Block of the particle and place in it, int32, shape (L,).
        mean, covariance, hits, score, birth: As in Maps, shape (L, ...).
        seen: Whether the landmark was detected in this scan, shape (L,).
        frozen: Whether it belongs to an uncertain place, so that it does not change, shape (L,).
        changed: Whether the row differs from the map, shape (L,).
        free: Block and place of unused places, int32, shape (L, 2).
        cells: Hash grid of the landmarks known before the scan, at their positions before it.
    """

    block: Int32
    place: Int32
    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int
    seen: Bool
    frozen: Bool
    changed: Bool
    free: Int32
    cells: Cells


def near_for(landmarks: int) -> Near:
    """Return uninitialised work arrays for this number of landmarks; the hash grid is empty."""
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
        np.empty(n, np.bool_),
        np.empty((n, 2), np.int32),
        cells_for(n),
    )


@compiled
def predict(pose: Float, motion: Float, covariance: Float, noise: Float, use_proposal: bool) -> Float:
    """Return the poses after a motion, shape (P, 3). With `use_proposal` each pose is only moved, and its yaw
    is not wrapped; otherwise it is sampled from the Gaussian about the moved pose, with a yaw in [-pi, pi).

    Args:
        pose: x, y [m], yaw [rad] of each particle, shape (P, 3); unchanged.
        motion: Motion in the frame of each particle, shape (3,).
        covariance: Covariance of `motion` in the same frame, shape (3, 3).
        noise: Standard normal numbers, shape (P, 3); used only without `use_proposal`.
        use_proposal: See `Rules`.
    """
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
    places: PlaceStates,
    rules: Rules,
    near: Near,
    room: Room,
    statistics: Float,
    measured: MeasuredPose,
    births: Int,
    mu: Float,
    P: Float,
) -> None:
    """Update all particles with the detections of one scan: correct and sample poses, update, add, miss and
    merge landmarks, and weigh. All results are written into the arguments.

    Args:
        pose: Poses before the motion, shape (P, 3); become the poses after the scan.
        moved: Poses after the motion, see `predict`.
        log_weight: Log weights, shape (P,); the log likelihood of the scan and of the measured pose is added.
        maps: Maps of the particles, changed in place; the pool has the free rows that `blocks_in_reach`
            requires.
        near_blocks, near_lengths: First two results of `blocks_in_reach`.
        motion, motion_covariance: Motion since the last used scan in the frame of each particle, shapes (3,)
            and (3, 3).
        noise: Standard normal numbers, shape (P, 3).
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        clear_range: Free range per direction [m], see `FastSlam.process`.
        reach: Distance beyond which landmarks are not used [m].
        first_birth: Birth number of the first detection; a detection d without landmark begins one with the
            birth `first_birth` + d.
        places: States of the places; landmarks of inactive places are not used, and those of uncertain ones
            are not updated.
        rules: Parameters.
        near, room: Work arrays for the landmarks in reach and for pairs.
        statistics: Statistics of the scan by particle, shape (P, STATISTICS), zeros; filled.
        measured: Pose measured by another source, `z` of length 0 for none; its shared errors are updated in
            place.
        births: Birth of the landmark of each detection, int64, shape (P, D); filled.
        mu, P: Work arrays for a pose, shape (3,), and its covariance, shape (3, 3), zeros.
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
        known, free = _gather(maps, p, near_blocks, near_lengths[p], mu, reach, places, near)
        fill(near.cells, near.mean, known, scale)
        likelihood = recognise(
            mu, P, centre, R, near.mean, near.covariance, near.hits, near.cells, scale,
            rules.gate, rules.distance_max, rules.hits_to_weigh, room, statistics, p,
        )  # fmt: skip
        _shift(x, y, yaw, before_c, before_s, motion, mu, statistics, p)
        if rules.use_proposal:
            draw(mu, P, noise, p, pose)
        else:
            pose[p, 0], pose[p, 1], pose[p, 2] = mu[0], mu[1], mu[2]
        if measured.mean.shape[0] > 0:
            update_shared_errors(pose, measured, p)
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        all_near = _learn(pose, p, c, s, maps, near, known, free, room.landmark_of, centre, R, first_birth)
        missed = _miss(pose, p, c, s, near, known, clear_range, farthest, rules, statistics)
        log_weight[p] += rules.weight_power * (likelihood - rules.miss_weight * missed)
        merge_duplicates(
            near.mean, near.covariance, near.hits, near.score, near.birth, known, near.seen,
            near.frozen, rules.merge_gate, near.cells, scale,
        )  # fmt: skip
        for d in range(centre.shape[0]):
            j = room.landmark_of[d]
            births[p, d] = near.birth[j] if j >= 0 else first_birth + d
        clear(near.cells, known)
        _write_back(maps, p, near, all_near)


@compiled_borrowing
def _gather(
    maps: Maps,
    p: int,
    near_blocks: Int32,
    blocks: int,
    mu: Float,
    reach: float,
    places: PlaceStates,
    near: Near,
) -> tuple[int, int]:
    """Copy the landmarks of particle p within `reach` of the pose into `near`, except those of inactive
    places. Landmarks of uncertain places are frozen: they are neither updated nor missed nor merged.

    Args:
        maps: Maps of the particles; unchanged.
        p: Row of the particle.
        near_blocks: Blocks in reach of each particle, int32, shape (P, K).
        blocks: Number of valid entries in row p of `near_blocks`.
        mu: x, y [m], yaw [rad] of the particle, shape (3,).
        reach: Maximum distance from the pose [m].
        places: States of the places.
        near: Work arrays; filled from row 0.

    Returns:
        Number of landmarks in `near`, and number of unused places of these blocks in `near.free`.
    """
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
            state = state_of(maps.birth[b, o], places)
            if state == INACTIVE:
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
            near.seen[n], near.frozen[n], near.changed[n] = False, state != ACTIVE, False
            n += 1
    return n, free


@compiled_borrowing
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
) -> int:
    """Update the landmarks of particle p that were detected, mark them as seen, and append a new landmark for
    each detection without one; return the number of rows of `near` then.

    Frozen landmarks are unchanged. A score grows by 1 up to SCORE_MAX. A new landmark has one
    hit, the score 1 and the covariance of its detection.

    Args:
        pose: Poses after the scan, shape (P, 3).
        p: Row of the particle.
        c, s: Cosine and sine of the yaw of the particle.
        maps: Maps; `places` of the particle grows where `near.free` has no place left.
        near: Landmarks in reach; changed in place.
        known: Number of landmarks in `near`.
        free: Number of unused places in `near.free`.
        landmark_of: Row of `near` of each detection, -1 for none, int64, shape (D,).
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        first_birth: Birth number of the first detection.
    """
    n = known
    for d in range(centre.shape[0]):
        z0 = pose[p, 0] + c * centre[d, 0] - s * centre[d, 1]
        z1 = pose[p, 1] + s * centre[d, 0] + c * centre[d, 1]
        R0, R1, R2 = rotated(R, d, c, s)
        j = landmark_of[d]
        if j >= 0:
            if near.frozen[j]:
                continue
            kalman_update(near.mean, near.covariance, j, z0, z1, R0, R1, R2)
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
    """Return the square [m^2] of the distance beyond which no landmark can be missed: of the minimum of
    `view_range` and the largest free range minus BEHIND; 0 if no free range exceeds BEHIND.

    Args:
        clear_range: Free range by azimuth, shape (bins,) [m].
        view_range: Maximum range of the sensor [m].
    """
    free = 0.0
    for k in range(clear_range.shape[0]):
        if clear_range[k] - BEHIND > free:
            free = clear_range[k] - BEHIND
    return min(free * free, view_range * view_range)


@compiled_borrowing
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
    statistics: Float,
) -> float:
    """Subtract `rules.miss` from the score of each missed landmark, and set `changed`. Return the number of
    missed landmarks with at least `rules.hits_to_weigh` hits; their hits, each at most MOST_HITS, are added
    to the column MISSED of row p.

    A landmark is missed if it was not seen, is not frozen, is at most sqrt(`farthest`) away from the pose,
    and is nearer than the free range in its direction minus BEHIND.

    Args:
        pose: Poses after the scan, shape (P, 3).
        p: Row of the particle.
        c, s: Cosine and sine of the yaw of the particle.
        near: Landmarks in reach; `score` and `changed` are written.
        known: Number of landmarks that existed before the scan; they are the first rows of `near`.
        clear_range: Free range by azimuth in the base frame, shape (bins,) [m].
        farthest: Result of `_farthest_missed` [m^2]; 0 if no landmark can be missed.
        rules: Parameters.
        statistics: Statistics by particle, shape (P, STATISTICS).
    """
    missed = 0.0
    if farthest == 0.0:
        return missed
    for j in range(known):
        if near.seen[j] or near.frozen[j]:
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
                statistics[p, MISSED] += min(float(near.hits[j]), MOST_HITS)
                missed += 1.0
    return missed


@compiled_borrowing
def _write_back(maps: Maps, p: int, near: Near, all_near: int) -> None:
    """Write the changed rows of `near` to the map of particle p, in place; the place of a landmark whose
    score is not positive becomes unused (hits 0).

    Args:
        maps: Maps; a block that other particles share is copied first, and bounding boxes are extended.
        p: Row of the particle.
        near: Landmarks; rows of one block are adjacent.
        all_near: Number of rows of `near`.
    """
    k, b = -1, 0
    x_min = y_min = np.inf
    x_max = y_max = -np.inf
    for j in range(all_near):
        gone = near.score[j] <= 0.0
        if not (near.changed[j] or gone):
            continue
        if near.block[j] != k:  # rows of one block are adjacent
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


@compiled_borrowing
def _turned_covariance(covariance: Float, c: float, s: float, P: Float) -> None:
    """Write C covariance C^T into P, where C is the rotation about z by the angle with cosine c and sine s;
    both matrices have the shape (3, 3), order x, y, yaw, and must be different arrays."""
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    P[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    P[0, 1] = P[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    P[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    P[0, 2] = P[2, 0] = c * covariance[0, 2] - s * covariance[1, 2]
    P[1, 2] = P[2, 1] = s * covariance[0, 2] + c * covariance[1, 2]
    P[2, 2] = covariance[2, 2]


@compiled_borrowing
def _shift(
    x: float, y: float, yaw: float, c: float, s: float, motion: Float, mu: Float, statistics: Float, p: int
) -> None:
    """Write the SHIFT columns of row p: how far the motion by SLAM deviates from the odometry, in the frame
    of the pose before.

    Args:
        x, y, yaw: Pose before the motion [m, m, rad].
        c, s: Cosine and sine of `yaw`.
        motion: Motion by odometry, shape (3,).
        mu: Corrected pose x, y [m], yaw [rad] in the map, shape (3,).
        statistics: Statistics by particle, shape (P, STATISTICS).
        p: Row of the particle.
    """
    dx, dy = mu[0] - x, mu[1] - y
    statistics[p, SHIFT_X] = c * dx + s * dy - motion[0]
    statistics[p, SHIFT_Y] = c * dy - s * dx - motion[1]
    turn = mu[2] - yaw - motion[2]
    statistics[p, SHIFT_YAW] = turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))


def against_slip(
    pose: Float,
    maps: Maps,
    best: int,
    motion: Float,
    motion_covariance: Float,
    driven: float,
    wheels: OdometryTrust,
    centre: Float,
    R: Float,
    clear_range: Float,
    places: PlaceStates,
    rules: Rules,
) -> TreeMotion:
    """Return the motion by odometry, corrected with the map of the best particle, see `motion_by_trees`. With
    fewer than FEWEST_PAIRS detections it is the odometry. Only landmarks of active places are used. All
    arguments are unchanged.

    Args:
        pose: Poses before the motion, shape (P, 3).
        maps: Maps of the particles.
        best: Row of the best particle.
        motion, motion_covariance, centre, R, clear_range, places, rules: See `particle_update.observe`.
        driven: Path length since the last used scan [m], see `drift_variances`.
        wheels: Trust in the odometry.
    """
    if len(centre) < FEWEST_PAIRS:
        return TreeMotion(False, motion.copy(), motion_covariance.copy(), False)
    x, y, _ = moved_pose(pose[best], motion).tolist()
    known, spread, hits, birth = known_near(maps, best, x, y, rules.view_range + SEARCH)
    if len(places.state):
        active = states_of(birth, places) == ACTIVE
        known, spread, hits = known[active], spread[active], hits[active]
    return motion_by_trees(
        pose[best], motion, motion_covariance, driven, wheels, centre, R, known, spread, hits,
        rules.hits_to_weigh, rules.gate, clear_range,
    )  # fmt: skip


def use_scan(
    pose: Float,
    log_weight: Float,
    maps: Maps,
    motion: Float,
    motion_covariance: Float,
    noise: Float,
    centre: Float,
    R: Float,
    clear_range: Float,
    first_birth: int,
    places: PlaceStates,
    rules: Rules,
    measured: MeasuredPose,
) -> tuple[Maps, Float, Float, float, Int]:
    """Update poses, log weights, maps and shared errors (of `measured`) of all particles in place. Afterwards
    the maximum log weight is 0. The arguments are those of `particle_update.observe`; there may be no
    detections.

    Returns:
        Maps, grown where they had no space for new landmarks (then the arrays of the argument are stale);
        normalised weights, shape (P,); both results of `mean_statistics`; and births of the associated or new
        landmarks, int64, shape (P, D).
    """
    found = len(centre)
    farthest = math.sqrt(float((centre * centre).sum(axis=1).max(initial=0.0)))
    reach = max(rules.view_range, farthest + rules.distance_max) if found else rules.view_range
    moved = predict(pose, motion, motion_covariance, noise, rules.use_proposal)
    blocks, lengths, rows = blocks_in_reach(maps, moved, reach, found)
    maps = with_room(maps, found, rows)
    landmarks = int(lengths.max()) * ROOM + found
    near, room = near_for(landmarks), room_for(found, landmarks)
    statistics = np.zeros((len(pose), STATISTICS))
    births = np.empty((len(pose), found), np.int64)
    observe(
        pose, moved, log_weight, maps, blocks, lengths, motion, motion_covariance, noise, centre, R,
        clear_range, reach, first_birth, places, rules, near, room, statistics, measured, births, np.empty(3),
        np.zeros((3, 3)),
    )  # fmt: skip
    log_weight -= log_weight.max()
    weights = normalised(log_weight)
    mean, odometry = mean_statistics(statistics, weights, motion_covariance)
    return maps, weights, mean, odometry, births


@compiled
def estimated(
    pose: Float, weights: Float, motion: Float, motion_covariance: Float
) -> tuple[Float, Float, Float, float]:
    """Return the poses after a motion, shape (P, 3), their mean and covariance (see `weighted_pose`), and the
    effective number of particles, 1 / sum of squared weights; see `weighted_pose` for the arguments, except
    that `pose` contains the poses before the motion."""
    particles = moved_poses(pose, motion)
    mean, covariance = weighted_pose(particles, weights, motion, motion_covariance)
    return particles, mean, covariance, 1.0 / (weights * weights).sum()
