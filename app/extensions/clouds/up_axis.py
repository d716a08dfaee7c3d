"""The axis of a whole cloud that points up, by its ground and its stems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.types.records import Bool, Float

_AXES = ("x", "y", "z")
#: Axes that can point up, and the rotation that turns each to z.
UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "-x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
}
#: How the warning begins if the axis that points up is not clear.
UP_UNCLEAR = "it is not clear which axis of the cloud points up"

_CELL = 0.5  # m, as the cells of the terrain
_LEAST_IN_CELL, _LEAST_CELLS = 5, 50
_NEAR = 0.25  # m above the lowest points of a cell
#: Slope between neighbouring cells of a ground: 0.00 to 0.15 on plots and maps of a LIO. Across other axes it
#: is 0.3 and more, or as small where a plot was cut straight; then fewer points lie near it (0.2 of 0.6).
_SMOOTH = 0.25
_CLEARER = 3.0  # times as smooth as across z
_FULLER = 1.8  # times as many points near it as across z
#: Slope between neighbouring cells beyond which they are no ground.
_STEEP = 1.0
#: Largest share of steeper slopes across x or y, and across -z. The share is 0.00 to 0.05 on a ground with
#: undergrowth, and 0.16 and more at the straight side of a plot with few points of the ground.
#: At the top of a plot that was cut level it is 0.1 and more, or no smaller than that of the ground below.
_FEW_STEEP, _FEWER_STEEP = 0.1, 0.02
_STEEPER = 5.0  # times as many of them across z


#: Side of the voxels in which stems are found, shortest run of voxels of a stem along its axis, and distance
#: around it that is empty [m]: stems stand apart, while ground, walls and crowns go on to the side.
_VOXEL, _BOLE, _APART = 0.2, 1.0, 0.6
#: Fewest voxels of stems, and how many times as many as along other axes. Along the stems of pine, lodgepole
#: pine and ponderosa plots it is 4 and more, also of those cut at 2 m or thinned to 30 %.
_FEWEST_VOXELS, _MORE_VOXELS = 50, 3.0
_TESTED = 5000  # voxels per axis that are tested for what is around them
#: Length that crowns have above the free boles of trees at least [m], and times the length below: it is 3 to
#: 6 times on whole trees, and about 1 time where the plot was cut below its crowns.
_CROWN, _LONGER = 5.0, 2.0


@dataclass(frozen=True, slots=True)
class _Surface:
    """The lowest points across an axis.

    Attributes:
        slope: Median slope between the lowest points of neighbouring cells; inf for few cells.
        near: Share of points near them.
        steep: Share of slopes beyond _STEEP.
    """

    slope: float
    near: float
    steep: float

    @property
    def is_ground(self) -> bool:
        """Whether it can be a ground."""
        return self.slope <= _SMOOTH and self.steep <= _FEW_STEEP

    def is_clear_of(self, top: _Surface) -> bool:
        """Return whether it can be a ground while the surface on the other end cannot. Upside down, ground
        without trees is as smooth as the other way up, but the tops of the trees are not."""
        few = self.steep <= _FEWER_STEEP and top.steep > _STEEPER * max(self.steep, 0.5 * _FEWER_STEEP)
        return self.slope <= _SMOOTH and few


@dataclass(frozen=True, slots=True)
class _Boles:
    """Voxels of stems that run along an axis and have nothing around them.

    Attributes:
        voxels: Number of them.
        below, above: Median length of what is below and above them in their place [m].
    """

    voxels: int
    below: float
    above: float


def turned_words(up: str) -> str:
    """Return which axes of the file become x and y, such as "x and -z"."""
    rows = UP[up][:2]
    return " and ".join(f"{'-' if row.sum() < 0 else ''}{_AXES[int(np.abs(row).argmax())]}" for row in rows)


def up_by_ground(metres: Float) -> tuple[str, tuple[str, ...]]:
    """Return the axis that points up, a key of UP, and those that may point up instead if it is not clear.

    The axis is that of the stems, if there are some and the lowest points across z have steps: the ground is
    at the end away from the crowns, or where the surface is smooth. Else it is the axis across which the
    lowest points are a ground, while those across z are rougher or have fewer points near them.

    Args:
        metres: Points, shape (N, 3) [m].
    """
    if len(metres) < _LEAST_IN_CELL * _LEAST_CELLS or not (np.abs(metres) < 1e8).all():
        return "z", ()
    surfaces = {up: _Surface(*_lowest_surface(metres @ R.T)) for up, R in UP.items()}
    z = surfaces["z"]
    # The side of a plot that was cut straight has more steps.
    is_sure = z.is_ground and z.steep <= _FEWER_STEEP
    boles = {} if is_sure else {axis: _boles(metres @ UP[axis].T) for axis in _AXES}
    stems = _axis_of_stems(boles)
    if stems:
        ends = stems, f"-{stems}"
        up = _end_of_ground(ends, surfaces, boles[stems])
        if stems == "z":
            is_turned = up == "-z" and (not z.is_ground or surfaces["-z"].is_clear_of(z))
            return "-z" if is_turned else "z", ()
        if up and (not z.is_ground or surfaces[up].near > z.near):
            return up, ()
        return "z", ends
    sides = {up: surfaces[up] for up in ("y", "-y", "x", "-x")}
    sides = {up: side for up, side in sides.items() if side.is_ground and side.near > z.near}
    found = {
        up: side.near
        for up, side in sides.items()
        if np.isfinite(z.slope) and (_CLEARER * side.slope < z.slope or side.near > _FULLER * z.near)
    }
    if found:  # more points lie near the ground than near the tops
        return max(found, key=found.__getitem__), ()
    if surfaces["-z"].is_clear_of(z):
        return "-z", ()
    return "z", () if z.is_ground else tuple(sides)


def _axis_of_stems(boles: dict[str, _Boles]) -> str:
    """Return the axis along which clearly most stems run; "" if none is clear."""
    order = sorted(boles, key=lambda axis: boles[axis].voxels)
    if not order:
        return ""
    most, second = boles[order[-1]].voxels, boles[order[-2]].voxels
    return order[-1] if most >= max(_FEWEST_VOXELS, _MORE_VOXELS * second) else ""


def _end_of_ground(ends: tuple[str, str], surfaces: dict[str, _Surface], boles: _Boles) -> str:
    """Return at which of two ends of stems the ground is: away from the crowns if more points lie near it,
    or where only this end has a smooth surface; "" if it is not clear.

    Args:
        ends: The positive and the negative axis of the stems, keys of UP.
        surfaces: Dict from the keys of UP to the lowest points across them.
        boles: The stems, with the first of the ends up.
    """
    here, there = (surfaces[end] for end in ends)
    long = max(boles.below, boles.above) >= _CROWN
    if long and boles.above >= _LONGER * boles.below and here.near > there.near:
        return ends[0]
    if long and boles.below >= _LONGER * boles.above and there.near > here.near:
        return ends[1]
    for end, own, other in ((ends[0], here, there), (ends[1], there, here)):
        smoother = own.is_ground and own.near > other.near and own.steep < other.steep
        if end == "-z":
            smoother = smoother and _CLEARER * own.slope < other.slope
        if smoother or own.is_clear_of(other):
            return end
    return ""


def _boles(points: Float) -> _Boles:
    """Return the voxels of stems.

    Args:
        points: Points with the axis of the stems up, shape (N, 3) [m].
    """
    around = round(_APART / _VOXEL)
    place = np.floor((points - points.min(axis=0)) / _VOXEL).astype(np.int64) + around
    if place.max() >= (1 << 20):  # an extent of 200 km
        return _Boles(0, 0.0, 0.0)
    step = np.array([1 << 42, 1 << 21, 1])  # z is last, so that the sorted voxels of a column are neighbours
    key = np.unique(place @ step)
    place = np.stack([key >> 42, (key >> 21) & ((1 << 21) - 1), key & ((1 << 21) - 1)], axis=1)
    runs = [_runs(place, axis) for axis in range(3)]
    across = np.maximum(runs[0], runs[1])
    tested = np.flatnonzero((runs[2] * _VOXEL >= _BOLE) & (2 * across <= runs[2]) & (across < 2 * around))
    share = max(1, -(-len(tested) // _TESTED))
    tested = tested[::share]
    side = np.arange(-around, around + 1)
    ring = [(i, j) for i in side for j in side if max(abs(i), abs(j)) == around]
    alone = np.ones(len(tested), np.bool_)
    for i, j in ring:
        wanted = key[tested] + i * step[0] + j * step[1]
        alone &= key[np.minimum(np.searchsorted(key, wanted), len(key) - 1)] != wanted
    tested = tested[alone]
    if not len(tested):
        return _Boles(0, 0.0, 0.0)
    wide = 2 * around - 1  # voxels of a place, 1 m
    cell = ((place[:, 0] // wide) << 32) + place[:, 1] // wide
    order = np.lexsort((place[:, 2], cell))
    first, last = (np.searchsorted(cell[order], cell[tested], side=end) for end in ("left", "right"))
    below = place[tested, 2] - place[order[first], 2]
    above = place[order[last - 1], 2] - place[tested, 2]
    return _Boles(share * len(tested), _VOXEL * float(np.median(below)), _VOXEL * float(np.median(above)))


def _runs(place: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Return the number of occupied voxels in a row along an axis, for each occupied voxel, shape (N,).

    Args:
        place: Occupied voxels, shape (N, 3).
        axis: 0, 1 or 2.
    """
    others = [k for k in range(3) if k != axis]
    order = np.lexsort((place[:, axis], place[:, others[0]], place[:, others[1]]))
    step = np.diff(place[order], axis=0)
    starts = np.concatenate(([True], (step[:, others] != 0).any(axis=1) | (step[:, axis] != 1)))
    number = np.cumsum(starts) - 1
    length = np.empty(len(place), np.int64)
    length[order] = np.bincount(number)[number]
    return length


def _supported(z: Float, starts: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the lowest point of each cell that is no noise below the ground, shape (C,).

    Two per cent of the points of a cell may be noise. Of the others, the lowest is used that has two more
    within _NEAR above it; the lowest of all if there is none, or if two per cent are less than one point.

    Args:
        z: Heights, ascending in each cell, shape (N,) [m].
        starts, count: First point and number of points of each cell, shape (C,).
    """
    lowest = starts + count // 50
    last = np.repeat(starts + count - 1, count)
    above = np.arange(len(z)) + 2
    is_supported = (above <= last) & (z[np.minimum(above, len(z) - 1)] - z < _NEAR)
    is_supported &= np.arange(len(z)) >= np.repeat(lowest, count)
    is_supported &= np.repeat(lowest > starts, count)
    cell = np.repeat(np.arange(len(starts)), count)[is_supported]
    found, first = np.unique(cell, return_index=True)
    lowest[found] = np.flatnonzero(is_supported)[first]
    return lowest


def _lowest_surface(points: Float) -> tuple[float, float, float]:
    """Return the median slope between the lowest points of neighbouring cells (inf for few cells), the share
    of points near them, and the share of slopes beyond _STEEP.

    Args:
        points: Points with z up, shape (N, 3) [m].
    """
    place = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _CELL).astype(np.int64)
    key = (place[:, 0] << 32) + place[:, 1]
    order = np.lexsort((points[:, 2], key))
    key, z = key[order], points[order, 2]
    starts = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
    count = np.diff(np.append(starts, len(key)))
    low = z[_supported(z, starts, count)]
    is_near: Bool = z - np.repeat(low, count) < _NEAR
    full = count >= _LEAST_IN_CELL
    if np.count_nonzero(full) < _LEAST_CELLS:
        return np.inf, 0.0, 1.0
    cells, low = key[starts][full], low[full]
    steps = []
    for neighbour in (1, 1 << 32):
        at = np.minimum(np.searchsorted(cells, cells + neighbour), len(cells) - 1)
        there = cells[at] == cells + neighbour
        steps.append(np.abs(low[at] - low)[there])
    slopes = np.concatenate(steps) / _CELL
    if not len(slopes):
        return np.inf, 0.0, 1.0
    slope, steep = float(np.median(slopes)), float((slopes > _STEEP).mean())
    return slope, float(is_near[np.repeat(full, count)].mean()), steep
