"""One scan in compiled code: poses, weights and maps of all particles, and the estimate of the pose."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.gaussian import draw
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.candidate_pairs import candidate_pairs, relative_positions, rotated_rows
from pipeline.slam.landmarks import clean, decide, update_existence, update_positions
from pipeline.slam.motion import OdometryTrust, moved_pose, moved_poses, weighted_pose
from pipeline.slam.particle_maps import ROOM, Maps, slots_near, with_room
from pipeline.slam.particle_update import (
    STATISTICS,
    Rules,
    choose_clear_pairs,
    gains_for,
    scan_for,
    update_particle,
)
from pipeline.slam.resampling import normalised
from pipeline.slam.rigid_shift_test import FEWEST as FEWEST_PAIRS
from pipeline.slam.scan_statistics import disagreement
from pipeline.slam.shared_errors import MeasuredPose, correct_by_measured, update_shared_errors
from pipeline.slam.slip_detection import SEARCH, TreeMotion, motion_by_trees
from pipeline.types.records import Int

FOUND, MISSED, ODOMETRY = STATISTICS, STATISTICS + 1, STATISTICS + 2


@compiled
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
    rules: Rules,
) -> TreeMotion:
    """Return what the scan says of the motion, by the map of one particle: see `motion_by_trees`.

    Args:
        pose: shape (P, 3) before the motion; maps: of the particles; best: the particle.
        motion, motion_covariance, centre, R, rules: See `use_scan`.
        driven, wheels: How far the odometry may be wrong, see drift_variances.
    """
    if centre.shape[0] < FEWEST_PAIRS:
        return TreeMotion(False, motion.copy(), motion_covariance.copy(), False)
    at = moved_pose(pose[best], motion)
    slots, known = slots_near(maps, best, at[0], at[1], rules.view_range + SEARCH)
    return motion_by_trees(
        pose[best], motion, motion_covariance, driven, wheels, centre, R, known, maps.covariance[slots],
        maps.hits[slots], rules.hits_to_weigh, rules.gate,
    )  # fmt: skip


@compiled
def use_scan(
    pose: Float,
    log_weight: Float,
    maps: Maps,
    best: int,
    motion: Float,
    motion_covariance: Float,
    noise: Float,
    centre: Float,
    R: Float,
    clear_range: Float,
    first_birth: int,
    rules: Rules,
    measured: MeasuredPose,
) -> tuple[Maps, Float, Float, Int]:
    """Update poses, weights and maps of all particles in place.

    Args:
        pose: Before the motion, shape (P, 3), becomes the pose after the scan.
        log_weight: shape (P,).
        maps: Maps.
        best: The particle whose map decides which landmarks are near and missed.
        motion, motion_covariance: Since the last scan that was used, in the frame of each particle.
        noise: Standard normal numbers, shape (P, 3).
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariances xx, xy, yy, (D, 3).
        clear_range: Free range by direction [m], see FastSlam.process.
        first_birth: Serial number of the first detection.
        rules: Parameters.
        measured: The pose by another source; what its poses share is learned.

    Returns:
        The maps, in which room was made; the weights, shape (P,); statistics of the scan, means over the
        particles; and the birth of the landmark of each detection, shape (D,).
    """
    P, D = len(pose), len(centre)
    moved, Q = _moved(pose, log_weight, motion, motion_covariance, noise, rules.use_proposal, measured, best)
    reach = rules.view_range
    for d in range(D):
        reach = max(reach, np.hypot(centre[d, 0], centre[d, 1]) + rules.distance_max)
    slots, _ = slots_near(maps, best, moved[best, 0], moved[best, 1], reach)
    relative, apart = relative_positions(maps, slots, moved, best)
    covariance = rotated_rows(maps.covariance[slots], -moved[best, 2])
    well_known = maps.hits[slots] >= rules.hits_to_weigh
    pairs = candidate_pairs(centre, R, relative[best], apart, covariance, well_known, Q, rules.distance_max)
    scan = scan_for(centre, R, Q, covariance, well_known.astype(np.int32), len(pairs.row), len(slots))
    gains = gains_for(D)
    pair_of, statistics, after = np.empty((P, D), np.int64), np.empty((P, STATISTICS)), moved.copy()
    choose_clear_pairs(best, relative[best], scan, pairs, rules, pair_of)
    scan.order[:] = np.argsort(scan.best)
    for turn in range(-1, P):  # the best particle first: its gains serve all that associate alike
        p = best if turn < 0 else turn
        if turn == best:
            continue
        likelihood = update_particle(
            p, after, relative[p], scan, pairs, rules, noise, gains, turn < 0, pair_of, statistics
        )
        log_weight[p] += rules.weight_power * likelihood
        if measured.mean.shape[0] > 0:
            update_shared_errors(after, measured, p)
    log_weight -= log_weight.max()
    weights = normalised(log_weight)

    decided = decide(pair_of, weights, pairs)
    maps = with_room(maps, D, P * (len(np.unique(slots // ROOM)) + D))
    births, begun, seen, found, missed = update_existence(
        maps, slots, pairs, decided, _relative_to(maps, slots, after, best), clear_range, first_birth, rules
    )
    update_positions(
        maps,
        slots,
        pairs,
        pair_of,
        decided,
        after,
        centre,
        rotated_rows(R, after[best, 2]),
        rules.looks,
        begun,
    )
    clean(maps, slots, seen, _positions(maps, slots, best), rules.merge_gate)

    mean, shift = np.zeros(STATISTICS + 3), np.zeros(3)
    for p in range(P):
        for a in range(STATISTICS):
            mean[a] += weights[p] * statistics[p, a]
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        dx, dy = after[p, 0] - pose[p, 0], after[p, 1] - pose[p, 1]
        turn = after[p, 2] - pose[p, 2] - motion[2]
        shift[0] += weights[p] * (c * dx + s * dy)
        shift[1] += weights[p] * (c * dy - s * dx)
        shift[2] += weights[p] * (turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi)))
    shift[2] += motion[2]
    mean[FOUND], mean[MISSED] = found, missed
    mean[ODOMETRY] = disagreement(shift, motion, motion_covariance)
    pose[:] = after
    return maps, weights, mean, births


@compiled
def _moved(
    pose: Float, log_weight: Float, motion: Float, covariance: Float, noise: Float, use_proposal: bool,
    measured: MeasuredPose, best: int,
) -> tuple[Float, Float]:  # fmt: skip
    """Return the poses after the motion and a measured pose, shape (P, 3), and the covariance that is left in
    the body frame, shape (3, 3): none where the poses are drawn."""
    moved, mu = moved_poses(pose, motion), np.empty(3)
    Q = np.zeros((3, 3))
    if use_proposal:
        Q = _turned(covariance, -motion[2])
    else:
        for p in range(len(pose)):
            draw(moved[p], _turned(covariance, pose[p, 2]), noise, p, moved)
    if measured.z.shape[0] > 0:
        left = Q
        for p in range(len(pose)):
            yaw = moved[p, 2]
            one = _turned(Q, yaw)
            mu[:] = moved[p]
            log_weight[p] += correct_by_measured(mu, one, measured, p)
            moved[p] = mu
            if p == best:
                left = _turned(one, -yaw)
        Q = left
    return moved, Q


@compiled
def _turned(covariance: Float, angle: float) -> Float:
    """Return the covariance of a pose, shape (3, 3), rotated by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    P = covariance.copy()
    P[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    P[0, 1] = P[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    P[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    P[0, 2] = P[2, 0] = c * covariance[0, 2] - s * covariance[1, 2]
    P[1, 2] = P[2, 1] = s * covariance[0, 2] + c * covariance[1, 2]
    return P


@compiled
def _positions(maps: Maps, slots: Int, p: int) -> Float:
    """Return the positions of some landmarks by one particle, shape (L, 2) [m]."""
    position = np.empty((len(slots), 2))
    for n in range(len(slots)):
        b, o = maps.block[p, slots[n] // ROOM], slots[n] % ROOM
        position[n, 0], position[n, 1] = maps.mean[b, o, 0], maps.mean[b, o, 1]
    return position


@compiled
def _relative_to(maps: Maps, slots: Int, pose: Float, p: int) -> Float:
    """Return some landmarks in the body frame of one particle, shape (L, 2) [m]."""
    position = _positions(maps, slots, p)
    c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
    for n in range(len(slots)):
        dx, dy = position[n, 0] - pose[p, 0], position[n, 1] - pose[p, 1]
        position[n, 0], position[n, 1] = c * dx + s * dy, c * dy - s * dx
    return position


@compiled
def estimated(
    pose: Float, weights: Float, motion: Float, motion_covariance: Float
) -> tuple[Float, Float, Float, float]:
    """Return the particles now, shape (P, 3), their mean and covariance (see `weighted_pose`), and N_eff."""
    particles = moved_poses(pose, motion)
    mean, covariance = weighted_pose(particles, weights, motion, motion_covariance)
    return particles, mean, covariance, 1.0 / (weights * weights).sum()
