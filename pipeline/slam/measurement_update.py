"""Measurement update of all particles with one scan, and the estimate of the pose, in compiled code."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.measured_pose import MeasuredPose
from pipeline.slam.motion import OdometryTrust, moved_pose, moved_poses, weighted_pose
from pipeline.slam.particle_maps import ROOM, Maps, blocks_in_reach, known_near, with_room
from pipeline.slam.particle_update import Rules, near_for, observe, predict
from pipeline.slam.places import INACTIVE, PlaceStates, state_of
from pipeline.slam.pose_quality import STATISTICS, mean_statistics
from pipeline.slam.proposal import room_for
from pipeline.slam.resampling import normalised
from pipeline.slam.rigid_shift_test import FEWEST as FEWEST_PAIRS
from pipeline.slam.slip_detection import SEARCH, TreeMotion, motion_by_trees
from pipeline.types.records import Int


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
    clear_range: Float,
    places: PlaceStates,
    rules: Rules,
) -> TreeMotion:
    """Return the motion by odometry, corrected with the map of the best particle, see `motion_by_trees`. With
    fewer than FEWEST_PAIRS detections it is the odometry. Landmarks of inactive places are not used. All
    arguments are unchanged.

    Args:
        pose: Poses before the motion, shape (P, 3).
        maps: Maps of the particles.
        best: Row of the best particle.
        motion, motion_covariance, centre, R, clear_range, places, rules: See `particle_update.observe`.
        driven: Path length since the last used scan [m], see `drift_variances`.
        wheels: Trust in the odometry.
    """
    if centre.shape[0] < FEWEST_PAIRS:
        return TreeMotion(False, motion.copy(), motion_covariance.copy(), False)
    at = moved_pose(pose[best], motion)
    known, spread, hits, birth = known_near(maps, best, at[0], at[1], rules.view_range + SEARCH)
    if places.state.shape[0]:
        active = np.array([state_of(b, places) != INACTIVE for b in birth], np.bool_)
        known, spread, hits = known[active], spread[active], hits[active]
    return motion_by_trees(
        pose[best], motion, motion_covariance, driven, wheels, centre, R, known, spread, hits,
        rules.hits_to_weigh, rules.gate, clear_range,
    )  # fmt: skip


@compiled
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
    """Update poses, log weights and maps of all particles in place; the greatest log weight is 0 then.

    The arguments are those of `particle_update.observe`; there may be no detections.

    Returns:
        Maps, grown where they had no space for new landmarks (then the arrays of the argument are stale);
        normalised weights, shape (P,); both results of `mean_statistics`; and births of the associated or new
        landmarks, int64, shape (P, D).
    """
    found = centre.shape[0]
    reach = 0.0
    for d in range(found):
        reach = max(reach, centre[d, 0] * centre[d, 0] + centre[d, 1] * centre[d, 1])
    reach = max(rules.view_range, np.sqrt(reach) + rules.distance_max) if found else rules.view_range
    moved = predict(pose, motion, motion_covariance, noise, rules.use_proposal)
    blocks, lengths, rows = blocks_in_reach(maps, moved, reach, found)
    maps = with_room(maps, found, rows)
    landmarks = lengths.max() * ROOM + found
    near, room = near_for(landmarks), room_for(found, landmarks)
    statistics = np.zeros((pose.shape[0], STATISTICS))
    births = np.empty((pose.shape[0], found), np.int64)
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
