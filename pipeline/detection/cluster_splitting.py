"""Separation of a trunk from a cluster that also contains shrubs or low branches.

The cluster is cut into height slices. In each slice, adjacent returns without a range jump form a run. A run
whose returns follow the front of a circle as wide as the run is a section of a stem. Where the circles of
enough slices are above each other, their returns are the trunk. Vegetation beside a trunk hides some of the
slices, rarely all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.detection.cylinder_fit import BARK, PRIOR_LEAN_SIGMA
from pipeline.geometry.hash_grid import group_rows
from pipeline.geometry.ordering import ascending_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Clusters, Float32, Int, Int32, Labels, Sensor

SLICE = 0.2  # m; of height
LEAST = 3  # minimum returns of a run
# m; a cluster of a larger radial deviation, twice that of a trunk with bark, is not a single trunk
ROUGH = 0.06
WIDEST = 2.5  # m; wider clusters (hedges, walls) are not split
SHOTS = 2.6  # maximum distance between returns of a run in shots; one may be missing
JUMP, JUMP_SIGMA = 0.06, 3.0  # m, and multiples of the range sigma: maximum range jump within a run
BENT = 2.0  # sigma; maximum root mean square distance of a run to its circle
# m, and m per metre of height: maximum distance between circles of one trunk
APART, LEAN = 0.06, PRIOR_LEAN_SIGMA
ALIKE, ALIKE_LEAST = 0.3, 0.02  # fraction of the radius, and m: maximum difference between their radii
SHARE = 0.6  # minimum share of agreeing slices among those with returns between the lowest and highest circle
FRONT = 0.95  # distance between the middle half of a run and the axis, as a fraction of the radius
MOST_RUNS = 600  # capacity of the run table


class Runs(NamedTuple):
    """Table of the runs of one cluster, each column of shape (MOST_RUNS,).

    Attributes:
        level: Index of the height slice.
        x, y, radius: Centre in the sensor frame and radius of the circle of the run [m].
        height: Mean z of the returns of the run [m].
        returns: Number of returns of the run.
        agrees: Whether the run belongs to the current trunk hypothesis.
        best: Whether the run belongs to the best trunk hypothesis.
    """

    level: Int
    x: Float
    y: Float
    radius: Float
    height: Float
    returns: Int
    agrees: Bool
    best: Bool


def split_trunks(
    points: Float32,
    labels: Labels,
    clusters: Clusters,
    sensor: Sensor,
    slices: int,
    radius_bounds: tuple[float, float],
) -> tuple[Labels, Int]:
    """Separate a trunk from each cluster that is not a single trunk but shows one in enough slices. The
    arguments are not changed.

    Only clusters are examined that are too rough (ROUGH), too wide (more than the largest diameter) or too
    thick (more than the largest radius) for a trunk, narrower than WIDEST, high enough for the slices, and
    not hidden at an edge.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        labels: Cluster of each point; not changed.
        clusters: Shape of each cluster.
        sensor: Range sigma and azimuth step of the LiDAR.
        slices: Minimum number of agreeing slices, at least 1.
        radius_bounds: Smallest and largest radius of a trunk [m].

    Returns:
        Labels in which a trunk keeps the number of its cluster and the remaining points form a new cluster
        with a number above all others, which counts as not hidden; and the ascending numbers of the reduced
        and of the new clusters, int64. If no trunk is separated, the labels are equal to the argument and
        there are no numbers.
    """
    width = np.maximum(clusters.extent[:, 0], clusters.extent[:, 1])
    thickest = radius_bounds[1]
    odd = (clusters.radial_std > ROUGH) | (width > 2.0 * thickest) | (clusters.radius > thickest)
    asked = odd & (width < WIDEST) & (clusters.extent[:, 2] > (slices - 1) * SLICE) & ~labels.hidden
    if not asked.any():
        return labels, np.zeros(0, np.int64)
    label = labels.label.copy()
    rows, bounds = group_rows(np.where(asked[label] & (label >= 0), label, -1).astype(np.int32), len(asked))
    apart = _split_trunks(
        points, rows, bounds, sensor.azimuth_step, sensor.range_sigma, slices, radius_bounds, label
    )
    more = len(apart)
    rests = np.arange(labels.clusters, labels.clusters + more)
    hidden = np.concatenate([labels.hidden, np.zeros(more, np.bool_)])
    return Labels(label, labels.clusters + more, hidden), np.concatenate([apart, rests])


@compiled
def _split_trunks(
    points: Float32,
    rows: Int,
    bounds: Int,
    step: float,
    sigma: float,
    slices: int,
    radius_bounds: tuple[float, float],
    label: Int32,
) -> Int:
    """Give the points that do not belong to trunks new numbers in `label`, in place: the i-th reduced cluster
    leaves a cluster with the number K + i. Return the ascending numbers of the reduced clusters, int64. A
    cluster whose points all belong to the trunk is not reduced.

    Args:
        points: Points, shape (N, 3) [m], sensor frame.
        rows: Rows of the points in the order of the clusters; those of clusters that are not examined are
            missing.
        bounds: First index of each cluster in `rows`, and the length of `rows`, shape (K + 1,).
        step: Azimuth step of the sensor [rad].
        sigma: Standard deviation of a range [m].
        slices: Number of slices that must agree.
        radius_bounds: Smallest and largest radius of a trunk [m].
        label: Cluster of each point, shape (N,); changed.
    """
    clusters = bounds.shape[0] - 1
    apart, more = np.empty(clusters, np.int64), 0
    flags = np.empty((2, MOST_RUNS), np.bool_)
    whole, real = np.empty((2, MOST_RUNS), np.int64), np.empty((4, MOST_RUNS))
    runs = Runs(whole[0], real[0], real[1], real[2], real[3], whole[1], flags[0], flags[1])
    for k in range(clusters):
        own = rows[bounds[k] : bounds[k + 1]]
        if own.shape[0] < slices * LEAST:
            continue
        run, level = np.full(own.shape[0], -1, np.int64), np.empty(own.shape[0], np.int64)
        found = _find_runs(points, own, step, sigma, radius_bounds, runs, run, level)
        if found < slices or not _find_trunk(runs, found, level, slices):
            continue
        left = 0
        for i in range(own.shape[0]):
            if run[i] < 0 or not runs.best[run[i]]:
                label[own[i]] = clusters + more
                left += 1
        if left > 0:
            apart[more] = k
            more += 1
    return apart[:more].copy()


@compiled
def _find_runs(
    points: Float32,
    own: Int,
    step: float,
    sigma: float,
    radius_bounds: tuple[float, float],
    runs: Runs,
    run: Int,
    level: Int,
) -> int:
    """Find the runs of a cluster that follow the front of a circle, and return their number, at most
    MOST_RUNS (further ones are ignored). Runs of fewer than LEAST returns are left out.

    Fills the table of runs, ordered by slice, the run of each return (unchanged, -1, for none) and its slice.
    The result is 0 for a cluster that is partly behind the sensor as seen along the direction to its
    centroid; then the slices are incomplete.

    Args:
        points: Points, shape (N, 3) [m], sensor frame.
        own: Rows of the points of the cluster, shape (n,).
        step: Azimuth step of the sensor [rad].
        sigma: Standard deviation of a range [m].
        radius_bounds: Smallest and largest radius of a trunk [m].
        runs: The table; the columns `agrees` and `best` are not written.
        run: Run of each return, shape (n,); must be -1; changed.
        level: Filled with the slice of each return, counted from the lowest return, shape (n,).
    """
    n = own.shape[0]
    x, y, lowest = 0.0, 0.0, np.inf
    for i in own:
        x += points[i, 0]
        y += points[i, 1]
        lowest = min(lowest, np.float64(points[i, 2]))
    away = max(np.sqrt(x * x + y * y), 1e-9)
    c, s = x / away, y / away
    # The lateral position is a tangent, monotonic in the angle; a cluster around the sensor is not a trunk.
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
    order = ascending_rows(key)
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
            if _follows_circle(part, across, reach, step, sigma, radius_bounds, c, s, runs, found):
                height = 0.0
                for i in part:
                    run[i] = found
                    height += points[own[i], 2]
                runs.level[found], runs.height[found] = level[part[0]], height / (k - begin)
                runs.returns[found] = k - begin
                found += 1
        begin = k
    return found


@compiled
def _follows_circle(
    part: Int,
    across: Float,
    reach: Float,
    step: float,
    sigma: float,
    radius_bounds: tuple[float, float],
    c: float,
    s: float,
    runs: Runs,
    at: int,
) -> bool:
    """Return whether a run follows the front of a circle as wide as the run (radius within the bounds, root
    mean square residual up to BENT sigma), and if so write x, y and radius of the circle into the table.

    Args:
        part: Indices in `across` and `reach` of the returns of the run, from right to left.
        across: Tangent of the azimuth of each return of the cluster, from its middle, shape (n,).
        reach: Horizontal range of each return [m], shape (n,).
        step: Azimuth step of the sensor [rad].
        sigma: Standard deviation of a range [m].
        radius_bounds: Smallest and largest radius of a trunk [m].
        c, s: Cosine and sine of the azimuth of the middle of the cluster.
        runs: The table.
        at: Row that is written.
    """
    n = part.shape[0]
    right, left = np.arctan(across[part[0]]), np.arctan(across[part[n - 1]])
    mean = 0.0
    for i in part:
        mean += reach[i]
    mean /= n
    radius = 0.5 * (left - right + 0.5 * step) * mean
    if not radius_bounds[0] <= radius <= radius_bounds[1]:
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
    runs.x[at], runs.y[at], runs.radius[at] = c * ahead - s * beside, s * ahead + c * beside, radius
    return True


@compiled
def _find_trunk(runs: Runs, found: int, level: Int, slices: int) -> bool:
    """Mark the runs of the trunk with the most agreeing slices, and among these the most returns, in
    `runs.best`, and return whether it is accepted: at least `slices` agree, and at least the share SHARE of
    the slices with returns between its lowest and its highest run.

    Args:
        runs: Table of the runs, ordered by slice; `agrees` and `best` are overwritten.
        found: Number of runs, at least 1.
        level: Slice of each return of the cluster, shape (n,).
        slices: Minimum number of agreeing slices.
    """
    most, returns = 0, 0
    for seed in range(found):
        agree, own = _count_agreeing_slices(runs, found, seed)
        if agree > most or (agree == most and own > returns):
            most, returns = agree, own
            for run in range(found):
                runs.best[run] = runs.agrees[run]
    if most < slices:
        return False
    highest = 0
    lowest = runs.level[found - 1]  # ordered by slice
    for a in range(found):
        if runs.best[a]:
            lowest, highest = min(lowest, runs.level[a]), max(highest, runs.level[a])
    seen, filled = np.zeros(highest + 1, np.bool_), 0
    for here in level:
        if lowest <= here <= highest and not seen[here]:
            seen[here] = True
            filled += 1
    return bool(most >= SHARE * filled)


@compiled
def _count_agreeing_slices(runs: Runs, found: int, seed: int) -> tuple[int, int]:
    """Mark in `runs.agrees`, in each slice, the run whose circle is most similar to that of the seed run, if
    one is within the limits of distance and radius; the seed agrees with itself.

    Args:
        runs: Table of the runs, ordered by slice.
        found: Number of runs.
        seed: Row of the seed run.

    Returns:
        Number of agreeing slices, and number of the returns of the marked runs.
    """
    agree, returns, a = 0, 0, 0
    near = ALIKE * runs.radius[seed] + ALIKE_LEAST
    while a < found:
        here, nearest, pick = runs.level[a], np.inf, -1
        while a < found and runs.level[a] == here:
            runs.agrees[a] = False
            dx, dy = runs.x[a] - runs.x[seed], runs.y[a] - runs.y[seed]
            off, wider = np.sqrt(dx * dx + dy * dy), abs(runs.radius[a] - runs.radius[seed])
            reach = APART + LEAN * abs(runs.height[a] - runs.height[seed])
            if off < reach and wider < near and off + wider < nearest:
                nearest, pick = off + wider, a
            a += 1
        if pick >= 0:
            runs.agrees[pick] = True
            agree += 1
            returns += runs.returns[pick]
    return agree, returns
