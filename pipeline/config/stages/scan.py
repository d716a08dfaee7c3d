"""The parameters of what one scan goes through, from the sensor to the verdict."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import model_validator

from pipeline.config.declare import Stage, choice, count, number


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
        0.5, "Nearest return", "m", 0.0, 10.0, 0.1, "Returns nearer than this are not mapped; obstacles are."
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
    slices: int = count(
        4,
        "Slices that agree",
        "",
        0,
        8,
        "A trunk is taken out of a cluster that fits none when so many slices of 0.2 m show it; 0 is off.",
    )


class Detection(Stage):
    """Detection: which clusters are trees, and why the others are not."""

    whole: bool = choice(
        True, "Whole trunks", "What the box, the range or the side of the view cuts off is no detection."
    )
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
