"""A path that grows scan by scan."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Int, Path


class GrowingPath:
    """Stamps, sigmas and the odometry of a path that grows by doubling."""

    def __init__(
        self, stamp_ns: Int | None = None, sigma: Float | None = None, motion: Float | None = None
    ) -> None:
        self._stamp = np.zeros(64, np.int64) if stamp_ns is None else stamp_ns.copy()
        self._sigma: Float = np.zeros(64) if sigma is None else sigma.copy()
        self._motion: Float = np.zeros((64, 3)) if motion is None else motion.copy()
        self._length = 0 if stamp_ns is None else len(stamp_ns)

    def __len__(self) -> int:
        return self._length

    @property
    def stamp_ns(self) -> Int:
        """Of the scans so far."""
        return self._stamp[: self._length]

    @property
    def sigma_xy(self) -> Float:
        """Of the poses so far [m]."""
        return self._sigma[: self._length]

    @property
    def motion(self) -> Float:
        """x, y [m], yaw [rad] by the odometry to each scan from the one before, shape (N, 3)."""
        return self._motion[: self._length]

    def append(self, stamp_ns: int, motion: Pose2) -> None:
        """Add a scan; `set_sigma` follows once its pose is estimated."""
        if self._length == len(self._stamp):
            self._stamp = np.concatenate([self._stamp, np.zeros_like(self._stamp)])
            self._sigma = np.concatenate([self._sigma, np.zeros_like(self._sigma)])
            self._motion = np.concatenate([self._motion, np.zeros_like(self._motion)])
        self._stamp[self._length] = stamp_ns
        self._motion[self._length] = motion.as_array()
        self._length += 1

    def set_sigma(self, covariance: Float) -> None:
        """Set the sigma of the newest pose from the covariance of x, y, yaw, shape (3, 3)."""
        self._sigma[self._length - 1] = np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))

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
