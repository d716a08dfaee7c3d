"""External stems: stems detected by another program, converted to clusters.

The following stages (verdicts, SLAM, tracking) are the same as for stems detected by stemmap.
"""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Acquisition
from pipeline.geometry.poses import Float, Pose3
from pipeline.types.records import Clusters, Float32, Stems, Step, Verdict

#: Standard deviation of an external DBH [m]: DBH of the same trees differ by a median of 4.9 cm between
#: frames of the Oxford Evo data (1.5 km of forest).
DBH_SIGMA = 0.05
#: Minimum number of stem axes from which the tilt of the robot is estimated.
AXES_TO_LEVEL = 5


def external_clusters(
    step: Step, stems: Stems, T_base_lidar: Pose3, parameters: Acquisition
) -> tuple[Float32, Float, Clusters]:
    """Return the stems of a scan in the level sensor frame, each as a cluster of one point with the verdict
    TREE.

    The positions are rotated by the tilt of the step or, if it is unknown, by the median of the stem axes,
    which are vertical on average. Without levelling, pitch of the robot would displace stems far below the
    sensor. Stems outside of the range limits (inclusive) or with NaN in their position are left out.

    Args:
        step: Step whose scan points are the stem positions in the sensor frame.
        stems: Axes and diameters, one row per point.
        T_base_lidar: Pose of the sensor on the robot.
        parameters: Range limits and levelling.

    Returns:
        Positions, float32, shape (N, 3) [m]; position of the sensor in the level base frame, shape (3,) [m];
        and the clusters: centre and radius (NaN for an unknown DBH) are those of the stem, covariance and arc
        are 0, `hidden` and `cut` are False, other unknown values are NaN.
    """
    R_level_base = _levelling(step, stems, T_base_lidar, parameters)
    place = step.scan.points.astype(np.float64)
    reach = np.linalg.norm(place, axis=1)
    taken = (reach >= parameters.range_min) & (reach <= parameters.range_max)
    place = place[taken] @ (R_level_base @ T_base_lidar.R).T
    return place.astype(np.float32), R_level_base @ T_base_lidar.t, _clusters(place, stems.dbh[taken])


def _levelling(step: Step, stems: Stems, T_base_lidar: Pose3, parameters: Acquisition) -> Float:
    """Return R_level_base, shape (3, 3), the rotation without yaw that levels the base frame: by the tilt of
    the step, else by the median axis of the stems. It is the identity if levelling is "none" or fewer than
    AXES_TO_LEVEL stems have an axis."""
    if parameters.level == "none":
        return np.eye(3)
    if step.tilt_known:
        return Pose3.from_euler(np.zeros(3), step.roll, step.pitch, 0.0).R
    axis = stems.axis[np.isfinite(stems.axis).all(axis=1)]
    if len(axis) < AXES_TO_LEVEL:
        return np.eye(3)
    up = T_base_lidar.R @ np.median(axis, axis=0)
    # The third row of Ry(pitch) Rx(roll) is the vertical in the base frame.
    roll = float(np.arctan2(up[1], up[2]))
    pitch = float(np.arctan2(-up[0], np.hypot(up[1], up[2])))
    return Pose3.from_euler(np.zeros(3), roll, pitch, 0.0).R


def _clusters(place: Float, dbh: Float) -> Clusters:
    """Return clusters of one point each with the verdict TREE: the centre is the position, the radius half of
    the DBH with the sigma DBH_SIGMA / 2, the horizontal extent the DBH, covariance and arc 0, `hidden` and
    `cut` False, and what is unknown NaN.

    Args:
        place: Positions, level sensor frame, shape (N, 3) [m].
        dbh: Diameters, shape (N,) [m]; NaN if unknown.
    """
    n = len(place)
    unknown = np.full(n, np.nan)
    radius = 0.5 * dbh
    return Clusters(
        size=np.ones(n, np.int64),
        centroid=place,
        eigenvalues=np.full((n, 3), np.nan),
        eccentricity=unknown,
        centre=place[:, :2].copy(),
        covariance=np.zeros((n, 2, 2)),
        radius=radius,
        radius_sigma=np.where(np.isfinite(radius), 0.5 * DBH_SIGMA, np.nan),
        radial_std=unknown,
        arc=np.zeros(n),
        extent=np.stack([dbh, dbh, unknown], axis=1),
        hidden=np.zeros(n, np.bool_),
        cut=np.zeros(n, np.bool_),
        verdict=np.full(n, Verdict.TREE, np.int32),
    )
