"""What the tracking is told of one scan, as compiled loops take it."""

from __future__ import annotations

from typing import NamedTuple

from pipeline.geometry.poses import Float


class Limits(NamedTuple):
    """Of the parameters `Tracking`; `miss` is what a tree in free view loses of its score."""

    acceleration_sigma: float
    velocity_sigma: float
    gate: float
    distance_max: float
    proximity_radius: float
    miss: float


class Sight(NamedTuple):
    """From where a scan looked, and how far.

    Attributes:
        pose: x, y [m], yaw [rad] in the frame of the map, shape (3,); covariance: of it, shape (3, 3);
            relative: with respect to the trees around, which decides how far from a tree its detection may
            lie, shape (3, 3).
        clear_range: How far the view was free by direction (see visibility).
        view_range: A tree nearer than this can be missed [m].
    """

    stamp_ns: int
    pose: Float
    covariance: Float
    relative: Float
    clear_range: Float
    view_range: float


class Found(NamedTuple):
    """The detections of a scan, shape (D, ...), see `Detections`; `above_breast`: how far above breast height
    each was seen, shape (D,) [m], NaN where that is not known."""

    centre: Float
    covariance: Float
    eccentricity: Float
    radius: Float
    radius_sigma: Float
    arc: Float
    above_breast: Float
