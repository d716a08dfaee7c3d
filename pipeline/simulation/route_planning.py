"""A way for the robot through a real plot: a loop between the stems, on a map of what stands in the way."""

from __future__ import annotations

import numpy as np

from pipeline.errors import SourceError
from pipeline.inventory.terrain_raster import HeightMap
from pipeline.types.records import Bool, Float, Float32, Int

CELL = 0.1  # m
LOW, HIGH = 0.25, 1.6  # m above the ground; what stands there is in the way
# Points of a cell that is in the way, as parts of what the densest cells hold: stems do, and leaves do not,
# through which a robot can push where there is no other way.
DENSITIES = (0.02, 0.1, 0.25, 0.5)
DENSE = 98  # percentile
REACHES = 0.5  # part of the plot, along both axes, that the way must reach over
CLEARANCES = (0.6, 0.45, 0.35, 0.25)  # m; the widest with which there is a loop
STATIONS = 16
PART = 0.6  # of the way from the middle to the border
SIDE = 0.2  # m, of the cells in which the way is sought
SPACING = 0.8  # m; between waypoints


def loop_through(points: Float32, ground: HeightMap, where: str) -> Float:
    """Waypoints of a closed loop, shape (N, 2) [m], always the same for the same cloud.

    Args:
        points: shape (N, 4): x, y, z, height above the ground [m].
        ground: Of the plot; the robot stays where it was seen.
        where: Name of the cloud, for the error.

    Raises:
        SourceError: Stems and undergrowth leave no way.
    """
    count = _obstacles(points, ground)
    densest = float(np.percentile(count[count > 0], DENSE)) if (count > 0).any() else 1.0
    for density in DENSITIES:
        clearance = _clearance(count < max(density * densest, 1.0), ground)
        for least in CLEARANCES:
            loop = _loop(clearance, least)
            if loop is not None:
                return ground.low + (loop + 0.5) * SIDE
    raise SourceError("there is no free way for a robot through the plot", where=where)


def _obstacles(points: Float32, ground: HeightMap) -> Int:
    """How many points stand in the way in each cell of CELL."""
    times = round(ground.cell / CELL)
    shape = (ground.seen.shape[0] * times, ground.seen.shape[1] * times)
    way = points[(points[:, 3] > LOW) & (points[:, 3] < HIGH)]
    cell = np.floor((way[:, :2] - ground.low) / CELL).astype(np.int64)
    inside = ((cell >= 0) & (cell < shape)).all(axis=1)
    count = np.zeros(shape, np.int64)
    np.add.at(count, tuple(cell[inside].T), 1)
    return count


def _clearance(free: Bool, ground: HeightMap) -> Float:
    """Distance to what stands in the way, of cells of SIDE [m]; where no ground was seen nobody drives."""
    from scipy.ndimage import binary_dilation, distance_transform_edt

    seen = binary_dilation(ground.seen, iterations=1)
    times = round(ground.cell / CELL)
    free = free & np.kron(seen, np.ones((times, times), np.bool_))
    distance = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * CELL
    both = round(SIDE / CELL)
    columns, rows = (n - n % both for n in distance.shape)
    coarse: Float = (
        distance[:columns, :rows].reshape(columns // both, both, rows // both, both).min(axis=(1, 3))
    )
    return coarse


def _loop(clearance: Float, least: float) -> Float | None:
    """A closed way over cells with at least so much clearance, None where there is none."""
    from scipy.ndimage import label

    region, regions = label(clearance >= least)
    if regions == 0:
        return None
    largest = region == 1 + int(np.argmax(np.bincount(region.ravel())[1:]))
    stations = _stations(clearance, largest)
    if len(stations) < 5 or (np.ptp(stations, axis=0) < REACHES * np.array(region.shape)).any():
        return None
    way = _joined(clearance, largest, stations)
    every = max(int(SPACING / SIDE), 1)
    loop: Float = way[::every].astype(np.float64)
    return loop if len(loop) >= 6 else None


def _stations(clearance: Float, region: Bool) -> Int:
    """Cells around the middle where the way is widest, one in each direction that has any."""
    cells = np.argwhere(region)
    middle = cells.mean(axis=0)
    off = cells - middle
    angle = np.arctan2(off[:, 1], off[:, 0])
    away = np.hypot(*off.T)
    chosen = []
    for k in range(STATIONS):
        there = (
            np.abs((angle - 2.0 * np.pi * k / STATIONS + np.pi) % (2.0 * np.pi) - np.pi) < np.pi / STATIONS
        )
        if not there.any():
            continue
        ideal = PART * away[there].max()
        width = clearance[tuple(cells[there].T)]
        cost = np.abs(away[there] - ideal) * SIDE - 1.5 * np.minimum(width, 1.0)
        chosen.append(cells[there][int(np.argmin(cost))])
    return np.array(chosen).reshape(-1, 2)


def _joined(clearance: Float, region: Bool, stations: Int) -> Int:
    """The cheapest way from station to station and back; narrow places are dear."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    number = np.full(region.shape, -1)
    number[region] = np.arange(int(region.sum()))
    starts, ends, costs = [], [], []
    for step in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = np.argwhere(region)
        b = a + step
        good = ((b >= 0) & (b < region.shape)).all(axis=1)
        a, b = a[good], b[good]
        good = region[tuple(b.T)]
        a, b = a[good], b[good]
        narrow = 1.0 / np.minimum(clearance[tuple(a.T)], clearance[tuple(b.T)])
        starts.append(number[tuple(a.T)])
        ends.append(number[tuple(b.T)])
        costs.append(np.hypot(*step) * (1.0 + narrow**2))
    n = int(region.sum())
    graph = coo_array((np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))), shape=(n, n))
    at = number[tuple(stations.T)]
    before = dijkstra(graph.tocsr(), directed=False, indices=at, return_predecessors=True)[1]
    cells = np.argwhere(region)
    way = []
    for k in range(len(at)):
        part, here = [], int(at[(k + 1) % len(at)])
        while here != at[k]:
            part.append(here)
            here = int(before[k, here])
        way += part[::-1]
    # Where it goes into a corner and back the same way, it turns at once.
    kept: list[int] = []
    for cell in way:
        if len(kept) >= 2 and kept[-2] == cell:
            kept.pop()
        else:
            kept.append(cell)
    return cells[kept]
