"""The way that shows trees without a diameter from the sides that were never seen.

A diameter needs views of a stem from an arc of `tracking.dbh_arc_min`. The places that would add the missing
part are known from the sectors that were seen (`Trees.sides`); the way visits them through the cells of the
observed area without undergrowth, clear of the trees. The shortest way that visits one place of each of
several sets is a generalised travelling salesman problem; here the place with the largest ratio of gain to
distance is always the next one, where each tree gains the share of its missing sectors that the place shows
(the greedy set cover of Chvatal, 1979).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.tracking.observation import SECTORS, WIDTH

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from pipeline.seen_area import SeenArea
    from pipeline.types.records import Bool, Float, Int

#: Arc that one view of a stem shows at least [rad]: a stem that is far in relation to its radius shows nearly
#: half, of which the outermost parts give few returns.
VIEW_ARC = math.radians(120.0)
#: Distances from which a view counts [m]: nearer, a stem fills the view; farther, beams of 0.2 degrees are
#: more than 3 cm apart, the largest standard deviation of a reported diameter of up to 30 cm.
NEAREST_VIEW, FARTHEST_VIEW = 1.0, 8.0
#: Share of the trees without a diameter after which the way ends.
MOST = 0.9
#: Length that each further place costs besides its distance, so that near places are not all visited [m].
STOP_COST = 2.0
#: Length within which the next place is searched first [m]: three times the view.
NEARBY = 25.0
#: Radius of a stem without a diameter [m], for the clearance: that of a stem of 60 cm.
UNKNOWN_RADIUS = 0.3


class Detour(NamedTuple):
    """A way that shows trees from further sides.

    Attributes:
        points: Corners of the way, shape (K, 2), frame of the map [m]; the first one is the robot.
        trees: Rows of the trees that it completes, ascending.
        length: Length of the way [m].
    """

    points: Float
    trees: list[int]
    length: float


def shortest_detour(
    start: Float,
    position: Float,
    radius: Float,
    sides: Sequence[int | None],
    arc: float,
    seen: SeenArea,
    width: float,
) -> Detour | None:
    """Return the way from the robot that completes the views of most of the trees without a diameter; None if
    there is none that completes one.

    Args:
        start: Position of the robot, shape (2,) [m].
        position, radius: Positions of all trees, shape (N, 2), and their radii, shape (N,) [m], NaN where
            unknown.
        sides: Sectors from which each tree without a diameter was seen, see `Trees.sides`; None for the
            others.
        arc: Arc that a diameter needs [rad].
        seen: The observed area; the way stays in its clear cells.
        width: Width of the robot with its lateral clearance [m].
    """
    radius = np.where(np.isfinite(radius), radius, UNKNOWN_RADIUS)
    graph, centres = _walkable(position, radius, seen, width)
    wanted = [row for row, bits in enumerate(sides) if bits is not None]
    known = np.array([sides[row] for row in wanted], np.int64)
    needed = math.ceil(arc / WIDTH - 1e-9)  # sectors
    lacking = np.bitwise_count(known) < needed
    if not len(centres) or not lacking.any():
        return None
    views = _views(centres, wanted, position, radius)
    cell = int(np.argmin(np.hypot(*(centres - start).T)))
    way, missing = [cell], lacking
    while missing.sum() > (1.0 - MOST) * lacking.sum():
        lack = np.maximum(needed - np.bitwise_count(known).astype(np.int64), 1)[views.tree]
        new = np.minimum(np.bitwise_count(views.sectors & ~known[views.tree]), lack) / lack  # of a tree
        gain = np.bincount(views.cell, new * missing[views.tree], len(centres)).astype(np.float64)
        leg = _best_leg(graph, way[-1], gain)
        if not leg:
            break
        way += leg
        on_leg = np.isin(views.cell, leg)
        np.bitwise_or.at(known, views.tree[on_leg], views.sectors[on_leg])
        missing = lacking & (np.bitwise_count(known) < needed)
    completed = lacking & ~missing
    if not completed.any() or len(way) == 1:
        return None
    points = np.concatenate([np.reshape(start, (1, 2)), _straightened(centres[way], 0.5 * seen.cell)])
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    return Detour(points, [wanted[k] for k in np.flatnonzero(completed)], length)


def _walkable(position: Float, radius: Float, seen: SeenArea, width: float) -> tuple[csr_array, Float]:
    """Return the graph of the cells that the robot can enter, with the distances of their eight neighbours
    [m], and their centres, shape (K, 2) [m]."""
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    seen = seen.where(seen.clear)  # not through undergrowth
    centres = seen.centres
    if len(position) and len(centres):
        clear = radius + 0.5 * width + seen.cell * math.sqrt(0.5)  # from anywhere in the cell
        blocked = [row for rows in cKDTree(centres).query_ball_point(position, clear) for row in rows]
        free = np.ones(len(centres), np.bool_)
        free[blocked] = False
        seen = seen.where(free)
        centres = seen.centres
    if not len(centres):
        return csr_array((0, 0)), centres
    pairs = cKDTree(seen.place).query_pairs(1.5, output_type="ndarray")  # sqrt(2) for diagonal neighbours
    lengths = np.hypot(*(centres[pairs[:, 0]] - centres[pairs[:, 1]]).T)
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    return csr_array((np.tile(lengths, 2), (rows, columns)), shape=(len(centres),) * 2), centres


class _Views(NamedTuple):
    """What is shown of trees from cells, a row per pair: `cell`, `tree`, and `sectors`, the bits of the
    sectors of the tree that a view from the cell shows as a whole; each int64, shape (M,)."""

    cell: Int
    tree: Int
    sectors: Int


def _views(places: Float, wanted: Sequence[int], position: Float, radius: Float) -> _Views:
    """Return the views of the wanted trees (by their index in `wanted`) from the places that are neither too
    near nor too far, without another stem in between."""
    rows, middles = [], (np.arange(SECTORS) + 0.5) * WIDTH
    for column, tree in enumerate(wanted):
        there = places - position[tree]
        distance = np.hypot(*there.T)
        near = np.flatnonzero((distance >= NEAREST_VIEW) & (distance <= FARTHEST_VIEW))
        near = near[~_hidden(places[near], tree, position, radius)]
        bearing = np.arctan2(there[near, 1], there[near, 0])
        apart = np.abs((middles - bearing[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
        sectors = (apart <= 0.5 * (VIEW_ARC - WIDTH)) @ (1 << np.arange(SECTORS))
        rows.append(np.stack([near, np.full(len(near), column), sectors]))
    return _Views(*np.concatenate(rows, axis=1))


def _best_leg(graph: csr_array, start: int, gain: Float) -> list[int]:
    """Return the cells from a cell to the one with the largest ratio of gain to distance, without the first;
    [] if no other one that can be reached has a gain. Cells beyond NEARBY count only if no nearer one has."""
    from scipy.sparse.csgraph import dijkstra

    gain[start] = 0.0
    for limit in (NEARBY, np.inf):
        distance, before = dijkstra(graph, indices=start, return_predecessors=True, limit=limit)
        ratio = gain / (distance + STOP_COST)
        best = int(np.argmax(ratio))
        if ratio[best] > 0.0:
            leg = [best]
            while leg[-1] != start:
                leg.append(int(before[leg[-1]]))
            return leg[-2::-1]
    return []


def _hidden(places: Float, tree: int, position: Float, radius: Float) -> Bool:
    """Return whether another stem is between a place and a tree, shape (K,)."""
    end = position[tree]
    others = np.flatnonzero(np.hypot(*(position - end).T) < FARTHEST_VIEW)
    others = others[others != tree]
    along = end - places
    share = (
        np.einsum("kd,kmd->km", along, position[others] - places[:, None]) / np.sum(along**2, axis=1)[:, None]
    )
    foot = places[:, None] + np.clip(share, 0.0, 1.0)[..., None] * along[:, None]
    gap = np.hypot(*np.moveaxis(position[others] - foot, -1, 0))
    return np.asarray((gap < radius[others]).any(axis=1), np.bool_)


def _straightened(points: Float, tolerance: float) -> Float:
    """Return the corners of a way through neighbouring cells, at most a tolerance [m] from them."""
    import shapely

    if len(points) < 2:
        return points
    return np.asarray(shapely.get_coordinates(shapely.LineString(points).simplify(tolerance)), np.float64)
