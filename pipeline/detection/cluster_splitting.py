"""Separation of a trunk from a cluster that also contains shrubs or low branches.

The cluster is cut into height slices. In each slice, adjacent returns without a range jump form a run. A run
whose returns follow the front of a circle as wide as the run is a section of a stem. Where the circles of
enough slices are above each other, their returns are the trunk. Vegetation beside a trunk hides some of the
slices, rarely all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.detection.cluster_shape import gather
from pipeline.detection.cylinder_fit import BARK
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Clusters, Float32, Int, Int32, Labels, Sensor

SLICE = 0.2  # m; of height
LEAST = 3  # returns of a run
# What does so fits no single trunk (the figures are those of a detection, unless somebody changes it).
ROUGH, WIDE, THICK = 0.06, 1.2, 0.6  # m; deviation from the circle, width, radius
WIDEST = 2.5  # m; a hedge or a wall is no trunk with a shrub beside it
SHOTS = 2.6  # between two returns of a run at the most: one may be lost
JUMP, JUMP_SIGMA = 0.06, 3.0  # m, and parts of the range's sigma, between two returns of a run
BENT = 2.0  # sigma; so near to the circle are the returns of its run, root mean square
RADIUS_MIN, RADIUS_MAX = 0.04, 0.5  # m
APART, LEAN = 0.06, 0.08  # m, and per metre of height: so far apart may circles of one trunk stand
ALIKE, ALIKE_LEAST = 0.3, 0.02  # of the radius, and m: so unlike may they be
SHARE = 0.6  # of the slices with returns, from the lowest circle to the highest, agree
FRONT = 0.95  # of the radius lies between the middle half of a run and the axis
MOST_RUNS = 600  # in a cluster, far more than trunks with shrubs have


class Room(NamedTuple):
    """For the runs of one cluster, MOST_RUNS each.

    Attributes:
        level: Slice; x, y, radius: of the circle [m]; height: mean of the run's returns [m]; returns: of it.
        agrees, best: Whether each belongs to the trunk that is tried, and to the best so far.
    """

    level: Int
    x: Float
    y: Float
    radius: Float
    height: Float
    returns: Int
    agrees: Bool
    best: Bool


def take_apart(
    points: Float32, labels: Labels, clusters: Clusters, sensor: Sensor, slices: int
) -> tuple[Labels, Int]:
    """Take a trunk out of each cluster that fits none as a whole and shows one in enough slices.

    Args:
        points: float32, shape (N, 3) [m], level sensor frame.
        labels: The cluster of each point; clusters: their figures.
        sensor: Its range sigma and azimuth step say what is one surface.
        slices: So many must agree, at least.

    Returns:
        The labels: a trunk keeps the number of its cluster, and what else was in it is a cluster of its own
        after all others. And the clusters that are new or less than they were, ascending.
    """
    width = np.maximum(clusters.extent[:, 0], clusters.extent[:, 1])
    odd = (clusters.radial_std > ROUGH) | (width > WIDE) | (clusters.radius > THICK)
    asked = odd & (width < WIDEST) & (clusters.extent[:, 2] > (slices - 1) * SLICE) & ~labels.hidden
    if not asked.any():
        return labels, np.zeros(0, np.int64)
    label = labels.label.copy()
    rows, bounds = gather(np.where(asked[label] & (label >= 0), label, -1).astype(np.int32), len(asked))
    apart = _take_apart(points, rows, bounds, sensor.azimuth_step, sensor.range_sigma, slices, label)
    more = len(apart)
    rests = np.arange(labels.clusters, labels.clusters + more)
    hidden = np.concatenate([labels.hidden, np.zeros(more, np.bool_)])
    return Labels(label, labels.clusters + more, hidden), np.concatenate([apart, rests])


@compiled
def _take_apart(
    points: Float32, rows: Int, bounds: Int, step: float, sigma: float, slices: int, label: Int32
) -> Int:
    """Write the labels of what is beside a trunk; returns the clusters that have lost it, ascending."""
    clusters = bounds.shape[0] - 1
    apart, more = np.empty(clusters, np.int64), 0
    flags = np.empty((2, MOST_RUNS), np.bool_)
    whole, real = np.empty((2, MOST_RUNS), np.int64), np.empty((4, MOST_RUNS))
    room = Room(whole[0], real[0], real[1], real[2], real[3], whole[1], flags[0], flags[1])
    for k in range(clusters):
        own = rows[bounds[k] : bounds[k + 1]]
        if own.shape[0] < slices * LEAST:
            continue
        run, level = np.full(own.shape[0], -1, np.int64), np.empty(own.shape[0], np.int64)
        found = _find_runs(points, own, step, sigma, room, run, level)
        if found < slices or not _find_trunk(room, found, level, slices):
            continue
        left = 0
        for i in range(own.shape[0]):
            if run[i] < 0 or not room.best[run[i]]:
                label[own[i]] = clusters + more
                left += 1
        if left > 0:
            apart[more] = k
            more += 1
    return apart[:more].copy()


@compiled
def _find_runs(points: Float32, own: Int, step: float, sigma: float, room: Room, run: Int, level: Int) -> int:
    """Fill the room with the runs of a cluster that are bent as a trunk; say of each return of which run it
    is (-1: of none) and in which slice. Returns how many there are."""
    n = own.shape[0]
    x, y, lowest = 0.0, 0.0, np.inf
    for i in own:
        x += points[i, 0]
        y += points[i, 1]
        lowest = min(lowest, np.float64(points[i, 2]))
    away = max(np.sqrt(x * x + y * y), 1e-9)
    c, s = x / away, y / away
    # Sideways as a tangent, which grows with the angle; what stands around the sensor is no trunk.
    across, reach, key = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        px, py, pz = points[own[i], 0], points[own[i], 1], points[own[i], 2]
        ahead = c * px + s * py
        if ahead <= 0.0:
            return 0
        across[i] = (c * py - s * px) / ahead
        reach[i] = np.sqrt(px * px + py * py)
        level[i] = int((pz - lowest) / SLICE)
        key[i] = level[i] + 0.5 + 0.499 * across[i] / (1.0 + abs(across[i]))
    order = np.argsort(key)
    found, begin, jump = 0, 0, JUMP + JUMP_SIGMA * sigma
    for k in range(1, n + 1):
        if k < n:
            a, b = order[k - 1], order[k]
            turn = across[b] - across[a]
            if (
                level[a] == level[b]
                and turn <= SHOTS * step * (1.0 + across[a] * across[a])
                and abs(reach[b] - reach[a]) <= jump
            ):
                continue
        if k - begin >= LEAST and found < MOST_RUNS:
            part = order[begin:k]
            if _is_bent(part, across, reach, step, sigma, c, s, room, found):
                height = 0.0
                for i in part:
                    run[i] = found
                    height += points[own[i], 2]
                room.level[found], room.height[found] = level[part[0]], height / (k - begin)
                room.returns[found] = k - begin
                found += 1
        begin = k
    return found


@compiled
def _is_bent(
    part: Int, across: Float, reach: Float, step: float, sigma: float, c: float, s: float, room: Room, at: int
) -> bool:
    """Whether a run lies on the front of a circle as wide as it is, which is written to the room."""
    n = part.shape[0]
    right, left = np.arctan(across[part[0]]), np.arctan(across[part[n - 1]])
    mean = 0.0
    for i in part:
        mean += reach[i]
    mean /= n
    radius = 0.5 * (left - right + 0.5 * step) * mean
    if radius < RADIUS_MIN or radius > RADIUS_MAX:
        return False
    middle, quarter = 0.5 * (left + right), 0.25 * (left - right)
    front, within = 0.0, 0
    for i in part:
        if abs(np.arctan(across[i]) - middle) <= quarter:
            front += reach[i]
            within += 1
    axis = (front / within if within > 0 else mean) + FRONT * radius
    squares = 0.0
    for i in part:
        aside = (np.arctan(across[i]) - middle) * axis / radius
        off = reach[i] - (axis - radius * np.sqrt(max(1.0 - aside * aside, 0.0)))
        squares += off * off
    if squares > n * BENT * BENT * (sigma * sigma + BARK * BARK):
        return False
    ahead, beside = axis * np.cos(middle), axis * np.sin(middle)
    room.x[at], room.y[at], room.radius[at] = c * ahead - s * beside, s * ahead + c * beside, radius
    return True


@compiled
def _find_trunk(room: Room, found: int, level: Int, slices: int) -> bool:
    """Mark the runs of the trunk on which most slices agree, of as many the one with more returns."""
    most, returns = 0, 0
    for seed in range(found):
        agree, own = _ask_slices(room, found, seed)
        if agree > most or (agree == most and own > returns):
            most, returns = agree, own
            room.best[:found] = room.agrees[:found]
    if most < slices:
        return False
    lowest, highest = level.max(), 0
    for a in range(found):
        if room.best[a]:
            lowest, highest = min(lowest, room.level[a]), max(highest, room.level[a])
    seen = np.zeros(highest + 1, np.bool_)
    for here in level:
        if here <= highest:
            seen[here] = True
    return bool(most >= SHARE * np.count_nonzero(seen[lowest:]))


@compiled
def _ask_slices(room: Room, found: int, seed: int) -> tuple[int, int]:
    """Mark in each slice the run whose circle is most like that of the seed, if it is like it at all. Returns
    how many slices agree, and their returns."""
    agree, returns, a = 0, 0, 0
    near = ALIKE * room.radius[seed] + ALIKE_LEAST
    while a < found:
        here, nearest, pick = room.level[a], np.inf, -1
        while a < found and room.level[a] == here:
            room.agrees[a] = False
            dx, dy = room.x[a] - room.x[seed], room.y[a] - room.y[seed]
            off, wider = np.sqrt(dx * dx + dy * dy), abs(room.radius[a] - room.radius[seed])
            reach = APART + LEAN * abs(room.height[a] - room.height[seed])
            if off < reach and wider < near and off + wider < nearest:
                nearest, pick = off + wider, a
            a += 1
        if pick >= 0:
            room.agrees[pick] = True
            agree += 1
            returns += room.returns[pick]
    return agree, returns
