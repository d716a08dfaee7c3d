"""Landmarks of all particles after a scan: updated, begun, missed, merged and removed.

Where the particles associate a detection differently, the choice with more than half of the weight decides
hits and covariance; the position of each particle follows its own choice.
"""

from __future__ import annotations

import numpy as np

from pipeline.detection.free_space import BEHIND
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.candidate_pairs import Pairs
from pipeline.slam.particle_maps import ABSENT, ROOM, Maps, own_block
from pipeline.slam.particle_update import NEW, OPEN, Rules
from pipeline.slam.scan_statistics import HITS_MAX
from pipeline.types.records import Bool, Int

VARIANCE_MIN = 1e-4  # m^2; views of one trunk share an error of about a centimetre
SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time


@compiled
def decide(pair_of: Int, weights: Float, pairs: Pairs) -> Int:
    """Return the pair of each detection that has more than half of the weight, shape (D,): NEW where most
    particles have none, OPEN where no choice has a majority."""
    P, D = pair_of.shape
    vote, new, decided = np.zeros(len(pairs.row)), np.zeros(D), np.full(D, OPEN)
    for p in range(P):
        for d in range(D):
            if pair_of[p, d] >= 0:
                vote[pair_of[p, d]] += weights[p]
            else:
                new[d] += weights[p]
    for d in range(D):
        if new[d] > 0.5:
            decided[d] = NEW
        for k in range(pairs.first[d], pairs.first[d + 1]):
            if vote[k] > 0.5:
                decided[d] = k
    return decided


@compiled
def kalman_gain(
    Sigma: Float, j: int, R0: float, R1: float, R2: float, looks: float
) -> tuple[float, float, float, float]:
    """Update the covariance of a resting landmark by a position with covariance R (xx, xy, yy); returns the
    gain K as K00, K01, K10, K11.

    Successive views of a trunk share their error, so Sigma never falls below R / looks.
    """
    S0, S1, S2 = Sigma[j, 0], Sigma[j, 1], Sigma[j, 2]
    a, b, d = S0 + R0, S1 + R1, S2 + R2  # S = Sigma + R, H = I
    scale = 1.0 / (a * d - b * b)
    k00, k01 = (S0 * d - S1 * b) * scale, (S1 * a - S0 * b) * scale  # K = Sigma S^-1
    k10, k11 = (S1 * d - S2 * b) * scale, (S2 * a - S1 * b) * scale
    # K R is (I - K) Sigma for K = Sigma S^-1, and stays positive in floating point.
    Sigma[j, 0] = max(k00 * R0 + k01 * R1, VARIANCE_MIN, R0 / looks)
    Sigma[j, 1] = 0.5 * (k00 * R1 + k01 * R2 + k10 * R0 + k11 * R1)
    Sigma[j, 2] = max(k10 * R1 + k11 * R2, VARIANCE_MIN, R2 / looks)
    return k00, k01, k10, k11


@compiled
def update_positions(
    maps: Maps, slots: Int, pairs: Pairs, pair_of: Int, decided: Int, pose: Float, centre: Float, R: Float,
    looks: float, begun: Int,
) -> None:  # fmt: skip
    """Move the landmarks of each particle towards the detections, and begin new ones.

    Args:
        maps: Maps, whose positions and covariances are updated.
        slots: Slots of the landmarks near.
        pairs: Candidate pairs.
        pair_of: Pair of each detection by particle, shape (P, D).
        decided: See `decide`.
        pose: Poses after the scan, shape (P, 3).
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Their covariances in the frame of the map, xx, xy, yy, shape (D, 3).
        looks: See `kalman_gain`.
        begun: Slot of the landmark that each detection begins, -1 for none, shape (D,).
    """
    gain, one = np.empty((len(pairs.row), 4)), np.empty((1, 3))
    for d in range(len(decided)):
        for k in range(pairs.first[d], pairs.first[d + 1]):
            j = slots[pairs.row[k]]
            one[0] = maps.covariance[j]
            gain[k, 0], gain[k, 1], gain[k, 2], gain[k, 3] = kalman_gain(
                one, 0, R[d, 0], R[d, 1], R[d, 2], looks
            )
            if decided[d] == k:
                maps.covariance[j] = one[0]
    for d in range(len(decided)):
        if begun[d] >= 0:
            maps.covariance[begun[d]] = R[d]
    for p in range(pose.shape[0]):
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        for d in range(len(decided)):
            x = pose[p, 0] + c * centre[d, 0] - s * centre[d, 1]
            y = pose[p, 1] + s * centre[d, 0] + c * centre[d, 1]
            k = pair_of[p, d]
            if k >= 0:
                j = slots[pairs.row[k]]
                b, o = own_block(maps, p, j // ROOM), j % ROOM
                y0, y1 = x - maps.mean[b, o, 0], y - maps.mean[b, o, 1]
                maps.mean[b, o, 0] += gain[k, 0] * y0 + gain[k, 1] * y1
                maps.mean[b, o, 1] += gain[k, 2] * y0 + gain[k, 3] * y1
            if begun[d] >= 0:
                b, o = own_block(maps, p, begun[d] // ROOM), begun[d] % ROOM
                # A particle that recognises another landmark does not get the new one.
                maps.mean[b, o, 0], maps.mean[b, o, 1] = (x, y) if k < 0 else (ABSENT, ABSENT)


@compiled
def update_existence(
    maps: Maps, slots: Int, pairs: Pairs, decided: Int, relative: Float, clear_range: Float, first_birth: int,
    rules: Rules,
) -> tuple[Int, Int, Bool, float, float]:  # fmt: skip
    """Count hits and misses, and reserve slots for new landmarks.

    Args:
        maps: Maps, whose hits, scores and births are updated.
        slots: Slots of the landmarks near; relative: their positions by one particle, shape (L, 2) [m].
        pairs, decided: See `decide`.
        clear_range: Free range by direction [m].
        first_birth: Serial number of the first detection.
        rules: Parameters.

    Returns:
        birth of the landmark of each detection (-1 where undecided); slot of each new landmark (-1 for none);
        which landmarks near were seen; the hits of the well-known ones among them, and of those missed.
    """
    D = len(decided)
    birth, begun = np.full(D, -1, np.int64), np.full(D, -1, np.int64)
    seen = np.zeros(len(slots), np.bool_)
    found = missed = 0.0
    for d in range(D):
        k = decided[d]
        if k >= 0:
            j = slots[pairs.row[k]]
            seen[pairs.row[k]] = True
            if maps.hits[j] >= rules.hits_to_weigh:
                found += min(float(maps.hits[j]), HITS_MAX)
            maps.hits[j] += 1
            maps.score[j] = min(maps.score[j] + 1.0, SCORE_MAX)
            birth[d] = maps.birth[j]
    for n in range(len(slots)):
        if seen[n]:
            continue
        x, y, j = relative[n, 0], relative[n, 1], slots[n]
        square, free = x * x + y * y, clear_range[direction_bin(x, y, len(clear_range))] - BEHIND
        if free > 0.0 and free * free > square and square <= rules.view_range * rules.view_range:
            if maps.hits[j] >= rules.hits_to_weigh:
                missed += min(float(maps.hits[j]), HITS_MAX)
            maps.score[j] -= rules.miss
    j = 0
    for d in range(D):
        if decided[d] == NEW:
            while maps.hits[j] > 0:
                j += 1
            begun[d], birth[d] = j, first_birth + d
            maps.hits[j], maps.score[j], maps.birth[j] = 1, 1.0, first_birth + d
    return birth, begun, seen, found, missed


@compiled
def clean(maps: Maps, slots: Int, seen: Bool, position: Float, gate: float) -> None:
    """Merge each landmark that was seen with those that were not and may be the same tree, and remove those
    without score.

    Two landmarks that one scan shows are two trees. The merged landmark keeps the older birth.

    Args:
        maps: Maps.
        slots: Slots of the landmarks near.
        seen: Which of them were seen, shape (L,).
        position: Their positions by one particle, shape (L, 2) [m].
        gate: Largest Mahalanobis distance of two landmarks that are merged [sigma].
    """
    covariance, gate2, largest = maps.covariance, gate * gate, 0.0
    for j in slots:
        largest = max(largest, covariance[j, 0] + covariance[j, 2])
    for n in range(len(slots)):
        if not seen[n]:
            continue
        for m in range(len(slots)):
            y0, y1 = position[m, 0] - position[n, 0], position[m, 1] - position[n, 1]
            # The trace bounds the larger eigenvalue.
            if seen[m] or y0 * y0 + y1 * y1 > 2.0 * gate2 * largest:
                continue
            j, k = slots[n], slots[m]
            a, d = covariance[j, 0] + covariance[k, 0], covariance[j, 2] + covariance[k, 2]
            b = covariance[j, 1] + covariance[k, 1]
            if maps.score[k] > 0.0 and d * y0 * y0 - 2.0 * b * y0 * y1 + a * y1 * y1 <= gate2 * (
                a * d - b * b
            ):
                _merge(maps, j, k)
    for j in slots:
        if maps.score[j] <= 0.0:
            maps.hits[j] = 0


@compiled
def _merge(maps: Maps, j: int, k: int) -> None:
    """Merge landmark k into landmark j in all maps."""
    R = maps.covariance[k]
    k00, k01, k10, k11 = kalman_gain(maps.covariance, j, R[0], R[1], R[2], np.inf)
    for p in range(maps.block.shape[0]):
        b, o = own_block(maps, p, j // ROOM), j % ROOM
        other = maps.mean[maps.block[p, k // ROOM], k % ROOM]
        if other[0] >= ABSENT:
            continue
        if maps.mean[b, o, 0] >= ABSENT:
            maps.mean[b, o] = other
        y0, y1 = other[0] - maps.mean[b, o, 0], other[1] - maps.mean[b, o, 1]
        maps.mean[b, o, 0] += k00 * y0 + k01 * y1
        maps.mean[b, o, 1] += k10 * y0 + k11 * y1
    maps.hits[j] += maps.hits[k]
    maps.score[j] = max(maps.score[j], maps.score[k])
    maps.birth[j] = min(maps.birth[j], maps.birth[k])
    maps.score[k] = 0.0
