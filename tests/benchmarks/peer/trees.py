"""A filterpy Kalman filter for each tree (Eq. 10), and merging within the proximity radius."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter

from tests.benchmarks.peer.stages import Detection, Float, Parameters


@dataclass(slots=True, eq=False)
class Tree:
    """A filter with the state x, y, vx, vy, its number of updates, and the time of the last one [ns]."""

    filter: KalmanFilter
    hits: int
    stamp_ns: int


class TreeMap:
    """All trees so far."""

    def __init__(self, p: Parameters) -> None:
        self.p = p
        self.trees: list[Tree] = []

    def process(
        self, stamp_ns: int, pose: Float, pose_covariance: Float, detections: list[Detection]
    ) -> None:
        """Associate each detection with the most likely tree or begin a tree (Eq. 9), then merge."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turn = np.array([[c, -s], [s, c]])
        taken: set[int] = set()
        for detection in detections:
            arm = turn @ detection.place
            J = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
            z = arm + pose[:2]
            R = turn @ detection.covariance @ turn.T + J @ pose_covariance @ J.T
            k = self._most_likely(z, R, taken)
            taken.add(len(self.trees) if k < 0 else k)
            if k < 0:
                self.trees.append(self._begin(stamp_ns, z, R))
            else:
                self._update(self.trees[k], stamp_ns, z, R)
        self._merge()

    def _most_likely(self, z: Float, R: Float, taken: set[int]) -> int:
        best, best_cost = -1, math.inf
        for k, tree in enumerate(self.trees):
            y = z - tree.filter.x[:2]
            S = tree.filter.P[:2, :2] + R
            d2 = float(y @ np.linalg.inv(S) @ y)
            near = math.hypot(y[0], y[1]) <= self.p["slam.distance_max"]
            cost = d2 + math.log(np.linalg.det(S))
            if k not in taken and near and d2 <= self.p["slam.gate"] ** 2 and cost < best_cost:
                best, best_cost = k, cost
        return best

    def _begin(self, stamp_ns: int, z: Float, R: Float) -> Tree:
        # filterpy's kinematic_kf builds an H that adds x and y up, so F and H are built by hand.
        kalman = KalmanFilter(dim_x=4, dim_z=2)
        kalman.x = np.array([z[0], z[1], 0.0, 0.0])
        kalman.H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
        kalman.P = np.zeros((4, 4))
        kalman.P[:2, :2] = R
        kalman.P[2:, 2:] = self.p["tracking.velocity_sigma"] ** 2 * np.eye(2)
        return Tree(kalman, 1, stamp_ns)

    def _update(self, tree: Tree, stamp_ns: int, z: Float, R: Float) -> None:
        dt = (stamp_ns - tree.stamp_ns) * 1e-9
        q = self.p["tracking.acceleration_sigma"] ** 2
        F, Q = np.eye(4), np.zeros((4, 4))
        for a in range(2):
            F[a, a + 2] = dt
            Q[a, a], Q[a + 2, a + 2] = q * dt**4 / 4, q * dt**2
            Q[a, a + 2] = Q[a + 2, a] = q * dt**3 / 2
        tree.filter.predict(F=F, Q=Q)
        tree.filter.update(z, R=R)
        tree.hits += 1
        tree.stamp_ns = stamp_ns

    def _merge(self) -> None:
        i = 0
        while i < len(self.trees):
            j = i + 1
            while j < len(self.trees):
                gap = self.trees[i].filter.x[:2] - self.trees[j].filter.x[:2]
                if np.linalg.norm(gap) < self.p["tracking.proximity_radius"]:
                    _join(self.trees[i], self.trees.pop(j))
                else:
                    j += 1
            i += 1

    def confirmed(self) -> list[tuple[float, float]]:
        """Return the positions of the trees with enough detections."""
        return [
            (float(tree.filter.x[0]), float(tree.filter.x[1]))
            for tree in self.trees
            if tree.hits >= self.p["tracking.hits_to_confirm"]
        ]


def _join(tree: Tree, other: Tree) -> None:
    """Update the older tree with the position of the other one as a measurement."""
    tree.filter.update(other.filter.x[:2], R=other.filter.P[:2, :2])
    tree.hits += other.hits
    tree.stamp_ns = max(tree.stamp_ns, other.stamp_ns)
