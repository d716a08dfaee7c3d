"""Named sets of parameters, each with where its numbers come from."""

from __future__ import annotations

from functools import cache

from pipeline.config.model import Parameters
from pipeline.errors import ParameterError

# Table 1 of the paper; what it does not say is set so that it changes nothing.
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
    "shape.plane": 2,
    "shape.centre": "centroid",
    "shape.slices": 0,
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
    "slam.looks": 10000.0,
    "slam.weight_power": 1.0,
    "slam.merge_gate": 0.0,
    # The centroid's error is the same in each scan from one side; only a step aside brings news.
    "slam.update_distance": 1.0,
    "detection.sigma_range": 0.1,
    "detection.sigma_bearing": 1.0,
    "relocalisation.method": "none",
    "gathering.method": "none",
    "tracking.dbh_arc_min": 0.0,
    "tracking.velocity_sigma": 0.1,
    "tracking.acceleration_sigma": 0.001,
    "tracking.proximity_radius": 1.0,
    "tracking.distance_max": 1.0,
}

# A planar laser on a car among park trees: trunks of one to ten beams, far apart, seen to 40 m. The
# car itself is seen at 0.7 m. Its encoders turn truer than those of a robot that skids.
_LASER2D: dict[str, object] = {
    "acquisition.level": "none",
    "acquisition.range_min": 1.5,
    "ground.method": "none",
    "filters.voxel_size": 0.0,
    "clustering.method": "range_jump",
    "clustering.eps": 1.0,
    "clustering.min_points": 1,
    "shape.slices": 0,  # one ring has no height
    # One ring meets no ground: where returns end says little of where the laser looks.
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
    "slam.update_distance": 0.5,
    "relocalisation.method": "none",
    "relocalisation.slack": 0.3,
    "gathering.method": "none",
    # The laser looks level, so nothing says how high a return stands.
    "obstacles.height_min": -10.0,
    "obstacles.height_max": 10.0,
    "obstacles.width": 2.0,
    "tracking.dbh_arc_min": 0.0,
    "tracking.distance_max": 3.0,
    "tracking.proximity_radius": 1.5,
}

# Stems that another program found, about a scan every half metre: their places err by a decimetre whatever
# their distance. In a dense forest those beyond 15 m double the time and better the path by a centimetre.
_STEMS: dict[str, object] = {
    "acquisition.range_min": 0.0,
    "acquisition.range_max": 15.0,
    "detection.radius_min": 0.0,
    "detection.arc_min": 0.0,
    "detection.sigma_range": 0.1,
    "slam.noise_distance": 0.05,
    "slam.noise_turn_distance": 0.6,
    "slam.weight_power": 0.3,
    "gathering.method": "none",
    "tracking.dbh_arc_min": 0.0,
}

PRESETS: dict[str, tuple[str, dict[str, object]]] = {
    "forest": ("The best that we know for trunks seen by a 3D LiDAR; the default", {}),
    "paper": ("Table 1 of the paper: eccentricity below 20", _PAPER),
    "paper-text": (
        "The paper's text: eccentricity between 10 and 20",
        {**_PAPER, "detection.e_min": 10.0},
    ),
    "stems": ("Ready stems of another program, as in a folder of TreeManagerState files", _STEMS),
    "laser2d": ("A planar laser, as on the car of Victoria Park", _LASER2D),
}


@cache
def preset(name: str) -> Parameters:
    """The parameters of a preset.

    Raises:
        ParameterError: There is no preset of this name.
    """
    if name not in PRESETS:
        raise ParameterError(f"there is no preset {name!r}", remedy=f"Presets: {', '.join(PRESETS)}")
    return Parameters().replace(PRESETS[name][1])
