"""Buffer for the path of a run, which grows scan by scan."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Int, Path


class TrajectoryBuffer:
    """Time, sigma and odometry of each scan; the capacity doubles when it is full.

    Args:
        stamp_ns: Times of the scans so far [ns], int64, shape (N,); None for none.
        sigma: Their position sigmas [m], shape (N,).
        motion: Their steps, shape (N, 3); see `motion`.
    """

    def __init__(
        self, stamp_ns: Int | None = None, sigma: Float | None = None, motion: Float | None = None
    ) -> None:
        self._stamp = np.zeros(64, np.int64) if stamp_ns is None else stamp_ns.copy()
        self._sigma: Float = np.zeros(64) if sigma is None else sigma.copy()
        self._motion: Float = np.zeros((64, 3)) if motion is None else motion.copy()
        self._length = 0 if stamp_ns is None else len(stamp_ns)

    def __len__(self) -> int:
        """Return the number of scans."""
        return self._length

    @property
    def stamp_ns(self) -> Int:
        """Times of the scans [ns], int64, shape (N,); a view."""
        return self._stamp[: self._length]

    @property
    def sigma_xy(self) -> Float:
        """Standard deviations of the positions [m], shape (N,); a view."""
        return self._sigma[: self._length]

    @property
    def motion(self) -> Float:
        """Steps x, y [m], yaw [rad] by odometry from the scan before to each scan, shape (N, 3); a view."""
        return self._motion[: self._length]

    def append(self, stamp_ns: int, motion: Pose2) -> None:
        """Add a scan with its time [ns] and the odometry step from the scan before to it. Its sigma is
        undefined until `set_sigma`."""
        if self._length == len(self._stamp):
            more = max(self._length, 1)
            self._stamp = np.concatenate([self._stamp, np.zeros(more, np.int64)])
            self._sigma = np.concatenate([self._sigma, np.zeros(more)])
            self._motion = np.concatenate([self._motion, np.zeros((more, 3))])
        self._stamp[self._length] = stamp_ns
        self._motion[self._length] = motion.as_array()
        self._length += 1

    def set_sigma(self, covariance: Float) -> None:
        """Set the sigma of the last scan, which must exist, to sqrt((Cxx + Cyy) / 2), from the covariance C
        of x, y [m], yaw [rad], shape (3, 3)."""
        self._sigma[self._length - 1] = np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))

    def cut(self, length: int) -> None:
        """Keep only the first `length` scans; `length` is at most the present number."""
        self._length = length

    def columns(self, poses: Float) -> Path:
        """Return the times and sigmas of all N scans as a path with the poses x, y [m], yaw [rad], shape (N,
        3); its arrays are copies."""
        n = self._length
        return Path(
            self._stamp[:n].copy(),
            poses[:, 0].copy(),
            poses[:, 1].copy(),
            poses[:, 2].copy(),
            self._sigma[:n].copy(),
        )
