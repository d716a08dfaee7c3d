"""Recorded steps in one compiled loop: what `FastSlam.process` gives one by one, to the byte, without the
interpreter in between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.best_particle import are_apart, heir, leader
from pipeline.slam.fastslam import FastSlam, rules_of
from pipeline.slam.frame_uncertainty import FrameMemory
from pipeline.slam.measurement_update import against_slip, estimated, use_scan
from pipeline.slam.motion import UNKNOWN, Noise, Wheels, advanced, noise_of
from pipeline.slam.particle_maps import Maps, take_ancestors
from pipeline.slam.particle_update import Rules
from pipeline.slam.random_draws import draws
from pipeline.slam.resampling import low_variance_ancestors, normalised
from pipeline.slam.running_statistics import (
    Doubted,
    driven_alone,
    fading_distrust,
    fading_familiar,
    remembered,
)
from pipeline.slam.scan_statistics import RECOGNISED, TOLD, disagreement, scan_of
from pipeline.slam.shared_errors import Measured, nothing_measured
from pipeline.types.records import Bool, Float32, Int


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """What a filter takes in over T steps.

    Attributes:
        motion: shape (T, 3): x, y [m], yaw [rad] by the odometry from each step to the next.
        centre: Detections of all steps in the base frame, shape (N, 2) [m]; covariance: xx, xy, yy,
            shape (N, 3) [m^2]; first: shape (T + 1,): the rows of step t are first[t] to first[t + 1].
        clear_range: See FastSlam.process, one for all steps.
    """

    motion: Float
    centre: Float
    covariance: Float
    first: Int
    clear_range: Float


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """Of each step the estimate: pose, shape (T, 3), and N_eff, shape (T,)."""

    pose: Float
    n_eff: Float


def _all_draws(slam: FastSlam, first_index: int, steps: int) -> tuple[Float, Float]:
    particles = slam.parameters.particles
    noise, offset = np.empty((steps, particles, 3)), np.empty(steps)
    for t in range(steps):
        noise[t], offset[t] = draws(slam.seed, first_index + t, particles)
    return noise, offset


class _Told(NamedTuple):
    """Of each step, in this order: the estimate; whether its detections were used, and if so whether they
    put the motion right, how far it was since the last ones [m], the best particle, and what `mean_told`
    gives; the particles before resampling, and their ancestors, the first of them -1 where there was none."""

    pose: Float
    n_eff: Float
    used: Bool
    slipped: Bool
    driven: Float
    best: Int
    mean: Float
    odometry: Float
    particles: Float32
    ancestors: Int


def drive(slam: FastSlam, first_index: int, recorded: Recorded) -> Driven:
    """Take recorded steps into a filter, the first of them having this number; its state is then that after
    the last one, but for the memory of the frame (see FrameMemory), which begins anew: no covariance in the
    frame of the map is told of these steps."""
    p, state = slam.parameters, slam.state.with_particles(slam.parameters.particles)
    maps, motion, motion_covariance, since_update, told = _drive(
        state.pose, state.log_weight, state.maps, state.motion, state.motion_covariance,
        state.since_update, state.detections, state.best, state.recent.distrust, state.recent.alone,
        state.recent.familiar,
        *_all_draws(slam, first_index, len(recorded.motion)), first_index, recorded.motion,
        recorded.centre, recorded.covariance, recorded.first, recorded.clear_range,
        rules_of(p), noise_of(p), p.update_distance, p.resample_below, nothing_measured(),
    )  # fmt: skip
    recent, best, shared, scans = state.recent, state.best, state.shared, []
    found = np.diff(recorded.first)
    for t in range(len(recorded.motion)):
        if told.used[t]:
            before = replace(recent, distrust=1.0) if told.slipped[t] else recent
            scan = scan_of(told.mean[t], told.odometry[t], int(found[t]))
            doubted = Doubted(False, bool(told.slipped[t]) or recent.slipped)
            recent = remembered(before, scan, told.driven[t], doubted)
        ancestors, best = told.ancestors[t] if told.ancestors[t, 0] >= 0 else None, int(told.best[t])
        shared = shared if ancestors is None else shared.drawn(ancestors)
        scans.append((told.particles[t], ancestors, best))
    slam.state = replace(
        state, maps=maps, motion=motion, motion_covariance=motion_covariance, since_update=since_update,
        detections=state.detections + int(found[told.used].sum()), best=best, recent=recent,
        genealogy=state.genealogy.with_scans(scans), frame=FrameMemory(), shared=shared,
    )  # fmt: skip
    return Driven(told.pose, told.n_eff)


@compiled
def _drive(
    pose: Float,
    log_weight: Float,
    maps: Maps,
    motion: Float,
    motion_covariance: Float,
    since_update: float,
    detections: int,
    best: int,
    distrust: float,
    alone: float,
    familiar: float,
    normal: Float,
    offset: Float,
    first_index: int,
    steps: Float,
    centres: Float,
    covariances: Float,
    first: Int,
    clear_range: Float,
    rules: Rules,
    noise: Noise,
    update_distance: float,
    resample_below: float,
    measured: Measured,
) -> tuple[Maps, Float, Float, float, _Told]:
    """See `drive`; `pose` and `log_weight` are changed in place."""
    particles, n = pose.shape[0], steps.shape[0]
    told = _room(n, particles)
    for t in range(n):
        _moved, motion, motion_covariance, driven = advanced(
            motion, motion_covariance, steps[t, 0], steps[t, 1], steps[t, 2], 0.0, 0.0, UNKNOWN, False,
            distrust, noise, update_distance,
        )  # fmt: skip
        since_update += driven
        centre, R = centres[first[t] : first[t + 1]], covariances[first[t] : first[t + 1]]
        by_trees = against_slip(
            pose, maps, best, motion, motion_covariance, since_update,
            Wheels(noise, distrust, alone, familiar), centre, R, rules,
        )  # fmt: skip
        used = first_index + t == 0 or since_update >= update_distance or by_trees.slipped
        if used:
            told.slipped[t] = by_trees.slipped
            away = disagreement(by_trees.motion, motion, motion_covariance)
            motion, motion_covariance = by_trees.motion, by_trees.covariance
            if by_trees.slipped:
                distrust = 1.0
            maps, weights, mean, odometry = use_scan(
                pose, log_weight, maps, motion, motion_covariance, normal[t], centre, R, clear_range,
                detections, rules, measured,
            )  # fmt: skip
            told.used[t], told.driven[t] = True, since_update
            best = leader(weights, best, pose, rules.distance_max)
            if by_trees.slipped:
                odometry = away
            told.mean[t], told.odometry[t] = mean, odometry
            distrust = fading_distrust(distrust)
            alone = driven_alone(alone, mean[RECOGNISED], since_update)
            familiar = fading_familiar(familiar, mean[RECOGNISED], centre.shape[0])
            detections += centre.shape[0]
            motion, motion_covariance, since_update = np.zeros(3), np.zeros((3, 3)), 0.0
        else:
            weights = normalised(log_weight)
        now, told.pose[t], _spread, told.n_eff[t] = estimated(pose, weights, motion, motion_covariance)
        told.particles[t] = now
        if are_apart(now, weights, rules.distance_max):
            told.pose[t] = now[best]
        if used and told.n_eff[t] < resample_below * particles:
            told.ancestors[t] = low_variance_ancestors(weights, offset[t])
            take_ancestors(told.ancestors[t], pose, maps)
            best = heir(best, told.ancestors[t], weights)
            log_weight[:] = 0.0
        told.best[t] = best
    return maps, motion, motion_covariance, since_update, told


@compiled
def _room(n: int, particles: int) -> _Told:
    return _Told(
        np.empty((n, 3)),
        np.empty(n),
        np.zeros(n, np.bool_),
        np.zeros(n, np.bool_),
        np.zeros(n),
        np.zeros(n, np.int64),
        np.zeros((n, TOLD)),
        np.zeros(n),
        np.empty((n, particles, 3), np.float32),
        np.full((n, particles), -1),
    )
