"""Wheels that slip or are stuck, an odometry that jumped: how far the robot really moved, told by the trees.

Where all trees lie off alike by a little, that is the motion that the odometry does not tell of (see
`together`). Where a scan contradicts the map, the offset is sought that brings most detections onto known
landmarks: the filter's own gates are far too narrow for it, and would begin all trees again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import Wheels, away_from_trees, moved_pose
from pipeline.slam.rigid_shift_test import STANDING, moved_together
from pipeline.types.records import Int32

SEARCH = 8.0  # m around where the odometry has the robot
TURNS = np.radians(np.arange(-12.0, 12.5, 2.0))
NEAR = 0.3  # m, added to the error of a detection that lies off by half a step of TURNS
FEWEST = 6  # detections; in a park three fit somewhere by chance, and throw a good pose away
EXPLAINED = 0.4  # of the detections on known landmarks contradict nothing
CONVINCING = 0.7  # of the detections must lie on landmarks after the offset
MARGIN = 2  # detections more than at any other place
SIGMA = np.array([0.15, 0.15, np.radians(1.5)])  # of the offset that is found: m, m, rad
FITTED = np.array([0.05, 0.05, np.radians(0.5)])  # the same of the least squares, and
OWN = 2.0  # times their own sigma: the filter takes in the scan that told them once more
WIDE = 0.5  # m; with so unsure a motion trees are mixed up
STOOD = (0.005, 0.002)  # m, rad; an odometry that moves less since a scan says that the robot stands
STUCK = "the odometry says that the robot stands, but the trees go by: it is stuck, and the trees lead"
UNSURE = "a few known trees go by, and the odometry passes none: it is wrong, or people walk there; it leads"
SLIPPED = "the trees contradict the odometry (wheels that slip, or a jump): the trees lead"


class ByTrees(NamedTuple):
    """What a scan tells of the motion.

    Attributes:
        slipped: Whether the trees say that it was another one.
        motion: Then that one, else as it was, shape (3,); covariance: of it, shape (3, 3).
        unsure: Whether they say so, but are so few that they may as well be people who walk off.
    """

    slipped: bool
    motion: Float
    covariance: Float
    unsure: bool


def why(motion: Float, corrected: bool, unsure: bool) -> str:
    """Why a motion of the odometry, shape (3,), is not believed, for people; empty when it is. `corrected`:
    the trees have, in this scan or one of the last ones; unsure: see ByTrees."""
    stood = np.hypot(motion[0], motion[1]) < STOOD[0] and abs(motion[2]) < STOOD[1]
    if corrected:
        return STUCK if stood else SLIPPED
    return UNSURE if unsure else ""


@compiled
def motion_by_trees(
    before: Float,
    motion: Float,
    covariance: Float,
    driven: float,
    wheels: Wheels,
    centre: Float,
    R: Float,
    known: Float,
    spread: Float,
    hits_of: Int32,
    hits_to_weigh: int,
    gate: float,
) -> ByTrees:
    """What a scan tells of the motion.

    Args:
        before: x, y [m], yaw [rad] in the frame of the map.
        motion: By the odometry since then, shape (3,); covariance: shape (3, 3); driven: see away_from_trees.
        wheels: How it errs if it is right: what is added where it is doubted does not count here, for it is
            contradicted still.
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariance xx, xy, yy, (D, 3).
        known: Landmarks within SEARCH of what the robot can see, shape (L, 2) [m]; spread: their covariance
            xx, xy, yy, shape (L, 3) [m^2]; hits_of: shape (L,).
        hits_to_weigh: With fewer a landmark is not well known.
        gate: [sigma].
    """
    pose = moved_pose(before, motion)
    position, heading = away_from_trees(motion, driven, wheels)
    well_known = hits_of >= hits_to_weigh
    sure, unsure, place, fitted = moved_together(
        pose, position, heading, wheels, centre, R, known, spread, well_known
    )
    if sure:
        told = np.zeros((3, 3))
        told[0, 0] = told[1, 1] = FITTED[0] ** 2 + OWN * OWN * max(fitted[0, 0], fitted[1, 1])
        told[2, 2] = FITTED[2] ** 2 + OWN * OWN * fitted[2, 2]
        return ByTrees(True, _from(before, place), told, False)
    well = known[well_known]
    sigma = np.sqrt(0.5 * (R[:, 0] + R[:, 2]))
    hits, expected, by_chance = explained(pose, centre, sigma, well, position, heading, gate)
    told = np.zeros((3, 3))
    told[0, 0], told[1, 1], told[2, 2] = position, position, heading
    for i in range(3):
        told[i, i] += SIGMA[i] ** 2
    if expected < FEWEST or hits >= EXPLAINED * expected:
        wide = covariance[0, 0] + covariance[1, 1] > 2.0 * WIDE * WIDE
        if wide and expected >= FEWEST and hits >= CONVINCING * expected:
            return ByTrees(False, motion.copy(), told, unsure)  # what was feared did not happen
        return ByTrees(False, motion.copy(), covariance.copy(), unsure)
    agree, sure, place = offset(pose, centre, sigma, well)
    if not sure or hits > by_chance + agree // STANDING:
        return ByTrees(False, motion.copy(), covariance.copy(), unsure)
    return ByTrees(True, _from(before, place), told, False)


@compiled
def _from(before: Float, place: Float) -> Float:
    """The motion from a pose to a place, shape (3,)."""
    c, s = np.cos(before[2]), np.sin(before[2])
    dx, dy = place[0] - before[0], place[1] - before[1]
    turn = (place[2] - before[2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.array([c * dx + s * dy, c * dy - s * dx, turn])


@compiled
def explained(
    pose: Float,
    centre: Float,
    sigma: Float,
    landmarks: Float,
    position: float,
    heading: float,
    gate: float,
) -> tuple[int, int, float]:
    """How many detections lie where a landmark is; how many of them should: as many as landmarks stand within
    their reach; and how many would if they stood anywhere in it. Where most of many do not, the scan
    contradicts the map.

    Args:
        pose: x, y [m], yaw [rad] by the odometry.
        centre: Detections, base frame, shape (D, 2) [m]; sigma: of each one [m].
        landmarks: Well known ones near by, shape (L, 2) [m].
        position: Variance of x and of y of the pose [m^2]; heading: of its yaw [rad^2].
        gate: [sigma].
    """
    found = centre.shape[0]
    if found < FEWEST or landmarks.shape[0] < FEWEST:
        return 0, 0, 0.0
    reach2, hits, expected, covered = 0.0, 0, 0, 0.0
    for d in range(found):
        square = centre[d, 0] ** 2 + centre[d, 1] ** 2
        reach2 = max(reach2, square)
        wide = gate * np.sqrt(sigma[d] ** 2 + 2.0 * position + square * heading)
        hits += _on_landmark(pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]), centre, d, landmarks, wide)
        covered += wide * wide
    for j in range(landmarks.shape[0]):
        dx, dy = landmarks[j, 0] - pose[0], landmarks[j, 1] - pose[1]
        expected += dx * dx + dy * dy < reach2
    return hits, min(found, expected), covered * expected / reach2


@compiled
def offset(pose: Float, centre: Float, sigma: Float, landmarks: Float) -> tuple[int, bool, Float]:
    """Where the robot is instead: how many detections lie on landmarks there, whether that is certain, and
    x, y [m], yaw [rad], shape (3,)."""
    found = centre.shape[0]
    best, second = 0, 0
    place = pose.copy()
    step = 0.5
    side = int(2 * SEARCH / step) + 3
    counts = np.zeros((side, side), np.int64)
    at = np.empty(2)
    for t in range(TURNS.shape[0]):
        yaw = pose[2] + TURNS[t]
        c, s = np.cos(yaw), np.sin(yaw)
        counts[:] = 0
        for d in range(found):
            wx, wy = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
            for j in range(landmarks.shape[0]):
                at[0], at[1] = landmarks[j, 0] - wx, landmarks[j, 1] - wy
                dx, dy = at[0] - pose[0], at[1] - pose[1]
                if dx * dx + dy * dy > SEARCH * SEARCH:
                    continue
                u, v = int((dx + SEARCH) / step), int((dy + SEARCH) / step)
                counts[u, v] += 1
                if counts[u, v] * 2 < best:  # neighbouring cells share what lies at their border
                    continue
                hits = 0
                for k in range(found):
                    hits += _on_landmark(at[0], at[1], c, s, centre, k, landmarks, NEAR + 2.0 * sigma[k])
                away = (at[0] - place[0]) ** 2 + (at[1] - place[1]) ** 2
                if hits > best:
                    if away > 1.0:
                        second = best
                    best = hits
                    place[0], place[1], place[2] = at[0], at[1], yaw
                elif hits > second and away > 1.0:
                    second = hits
    sure = best >= FEWEST and best >= CONVINCING * found and best >= second + MARGIN
    return best, sure, place


@compiled
def _on_landmark(
    x: float, y: float, c: float, s: float, centre: Float, d: int, landmarks: Float, reach: float
) -> int:
    wx = x + c * centre[d, 0] - s * centre[d, 1]
    wy = y + s * centre[d, 0] + c * centre[d, 1]
    for j in range(landmarks.shape[0]):
        dx, dy = landmarks[j, 0] - wx, landmarks[j, 1] - wy
        if dx * dx + dy * dy < reach * reach:
            return 1
    return 0
