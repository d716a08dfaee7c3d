"""Records of a story, sent from the worker to the browser.

Lengths are in metres; angles are in degrees if the name ends in `_deg`, else in radians. NaN becomes null in
the browser.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from pipeline.types.records import Float, Int32


class CheckResult(msgspec.Struct, frozen=True):
    """One check of a cluster.

    Attributes:
        figure, unit, value: Name, unit and value of the checked quantity; NaN if it is unknown.
        relation: "at least" or "at most" the limit; empty if every value except 0 fails.
        limit, parameter, title: Limit, dotted name of its parameter, and title of the parameter.
        fails: Whether the cluster fails the check.
        verdict: Verdict on the cluster if this is the first check that fails.
    """

    figure: str
    unit: str
    value: float
    relation: str
    limit: float
    parameter: str
    title: str
    fails: bool
    verdict: str


class Circle(msgspec.Struct, frozen=True):
    """The fitted stem seen from above: its axis is at the origin and the sensor is below the picture.

    Attributes:
        radius, radius_sigma: Radius and its standard deviation [m].
        arc_deg: Visible arc [deg].
        arc_start, arc_end: Ends of the visible arc, counter-clockwise from the right of the picture [rad].
        lean: Shift of the axis per metre of height, to the right and up in the picture.
        lean_deg: Angle of the axis from the vertical.
        ellipse: 1-sigma ellipse of the centre: half axes [m], direction of the major axis [rad].
    """

    radius: float
    radius_sigma: float
    arc_deg: float
    arc_start: float
    arc_end: float
    lean: tuple[float, float]
    lean_deg: float
    ellipse: tuple[float, float, float]


class FeatureEffect(msgspec.Struct, frozen=True):
    """Effect of a feature of a voxel column: share of votes for a tree with it minus the share without it."""

    figure: str
    value: float
    effect: float


class ColumnStory(msgspec.Struct, frozen=True):
    """Classification of the accumulated scans at a position.

    Attributes:
        verdict: Label of the verdict.
        distance: Distance from the requested position to the axis of the column [m].
        votes: Dict from the label of each class to its share of the votes.
        tree_share: Minimum share of the votes of a tree.
        tree_in_free_air: For an object with a free upper end, the share of votes for a tree of the decision
            trees that separate trees from poles; None otherwise. Where they vote for a pole, `effects`
            explain their votes.
        by_votes: Whether the votes decided the verdict; otherwise a rule did.
        present, absent: Number of accumulated scans with a clear view of the position that show it occupied,
            and that show it empty.
        absent_lately: Number of the last of these scans without a break that show it empty.
        viewed: Maximum height above ground that any scan observed there [m].
        effects: The most influential features, at most six, the strongest first; none without an effect.
    """

    verdict: str
    distance: float
    votes: dict[str, float]
    tree_share: float
    tree_in_free_air: float | None
    by_votes: bool
    present: int
    absent: int
    absent_lately: int
    viewed: float
    effects: list[FeatureEffect]


class ClusterStory(msgspec.Struct, frozen=True):
    """A cluster of one scan.

    Attributes:
        scan, cluster: Number of the scan, and of the cluster in it.
        time_s: Time of the scan since the first scan of the run [s].
        verdict: Label of the verdict.
        checks: All checks, in the order in which they decide; empty for an external stem, and for a candidate
            for a stem without a circle.
        size: Number of points of the cluster.
        eccentricity: lambda1 / lambda2.
        position: Position in the frame of the map [m].
        distance: Distance from the sensor [m].
        sensor_sigma: Standard deviation of a range [m].
        points: Points (right, up) in the picture relative to the axis at their height, or without a circle to
            the centre of the cluster [m]; at most 400.
        residual: Residuals of the same points, positive outside of the circle [m]; empty if there is no
            circle.
        circle: Circle of the cluster; None if the preset fits no circle or the points are too few.
        axes: One standard deviation along the principal axes in the picture: (right, up) of each [m].
        tree: The nearest confirmed tree within `slam.distance_max`, or that of the candidate; None if there
            is none.
        column: Classification of the accumulated scans at the position; None if there is none.
        extensions: Explanations by extensions, by the name of the extension.
    """

    scan: int
    cluster: int
    verdict: str
    checks: list[CheckResult]
    size: int
    position: tuple[float, float]
    time_s: float = 0.0
    eccentricity: float = math.nan
    distance: float = math.nan
    sensor_sigma: float = math.nan
    points: list[tuple[float, float]] = []
    residual: list[float] = []
    circle: Circle | None = None
    axes: list[tuple[float, float]] = []
    tree: int | None = None
    column: ColumnStory | None = None
    extensions: dict[str, Any] = {}


class History(msgspec.Struct, frozen=True):
    """Estimates of a tree after the scans that detected it, as columns of equal length: time since the first
    scan of the run [s], position [m], half axes [m] and direction [rad] of its 1-sigma ellipse, DBH and its
    sigma [m]."""

    time_s: list[float] = []
    x: list[float] = []
    y: list[float] = []
    major: list[float] = []
    minor: list[float] = []
    angle: list[float] = []
    dbh: list[float] = []
    dbh_sigma: list[float] = []


class MapSection(msgspec.Struct, frozen=True):
    """The accumulated points at breast height, seen from above.

    Attributes:
        side: Side of a cell [m].
        origin: Lower left corner (smallest x and y) of cell (0, 0) in the frame of the map [m].
        cells: Occupied cells along x and y, int32, shape (N, 2); numbers may be negative.
    """

    side: float
    origin: tuple[float, float]
    cells: Int32


class TreeStory(msgspec.Struct, frozen=True):
    """A tree of the map.

    Attributes:
        tree: Number of the tree.
        scan, time_s: Number and time [s since the first scan] of the scan after which the estimates are
            given.
        confirmed: Whether the tree is shown in the map.
        position: Position x, y in the map [m].
        ellipse: Half axes [m] and direction of the major axis [rad] of the 1-sigma ellipse of the position.
        dbh, dbh_sigma: DBH and its standard deviation [m]; NaN if the DBH was not measured.
        coverage_deg: Observed part of the circumference [deg].
        dbh_arc_deg: Minimum observed part of the circumference for a DBH [deg].
        sides: Observed sectors of 36, counted from x to y; empty if unknown.
        eccentricity: Mean over the observations.
        observations: Number of scans that detected the tree.
        first_seen_s, last_seen_s: Times of the first and the last detection [s since the first scan].
        cluster: Row of the cluster of the tree in the current scan, see `app.explain.build._cluster_of`, or
            of its candidate for a stem; None if there is none.
        column: Classification of the accumulated scans at the position; None if there is none.
        points: Accumulated points around the tree: x, y relative to the position of the tree along the axes
            of the map, and height above the ground [m], see `app.explain.build.points_around`; may be empty.
        history: Estimates in order of time.
        extensions: Explanations by extensions, by the name of the extension.
    """

    tree: int
    scan: int
    confirmed: bool
    position: tuple[float, float]
    ellipse: tuple[float, float, float]
    dbh: float
    dbh_sigma: float
    coverage_deg: float
    dbh_arc_deg: float
    observations: int
    cluster: int | None
    time_s: float = 0.0
    sides: list[bool] = []
    eccentricity: float = math.nan
    first_seen_s: float = 0.0
    last_seen_s: float = 0.0
    column: ColumnStory | None = None
    points: list[tuple[float, float, float]] = []
    history: History = History()
    extensions: dict[str, Any] = {}


def half_axes(covariance: Float) -> Float:
    """Return major half axis [m], minor half axis [m] and direction of the major axis [rad] of 1-sigma
    ellipses, shape (T, 3). Either of the two opposite directions may be returned.

    Args:
        covariance: Covariances, shape (T, 2, 2) [m^2].
    """
    values, vectors = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0.0)).T
    return np.stack([major, minor, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])], axis=1)
