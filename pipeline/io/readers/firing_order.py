"""Times of points from their order: a spinning LiDAR that writes its points as it fires them turns evenly, so
the azimuth gives the time of a point as a share of a turn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.types.records import Float, Float32

#: Name of this source of times beside the names of fields.
FIRING_ORDER = "order of firing"
#: Lasers of one firing point up to 10 degrees apart in azimuth; the median of so many points, two firings of
#: 128 lasers, does not show this, and it keeps gaps.
_MEDIAN = 257
_FEWEST = 4 * _MEDIAN
#: A sensor that turns shows half a turn at least, and in one sweep little more than one.
_LEAST_TURN, _MOST_TURN = 0.5, 1.1
#: Largest step back of the median as a share of a turn: few points next to the sensor may decide it.
_BACK = 0.01
#: Horizontal range below which the azimuth is that of the housing [m].
_NEAR = 0.3


def turn_shares(points: Float32) -> Float | None:
    """Return the share of a turn at which each point was fired, 0 at the first one, shape (N,).

    Args:
        points: Points in the sensor frame, in their order, shape (N, 3) [m].

    Returns:
        The shares, which ascend. None if the azimuth does not pass evenly through one turn or at least half
        of it, as in scans that are sorted by ring, or of sensors that do not spin.
    """
    from scipy.ndimage import median_filter

    x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
    rows = np.flatnonzero(np.hypot(x, y) > _NEAR)
    if len(rows) < _FEWEST:
        return None
    turn = median_filter(np.unwrap(np.arctan2(y[rows], x[rows])) / (2.0 * np.pi), _MEDIAN, mode="nearest")
    turn = (turn - turn[0]) * np.sign(turn[-1] - turn[0])
    if not _LEAST_TURN < turn[-1] < _MOST_TURN or (np.maximum.accumulate(turn) - turn).max() > _BACK:
        return None
    shares: Float = np.interp(np.arange(len(points)), rows, np.maximum.accumulate(turn))
    return shares


#: Fewest angles between neighbours for a step in azimuth.
_FEWEST_STEPS = 8


def firing_ns(points: Float32, ring: NDArray[np.generic] | None, turn_ns: int) -> float:
    """Return the time between two shots of a laser [ns] for a turn of `turn_ns`; 0 if it is unknown, as
    without ring numbers."""
    return 0.0 if ring is None else azimuth_step(points, ring) / (2.0 * np.pi) * turn_ns


def azimuth_step(points: Float32, ring: NDArray[np.generic]) -> float:
    """Return the median angle between neighbouring returns of a ring [rad], without equal azimuths and holes;
    0 for fewer than _FEWEST_STEPS such angles."""
    steps = []
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    for number in np.unique(ring):
        gaps = np.diff(np.sort(azimuth[ring == number]))
        # Two returns of one shot have the same azimuth; gaps of 2 degrees are holes.
        steps.append(gaps[(gaps > 2e-4) & (gaps < 0.035)])
    gaps = np.concatenate(steps) if steps else np.zeros(0)
    return float(np.median(gaps)) if len(gaps) >= _FEWEST_STEPS else 0.0
