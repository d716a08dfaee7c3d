"""Data association, pose and weight of each particle for one scan (Eq. 7).

FastSLAM 2.0 (Montemerlo et al. 2003) draws the pose from odometry and scan together: each recognised landmark
corrects the Gaussian of the pose before the next detection is associated. FastSLAM 1.0 is the same with a
pose that was drawn from the odometry and has no covariance left.

In the body frame all particles have the same prior N(0, P), and the gain of a correction depends on no
measured value. So particles that associate the same landmarks share all gains; `Gains` keeps those of the
best particle, and only particles with another association compute their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, draw, expected_spread
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within
from pipeline.slam.candidate_pairs import Pairs
from pipeline.slam.joint_association import CHOICES, MOST, Doubts, choose_jointly, doubts_for
from pipeline.types.records import Bool, Int, Int32

LIKELY = 6.0  # of -2 log likelihood, a likelihood ratio of 20: a choice with a smaller lead is ambiguous
# Statistics of a scan by particle: columns of `statistics`.
INNOVATION, RECOGNISED, AMBIGUOUS = 0, 1, 2
STATISTICS = 3
NEW, OPEN = -1, -2  # in place of a pair: a new landmark; not decided yet


class Rules(NamedTuple):
    """The parameters of the kernels.

    Attributes:
        use_proposal: FastSLAM 2.0; else the pose was drawn before the scan is used.
        gate: Largest Mahalanobis distance of an association [sigma].
        distance_max: Largest distance of an association [m].
        hits_to_weigh: Landmarks with fewer hits neither correct the pose nor weigh.
        view_range: Landmarks within this range can be missed [m].
        miss: Score that one miss takes.
        weight_power: Exponent of a scan's likelihood in the weights.
        looks: Number of independent views that bounds a landmark's covariance.
        merge_gate: Two landmarks nearer than this are merged [sigma].
    """

    use_proposal: bool
    gate: float
    distance_max: float
    hits_to_weigh: int
    view_range: float
    miss: float
    weight_power: float
    looks: float
    merge_gate: float


class Scan(NamedTuple):
    """The detections, and memory for the association of one particle.

    Attributes:
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Their covariances xx, xy, yy, shape (D, 3) [m^2].
        P: Covariance of the motion in the body frame, shape (3, 3).
        covariance: Of the landmarks in the body frame, xx, xy, yy, shape (L, 3) [m^2].
        well_known: 1 for landmarks that weigh, else 0, int32, shape (L,).
        order: Detections in the order of correction, int64, shape (D,).
        residual: Innovation of each pair at the prior pose, shape (K, 2) [m].
        cost: -2 log likelihood of each pair, infinite outside the gate, shape (K,).
        best: Least cost of each detection, shape (D,).
        rivals: The two least costs of each landmark, shape (L, 2).
        taken: Which landmarks are associated, shape (L,).
        mu, posterior: Pose and its covariance, shapes (1, 3) and (3, 3).
        doubts: For detections that are decided together.
    """

    centre: Float
    R: Float
    P: Float
    covariance: Float
    well_known: Int32
    order: Int
    residual: Float
    cost: Float
    best: Float
    rivals: Float
    taken: Bool
    mu: Float
    posterior: Float
    doubts: Doubts


class Gains(NamedTuple):
    """Corrections of the pose by the best particle's detections with one likely landmark.

    Attributes:
        pair: Pair of each correction, int64, shape (D,), by the order of the scan; NEW or OPEN for none.
        information: Inverse of the innovation's covariance, xx, xy, yy, shape (D, 3).
        gain: Gain of x, y and yaw, shape (D, 6): zeros where the landmark does not weigh.
        result: shape (9,): whether the gains are valid, corrections, logarithm of the determinants, and
            xx, xy, xt, yy, yt, tt of the corrected pose.
    """

    pair: Int
    information: Float
    gain: Float
    result: Float


@compiled
def scan_for(
    centre: Float, R: Float, P: Float, covariance: Float, well_known: Int32, pairs: int, landmarks: int
) -> Scan:
    """Return a scan with memory for a number of pairs and landmarks."""
    D = centre.shape[0]
    return Scan(
        centre, R, P, covariance, well_known,
        np.arange(D), np.empty((pairs, 2)), np.empty(pairs), np.empty(D),
        np.empty((landmarks, 2)), np.empty(landmarks, np.bool_), np.empty((1, 3)), np.empty((3, 3)),
        doubts_for(),
    )  # fmt: skip


@compiled
def gains_for(detections: int) -> Gains:
    """Return gains that are not valid yet."""
    return Gains(
        np.full(detections, OPEN, np.int64),
        np.empty((detections, 3)),
        np.zeros((detections, 6)),
        np.zeros(9),
    )


@compiled_borrowing
def update_particle(
    p: int,
    pose: Float,
    relative: Float,
    scan: Scan,
    pairs: Pairs,
    rules: Rules,
    noise: Float,
    gains: Gains,
    keep_gains: bool,
    pair_of: Int,
    statistics: Float,
) -> float:
    """Associate the detections with landmarks, one to one, correct and draw the pose; returns the log
    likelihood.

    Detections with one likely landmark correct the pose, in the order of the scan. Of the others, the surest
    are decided together (see `joint_association`), and the rest by falling likelihood.

    Args:
        p: Row of the particle.
        pose: Poses after the motion, shape (P, 3); row p is updated.
        relative: Landmarks in the body frame of the particle, shape (L, 2) [m].
        scan: Detections.
        pairs: Candidate pairs.
        rules: Parameters.
        noise: Standard normal numbers, shape (P, 3).
        gains: Gains of the best particle.
        keep_gains: Whether this is the best particle, whose gains are stored.
        pair_of: Pair of each detection, NEW for none, shape (P, D); row p is filled.
        statistics: shape (P, STATISTICS); row p is filled.
    """
    statistics[p, AMBIGUOUS] = choose_clear_pairs(p, relative, scan, pairs, rules, pair_of)
    same, at, innovation = _corrected_by_gains(p, scan, pairs, rules, gains, pair_of)
    log_det, recognised = gains.result[2], gains.result[1]
    if not same:
        at, innovation, log_det, recognised = _corrected_by_pairs(
            p, scan, pairs, rules, gains, keep_gains, pair_of
        )
    levels, level = _open_levels(p, scan, pairs, pair_of), 0
    if levels > 0:
        choose_jointly(
            at, scan.centre, scan.R, relative, scan.covariance, scan.well_known, rules.gate * rules.gate, 1,
            scan.taken, levels, scan.doubts,
        )  # fmt: skip
    while True:
        if level < levels:
            k, d, cost, square = _chosen_pair(level, at, scan, pairs)
            level += 1
            if k < 0 or square > rules.gate * rules.gate:
                pair_of[p, d] = NEW
                continue
        else:
            k, d, cost, square = _next_pair(p, at, scan, pairs, rules, pair_of)
            if k < 0:
                break
        pair_of[p, d] = k
        scan.taken[pairs.row[k]] = True
        if pairs.weighs[k]:
            innovation += square
            log_det += cost - square
            recognised += 1.0
            r0, r1, S0, S1, S2 = _innovation(at, d, k, scan, pairs)
            at = corrected(at, scan.centre[d, 0], scan.centre[d, 1], S0, S1, S2, r0, r1)
    # A new tree is as likely as one at the gate, or particles that recognise nothing would win.
    price = 0.0
    for d in range(scan.centre.shape[0]):
        k = pair_of[p, d] = max(pair_of[p, d], NEW)
        if k < 0 or not pairs.weighs[k]:
            S0, S1, S2 = expected_spread(at, 1.0, 0.0, scan.centre[d, 0], scan.centre[d, 1], scan.R, d)
            price += rules.gate * rules.gate + np.log(S0 * S2 - S1 * S1)
    statistics[p, INNOVATION], statistics[p, RECOGNISED] = innovation, recognised
    _draw(p, at, pose, noise, scan.mu, scan.posterior)
    return float(-0.5 * (innovation + log_det + price))


@compiled_borrowing
def choose_clear_pairs(p: int, relative: Float, scan: Scan, pairs: Pairs, rules: Rules, pair_of: Int) -> int:
    """Fill residuals and costs, and associate each detection that has one likely landmark.

    Row p of `pair_of` becomes NEW without a landmark in the gate, and OPEN where a second landmark or another
    detection of the same landmark is nearly as likely. Returns the number of detections with a second
    likely landmark.
    """
    gate2, distance2 = rules.gate * rules.gate, rules.distance_max * rules.distance_max
    ambiguous = 0
    for n in range(scan.taken.shape[0]):
        scan.taken[n] = False
        scan.rivals[n, 0] = scan.rivals[n, 1] = np.inf
    for d in range(scan.centre.shape[0]):
        best, second, likeliest = np.inf, np.inf, NEW
        for k in range(pairs.first[d], pairs.first[d + 1]):
            n = pairs.row[k]
            r0, r1 = relative[n, 0] - scan.centre[d, 0], relative[n, 1] - scan.centre[d, 1]
            scan.residual[k, 0], scan.residual[k, 1], scan.cost[k] = r0, r1, np.inf
            square = (
                pairs.gate[k, 0] * r0 * r0 + 2.0 * pairs.gate[k, 1] * r0 * r1 + pairs.gate[k, 2] * r1 * r1
            )
            if r0 * r0 + r1 * r1 > distance2 or not square <= gate2:
                continue
            cost = square + pairs.log_det[k]
            scan.cost[k] = cost
            if cost < best:
                best, second, likeliest = cost, best, k
            elif cost < second:
                second = cost
            if cost < scan.rivals[n, 0]:
                scan.rivals[n, 0], scan.rivals[n, 1] = cost, scan.rivals[n, 0]
            elif cost < scan.rivals[n, 1]:
                scan.rivals[n, 1] = cost
        scan.best[d] = best
        close = second - best < LIKELY
        ambiguous += close
        pair_of[p, d] = OPEN if close else likeliest
    for d in range(scan.centre.shape[0]):
        k = pair_of[p, d]
        if k >= 0:
            n, cost = pairs.row[k], scan.cost[k]
            rival = scan.rivals[n, 1] if cost == scan.rivals[n, 0] else scan.rivals[n, 0]
            if rival - cost < LIKELY:
                pair_of[p, d] = OPEN
            else:
                scan.taken[n] = True
    return ambiguous


@compiled_within
def _corrected_by_gains(
    p: int, scan: Scan, pairs: Pairs, rules: Rules, gains: Gains, pair_of: Int
) -> tuple[bool, Pose, float]:
    """Return whether the clear pairs of a particle are those of the best one, and are within the gate; the
    corrected pose, and the sum of the squared Mahalanobis distances."""
    g = gains.result
    same, x, y, yaw, innovation = g[0] > 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(scan.order.shape[0]):
        d = scan.order[i]
        k = pair_of[p, d]
        same = same and k == gains.pair[i]
        if not same:
            break
        if k < 0:
            continue
        r0 = scan.residual[k, 0] - x + scan.centre[d, 1] * yaw
        r1 = scan.residual[k, 1] - y - scan.centre[d, 0] * yaw
        W = gains.information
        square = W[i, 0] * r0 * r0 + 2.0 * W[i, 1] * r0 * r1 + W[i, 2] * r1 * r1
        same = square <= rules.gate * rules.gate
        x += gains.gain[i, 0] * r0 + gains.gain[i, 1] * r1
        y += gains.gain[i, 2] * r0 + gains.gain[i, 3] * r1
        yaw += gains.gain[i, 4] * r0 + gains.gain[i, 5] * r1
        if pairs.weighs[k]:
            innovation += square
    return same, Pose(x, y, yaw, g[3], g[4], g[5], g[6], g[7], g[8]), innovation


@compiled_within
def _corrected_by_pairs(
    p: int, scan: Scan, pairs: Pairs, rules: Rules, gains: Gains, keep_gains: bool, pair_of: Int
) -> tuple[Pose, float, float, float]:
    """Return the pose corrected by the clear pairs of a particle, the sum of the squared Mahalanobis
    distances, the logarithm of the determinants, and the number of corrections. A pair outside the gate at
    the pose corrected so far becomes OPEN."""
    P, innovation, product, log_det, recognised = scan.P, 0.0, 1.0, 0.0, 0.0
    at = Pose(0.0, 0.0, 0.0, P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
    valid = keep_gains
    for i in range(scan.order.shape[0]):
        d = scan.order[i]
        k = pair_of[p, d]
        if keep_gains:
            gains.pair[i] = k
        if k < 0:
            continue
        ax, ay = scan.centre[d, 0], scan.centre[d, 1]
        r0, r1, S0, S1, S2 = _innovation(at, d, k, scan, pairs)
        det = S0 * S2 - S1 * S1
        square = (S2 * r0 * r0 - 2.0 * S1 * r0 * r1 + S0 * r1 * r1) / det
        if square > rules.gate * rules.gate:
            pair_of[p, d] = OPEN
            scan.taken[pairs.row[k]] = valid = False
            continue
        if keep_gains:
            gains.information[i, 0], gains.information[i, 1], gains.information[i, 2] = (
                S2 / det,
                -S1 / det,
                S0 / det,
            )
        if not pairs.weighs[k]:
            continue
        if keep_gains:
            # K = P J^T S^-1, by the correction for unit innovations.
            a = corrected(at, ax, ay, S0, S1, S2, 1.0, 0.0)
            b = corrected(at, ax, ay, S0, S1, S2, 0.0, 1.0)
            gains.gain[i, 0], gains.gain[i, 2], gains.gain[i, 4] = a.x - at.x, a.y - at.y, a.yaw - at.yaw
            gains.gain[i, 1], gains.gain[i, 3], gains.gain[i, 5] = b.x - at.x, b.y - at.y, b.yaw - at.yaw
        at = corrected(at, ax, ay, S0, S1, S2, r0, r1)
        innovation += square
        recognised += 1.0
        product *= det
        if product < 1e-200 or product > 1e200:  # within the range of a double
            log_det, product = log_det + np.log(product), 1.0
    log_det += np.log(product)
    if keep_gains:
        g = gains.result
        g[0], g[1], g[2] = 1.0 if valid else 0.0, recognised, log_det
        g[3], g[4], g[5], g[6], g[7], g[8] = at.xx, at.xy, at.xt, at.yy, at.yt, at.tt
    return at, innovation, log_det, recognised


@compiled_within
def _innovation(
    at: Pose, d: int, k: int, scan: Scan, pairs: Pairs
) -> tuple[float, float, float, float, float]:
    """Return innovation and its covariance xx, xy, yy of a pair at a pose relative to the prior one."""
    x, y = scan.centre[d, 0], scan.centre[d, 1]
    S0, S1, S2 = expected_spread(at, 1.0, 0.0, x, y, pairs.spread, k)
    return scan.residual[k, 0] - at.x + y * at.yaw, scan.residual[k, 1] - at.y - x * at.yaw, S0, S1, S2


@compiled_within
def _open_levels(p: int, scan: Scan, pairs: Pairs, pair_of: Int) -> int:
    """Fill the levels of the joint search with the first OPEN detections and their likeliest free landmarks;
    returns the number of levels."""
    doubts, levels = scan.doubts, 0
    for d in scan.order:
        if pair_of[p, d] != OPEN or levels == MOST:
            continue
        n, last = 0, -np.inf
        while n < CHOICES:
            least, likeliest = np.inf, NEW
            for k in range(pairs.first[d], pairs.first[d + 1]):
                if last < scan.cost[k] < least and not scan.taken[pairs.row[k]]:
                    least, likeliest = scan.cost[k], k
            if likeliest < 0:
                break
            doubts.landmark[levels, n], last = pairs.row[likeliest], least
            n += 1
        if n > 0:
            doubts.detection[levels], doubts.choices[levels] = d, n
            levels += 1
    return levels


@compiled_within
def _chosen_pair(level: int, at: Pose, scan: Scan, pairs: Pairs) -> tuple[int, int, float, float]:
    """Return what `_next_pair` returns for the choice of a level of the joint search."""
    d, j = scan.doubts.detection[level], scan.doubts.best[level]
    for k in range(pairs.first[d], pairs.first[d + 1]):
        if pairs.row[k] == j:
            r0, r1, S0, S1, S2 = _innovation(at, d, k, scan, pairs)
            det = S0 * S2 - S1 * S1
            square = (S2 * r0 * r0 - 2.0 * S1 * r0 * r1 + S0 * r1 * r1) / det
            return k, d, square + np.log(det), square
    return NEW, d, 0.0, 0.0


@compiled_within
def _next_pair(
    p: int, at: Pose, scan: Scan, pairs: Pairs, rules: Rules, pair_of: Int
) -> tuple[int, int, float, float]:
    """Return the likeliest pair of the detections that are OPEN: pair (NEW for none), detection, cost and
    squared Mahalanobis distance."""
    least, likeliest, detection, nearest = np.inf, NEW, 0, 0.0
    for d in range(scan.centre.shape[0]):
        if pair_of[p, d] != OPEN:
            continue
        for k in range(pairs.first[d], pairs.first[d + 1]):
            if scan.cost[k] == np.inf or scan.taken[pairs.row[k]]:
                continue
            r0, r1, S0, S1, S2 = _innovation(at, d, k, scan, pairs)
            det = S0 * S2 - S1 * S1
            square = (S2 * r0 * r0 - 2.0 * S1 * r0 * r1 + S0 * r1 * r1) / det
            cost = square + np.log(det)
            if square <= rules.gate * rules.gate and cost < least:
                least, likeliest, detection, nearest = cost, k, d, square
    return likeliest, detection, least, nearest


@compiled_within
def _draw(p: int, at: Pose, pose: Float, noise: Float, mu: Float, P: Float) -> None:
    """Move the pose of a particle by a draw from the corrected motion error, which is in the body frame."""
    mu[0, 0], mu[0, 1], mu[0, 2] = at.x, at.y, at.yaw
    P[0, 0], P[1, 0], P[2, 0], P[1, 1], P[2, 1], P[2, 2] = at.xx, at.xy, at.xt, at.yy, at.yt, at.tt
    draw(mu[0], P, noise[p : p + 1], 0, mu)
    c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
    pose[p, 0] += c * mu[0, 0] - s * mu[0, 1]
    pose[p, 1] += s * mu[0, 0] + c * mu[0, 1]
    pose[p, 2] = (pose[p, 2] + mu[0, 2] + np.pi) % (2.0 * np.pi) - np.pi
