"""Rigid-shift test for wheel slip: a motion of the robot that the odometry does not report shifts all
detections alike.

Wheels that slip a little contradict no single tree: each deviation is within a gate, and a filter that trusts
the odometry moves its landmarks instead of the robot, scan by scan. All trees together contradict the
odometry at once: the rigid motion that fits the detections to the landmarks (least squares over the pairs
that agree) exceeds the errors of odometry and trees.

People who walk side by side cause the same shift. Therefore only landmarks that were known for a while may
vote, at a place where most detections are such landmarks. Otherwise, more pairs are required than the number
of people who walk together. A pair that agrees with the odometry and not with the motion refutes it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.detection.free_space import BEHIND
from pipeline.geometry.directions import direction_bins
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import OdometryTrust, inverted
from pipeline.types.records import Bool, Int

NEAR = 0.8  # m; maximum distance of a pair; beyond it the nearest tree may be another one
# Minimum numbers of agreeing pairs: of well-known landmarks, fewer fit by chance; without a recent fault of
# the odometry, since a smaller group may be people who stood for long and walk off; and of landmarks that are
# not well known, more than people walk side by side.
FEWEST, SEVERAL, MANY = 5, 8, 10
FAMILIAR = 0.6  # share of well-known trees among recent detections, from which new objects are an exception
CONVINCING = 0.7  # share of the pairs, and of the landmarks missed in free view, that must agree
CLEARLY = 6.0  # excess in squared sigma (twice the log likelihood) by which a pair must prefer the odometry
STANDING = 16  # agreeing pairs per permitted pair that prefers the odometry, by chance or on the robot itself
AGREE = 3.5  # sigma; maximum distance of a pair after the motion
ROUNDS = 5  # iterations of fitting and removing pairs that do not agree
BEYOND, STILL_BEYOND = 6.0, 4.0  # sigma; minimum motion, and the same directly after a fault of the odometry
# m, at LEVER for a turn; minimum motion, likewise: errors that all views from one side share are as large.
LEAST, STILL_LEAST = 0.05, 0.02
LEVER = 5.0  # m; distance of a typical tree
MISFIT = 3.0  # maximum mean squared deviation, relative to the variances, of a rigid motion


def estimate_rigid_shift(
    pose: Float,
    position: float,
    heading: float,
    trust: OdometryTrust,
    centre: Float,
    R: Float,
    known: Float,
    spread: Float,
    well: Bool,
    clear_range: Float,
) -> tuple[bool, bool, Float, Float]:
    """Test whether detections and landmarks contradict the odometry by a rigid shift, and estimate the pose
    that they determine.

    Args:
        pose: x, y [m], yaw [rad] by the odometry, shape (3,).
        position, heading: Variances of this pose relative to the landmarks [m^2, rad^2], see
            `drift_variances`.
        trust: Trust in the odometry; distrust lowers the limits.
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        known: Landmarks in the frame of the map, shape (L, 2) [m].
        spread: Covariances xx, xy, yy of the landmarks, shape (L, 3) [m^2].
        well: Which landmarks have at least `hits_to_weigh` hits, shape (L,).
        clear_range: Free distance by azimuth in the base frame, shape (bins,) [m].

    Returns:
        Whether the shift is significant and enough pairs agree (SEVERAL, or any number if `trust.distrust` is
        above 0); whether it is significant but too few pairs agree; the pose x, y [m], yaw [rad] by the
        trees, shape (3,); and the covariance of this pose, shape (3, 3). If both bools are False, pose and
        covariance have no meaning.
    """
    fit = _fitted_twice(pose, centre, R, known, spread, well, trust)
    place, agree, nothing = fit.place, fit.agree, (False, False, fit.place, fit.covariance)
    if agree == 0:
        return nothing
    shift = place - pose
    least = LEAST + trust.distrust * (STILL_LEAST - LEAST)
    if fit.misfit > MISFIT or math.hypot(shift[0], shift[1], LEVER * shift[2]) < least:
        return nothing
    # Landmarks that other trees hide are not expected.
    if agree < CONVINCING * (fit.voting + _missed(place, centre, known, fit.votes, fit.owner, clear_range)):
        return nothing
    lever, off, variance, _ = _pair_arrays(pose, centre, R, known, spread, fit.owner)
    if _standing(lever, off, variance, position, heading, fit.square, fit.kept) > agree // STANDING:
        return nothing
    covariance = fit.covariance * max(1.0, fit.misfit)
    total = shift @ np.linalg.solve(covariance + np.diag([position, position, heading]), shift)
    beyond = BEYOND + trust.distrust * (STILL_BEYOND - BEYOND)
    significant, enough = bool(total > beyond * beyond), agree >= SEVERAL or trust.distrust > 0.0
    return significant and enough, significant and not enough, place, covariance


class Fit(NamedTuple):
    """Rigid motion that fits detections to landmarks.

    Attributes:
        agree: Number of agreeing pairs; 0 if they are too few or determine no motion, and then the other
            attributes have no meaning.
        place: Pose x, y [m], yaw [rad] after the motion, shape (3,).
        covariance: Covariance of the pose relative to the landmarks, shape (3, 3).
        misfit: Sum of squared normalised deviations per degree of freedom.
        votes: Landmarks that vote, shape (L,).
        voting: Number of pairs with these landmarks.
        owner: Detection of each landmark, -1 for none, int64, shape (L,).
        square: Squared deviation of each pair after the motion, shape (K,) [m^2].
        kept: Which pairs agree, shape (K,).
    """

    agree: int
    place: Float
    covariance: Float
    misfit: float
    votes: Bool
    voting: int
    owner: Int
    square: Float
    kept: Bool


@compiled
def _fitted_twice(
    pose: Float, centre: Float, R: Float, known: Float, spread: Float, well: Bool, trust: OdometryTrust
) -> Fit:
    """Return `_fitted` at a pose and, if enough pairs agree, at the pose that these determine (iterative
    closest point; Besl, McKay 1992), since a turn moves distant trees beyond NEAR."""
    fit = _fitted(pose, centre, R, known, spread, well, trust)
    return _fitted(fit.place, centre, R, known, spread, well, trust) if fit.agree > 0 else fit


@compiled
def _fitted(
    pose: Float, centre: Float, R: Float, known: Float, spread: Float, well: Bool, trust: OdometryTrust
) -> Fit:
    """Return the least-squares motion of the pairs at a pose, without the pairs that do not agree with it.
    See `estimate_rigid_shift` for the arguments."""
    owner = _pairs(pose, centre, known)
    lever, off, variance, landmark = _pair_arrays(pose, centre, R, known, spread, owner)
    familiar = trust.known_share >= FAMILIAR and well[landmark].sum() >= FEWEST
    fewest, votes = (FEWEST, well) if familiar else (MANY, np.ones(well.shape[0], np.bool_))
    may = votes[landmark]
    kept, voting, agree, misfit = may.copy(), may.sum(), may.sum(), 0.0
    motion, N_inv = np.zeros(3), np.zeros((3, 3))
    for _ in range(ROUNDS):
        if agree < fewest:
            agree = 0
            break
        N, b = _normal_equations(lever, off, variance, kept)
        N_inv, det = inverted(N)
        if not det > 0.0:
            agree = 0
            break
        for i in range(3):
            motion[i] = N_inv[i, 0] * b[0] + N_inv[i, 1] * b[1] + N_inv[i, 2] * b[2]
        agree, misfit = _agreeing(lever, off, variance, motion, may, kept)
    agree = agree if agree >= fewest else 0
    square = _deviations(lever, off, motion)
    return Fit(agree, pose + motion, N_inv, misfit, votes, voting, owner, square, kept)


def _missed(place: Float, centre: Float, known: Float, votes: Bool, owner: Int, clear_range: Float) -> int:
    """Return the number of landmarks in `votes` that are in free view at a pose and no farther than the
    farthest detection, but have no detection.

    Args:
        place: x, y [m], yaw [rad], shape (3,).
        centre: Detections in the base frame, shape (D, 2) [m].
        known: Landmarks in the frame of the map, shape (L, 2) [m].
        votes: Landmarks that count, shape (L,).
        owner: Detection of each landmark, -1 for none, int64, shape (L,).
        clear_range: Free distance by azimuth in the base frame, shape (bins,) [m].
    """
    farthest = (centre * centre).sum(axis=1).max(initial=0.0)
    c, s = math.cos(place[2]), math.sin(place[2])
    ahead = (known - place[:2]) @ np.array([[c, -s], [s, c]])
    free = np.maximum(clear_range[direction_bins(ahead, len(clear_range))] - BEHIND, 0.0)
    seen = np.minimum(free * free, farthest) > (ahead * ahead).sum(axis=1)
    return int(np.count_nonzero(seen & votes & (owner < 0)))


def _standing(
    lever: Float, off: Float, variance: Float, position: float, heading: float, shifted: Float, kept: Bool
) -> int:
    """Return the number of pairs that agree with the odometry and fit it better than the shifted pose.

    A pair that also agrees with the shifted pose counts only if it prefers the odometry by CLEARLY: near
    people who walk slowly, a tree is within the gate of their motion as well.

    Args:
        lever, off, variance: The first three results of `_pair_arrays` at the pose by odometry.
        position, heading: Variances of this pose [m^2, rad^2].
        shifted: Squared deviations at the shifted pose, shape (K,) [m^2].
        kept: Which pairs agree with the shifted pose, shape (K,).
    """
    square, far2 = (off * off).sum(axis=1), (lever * lever).sum(axis=1)
    agrees = square <= AGREE * AGREE * (variance + position + far2 * heading)
    return int(np.count_nonzero(agrees & (shifted > square + np.where(kept, CLEARLY * variance, 0.0))))


@compiled
def _pairs(pose: Float, centre: Float, known: Float) -> Int:
    """Return the detection of each landmark, -1 for none, int64, shape (L,): of the detections whose nearest
    landmark within NEAR is this one, the nearest detection. Of equal distances the first row counts. See
    `estimate_rigid_shift` for the arguments."""
    found, c, s = centre.shape[0], np.cos(pose[2]), np.sin(pose[2])
    owner = np.full(known.shape[0], -1, np.int64)
    least = np.full(known.shape[0], np.inf)
    for d in range(found):
        x = pose[0] + c * centre[d, 0] - s * centre[d, 1]
        y = pose[1] + s * centre[d, 0] + c * centre[d, 1]
        best, nearest = NEAR * NEAR, -1
        for j in range(known.shape[0]):
            square = (known[j, 0] - x) ** 2 + (known[j, 1] - y) ** 2
            if square < best:
                best, nearest = square, j
        if nearest >= 0 and best < least[nearest]:
            least[nearest], owner[nearest] = best, d
    return owner


@compiled
def _pair_arrays(
    pose: Float, centre: Float, R: Float, known: Float, spread: Float, owner: Int
) -> tuple[Float, Float, Float, Int]:
    """Return the pairs at a pose, in the order of the landmarks.

    Args:
        pose, centre, R, known, spread: See `estimate_rigid_shift`.
        owner: Detection of each landmark, -1 for none, int64, shape (L,).

    Returns:
        For each of K pairs: vector from the robot to the detection, shape (K, 2) [m]; vector from the
        detection to the landmark, shape (K, 2) [m], both in the frame of the map; variance of the latter per
        axis, shape (K,) [m^2]; and row of the landmark, shape (K,).
    """
    n, c, s = (owner >= 0).sum(), np.cos(pose[2]), np.sin(pose[2])
    lever, off, variance = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    landmark, k = np.empty(n, np.int64), 0
    for j in range(owner.shape[0]):
        d = owner[j]
        if d < 0:
            continue
        lever[k, 0] = c * centre[d, 0] - s * centre[d, 1]
        lever[k, 1] = s * centre[d, 0] + c * centre[d, 1]
        off[k, 0] = known[j, 0] - pose[0] - lever[k, 0]
        off[k, 1] = known[j, 1] - pose[1] - lever[k, 1]
        variance[k] = 0.5 * (R[d, 0] + R[d, 2] + spread[j, 0] + spread[j, 2])
        landmark[k] = j
        k += 1
    return lever, off, variance, landmark


@compiled
def _deviations(lever: Float, off: Float, motion: Float) -> Float:
    """Return the squared deviations of pairs after a small rigid motion x, y [m], yaw [rad], shape (3,), as
    shape (K,) [m^2]; see `_pair_arrays` for `lever` and `off`."""
    square = np.empty(lever.shape[0])
    for k in range(lever.shape[0]):
        ex = off[k, 0] - motion[0] + motion[2] * lever[k, 1]
        ey = off[k, 1] - motion[1] - motion[2] * lever[k, 0]
        square[k] = ex * ex + ey * ey
    return square


@compiled
def _normal_equations(lever: Float, off: Float, variance: Float, kept: Bool) -> tuple[Float, Float]:
    """Return the normal equations N, b, shapes (3, 3) and (3,), of off = t + theta (-lever_y, lever_x) for
    the unknowns t [m] and theta [rad], over the pairs in `kept`, weighted by 1 / variance; zeros without
    pairs. See `_pair_arrays` for the arguments; `kept` is bool, shape (K,)."""
    N, b = np.zeros((3, 3)), np.zeros(3)
    for k in range(lever.shape[0]):
        if not kept[k]:
            continue
        w, lx, ly = 1.0 / variance[k], lever[k, 0], lever[k, 1]
        N[0, 0] += w
        N[0, 2] -= w * ly
        N[1, 2] += w * lx
        N[2, 2] += w * (lx * lx + ly * ly)
        b[0] += w * off[k, 0]
        b[1] += w * off[k, 1]
        b[2] += w * (lx * off[k, 1] - ly * off[k, 0])
    N[1, 1] = N[0, 0]
    N[2, 0], N[2, 1] = N[0, 2], N[1, 2]
    return N, b


@compiled
def _agreeing(
    lever: Float, off: Float, variance: Float, motion: Float, may: Bool, kept: Bool
) -> tuple[int, float]:
    """Mark the pairs in `may` that agree with a motion, in `kept`, in place. A pair agrees if its squared
    normalised deviation is at most AGREE^2, or twice the mean of the pairs in `kept` before, if that is
    larger.

    Args:
        lever, off, variance: The first three results of `_pair_arrays`.
        motion: x, y [m], yaw [rad], shape (3,).
        may: Pairs that are considered, shape (K,).
        kept: Pairs by which the motion was estimated, shape (K,), at least one true; overwritten.

    Returns:
        Number of agreeing pairs, and the sum of their squared normalised deviations divided by the degrees of
        freedom (2 n - 3, at least 1).
    """
    square, total, n = _deviations(lever, off, motion) / variance, 0.0, 0
    for k in range(lever.shape[0]):
        if kept[k]:
            total += square[k]
            n += 1
    limit = max(AGREE * AGREE, 2.0 * total / n)
    total, n = 0.0, 0
    for k in range(lever.shape[0]):
        kept[k] = may[k] and square[k] <= limit
        if kept[k]:
            total += square[k]
            n += 1
    return n, total / max(2.0 * n - 3.0, 1.0)
