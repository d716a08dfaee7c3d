"""Wheels that slipped, an odometry that jumped: how far the robot really moved, told by the trees.

Asked only where a scan contradicts the map: then the offset is sought that brings most detections onto
known landmarks. The filter's own gates are far too narrow for it, and would begin all trees again.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.slam.motion import moved_pose

SEARCH = 8.0  # m around where the odometry has the robot
TURNS = np.radians(np.arange(-12.0, 12.5, 2.0))
NEAR = 0.3  # m, added to the error of a detection that lies off by half a step of TURNS
FEWEST = 6  # detections; in a park three fit somewhere by chance, and throw a good pose away
EXPLAINED = 0.4  # of the detections on known landmarks contradict nothing
CONVINCING = 0.7  # of the detections must lie on landmarks after the offset
MARGIN = 2  # detections more than at any other place
SIGMA = np.array([0.15, 0.15, np.radians(1.5)])  # of the offset that is found: m, m, rad


@compiled
def motion_by_trees(
    before: Float,
    motion: Float,
    covariance: Float,
    centre: Float,
    R: Float,
    known: Float,
    gate: float,
) -> tuple[bool, Float]:
    """Whether the scan says how the robot really moved, and that motion, shape (3,); not where it
    contradicts nothing or tells nothing.

    Args:
        before: x, y [m], yaw [rad] in the frame of the map.
        motion: By the odometry since then, shape (3,); covariance: shape (3, 3).
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariance xx, xy, yy, (D, 3).
        known: Well known landmarks within SEARCH of what the robot can see, shape (L, 2) [m].
        gate: [sigma].
    """
    sigma = np.sqrt(0.5 * (R[:, 0] + R[:, 2]))
    spread = np.empty(3)
    for i in range(3):
        spread[i] = np.sqrt(max(covariance[i, i], 0.0))
    pose = moved_pose(before, motion)
    if not contradicts(pose, centre, sigma, known, spread, gate):
        return False, motion.copy()
    sure, place = offset(pose, centre, sigma, known)
    if not sure:
        return False, motion.copy()
    c, s = np.cos(before[2]), np.sin(before[2])
    dx, dy = place[0] - before[0], place[1] - before[1]
    turn = (place[2] - before[2] + np.pi) % (2.0 * np.pi) - np.pi
    return True, np.array([c * dx + s * dy, c * dy - s * dx, turn])


@compiled
def contradicts(
    pose: Float, centre: Float, sigma: Float, landmarks: Float, spread: Float, gate: float
) -> bool:
    """Whether most detections lie where no landmark is, though landmarks stand within their reach.

    Args:
        pose: x, y [m], yaw [rad] by the odometry.
        centre: Detections, base frame, shape (D, 2) [m]; sigma: of each one [m].
        landmarks: Well known ones near by, shape (L, 2) [m].
        spread: Standard deviations of x, y [m] and yaw [rad] of the pose.
        gate: [sigma].
    """
    found = centre.shape[0]
    if found < FEWEST or landmarks.shape[0] < FEWEST:
        return False
    reach2, hits, expected = 0.0, 0, 0
    for d in range(found):
        square = centre[d, 0] ** 2 + centre[d, 1] ** 2
        reach2 = max(reach2, square)
        wide = gate * np.sqrt(sigma[d] ** 2 + spread[0] ** 2 + spread[1] ** 2 + square * spread[2] ** 2)
        hits += _on_landmark(pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]), centre, d, landmarks, wide)
    for j in range(landmarks.shape[0]):
        dx, dy = landmarks[j, 0] - pose[0], landmarks[j, 1] - pose[1]
        expected += dx * dx + dy * dy < reach2
    return expected >= FEWEST and hits < EXPLAINED * min(found, expected)


@compiled
def offset(pose: Float, centre: Float, sigma: Float, landmarks: Float) -> tuple[bool, Float]:
    """Where the robot is instead: x, y [m], yaw [rad], shape (3,), and whether that is certain."""
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
    return sure, place


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
