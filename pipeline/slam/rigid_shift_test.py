"""Trees that all lie off alike: a small motion of the robot that its odometry does not tell of.

Wheels that are stuck or slip a little contradict no single tree: each one lies off by less than a gate, and a
filter that believes the odometry moves its landmarks instead of the robot, scan after scan. All of them
together contradict it at once: the motion of the robot that lays the detections upon the landmarks (least
squares over the pairs that agree) is far beyond what odometry and trees can err by.

People who walk side by side look alike. So only what stood where the odometry had it for a while may vote, in
a place where most of what is seen is that, or more at once than walk together; and nobody may stand beside.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import Wheels, inverted
from pipeline.types.records import Bool, Int

NEAR = 0.8  # m; farther from where it was seen the nearest tree may be another one
FEWEST = 5  # pairs; fewer fit by chance, and so few may be a company that stood for long and walks off:
SEVERAL = 8  # pairs overrule an odometry that was not wrong lately
MANY = 10  # pairs, where none of them was known before: more than people walk side by side
FAMILIAR = 0.6  # of the last detections were well known trees: what walks is new wherever it comes
CONVINCING = 0.7  # of all that should be seen must agree
CLEARLY = 6.0  # of twice the log-likelihood is a pair as the odometry has it that would agree otherwise too
STANDING = 16  # agreeing pairs for each one that stands where the odometry has it, by chance or on the robot
AGREE = 3.5  # sigma of a pair's distance after the motion
ROUNDS = 5  # of leaving out what does not agree
BEYOND, STILL_BEYOND = 6.0, 4.0  # sigma of the motion; of an odometry that was wrong just now
LEAST, STILL_LEAST = 0.05, 0.02  # m, or as much at LEVER; so much all views from one side err alike
LEVER = 5.0  # m, of a typical tree
MISFIT = 3.0  # times as large squares as their sigmas say are no rigid motion


@compiled
def moved_together(
    pose: Float,
    position: float,
    heading: float,
    wheels: Wheels,
    centre: Float,
    R: Float,
    known: Float,
    spread: Float,
    well: Bool,
) -> tuple[bool, bool, Float, Float]:
    """Whether the trees tell that the robot is elsewhere; whether they would if they were more; where, x, y
    [m], yaw [rad], shape (3,); and the covariance of that, shape (3, 3).

    Args:
        pose: Where the odometry has it, shape (3,).
        position, heading: Variances of that with respect to the known trees [m^2, rad^2].
        wheels: How much the odometry was wrong lately, and how familiar the place is.
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariance xx, xy, yy, (D, 3).
        known: Landmarks, shape (L, 2) [m]; spread: their covariance xx, xy, yy, shape (L, 3) [m^2]; well:
            which of them are well known, shape (L,).
    """
    lever, off, variance, landmark = _pairs(pose, centre, R, known, spread)
    place, motion, N_inv = pose.copy(), np.zeros(3), np.zeros((3, 3))
    familiar = wheels.familiar >= FAMILIAR and well[landmark].sum() >= FEWEST
    fewest, votes = (FEWEST, well) if familiar else (MANY, np.ones(well.shape[0], np.bool_))
    may = votes[landmark]
    kept, agree, misfit = may.copy(), may.sum(), 0.0
    if agree < fewest:
        return False, False, place, N_inv
    for _ in range(ROUNDS):
        N, b = _normal_equations(lever, off, variance, kept)
        N_inv, det = inverted(N)
        if not det > 0.0:
            return False, False, place, N_inv
        for i in range(3):
            motion[i] = N_inv[i, 0] * b[0] + N_inv[i, 1] * b[1] + N_inv[i, 2] * b[2]
        agree, misfit = _agreeing(lever, off, variance, motion, may, kept)
        if agree < fewest:
            return False, False, place, N_inv
    away = motion[0] * motion[0] + motion[1] * motion[1] + (LEVER * motion[2]) ** 2
    least, expected = LEAST + wheels.distrust * (STILL_LEAST - LEAST), _expected(pose, centre, known, votes)
    if agree < CONVINCING * expected or misfit > MISFIT or away < least * least:
        return False, False, place, N_inv
    if _standing(lever, off, variance, position, heading, motion, kept) > agree // STANDING:
        return False, False, place, N_inv
    N_inv *= max(1.0, misfit)
    S = N_inv.copy()
    S[0, 0] += position
    S[1, 1] += position
    S[2, 2] += heading
    S_inv, _ = inverted(S)
    square, beyond = 0.0, BEYOND + wheels.distrust * (STILL_BEYOND - BEYOND)
    for i in range(3):
        for j in range(3):
            square += motion[i] * S_inv[i, j] * motion[j]
        place[i] += motion[i]
    told, enough = square > beyond * beyond, agree >= SEVERAL or wheels.distrust > 0.0
    return told and enough, told and not enough, place, N_inv


@compiled
def _expected(pose: Float, centre: Float, known: Float, votes: Bool) -> int:
    """How many detections should agree: as many as there are, or as landmarks that may vote stand as near."""
    farthest, expected = 0.0, 0
    for d in range(centre.shape[0]):
        farthest = max(farthest, centre[d, 0] ** 2 + centre[d, 1] ** 2)
    for j in range(known.shape[0]):
        if votes[j] and (known[j, 0] - pose[0]) ** 2 + (known[j, 1] - pose[1]) ** 2 <= farthest:
            expected += 1
    return int(min(centre.shape[0], expected))


@compiled
def _standing(
    lever: Float, off: Float, variance: Float, position: float, heading: float, motion: Float, kept: Bool
) -> int:
    """How many pairs are as the odometry has it, and not as this motion does. Beside people who stroll a tree
    lies within the gate of their motion as well and is kept: it must tell clearly.

    Args:
        variance: Of the pairs, shape (K,) [m^2].
        position, heading: Variances of the place by odometry [m^2, rad^2].
        kept: Which pairs agree with the motion, shape (K,).
    """
    standing = 0
    for k in range(lever.shape[0]):
        square, far2 = off[k, 0] ** 2 + off[k, 1] ** 2, lever[k, 0] ** 2 + lever[k, 1] ** 2
        if square > AGREE * AGREE * (variance[k] + position + far2 * heading):
            continue
        ex = off[k, 0] - motion[0] + motion[2] * lever[k, 1]
        ey = off[k, 1] - motion[1] - motion[2] * lever[k, 0]
        standing += ex * ex + ey * ey > square + (CLEARLY * variance[k] if kept[k] else 0.0)
    return standing


@compiled
def _pairs(
    pose: Float, centre: Float, R: Float, known: Float, spread: Float
) -> tuple[Float, Float, Float, Int]:
    """Detections and landmarks that are nearest to one another.

    Returns:
        From the robot to the detection, frame of the map, shape (K, 2) [m]; from the detection to the
        landmark, shape (K, 2) [m]; the variance of that along an axis, shape (K,) [m^2]; and which landmark
        it is, shape (K,).
    """
    found, c, s = centre.shape[0], np.cos(pose[2]), np.sin(pose[2])
    nearest, owner = np.full(found, -1, np.int64), np.full(known.shape[0], -1, np.int64)
    least = np.full(known.shape[0], np.inf)
    for d in range(found):
        x = pose[0] + c * centre[d, 0] - s * centre[d, 1]
        y = pose[1] + s * centre[d, 0] + c * centre[d, 1]
        best = NEAR * NEAR
        for j in range(known.shape[0]):
            square = (known[j, 0] - x) ** 2 + (known[j, 1] - y) ** 2
            if square < best:
                best, nearest[d] = square, j
        j = nearest[d]
        if j >= 0 and best < least[j]:
            least[j], owner[j] = best, d
    return _laid_out(pose, c, s, centre, R, known, spread, owner)


@compiled
def _laid_out(
    pose: Float, c: float, s: float, centre: Float, R: Float, known: Float, spread: Float, owner: Int
) -> tuple[Float, Float, Float, Int]:
    """What `_pairs` gives, of landmarks and their detections, -1 for none, shape (L,)."""
    n = (owner >= 0).sum()
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
def _normal_equations(lever: Float, off: Float, variance: Float, kept: Bool) -> tuple[Float, Float]:
    """Of off = t + theta (-lever_y, lever_x) over the pairs that are kept: shapes (3, 3) and (3,)."""
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
    """Keep the pairs that may vote and agree with a motion, and leave out all others; returns how many those
    are, and the mean of their squared distances by what it should be."""
    square, total, n = np.empty(lever.shape[0]), 0.0, 0
    for k in range(lever.shape[0]):
        ex = off[k, 0] - motion[0] + motion[2] * lever[k, 1]
        ey = off[k, 1] - motion[1] - motion[2] * lever[k, 0]
        square[k] = (ex * ex + ey * ey) / variance[k]
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
