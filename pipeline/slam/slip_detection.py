"""Motion of the robot from trees, where the wheels slip or are stuck or the odometry jumps.

Small errors are found by a rigid shift of all detections (`rigid_shift_test`). Where a scan contradicts the
map entirely, the pose offset is searched that brings most detections onto known landmarks: the gates of the
filter are too narrow for it, and the filter would begin all trees a second time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import OdometryTrust, drift_variances, moved_pose, wrapped
from pipeline.slam.rigid_shift_test import STANDING, estimate_rigid_shift
from pipeline.types.records import Int32

SEARCH = 8.0  # m; radius of the search around the pose by odometry
TURNS = np.radians(np.arange(-12.0, 12.5, 2.0))  # rad; searched headings relative to the odometry
NEAR = 0.3  # m; added to two sigma of a detection: half a step of TURNS at a distance of 15 m
FEWEST = 6  # minimum number of detections and landmarks; in a park, three fit somewhere by chance
EXPLAINED = 0.4  # share of the expected matches from which a scan does not contradict the map
CONVINCING = 0.7  # share of the detections that must match after the offset
MARGIN = 2  # matches more than at any other offset
SIGMA = np.array([0.15, 0.15, np.radians(1.5)])  # m, m, rad; of an offset found by the search
FITTED = np.array([0.05, 0.05, np.radians(0.5)])  # m, m, rad; systematic part of a rigid shift
OWN = 2.0  # factor on the sigmas of the fit of a rigid shift, since the filter uses the same scan again
WIDE = 0.5  # m; sigma of a motion from which detections are associated with wrong trees
STOOD = (0.005, 0.002)  # m, rad; an odometry that moves less between two scans reports standstill
STUCK = "the odometry reports standstill, but the trees move: it is stuck, and the trees determine the motion"
UNSURE = "a few known trees move against the odometry: it is wrong, or they are people; it is used"
SLIPPED = "the trees contradict the odometry (slip, drift or a jump): the trees determine the motion"
MISREGISTERED = (
    "the trees contradict the LiDAR odometry (drift, or something that moves with the robot): the trees "
    "determine the motion"
)


class TreeMotion(NamedTuple):
    """Motion by odometry, corrected by trees where they contradict it.

    Attributes:
        slipped: Whether the trees contradict the odometry; `motion` is then that of the trees.
        motion: x, y [m], yaw [rad] since the last used scan, shape (3,).
        covariance: Covariance of `motion`, shape (3, 3).
        unsure: Whether trees contradict the odometry that are too few to be distinguished from walking
            people; `motion` is then that of the odometry.
    """

    slipped: bool
    motion: Float
    covariance: Float
    unsure: bool


def slip_message(motion: Float, corrected: bool, unsure: bool, registered: bool = False) -> str:
    """Return the message why the odometry is doubted: MISREGISTERED for LiDAR odometry, STUCK, SLIPPED or
    UNSURE; empty if there is no doubt.

    Args:
        motion: Motion by the odometry since the last used scan, shape (3,).
        corrected: Whether trees contradicted the odometry in this scan or in one of the last scans.
        unsure: See TreeMotion.
        registered: Whether the motion is that of LiDAR odometry.
    """
    if corrected and registered:
        return MISREGISTERED
    if corrected:
        stood = np.hypot(motion[0], motion[1]) < STOOD[0] and abs(motion[2]) < STOOD[1]
        return STUCK if stood else SLIPPED
    return UNSURE if unsure else ""


def motion_by_trees(
    before: Float,
    motion: Float,
    covariance: Float,
    driven: float,
    trust: OdometryTrust,
    centre: Float,
    R: Float,
    known: Float,
    spread: Float,
    hits_of: Int32,
    hits_to_weigh: int,
    gate: float,
    clear_range: Float,
) -> TreeMotion:
    """Return the motion since the last used scan, from trees where they contradict the odometry.

    If neither the rigid shift nor the search contradicts the odometry, or the search is ambiguous, the result
    is `motion` with `covariance`. If `covariance` is large (WIDE) and most detections match landmarks at the
    pose by odometry, the covariance is reduced to that of an undisturbed odometry.

    Args:
        before: x, y [m], yaw [rad] in the frame of the map at the last used scan, shape (3,).
        motion: Motion by the odometry since then, shape (3,).
        covariance: Covariance of the motion with all doubts, shape (3, 3).
        driven: Path length since then [m], see `drift_variances`.
        trust: Trust in the odometry. Its noise excludes doubts, since the test assumes an undisturbed
            odometry.
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        known: Landmarks within the view plus SEARCH, in the frame of the map, shape (L, 2) [m].
        spread: Covariances xx, xy, yy of the landmarks, shape (L, 3) [m^2].
        hits_of: Hits of the landmarks, shape (L,).
        hits_to_weigh: Minimum number of hits of a landmark that counts as well known.
        gate: Association gate [sigma].
        clear_range: Free distance by azimuth in the base frame, shape (bins,) [m].
    """
    pose = moved_pose(before, motion)
    position, heading = drift_variances(motion, driven, trust)
    well_known = hits_of >= hits_to_weigh
    sure, unsure, place, fitted = estimate_rigid_shift(
        pose, position, heading, trust, centre, R, known, spread, well_known, clear_range
    )
    if sure:
        xx, yy, tt = np.diag(fitted).tolist()
        reduced = np.diag(FITTED**2 + OWN * OWN * np.array([max(xx, yy), max(xx, yy), tt]))
        return TreeMotion(True, _from(before, place), reduced, False)
    well = known[well_known]
    sigma = np.sqrt(0.5 * (R[:, 0] + R[:, 2]))
    hits, expected, by_chance = count_matches(pose, centre, sigma, well, position, heading, gate)
    variances = np.array([position, position, heading])
    if expected < FEWEST or hits >= EXPLAINED * expected:
        wide = covariance[0, 0] + covariance[1, 1] > 2.0 * WIDE * WIDE
        if wide and expected >= FEWEST and hits >= CONVINCING * expected:
            # the doubt is refuted
            return TreeMotion(False, motion.copy(), np.diag(variances + SIGMA**2), unsure)
        return TreeMotion(False, motion.copy(), covariance.copy(), unsure)
    agree, sure, place = search_offset(pose, centre, sigma, well)
    if not sure or hits > by_chance + agree // STANDING:
        return TreeMotion(False, motion.copy(), covariance.copy(), unsure)
    return TreeMotion(True, _from(before, place), np.diag(variances + SIGMA**2), False)


def _from(before: Float, place: Float) -> Float:
    """Return the pose `place` relative to the pose `before`: x, y [m], yaw [rad], wrapped, shape (3,). Both
    poses are x, y [m], yaw [rad] in the map."""
    c, s = math.cos(before[2]), math.sin(before[2])
    dx, dy, turn = (place - before).tolist()
    return np.array([c * dx + s * dy, c * dy - s * dx, wrapped(turn)])


@compiled
def count_matches(
    pose: Float,
    centre: Float,
    sigma: Float,
    landmarks: Float,
    position: float,
    heading: float,
    gate: float,
) -> tuple[int, int, float]:
    """Count the detections that match a landmark at the pose by the odometry.

    Args:
        pose: x, y [m], yaw [rad] by the odometry, shape (3,).
        centre: Detections in the base frame, shape (D, 2) [m].
        sigma: Standard deviation of each detection [m], shape (D,).
        landmarks: Landmarks with at least `hits_to_weigh` hits in the frame of the map, shape (L, 2) [m].
        position: Variance of x and of y of the pose [m^2].
        heading: Variance of the yaw of the pose [rad^2].
        gate: Maximum distance of a match [sigma].

    Returns:
        Number of matches; number of expected matches, the minimum of D and the number of landmarks nearer
        than the farthest detection; and the mean number of matches of uniformly distributed detections. All
        are 0 with fewer than FEWEST detections or landmarks.
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
def search_offset(pose: Float, centre: Float, sigma: Float, landmarks: Float) -> tuple[int, bool, Float]:
    """Search the pose with most matches between detections and landmarks, within SEARCH and TURNS of `pose`.

    Each pair of a detection and a landmark proposes a position for each heading. Positions whose grid cell of
    0.5 m has at least half of the votes of the best pose are counted exactly.

    Args:
        pose, centre, sigma, landmarks: See `count_matches`.

    Returns:
        Number of matches; whether the pose is unambiguous (FEWEST, CONVINCING, and MARGIN over positions more
        than 1 m away); and the pose x, y [m], yaw [rad], shape (3,), which is `pose` without any match. Of
        poses with equal matches the first one in the order of TURNS counts.
    """
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
                if counts[u, v] * 2 < best:  # a pose at a border divides its votes between two cells
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
    """Return 1 if detection d (row of `centre`, base frame, shape (D, 2) [m]) at a pose x, y [m] with cosine
    c and sine s of its yaw is nearer than `reach` [m] to a landmark (`landmarks`, frame of the map, shape (L,
    2) [m]), else 0."""
    wx = x + c * centre[d, 0] - s * centre[d, 1]
    wy = y + s * centre[d, 0] + c * centre[d, 1]
    for j in range(landmarks.shape[0]):
        dx, dy = landmarks[j, 0] - wx, landmarks[j, 1] - wy
        if dx * dx + dy * dy < reach * reach:
            return 1
    return 0
