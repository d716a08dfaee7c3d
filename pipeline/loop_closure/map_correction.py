"""Correction of the path by a loop closure, and the motion of mapped objects that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, wrap_angle
from pipeline.types.records import Int

TILE = 4.0  # m; all objects of one tile move as one piece, so that no trunk is split
NEAR = 20.0  # m of path before and after the first view of a tree; later passes may move in another way


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """The path before and after a correction.

    Attributes:
        before, after: x, y [m], yaw [rad] of every scan, shape (N, 3), in the frame of the map.
        first: Objects that were mapped up to this scan stay.
        last: Last scan that changed the map.
    """

    before: Float
    after: Float
    first: int
    last: int

    @property
    def largest(self) -> float:
        """Largest displacement of a scan that moves [m]."""
        moved = self.after[self.first + 1 :, :2] - self.before[self.first + 1 :, :2]
        return float(np.hypot(*moved.T).max(initial=0.0))

    def followed_by(self, later: Bend) -> Bend:
        """Return this correction and a later one as one."""
        before = np.concatenate([self.before, later.before[len(self.before) :]])
        return Bend(before, later.after, min(self.first, later.first), later.last)

    def moved(self, place: Float, scan: Int) -> Float:
        """Return the corrected positions, shape (N, 2) [m].

        Args:
            place: Positions before the correction, shape (N, 2) [m].
            scan: int64, shape (N,): the scan that mapped each position. It decides whether a position moves,
                not by how much, since neighbours move alike.
        """
        out = place.copy()
        moves = np.flatnonzero(scan > self.first)
        if not len(moves) or self.last <= self.first:
            return out
        rows = self._nearest(place[moves])
        before, after = self.before[rows], self.after[rows]
        turn = after[:, 2] - before[:, 2]
        c, s = np.cos(turn), np.sin(turn)
        dx, dy = (place[moves] - before[:, :2]).T
        out[moves] = after[:, :2] + np.column_stack([c * dx - s * dy, s * dx + c * dy])
        return out

    def of_trees(self, place: Float, scan: Int) -> tuple[Float, Float]:
        """Return the corrected positions of trees, shape (N, 2) [m], and their rotations, shape (N,) [rad].

        A tree moves with the nearest scan within NEAR of its first view. A later part of the path may seem to
        pass the tree because of its error, and has another correction.

        Args:
            place: Positions before the correction, shape (N, 2) [m].
            scan: int64, shape (N,): the scan in which each tree was seen first.
        """
        out, turn = place.copy(), np.zeros(len(place))
        moves = np.flatnonzero(scan > self.first)
        if not len(moves) or self.last <= self.first:
            return out, turn
        step = np.hypot(*np.diff(self.before[:, :2], axis=0, prepend=self.before[:1, :2]).T)
        way = np.cumsum(step)
        at = way[np.minimum(scan[moves], self.last)]
        low = np.maximum(np.searchsorted(way, at - NEAR), self.first + 1)
        high = np.minimum(np.searchsorted(way, at + NEAR, side="right"), self.last + 1)
        for k, i, j in zip(moves.tolist(), low.tolist(), high.tolist(), strict=True):
            row = i + int(np.argmin(np.hypot(*(self.before[i:j, :2] - place[k]).T)))
            was, now = self.before[row], self.after[row]
            turn[k] = wrap_angle(now[2] - was[2])
            c, s = np.cos(turn[k]), np.sin(turn[k])
            dx, dy = place[k] - was[:2]
            out[k] = now[0] + c * dx - s * dy, now[1] + s * dx + c * dy
        return out, turn

    def turned(self, place: Float, scan: Int) -> Float:
        """Return the rotation of the objects at positions, shape (N,) [rad]; arguments as in `moved`."""
        turn = np.zeros(len(place))
        moves = np.flatnonzero(scan > self.first)
        if len(moves) and self.last > self.first:
            rows = self._nearest(place[moves])
            turn[moves] = wrap_angle(self.after[rows, 2] - self.before[rows, 2])
        return turn

    def poses(self, pose: Float, scan: Int) -> Float:
        """Return poses, shape (N, 3), moved with the scans that they belong to, int64, shape (N,)."""
        before, after = self.before[scan], self.after[scan]
        turn = after[:, 2] - before[:, 2]
        c, s = np.cos(turn), np.sin(turn)
        dx, dy = (pose[:, :2] - before[:, :2]).T
        return np.column_stack(
            [after[:, 0] + c * dx - s * dy, after[:, 1] + s * dx + c * dy, wrap_angle(pose[:, 2] + turn)]
        )

    def _nearest(self, place: Float) -> Int:
        """Return, for each position, the moving scan nearest to the centre of its tile."""
        from scipy.spatial import cKDTree

        tiles, of = np.unique(np.floor(place / TILE), axis=0, return_inverse=True)
        _, row = cKDTree(self.before[self.first + 1 : self.last + 1, :2]).query((tiles + 0.5) * TILE)
        rows: Int = self.first + 1 + row[of.ravel()]
        return rows
