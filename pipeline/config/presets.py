"""Presets: named sets of parameters, each with the source of its values."""

from __future__ import annotations

from functools import cache

from pipeline.config.model import Parameters
from pipeline.errors import ParameterError

# Table 1 of the paper. Stages that the paper does not have are turned off.
_PAPER: dict[str, object] = {
    "acquisition.level": "none",
    "acquisition.deskew": False,
    "acquisition.gyro": False,
    "acquisition.range_min": 0.0,
    "filters.x_min": 0.0,
    "filters.x_max": 10.0,
    "filters.y_min": -10.0,
    "filters.y_max": 10.0,
    "filters.z_min": -0.5,
    "filters.z_max": 0.0,
    "filters.voxel_size": 0.01,
    "ground.method": "none",
    "clustering.dimensions": 3,
    "clustering.eps": 0.25,
    "clustering.min_points": 20,
    "clustering.stem_area": 0.0,
    "shape.centre": "centroid",
    "shape.split_slices": 0,
    "detection.whole": False,
    "detection.e_min": 1.0,
    "detection.e_max": 20.0,
    "detection.cylindrical_stddev_thresh": 0.1,
    "detection.radius_min": 0.0,
    "detection.radius_max": 5.0,
    "detection.height_extent_min": 0.0,
    "detection.size_max": 20.0,
    "detection.arc_min": 0.0,
    "slam.method": "fastslam1",
    "slam.particles": 100,
    "slam.view_range": 0.0,
    "slam.weight_power": 1.0,
    "slam.merge_gate": 0.0,
    # The error of the centroid is the same in successive scans; only a changed viewpoint is independent.
    "slam.update_distance": 1.0,
    "slam.update_interval": 0.0,
    "detection.sigma_range": 0.1,
    "detection.sigma_bearing": 1.0,
    "relocalisation.method": "none",
    "classification.method": "none",
    "tracking.dbh_arc_min": 0.0,
    "tracking.dbh_sigma_max": 0.5,
    "tracking.velocity_sigma": 0.1,
    "tracking.acceleration_sigma": 0.001,
    "tracking.proximity_radius": 1.0,
    "tracking.confirm_time": 0.0,
}

# A planar laser on a car in a park: trunks have one to ten beams, large distances between each other and a
# range of up to 40 m. The laser sees the car itself at 0.7 m. The heading of the encoders is more accurate
# than that of a skid-steered robot.
_LASER2D: dict[str, object] = {
    "acquisition.level": "none",
    "acquisition.range_min": 1.5,
    "ground.method": "none",
    "filters.voxel_size": 0.0,
    "clustering.method": "range_jump",
    "clustering.eps": 1.0,
    "clustering.min_points": 1,
    "shape.split_slices": 0,  # a single ring has no height
    # A single ring shows no ground, so the field of view cannot be estimated from the returns.
    "detection.whole": False,
    "detection.e_max": 1000.0,
    "detection.cylindrical_stddev_thresh": 0.3,
    "detection.radius_min": 0.0,
    "detection.height_extent_min": 0.0,
    "detection.size_max": 0.6,
    "detection.arc_min": 0.0,
    "detection.sigma_range": 0.45,
    "detection.sigma_bearing": 1.35,
    "slam.noise_distance": 0.05,
    "slam.noise_turn_distance": 0.15,
    "slam.noise_turn": 0.7,
    "slam.distance_max": 4.0,
    "slam.view_range": 35.0,
    "slam.weight_power": 0.3,
    "slam.miss_weight": 1.0,
    "tracking.hits_to_confirm": 5,
    "tracking.confirm_time": 0.0,
    "slam.update_distance": 0.5,
    "slam.update_interval": 0.0,
    "relocalisation.method": "none",
    "relocalisation.slack": 0.3,
    "classification.method": "none",
    # The laser is horizontal: the height of a return above the ground is unknown.
    "obstacles.height_min": -10.0,
    "obstacles.height_max": 10.0,
    "obstacles.width": 2.0,
    "tracking.dbh_arc_min": 0.0,
    "tracking.dbh_sigma_max": 0.5,
    "tracking.proximity_radius": 1.5,
}

# Stems detected by another program, about one scan per half metre. Their position error is about 0.1 m at any
# range. In a dense forest, stems beyond 15 m double the computing time and improve the path by 1 cm.
_STEMS: dict[str, object] = {
    "acquisition.range_min": 0.0,
    "acquisition.range_max": 15.0,
    "detection.radius_min": 0.0,
    "detection.arc_min": 0.0,
    "detection.sigma_range": 0.1,
    "slam.noise_distance": 0.05,
    "slam.noise_turn_distance": 0.6,
    "slam.weight_power": 0.3,
    "classification.method": "none",
    "tracking.confirm_time": 0.0,
    "tracking.dbh_arc_min": 0.0,
    "tracking.dbh_sigma_max": 0.5,
}

PRESETS: dict[str, tuple[str, dict[str, object]]] = {
    "forest": ("Default for trunks seen by a 3D LiDAR", {}),
    "paper": ("Table 1 of the paper: eccentricity below 20", _PAPER),
    "paper-text": (
        "The paper's text: eccentricity between 10 and 20",
        {**_PAPER, "detection.e_min": 10.0},
    ),
    "stems": ("Stems detected by another program", _STEMS),
    "laser2d": ("A planar laser, as on a car", _LASER2D),
}

#: Presets for one other kind of sensor each; the remaining presets are for scans of a 3D LiDAR.
OF_ONE_SENSOR = frozenset({"stems", "laser2d"})


@cache
def preset(name: str) -> Parameters:
    """Return the parameters of a preset, the same object in each call.

    Raises:
        ParameterError: There is no preset of this name; the message lists the presets.
    """
    if name not in PRESETS:
        raise ParameterError(f"there is no preset {name!r}", remedy=f"Presets: {', '.join(PRESETS)}")
    return Parameters().replace(PRESETS[name][1])
