"""Crowns: the points of each tree above its stem, and the heights of the trees where the cloud shows them.

The occupied voxels of the cloud are the nodes of a graph. A point belongs to the tree from whose stem the
shortest chain of voxels leads to it (Dijkstra), where a wide step costs more than several narrow ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.inventory.stem_model import FIRST, LAST, LEAN_X, LEAN_Y, RADIUS, X, Y
from pipeline.inventory.stem_tracing import BREAST
from pipeline.inventory.terrain_raster import TerrainRaster
from pipeline.types.records import Bool, Float32, Int, Int32

CELL = 0.25  # m; side of a voxel
GAP = 2.3  # voxels; longest step of a chain
FOOT = 0.3  # m above the ground; lower points connect all trees
BARK = 0.2  # m around the stem in which a chain begins
NEAR_TOP = 0.5  # m; horizontal distance in which nothing else may rise above the top of a tree
ABOVE = 0.1  # m above the top that count
BORDER = 0.5  # m; a top so near to the border of the plot or to the upper end of the cloud may be cut
LAYER, CUT = 0.3, 0.03  # m, and share of the columns of voxels that end in it where the cloud is cut off
HIGHEST_POINTS = 10  # from which the distance between the highest returns is estimated
WIDEST = 0.5  # m; largest mean distance between the highest returns
GROUND_NEAR, GROUND_CELLS = 1.0, 5  # m; distance of visible ground from a stem; a stem covers up to 4 cells
GROUND_SIGMA = 0.05  # m; of the height of visible ground
ABRUPT = 0.05  # m; a stem that is thicker at the highest point of the tree ends out of sight


@dataclass(frozen=True, slots=True, eq=False)
class Crowns:
    """The points of each tree, and its height.

    Attributes:
        tree: Row of the tree of each point, -1 for none, int32, shape (M,).
        height: Height of the highest point above the ground at the stem, NaN where the top is not seen, shape
            (T,) [m].
        sigma: Its standard deviation [m], or NaN.
        hidden: Reason why the height is not seen; "" where it is.
    """

    tree: Int32
    height: Float
    sigma: Float
    hidden: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """The thinned points of a cloud as a graph of voxels.

    Attributes:
        points: x, y, z, height above the ground, shape (M, 4) [m]; M may be 0.
        side: Side of the cubes of the thinning [m].
        upper: Rows of the points higher than FOOT, shape (U,).
        voxel: Voxel of each of these, shape (U,).
        graph: Squared lengths of the steps between voxels, sparse, shape (K, K).
        end_z, end_h: z, and height above the ground, at which the cloud is cut off, infinite where it is not
            [m].
    """

    points: Float32
    side: float
    upper: Int
    voxel: Int
    graph: Any
    end_z: float
    end_h: float


def voxels_of(points: Float32, side: float) -> Voxels:
    """Return the graph of the voxels of a cloud; arguments as in `Voxels`."""
    from scipy.sparse import coo_matrix
    from scipy.spatial import cKDTree

    upper = np.flatnonzero(points[:, 3] > FOOT)
    keys = np.floor(points[upper, :3].astype(np.float64) / CELL).astype(np.int64)
    cells, voxel = np.unique(keys, axis=0, return_inverse=True)
    pairs = (
        cKDTree(cells).query_pairs(GAP, output_type="ndarray") if len(cells) else np.zeros((0, 2), np.int64)
    )
    square = ((cells[pairs[:, 0]] - cells[pairs[:, 1]]) ** 2).sum(axis=1).astype(np.float64)
    graph = coo_matrix((square, (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells))).tocsr()
    return Voxels(points, side, upper, voxel.reshape(-1), graph, _cut_off(points, 2), _cut_off(points, 3))


def find_crowns(voxels: Voxels, stems: Float, fits: Float, ground: TerrainRaster) -> Crowns:
    """Return the points of each tree and its height.

    The height is that of the highest point of the tree. It is not seen if the ground at the stem is not seen,
    the stem ends abruptly, the top may be cut by the border or the upper end of the cloud, something else
    rises above it, or the highest returns are far apart. The standard deviation combines the height of the
    ground, the thinning, and the mean distance between the highest returns, by which the top can be missed.

    Args:
        voxels: The cloud.
        stems: Models of the trees, shape (T, COLUMNS).
        fits: Circles of the trees, shape (T, S, FIGURES).
        ground: Height map.
    """
    points, side = voxels.points, voxels.side
    tree = np.full(len(points), -1, np.int32)
    height, sigma = np.full(len(stems), np.nan), np.full(len(stems), np.nan)
    if len(points) == 0 or len(stems) == 0:
        return Crowns(tree, height, sigma, ("no points",) * len(stems))
    tree[voxels.upper] = _nearest_stems(voxels, stems)
    places, high = points[:, :2].astype(np.float64), points[:, 2].astype(np.float64)
    low_xy, high_xy = places.min(axis=0), places.max(axis=0)
    ends = _last_radii(fits)
    hidden = []
    for k in range(len(stems)):
        rows = np.flatnonzero(tree == k)
        rows = rows[np.argsort(-high[rows], kind="stable")]
        foot = stems[k, [X, Y]] - BREAST * stems[k, [LEAN_X, LEAN_Y]]
        reason = "" if _sees_ground(ground, foot) else "the ground at the stem is not visible"
        if not reason and len(rows) < HIGHEST_POINTS:
            reason = "too few points above the stem"
        if not reason:
            top = rows[0]
            z0 = float(ground.at(foot[:1], foot[1:])[0])
            apart = float(high[top] - high[rows[HIGHEST_POINTS - 1]]) / (HIGHEST_POINTS - 1)
            around = np.hypot(*(places - places[top]).T) < NEAR_TOP
            if high[top] - z0 < stems[k, LAST] + 1.0 and ends[k] > ABRUPT:
                reason = "the stem ends abruptly: its upper part is out of sight"
            elif high[top] > voxels.end_z - BORDER or points[top, 3] > voxels.end_h - BORDER:
                reason = "the cloud is cut off at its top"
            elif (places[top] < low_xy + BORDER).any() or (places[top] > high_xy - BORDER).any():
                reason = "its top is at the border of the plot"
            elif (around & (tree != k) & (high > high[top] + ABOVE)).any():
                reason = "another crown continues above its top"
            elif apart > WIDEST:
                reason = "there are too few returns at its top"
            else:
                height[k] = high[top] - z0
                sigma[k] = np.sqrt(GROUND_SIGMA**2 + side * side / 12.0 + apart * apart)
        hidden.append(reason)
    return Crowns(tree, height, sigma, tuple(hidden))


def _nearest_stems(voxels: Voxels, stems: Float) -> Int32:
    """Return the tree from whose stem the shortest chain of voxels leads to each upper point, -1 where none
    does, shape (U,); `stems` as in `find_crowns`."""
    from scipy.sparse.csgraph import dijkstra

    n = voxels.graph.shape[0]
    seeds, owners = _seeds(voxels.points[voxels.upper].astype(np.float64), voxels.voxel, stems)
    tree = np.full(n, -1, np.int32)
    if len(seeds):
        distance, _, source = dijkstra(
            voxels.graph, directed=False, indices=seeds, min_only=True, return_predecessors=True
        )
        owner_of = np.full(n, -1, np.int32)
        owner_of[seeds] = owners
        reached = np.isfinite(distance)
        tree[reached] = owner_of[source[reached]]
    found: Int32 = tree[voxels.voxel]
    return found


def _seeds(points: Float, cell_of: Int, stems: Float) -> tuple[Int, Int32]:
    """Return the voxels in which chains begin, those on the traced stems, and the tree of each. A voxel on
    two stems belongs to the first.

    Args:
        points: x, y, z, height above the ground, shape (U, 4) [m].
        cell_of: Voxel of each point, shape (U,).
        stems: Models of the trees, shape (T, COLUMNS).
    """
    seeds: list[Int] = []
    owners: list[Int32] = []
    h = points[:, 3]
    for k, stem in enumerate(stems):
        axis = stem[[X, Y]] + (h[:, None] - BREAST) * stem[[LEAN_X, LEAN_Y]]
        on: Bool = (h >= stem[FIRST] - CELL) & (h <= stem[LAST] + CELL)
        on &= np.hypot(*(points[:, :2] - axis).T) < stem[RADIUS] + BARK
        mine = np.unique(cell_of[on])
        seeds.append(mine)
        owners.append(np.full(len(mine), k, np.int32))
    seed, first = np.unique(np.concatenate(seeds), return_index=True)
    return seed, np.concatenate(owners)[first]


def _cut_off(points: Float32, column: int) -> float:
    """Return the value of a column above which the cloud is cut off; infinite if it is not.

    The cloud is cut off if a share of more than CUT of its vertical columns of voxels ends in its uppermost
    LAYER; without a cut this layer has the tip of a single tree.

    Args:
        points: shape (M, 4) [m].
        column: 2 for z, 3 for the height above the ground.
    """
    value = points[:, column].astype(np.float64)
    if len(value) == 0:
        return np.inf
    cells, which = np.unique(np.floor(points[:, :2] / CELL).astype(np.int64), axis=0, return_inverse=True)
    ends = np.full(len(cells), -np.inf)
    np.maximum.at(ends, which.reshape(-1), value)
    last = float(value.max())
    return last if np.mean(ends > last - LAYER) > CUT else np.inf


def _last_radii(fits: Float) -> Float:
    """Return the median radius of the three highest circles of each stem, shape (T,) [m]; 0 without any."""
    out = np.zeros(len(fits))
    for k, rows in enumerate(fits):
        radii = rows[np.isfinite(rows[:, 2]), 2]
        out[k] = np.median(radii[-3:]) if len(radii) else 0.0
    return out


def _sees_ground(ground: TerrainRaster, place: Float) -> bool:
    """Return whether at least GROUND_CELLS cells with ground returns have their centres within GROUND_NEAR of
    a position, shape (2,) [m]; fewer may be the foot of the stem."""
    columns, rows = np.nonzero(ground.seen)
    centre = ground.low + (np.stack([columns, rows], axis=1) + 0.5) * ground.cell
    return bool(np.count_nonzero(np.hypot(*(centre - place).T) <= GROUND_NEAR) >= GROUND_CELLS)


__all__ = ["Crowns", "Voxels", "find_crowns", "voxels_of"]
