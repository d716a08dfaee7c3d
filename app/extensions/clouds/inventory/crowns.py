"""Crowns: the points of each tree above its stem, and the heights of the trees where the cloud shows them.

The occupied voxels of the cloud are the nodes of a graph. A point belongs to the tree from whose stem the
shortest chain of voxels leads to it (Dijkstra), where a wide step costs more than several narrow ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from app.extensions.clouds.inventory.stem_model import Stems
from app.extensions.clouds.terrain_raster import TerrainRaster
from pipeline.classification.column_extraction import BREAST
from pipeline.geometry.poses import Float
from pipeline.types.records import Float32, Int, Int32

CELL = 0.25  # m; side of a voxel, the resolution of all rules here
CUT = 0.03  # share of the columns of voxels that end in the uppermost one where the cloud is cut off
TIP = 10  # highest points of a tree, from whose gaps the error of its top is estimated
FOOT_CELLS = 4  # cells of the ground that the foot of a stem covers at most
GROUND_SIGMA = 0.05  # m; of the height of visible ground
ABRUPT = 0.05  # m; a stem that is thicker at the highest point of the tree ends out of sight


@dataclass(frozen=True, slots=True, eq=False)
class Crowns:
    """The points of each tree, and its height.

    Attributes:
        tree: Row of the tree of each point, -1 for none, int32, shape (M,).
        height: Height of the highest point above the ground at the stem, shape (T,) [m]; NaN where `hidden`
            is not "".
        sigma: Standard deviation of the height, shape (T,) [m]; NaN where the height is NaN.
        hidden: Reason why the height of each tree is unknown, length T; "" where it is known.
    """

    tree: Int32
    height: Float
    sigma: Float
    hidden: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """The thinned points of a cloud as a graph of voxels.

    Attributes:
        points: Points x, y, z and height above the ground, shape (M, 4) [m]; M may be 0.
        side: Side of the cubes of the thinning [m].
        upper: Rows of the points higher than CELL, shape (U,): lower points connect all trees.
        voxel: Voxel of each upper point, shape (U,).
        graph: Squared lengths of the steps between voxels in units of CELL, sparse, shape (K, K); each pair
            of voxels is stored once.
    """

    points: Float32
    side: float
    upper: Int
    voxel: Int
    graph: Any


def voxels_of(points: Float32, side: float) -> Voxels:
    """Return the graph of the voxels with points more than CELL above the ground. Each step leads to one of
    the 80 voxels around a voxel whose distance is at most the square root of 5 cells.

    Args:
        points: Points x, y, z and height above the ground, shape (M, 4) [m]; M may be 0.
        side: Side of the cubes of the thinning [m].
    """
    from scipy.sparse import coo_matrix
    from scipy.spatial import cKDTree

    upper = np.flatnonzero(points[:, 3] > CELL)
    keys = np.floor(points[upper, :3].astype(np.float64) / CELL).astype(np.int64)
    cells, voxel = np.unique(keys, axis=0, return_inverse=True)
    pairs = np.zeros((0, 2), np.int64)
    if len(cells):
        pairs = cKDTree(cells).query_pairs(np.sqrt(5.0) + 1e-6, output_type="ndarray")
    square = ((cells[pairs[:, 0]] - cells[pairs[:, 1]]) ** 2).sum(axis=1).astype(np.float64)
    graph = coo_matrix((square, (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells))).tocsr()
    return Voxels(points, side, upper, voxel.reshape(-1), graph)


def find_crowns(voxels: Voxels, stems: Stems, ground: TerrainRaster) -> Crowns:
    """Return the points of each tree and its height. Points up to CELL above the ground, and those without a
    chain of voxels to a stem, belong to no tree. Without any points, no height is known.

    The height is that of the highest point of the tree. It is not seen (NaN, with the reason) if the ground
    at the stem is not seen, the tree has fewer than TIP points, the stem ends abruptly, the top may be cut by
    the border or the upper end of the cloud, something else rises above it, returns above the tree are
    connected with no stem, or the highest returns are far apart. The standard deviation combines the height
    of the ground, the thinning, and the largest gap between the heights of the TIP highest points, by which
    the top can be missed.

    Args:
        voxels: The cloud.
        stems: Models of the trees, STEM of shape (T,).
        ground: Height map.
    """
    points = voxels.points.astype(np.float64)
    tree = np.full(len(points), -1, np.int32)
    height, sigma = np.full(len(stems), np.nan), np.full(len(stems), np.nan)
    if len(points) == 0 or len(stems) == 0:
        return Crowns(tree, height, sigma, ("no points",) * len(stems))
    tree[voxels.upper] = _nearest_stems(voxels, stems)
    foot = np.column_stack([stems["x"] - BREAST * stems["lean_x"], stems["y"] - BREAST * stems["lean_y"]])
    z0 = ground.at(*foot.T)
    sees_ground = ground.cells_seen_around(foot) > FOOT_CELLS
    ends = [_cut_off(points, column) for column in (2, 3)]
    low, high = points[:, :2].min(axis=0) + 2.0 * CELL, points[:, :2].max(axis=0) - 2.0 * CELL
    loose = _highest_loose(points, tree, len(stems))
    hidden = []
    for k, stem in enumerate(stems):
        rows = np.flatnonzero(tree == k)
        tip = rows[np.argsort(-points[rows, 2], kind="stable")[:TIP]]
        if not sees_ground[k]:
            hidden.append("the ground at the stem is not visible")
            continue
        if len(tip) < TIP:
            hidden.append("too few points above the stem")
            continue
        top = points[tip[0]]
        gap = float(np.diff(points[tip[::-1], 2]).max())
        over = (np.hypot(*(points[:, :2] - top[:2]).T) < 2.0 * CELL) & (points[:, 2] > top[2] + 0.5 * CELL)
        radius = stem["radius"] + stem["taper"] * (stem["last"] - BREAST)
        if top[2] - z0[k] < stem["last"] + 4.0 * CELL and radius > ABRUPT:
            hidden.append("the stem ends abruptly: its upper part is out of sight")
        elif top[2] > ends[0] - 2.0 * CELL or top[3] > ends[1] - 2.0 * CELL:
            hidden.append("the cloud is cut off at its top")
        elif (top[:2] < low).any() or (top[:2] > high).any():
            hidden.append("its top is at the border of the plot")
        elif (over & (tree != k)).any():
            hidden.append("another crown continues above its top")
        elif loose[k] > top[2] + 0.5 * CELL:
            hidden.append("returns above its top are not connected with it")
        elif gap > 2.0 * CELL:
            hidden.append("there are too few returns at its top")
        else:
            hidden.append("")
            height[k] = top[2] - z0[k]
            sigma[k] = np.sqrt(GROUND_SIGMA**2 + voxels.side**2 / 12.0 + gap**2)
    return Crowns(tree, height, sigma, tuple(hidden))


def without_heights(crowns: Crowns, why: str) -> Crowns:
    """Return crowns whose heights are all unknown (NaN) for the reason `why`; `tree` is that of the argument,
    which is not changed."""
    unknown = np.full(len(crowns.height), np.nan)
    return Crowns(crowns.tree, unknown, unknown.copy(), (why,) * len(unknown))


def _nearest_stems(voxels: Voxels, stems: Stems) -> Int32:
    """Return the row of the tree from whose stem the shortest chain of voxels leads to each upper point, -1
    for none, int32, shape (U,). Chains begin in the voxels on the traced stems; a voxel on two stems belongs
    to the stem with the lower row.

    Args:
        voxels: The cloud.
        stems: Models of the trees, STEM of shape (T,).
    """
    from scipy.sparse.csgraph import dijkstra

    points = voxels.points[voxels.upper].astype(np.float64)
    owner = np.full(voxels.graph.shape[0], -1, np.int32)
    h = points[:, 3]
    for k, stem in reversed(list(enumerate(stems))):
        off_x = points[:, 0] - stem["x"] - (h - BREAST) * stem["lean_x"]
        off_y = points[:, 1] - stem["y"] - (h - BREAST) * stem["lean_y"]
        on = (h >= stem["first"] - CELL) & (h <= stem["last"] + CELL)
        owner[voxels.voxel[on & (np.hypot(off_x, off_y) < stem["radius"] + CELL)]] = k
    seeds = np.flatnonzero(owner >= 0)
    if len(seeds):
        distance, _, source = dijkstra(
            voxels.graph, directed=False, indices=seeds, min_only=True, return_predecessors=True
        )
        reached = np.isfinite(distance)
        owner[reached] = owner[source[reached]]
    return owner[voxels.voxel]


def _highest_loose(points: Float, tree: Int32, count: int) -> Float:
    """Return for each tree the largest z [m] of the points of no tree whose nearest point of a tree is one of
    it, less than two cells aside; -inf without any."""
    from scipy.spatial import cKDTree

    highest, known = np.full(count, -np.inf), np.flatnonzero(tree >= 0)
    loose = np.flatnonzero((tree < 0) & (points[:, 3] > CELL))
    if len(known) and len(loose):
        nearest = known[cKDTree(points[known, :3]).query(points[loose, :3])[1]]
        over = np.hypot(*(points[loose, :2] - points[nearest, :2]).T) < 2.0 * CELL
        np.maximum.at(highest, tree[nearest[over]], points[loose[over], 2])
    return highest


def _cut_off(points: Float, column: int) -> float:
    """Return the largest value of a column if the cloud is cut off there; infinite if it is not.

    The cloud is cut off if more than the share CUT of its vertical columns of voxels ends in its uppermost
    CELL.

    Args:
        points: Points x, y, z and height above the ground, shape (M, 4) [m], M at least 1.
        column: 2 for z, 3 for the height above the ground.
    """
    cells, which = np.unique(np.floor(points[:, :2] / CELL).astype(np.int64), axis=0, return_inverse=True)
    ends = np.full(len(cells), -np.inf)
    np.maximum.at(ends, which.reshape(-1), points[:, column])
    last = float(points[:, column].max())
    return last if np.mean(ends > last - CELL) > CUT else np.inf
