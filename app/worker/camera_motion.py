"""How far the robot moved between a scan and the picture that is shown beside it."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Pose2, interpolate
from pipeline.types.records import Path

#: Beyond the ends of a path the robot goes on as it did so long before [ns]: corrections of single poses
#: would be taken for speed over a shorter time.
_STEADY_NS = 500_000_000


def motion(path: Path | None, from_ns: int, to_ns: int) -> Pose2:
    """`T_from_to` of the base between two times, none where the path has fewer than two poses.

    Within the path it is interpolated; before and after it the robot's velocities are held.
    """
    if path is None or len(path.stamp_ns) < 2:
        return Pose2()
    return _pose_at(path, from_ns).inverse() @ _pose_at(path, to_ns)


def _pose_at(path: Path, stamp_ns: int) -> Pose2:
    """`T_map_base` at a time."""
    stamps = path.stamp_ns
    first, last = 0, len(stamps) - 1
    if stamp_ns <= stamps[first]:
        last = max(1, int(np.searchsorted(stamps, stamps[first] + _STEADY_NS, side="right")) - 1)
    elif stamp_ns >= stamps[last]:
        first = min(last - 1, int(np.searchsorted(stamps, stamps[last] - _STEADY_NS)))
    else:
        last = int(np.searchsorted(stamps, stamp_ns))
        first = last - 1
    begin, end = (Pose2(*(float(axis[k]) for axis in (path.x, path.y, path.yaw))) for k in (first, last))
    part = float(stamp_ns - stamps[first]) / float(max(1, stamps[last] - stamps[first]))
    if part < 0.0 or part > 1.0:
        return _held(begin, end, part)
    return interpolate(begin, end, part)


def _held(begin: Pose2, end: Pose2, part: float) -> Pose2:
    """Before `begin` (part < 0) or beyond `end` (part > 1) with the motion between them held."""
    moved = begin.inverse() @ end
    rest = part if part < 0.0 else part - 1.0
    turn = rest * moved.yaw
    start = begin if part < 0.0 else end
    # Half the turn is made halfway: the chord of the arc of constant velocities (midpoint rule).
    along = Pose2(0.0, 0.0, 0.5 * turn - 0.5 * moved.yaw).apply(np.array([[rest * moved.x, rest * moved.y]]))[
        0
    ]
    return start @ Pose2(float(along[0]), float(along[1]), turn)
