"""What a story holds. Plain data: it travels from the worker to the browser. Lengths are metres, angles
degrees where the name says so and radians else; NaN becomes null in the browser.
"""

from __future__ import annotations

import msgspec


class Asked(msgspec.Struct, frozen=True):
    """One check of a cluster.

    Attributes:
        figure, unit, value: What was looked at; NaN where it cannot be told.
        relation: "at least" or "at most" the limit; empty where any value but 0 fails.
        limit, parameter, title: The limit with the dotted name of its parameter and its title.
        fails: Whether it fails.
        verdict: What the cluster is when this is its first check that fails.
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
    """The fitted stem in the picture: seen from above, its axis at the origin, the sensor looking from below.

    Attributes:
        radius, radius_sigma: [m].
        arc_deg: Visible arc; arc_start, arc_end: counter-clockwise from the picture's right [rad].
        lean: Shift of the axis per metre of height, to the right and up in the picture.
        lean_deg: Angle of the axis from the vertical.
        ellipse: Of the centre: half axes [m], direction of the longer one [rad].
    """

    radius: float
    radius_sigma: float
    arc_deg: float
    arc_start: float
    arc_end: float
    lean: tuple[float, float]
    lean_deg: float
    ellipse: tuple[float, float, float]


class Told(msgspec.Struct, frozen=True):
    """What one figure of a column says: the share of votes for a tree with it, less the share without."""

    figure: str
    value: float
    effect: float


class Gathered(msgspec.Struct, frozen=True):
    """What all scans together say of a place.

    Attributes:
        verdict: In words.
        distance: From what was asked for to the column [m].
        votes: Share of each kind, by its name.
        tree_share: Needed for a tree.
        tree_in_free_air: Of the decision trees that tell a tree that ends in free air from a pole, the share
            for a tree; None where they are not asked. `told` is of them where they say pole.
        by_votes: Whether the votes decided; else a rule did, which `verdict` names.
        present, absent: In how many gathered scans something, or nothing, stood there in free view.
        viewed: How high above the ground any scan looked there [m].
        told: The figures that told most, the strongest first.
    """

    verdict: str
    distance: float
    votes: dict[str, float]
    tree_share: float
    tree_in_free_air: float | None
    by_votes: bool
    present: int
    absent: int
    viewed: float
    told: list[Told]


class ClusterStory(msgspec.Struct, frozen=True):
    """A cluster of one scan.

    Attributes:
        scan, cluster: Number of the scan, and of the cluster in it.
        time_s: Of the scan since the run's first one.
        verdict: In words.
        checks: All of them, in the order in which they decide.
        size: Points in the cluster.
        eccentricity: lambda1 / lambda2.
        position: In the frame of the map [m].
        distance: From the sensor [m].
        sensor_sigma: Of a range [m].
        points: Right and up in the picture, from the axis at their own height [m]; some of them if many.
        residual: Of the same points from the circle, outside positive [m]; empty without a circle.
        circle: None where the preset fits none, or the points are too few.
        axes: One standard deviation along the principal axes in the picture: (right, up) of each [m].
        tree, tree_distance: The nearest confirmed tree in reach, None where there is none.
        gathered: Of its place, None where nothing is gathered.
    """

    scan: int
    cluster: int
    time_s: float
    verdict: str
    checks: list[Asked]
    size: int
    eccentricity: float
    position: tuple[float, float]
    distance: float
    sensor_sigma: float
    points: list[tuple[float, float]]
    residual: list[float]
    circle: Circle | None
    axes: list[tuple[float, float]]
    tree: int | None
    tree_distance: float
    gathered: Gathered | None


class History(msgspec.Struct, frozen=True):
    """A tree's estimates after scans that saw it, columns of equal length: time since the run's first scan
    [s], position [m], half axes [m] and direction [rad] of its 1-sigma ellipse, DBH and its sigma [m]."""

    time_s: list[float]
    x: list[float]
    y: list[float]
    major: list[float]
    minor: list[float]
    angle: list[float]
    dbh: list[float]
    dbh_sigma: list[float]


class TreeStory(msgspec.Struct, frozen=True):
    """A tree of the map.

    Attributes:
        tree: Its number.
        scan, time_s: What holds after this scan.
        confirmed: Whether it is shown in the map.
        position, ellipse: [m]; half axes [m] and direction of the longer one [rad].
        dbh, dbh_sigma: [m], NaN where no arc carried one.
        coverage_deg: Part of its circumference that was seen.
        dbh_arc_deg: How much is needed for a DBH.
        sides: Which of 36 sectors were seen, counted from x to y; empty where that is not known.
        eccentricity: Mean over the observations.
        observations: Number of scans it was seen in.
        first_seen_s, last_seen_s: [s].
        cluster: Its cluster in the standing scan, None where there is none.
        gathered: Of its place, None where nothing is gathered.
        history: In the order of time.
    """

    tree: int
    scan: int
    time_s: float
    confirmed: bool
    position: tuple[float, float]
    ellipse: tuple[float, float, float]
    dbh: float
    dbh_sigma: float
    coverage_deg: float
    dbh_arc_deg: float
    sides: list[bool]
    eccentricity: float
    observations: int
    first_seen_s: float
    last_seen_s: float
    cluster: int | None
    gathered: Gathered | None
    history: History
