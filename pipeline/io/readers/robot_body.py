"""Parts of the robot in view of its LiDAR: posts, a mast or a trailer, which stand still in each scan."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipeline.types.records import Float

#: Parts of a robot are within this distance of its LiDAR [m]. Nearer returns than the first limit are left
#: out by the default of `acquisition.range_min`.
_NEAREST, _FARTHEST = 0.5, 5.0
#: Points of a part repeat within twice the range error of a coarse LiDAR [m].
_SAME = 0.06
#: Scans are from different places if less than this share of the points farther away, and higher than _ABOVE
#: [m], repeats within _NEAR [m], the size of a trunk: a side of it along the motion repeats over less.
_ELSEWHERE, _ABOVE, _NEAR = 0.3, 0.5, 0.5
#: Fewest places, fewest points of a part, and of those of them in a column, of which a post may be in four;
#: its least height, and side of the columns [m].
_PLACES, _POINTS, _PART, _HEIGHT, _COLUMN = 4, 20, 6, 0.4, 0.5
#: Sectors of the view. A LiDAR sees past its robot in half of them or more; low plants repeat all around.
_SECTORS = 36


def body_words(scans: Sequence[Float]) -> tuple[str, ...]:
    """Return a message about parts of the robot in view, and the limit that leaves them out; () without
    any. `scans` as in `reach_of_body`."""
    reach = reach_of_body(scans)
    if not reach:
        return ()
    limit = 0.1 * math.ceil(10.0 * reach)
    return (
        f"parts of the robot up to {reach:.1f} m from the LiDAR are in view in all scans: where the robot "
        f"stops, they may be mapped as trees; --set acquisition.range_min={limit:.1f} "
        "leaves them out",
    )


def reach_of_body(scans: Sequence[Float]) -> float:
    """Return the distance from the LiDAR within which upright parts of the robot are in view [m]; 0 if there
    are none, or the robot did not move.

    A point is one of the robot if the scans from all other places have a point there, too.

    Args:
        scans: Points of scans from all over a drive, about the sensor, z up, shape (N, 3) each [m].
    """
    from scipy.spatial import cKDTree

    from pipeline.odometry.mounting_yaw import standing_height

    near, far = list[Float](), list[cKDTree]()
    for points in scans:
        standing, height = standing_height(points)
        standing = standing[height > _ABOVE]
        reach = np.linalg.norm(standing, axis=1)
        there = standing[(reach > _FARTHEST) & (reach < 3.0 * _FARTHEST)]
        if len(there) < _POINTS or any(
            np.mean(other.query(there, distance_upper_bound=_NEAR)[0] < _NEAR) > _ELSEWHERE for other in far
        ):
            continue
        far.append(cKDTree(there))
        reach = np.linalg.norm(points, axis=1)
        near.append(points[(reach > _NEAREST) & (reach <= _FARTHEST)])
    if len(near) < _PLACES:
        return 0.0
    body, *others = near
    for other in others:
        if len(body) < _POINTS or len(other) < _POINTS:
            return 0.0
        body = body[cKDTree(other).query(body, distance_upper_bound=_SAME)[0] < _SAME]
    # Rings on even ground repeat, too, but not above one another.
    _, column, count = np.unique(
        np.floor(body[:, :2] / _COLUMN), axis=0, return_inverse=True, return_counts=True
    )
    column = column.ravel()
    low, high = (np.full(len(body), start) for start in (np.inf, -np.inf))
    np.minimum.at(low, column, body[:, 2])
    np.maximum.at(high, column, body[:, 2])
    body = body[((high - low)[column] > _HEIGHT) & (count[column] >= _PART)]
    sectors = np.unique(np.floor(np.arctan2(body[:, 1], body[:, 0]) / (2.0 * np.pi) * _SECTORS))
    if len(body) < _POINTS or len(sectors) > _SECTORS // 2:
        return 0.0
    return float(np.linalg.norm(body, axis=1).max()) + _SAME
