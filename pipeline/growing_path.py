"""A path that grows scan by scan."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float
from pipeline.records import Int, Path, PoseEstimate


class GrowingPath:
    """Stamps and sigmas of a path that grows by doubling."""

    def __init__(self, stamp_ns: Int | None = None, sigma: Float | None = None) -> None:
        self._stamp = np.zeros(64, np.int64) if stamp_ns is None else stamp_ns.copy()
        self._sigma: Float = np.zeros(64) if sigma is None else sigma.copy()
        self._length = 0 if stamp_ns is None else len(stamp_ns)

    def __len__(self) -> int:
        return self._length

    def append(self, stamp_ns: int, estimate: PoseEstimate) -> None:
        """One scan more."""
        if self._length == len(self._stamp):
            self._stamp = np.concatenate([self._stamp, np.zeros_like(self._stamp)])
            self._sigma = np.concatenate([self._sigma, np.zeros_like(self._sigma)])
        self._stamp[self._length] = stamp_ns
        self._sigma[self._length] = np.sqrt(0.5 * (estimate.covariance[0, 0] + estimate.covariance[1, 1]))
        self._length += 1

    def cut(self, length: int) -> None:
        """Keep the first scans alone."""
        self._length = length

    def columns(self, poses: Float) -> Path:
        """With the poses, shape (N, 3): x, y [m], yaw [rad]."""
        n = self._length
        return Path(
            self._stamp[:n].copy(),
            poses[:, 0].copy(),
            poses[:, 1].copy(),
            poses[:, 2].copy(),
            self._sigma[:n].copy(),
        )
