"""Buffer for the path of a run, which grows scan by scan."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.growing_columns import GrowingColumns
from pipeline.geometry.poses import Float, Pose2
from pipeline.slam.particle_ancestry import EstimatedPath
from pipeline.types.records import Int, Path

_STAMP, _SIGMA, _MOTION = 0, 4, 5  # columns; 1 to 3 are x, y, yaw


class TrajectoryBuffer:
    """Time, pose, sigma and odometry of each scan.

    Args:
        stamp_ns: Times of the scans so far [ns], int64, shape (N,); None for none.
        sigma: Their position sigmas [m], shape (N,).
        motion: Their steps, shape (N, 3); see `motion`.
    """

    def __init__(
        self, stamp_ns: Int | None = None, sigma: Float | None = None, motion: Float | None = None
    ) -> None:
        stamp_ns = np.zeros(0, np.int64) if stamp_ns is None else stamp_ns
        sigma = np.zeros(0) if sigma is None else sigma
        motion = np.zeros((0, 3)) if motion is None else motion
        unknown = np.full(len(stamp_ns), np.nan)
        self._rows = GrowingColumns(stamp_ns, unknown, unknown, unknown, sigma, motion)
        self._poses, self._with_pose = EstimatedPath(), 0  # the last path, and the rows that have its poses

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._rows)

    @property
    def stamp_ns(self) -> Int:
        """Times of the scans [ns], int64, shape (N,); a view."""
        return self._rows.column(_STAMP)

    @property
    def sigma_xy(self) -> Float:
        """Standard deviations of the positions [m], shape (N,); a view."""
        return self._rows.column(_SIGMA)

    @property
    def motion(self) -> Float:
        """Steps x, y [m], yaw [rad] by odometry from the scan before to each scan, shape (N, 3); a view."""
        return self._rows.column(_MOTION)

    def append(self, stamp_ns: int, motion: Pose2) -> None:
        """Add a scan with its time [ns] and the odometry step from the scan before to it. Its sigma is
        undefined until `set_sigma`."""
        unknown = np.full(1, np.nan)
        stamp, step = np.array([stamp_ns]), motion.as_array()[None]
        self._rows.write(len(self), stamp, unknown, unknown, unknown, unknown, step)

    def set_sigma(self, covariance: Float) -> None:
        """Set the sigma of the last scan, which must exist and not be in a path yet, to sqrt((Cxx + Cyy) /
        2), from the covariance C of x, y [m], yaw [rad], shape (3, 3)."""
        self.sigma_xy[-1] = np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]))

    def return_to(self, length: int) -> None:
        """Set the number of scans to one that was reached before. After a return, scans that follow again
        keep their rows until they are replaced."""
        self._rows.return_to(length)
        self._with_pose = min(self._with_pose, length)

    def path(self, poses: EstimatedPath) -> Path:
        """Return the path with the poses of all N scans. It never changes, and shares its memory with later
        ones, so that a call takes a time that depends only on the rows that differ from those of the last
        call."""
        start = min(self._poses.rows_in_common(poses), self._with_pose)
        if start < len(self):
            stamp, *_, sigma, motion = (self._rows.column(k)[start:] for k in range(_MOTION + 1))
            self._rows.write(start, stamp, *poses.poses(start).T, sigma, motion)
        self._poses, self._with_pose = poses, len(self)
        return Path(*self._rows.shared()[:_MOTION])
