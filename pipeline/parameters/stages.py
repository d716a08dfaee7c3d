"""The parameters of each stage. The defaults are the preset `forest`."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import model_validator

from pipeline.parameters.declare import Stage, choice, count, number
from pipeline.parameters.extras import SlamMethod


class Acquisition(Stage):
    """Acquisition: which returns of the sensor are taken at all (Eq. 1)."""

    level: Literal["none", "imu"] = choice(
        "imu", "Level the scan", "Turn the scan upright by the tilt that the IMU or the pose tells."
    )
    deskew: bool = choice(
        True, "De-skew", "Move each point to where it would be had the robot stood still during the sweep."
    )
    gyro: bool = choice(True, "Gyroscope", "Take turns from the IMU's gyroscope where there is one.")
    range_min: float = number(
        0.5, "Nearest return", "m", 0.0, 10.0, 0.1, "Returns nearer than this are the robot itself."
    )
    range_max: float = number(
        40.0, "Farthest return", "m", 1.0, 250.0, 1.0, "Returns farther than this are not used."
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.range_min >= self.range_max:
            raise ValueError(
                f"acquisition.range_min = {self.range_min} must be less than "
                f"acquisition.range_max = {self.range_max}"
            )
        return self


class Filters(Stage):
    """Filters: the pass-through box in the sensor frame and the voxel grid (Eq. 2)."""

    x_min: float = number(-40.0, "x min", "m", -100.0, 100.0, 0.1, "Rear face of the pass-through box.")
    x_max: float = number(40.0, "x max", "m", -100.0, 100.0, 0.1, "Front face of the pass-through box.")
    y_min: float = number(-40.0, "y min", "m", -100.0, 100.0, 0.1, "Right face of the pass-through box.")
    y_max: float = number(40.0, "y max", "m", -100.0, 100.0, 0.1, "Left face of the pass-through box.")
    z_min: float = number(-20.0, "z min", "m", -50.0, 50.0, 0.05, "Lower face of the pass-through box.")
    z_max: float = number(20.0, "z max", "m", -50.0, 50.0, 0.05, "Upper face of the pass-through box.")
    voxel_size: float = number(
        0.01, "Voxel size", "m", 0.0, 1.0, 0.005, "Points in a cube of this size become their mean; 0 is off."
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for axis in "xyz":
            low, high = getattr(self, f"{axis}_min"), getattr(self, f"{axis}_max")
            if low >= high:
                raise ValueError(f"filters.{axis}_min = {low} must be less than filters.{axis}_max = {high}")
        return self


class Ground(Stage):
    """Ground: the band of heights above the terrain in which trunks are looked for."""

    method: Literal["none", "polar"] = choice(
        "polar", "Ground model", "How the terrain is found: none, or a polar grid with a limited slope."
    )
    height_min: float = number(
        0.3, "Lowest height", "m", -1.0, 10.0, 0.05, "Points lower above the ground are left out."
    )
    height_max: float = number(
        2.0, "Greatest height", "m", 0.1, 30.0, 0.05, "Points higher above the ground are left out."
    )
    slope_max: float = number(
        35.0, "Steepest slope", "deg", 1.0, 80.0, 1.0, "The terrain never rises steeper than this."
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.height_min >= self.height_max:
            raise ValueError(
                f"ground.height_min = {self.height_min} must be less than "
                f"ground.height_max = {self.height_max}"
            )
        return self


class Clustering(Stage):
    """Clustering: DBSCAN, or cuts at jumps of range for a planar laser."""

    method: Literal["dbscan", "range_jump"] = choice(
        "dbscan", "Method", "DBSCAN on the points, or a cut wherever neighbouring beams jump in range."
    )
    engine: Literal["grid", "sklearn", "open3d"] = choice(
        "grid", "DBSCAN engine", "Our compiled grid, scikit-learn or Open3D; cores and noise are the same."
    )
    dimensions: int = count(2, "Dimensions", "", 2, 3, "2 clusters the points seen from above, 3 in space.")
    eps: float = number(0.15, "Radius eps", "m", 0.01, 5.0, 0.01, "Points nearer than this are neighbours.")
    min_points: int = count(
        8, "Points of a core", "", 1, 500, "A point with so many neighbours (itself too) is a core."
    )
    stem_area: float = number(
        0.1,
        "Area of a stem",
        "m²",
        0.0,
        10.0,
        0.01,
        "Where so much of a stem returns fewer points than a core needs, each counts for more; 0 is off.",
    )
    weight_max: int = count(2, "Weight max", "", 1, 100, "No return counts for more neighbours than this.")


class Shape(Stage):
    """Shape: covariance and eccentricity (Eq. 3-4) and the circle of a trunk."""

    plane: int = count(
        2, "Dimensions of the covariance", "", 2, 3, "2 takes x and y, 3 takes all; e = lambda1 / lambda2."
    )
    centre: Literal["centroid", "circle"] = choice(
        "circle", "Centre of a trunk", "The centroid of the visible arc, as in the paper, or a fitted circle."
    )


class Detection(Stage):
    """Detection: which clusters are trees, and why the others are not."""

    e_min: float = number(
        1.0,
        "Eccentricity min",
        "",
        1.0,
        1000.0,
        0.5,
        "Clusters with a smaller lambda1 / lambda2 are too round.",
    )
    e_max: float = number(
        60.0,
        "Eccentricity max",
        "",
        1.0,
        1000.0,
        0.5,
        "Clusters with a larger lambda1 / lambda2 are too long.",
    )
    cylindrical_stddev_thresh: float = number(
        0.06,
        "Radial deviation max",
        "m",
        0.001,
        2.0,
        0.005,
        "Standard deviation of the distances to the axis that a trunk may have.",
    )
    radius_min: float = number(
        0.04, "Radius min", "m", 0.0, 2.0, 0.01, "Thinner circles are poles and stakes."
    )
    radius_max: float = number(0.6, "Radius max", "m", 0.01, 5.0, 0.01, "Thicker circles are not trunks.")
    height_extent_min: float = number(
        0.5, "Visible height min", "m", 0.0, 10.0, 0.05, "Clusters that reach over less height are left out."
    )
    size_max: float = number(
        1.2, "Width max", "m", 0.05, 20.0, 0.05, "Clusters that are wider than this are not one trunk."
    )
    arc_min: float = number(
        40.0, "Visible arc min", "deg", 0.0, 360.0, 5.0, "A circle is trusted from this much of an arc on."
    )

    sigma_range: float = number(
        0.05, "Range sigma", "m", 0.001, 5.0, 0.005, "Error of a trunk's distance, added to the fit's own."
    )
    sigma_bearing: float = number(
        0.4, "Bearing sigma", "deg", 0.01, 20.0, 0.05, "Error of a trunk's direction, added to the fit's own."
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("e", "radius"):
            low, high = getattr(self, f"{name}_min"), getattr(self, f"{name}_max")
            if low >= high:
                raise ValueError(
                    f"detection.{name}_min = {low} must be less than detection.{name}_max = {high}"
                )
        return self


class Slam(Stage):
    """SLAM: FastSLAM with a map per particle (Eq. 5-7), or a pose graph."""

    method: SlamMethod = choice(
        "fastslam2", "Method", "FastSLAM by odometry (1.0), by the scan too (2.0), or a pose graph (extra)."
    )
    particles: int = count(100, "Particles", "", 1, 5000, "How many hypotheses of the path are kept.")
    noise_distance: float = number(
        0.03,
        "Position noise",
        "m/√m",
        0.0,
        1.0,
        0.005,
        "Error of the odometry after one metre; it grows with the root of the distance.",
    )
    noise_turn_distance: float = number(
        0.4,
        "Heading noise",
        "deg/√m",
        0.0,
        30.0,
        0.1,
        "Error of the heading after one metre; it grows with the root of the distance.",
    )
    noise_turn: float = number(
        2.0,
        "Turn noise",
        "deg/√rad",
        0.0,
        60.0,
        0.1,
        "Error of the heading after turning by one radian; it grows with the root of the turn.",
    )
    gate: float = number(
        3.5, "Gate", "sigma", 0.5, 20.0, 0.1, "A detection farther from a landmark than this is another tree."
    )
    distance_max: float = number(
        1.0, "Association reach", "m", 0.05, 20.0, 0.05, "No association over more than this distance."
    )
    hits_to_weigh: int = count(
        3, "Hits before it weighs", "", 1, 50, "A landmark seen fewer times does not weigh particles."
    )
    view_range: float = number(
        15.0,
        "View range",
        "m",
        0.0,
        100.0,
        0.5,
        "A landmark nearer than this, in free view and not detected, counts as missed; 0 is off.",
    )
    misses_per_hit: int = count(
        3,
        "Misses per hit",
        "",
        1,
        100,
        "So many misses undo one hit; a landmark without hits left is removed.",
    )
    miss_weight: float = number(
        0.0,
        "Weight of a miss",
        "",
        0.0,
        5.0,
        0.05,
        "What a well known landmark in free view that is not detected takes from a particle's log weight.",
    )
    weight_power: float = number(
        0.1,
        "Weight power",
        "",
        0.01,
        1.0,
        0.05,
        "Power of a scan's likelihood in the weights; 1 takes the views of one trunk as independent.",
    )
    looks: float = number(
        100.0,
        "Independent looks",
        "",
        1.0,
        10000.0,
        1.0,
        "Views of a trunk share their error: a landmark is never known better than by so many of them.",
    )
    merge_gate: float = number(
        1.0,
        "Merge gate",
        "sigma",
        0.0,
        10.0,
        0.1,
        "Two landmarks nearer than this, of which a scan sees one alone, become one; 0 is off.",
    )
    resample_below: float = number(
        0.5,
        "Resample below",
        "",
        0.0,
        1.0,
        0.05,
        "Resample when N_eff falls below this part of the particles.",
    )
    update_distance: float = number(
        0.0, "Update every", "m", 0.0, 10.0, 0.05, "Use a scan only after this much motion; 0 uses all."
    )


class Relocalisation(Stage):
    """Relocalisation: where a constellation of stems stands in a map that is known."""

    method: Literal["none", "constellation"] = choice(
        "constellation",
        "When lost",
        "Search the map for the stems around by the distances between them, or map on as if nothing were.",
    )
    stems_min: int = count(
        6, "Stems in agreement", "", 4, 100, "No pose is taken that fewer stems agree with."
    )
    slack: float = number(
        0.1, "Slack", "m", 0.0, 1.0, 0.01, "How far a map may be bent over a constellation (one sigma)."
    )


class Gathering(Stage):
    """Gathering: what all scans together say of each place; the verdict on a tree is taken there."""

    method: Literal["none", "columns"] = choice(
        "columns",
        "Verdict on a tree",
        "By the columns that the scans gathered over height, or none: by the number of hits alone.",
    )
    range_max: float = number(
        25.0, "Gathered within", "m", 1.0, 100.0, 1.0, "Returns farther away are not gathered."
    )
    every: int = count(
        4,
        "Gather every so many scans",
        "",
        1,
        100,
        "Of so many scans one is gathered (the first ten all are); the scans between show the same trunks.",
    )
    voxels_log2: int = count(
        19,
        "Memory",
        "",
        12,
        24,
        "Room for 2 to this power voxels; when full, the oldest half is forgotten.",
    )
    tree_share: float = number(
        0.4, "Votes for a tree", "", 0.0, 1.0, 0.05, "A column is a tree from this share of the votes on."
    )


class Tracking(Stage):
    """Tracking: a Kalman filter per tree (Eq. 10) and merging."""

    engine: Literal["compiled", "filterpy"] = choice(
        "compiled", "Kalman engine", "Our compiled filter or filterpy's; both give the same numbers."
    )
    velocity_sigma: float = number(
        0.0,
        "Velocity sigma",
        "m/s",
        0.0,
        5.0,
        0.01,
        "Velocity that a new tree may have; 0 keeps trees still.",
    )
    acceleration_sigma: float = number(
        0.0, "Acceleration sigma", "m/s²", 0.0, 5.0, 0.001, "How much a tree's velocity may wander."
    )
    gate: float = number(
        4.0, "Gate", "sigma", 0.5, 20.0, 0.1, "A detection farther from a tree than this starts another."
    )
    distance_max: float = number(
        0.6, "Association reach", "m", 0.05, 10.0, 0.05, "No detection joins a tree farther away than this."
    )
    proximity_radius: float = number(
        0.4, "Proximity radius", "m", 0.0, 10.0, 0.05, "Trees nearer to one another than this are one tree."
    )
    hits_to_confirm: int = count(
        3, "Hits to confirm", "", 1, 200, "A tree is shown and exported when it was seen so often."
    )
    misses_per_hit: int = count(
        1, "Misses per hit", "", 1, 100, "So many misses in free view undo one hit; without hits a tree goes."
    )
    dbh_arc_min: float = number(
        180.0, "Arc for a DBH", "deg", 0.0, 360.0, 10.0, "A diameter is told from this much of the trunk on."
    )
    breast_height: float = number(
        1.3,
        "Breast height",
        "m",
        0.1,
        5.0,
        0.05,
        "Height above the ground that a tree's diameter is told for.",
    )


class Evaluation(Stage):
    """Evaluation: how the map is compared with the ground truth."""

    match_distance: float = number(
        0.5, "Match distance", "m", 0.05, 5.0, 0.05, "A tree farther from its truth than this is no match."
    )
    reach: float = number(
        10.0, "Reach", "m", 1.0, 200.0, 0.5, "Truth farther than this from the whole path is not asked for."
    )
