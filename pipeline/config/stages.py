"""Parameter declarations of every stage. The defaults form the preset `forest`."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Stage(BaseModel):
    """Parameters of one stage: immutable, strictly typed, without unknown names, NaN or infinity.

    The docstring of a parameter explains it in one sentence, for the help text and docs/parameters.md.
    """

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )
    #: Pairs of parameters of which the first must be less than the second.
    ascending: ClassVar[tuple[tuple[str, str], ...]] = ()

    @classmethod
    def title(cls) -> str:
        """Return the title of the stage: its docstring up to the first colon, without spaces at its ends; the
        whole docstring if it has no colon, the name of the class if there is no docstring."""
        return (cls.__doc__ or cls.__name__).partition(":")[0].strip()

    @model_validator(mode="after")
    def _is_ascending(self) -> Self:
        """Return the parameters; ValueError that names both parameters of a pair of `ascending` and their
        values if the first is not less than the second, also if both are equal."""
        stage = type(self).__name__.lower()
        for low, high in self.ascending:
            first, second = getattr(self, low), getattr(self, high)
            if first >= second:
                raise ValueError(f"{stage}.{low} = {first} must be less than {stage}.{high} = {second}")
        return self


def number(
    default: float,
    title: str,
    unit: str,
    low: float,
    high: float,
    step: float,
    shown: tuple[float, float] | None = None,
    *,
    main: bool = False,
) -> Any:  # noqa: ANN401 - pydantic's Field is the default of a field of any type
    """Return the declaration of a floating-point parameter: pydantic's Field with the bounds, and with unit,
    step, `shown` and `main` in the JSON schema.

    Args:
        default: Value in the preset `forest`.
        title: Label of the slider.
        unit: Unit symbol; empty if dimensionless.
        low, high: Bounds, inclusive.
        step: Increment of the slider by a key.
        shown: Range of the slider; not compared with the bounds. None: from a tenth to ten times the default,
            clipped to the bounds, if the default is positive and `low` is not negative, else the bounds.
        main: Whether the parameter has a slider next to the 3D scene.
    """
    if shown is None:
        shown = (max(low, default / 10), min(high, default * 10)) if default > 0.0 <= low else (low, high)
    extra: dict[str, Any] = {"unit": unit, "step": step, "shown": list(shown), "main": main}
    return Field(default=default, title=title, ge=low, le=high, json_schema_extra=extra)


def count(default: int, title: str, unit: str, low: int, high: int, *, main: bool = False) -> Any:  # noqa: ANN401
    """Return the declaration of an integer parameter, as `number` with the step 1 and the default range of
    the slider, whose ends need not be integers.

    Args:
        default: Value in the preset `forest`.
        title: Label of the slider.
        unit: Unit symbol; empty if dimensionless.
        low, high: Bounds, inclusive.
        main: Whether the parameter has a slider next to the 3D scene.
    """
    return number(default, title, unit, low, high, 1, main=main)


def name(default: str, title: str, pattern: str) -> Any:  # noqa: ANN401
    """Return the declaration of a parameter that holds a name.

    Args:
        default: Value in the preset `forest`.
        title: Label on the dashboard.
        pattern: Regular expression of the valid names.
    """
    return Field(default=default, title=title, pattern=pattern)


def choice(default: str | bool, title: str) -> Any:  # noqa: ANN401
    """Return the declaration of a parameter of type bool or Literal. The type and the valid values are those
    of the annotation.

    Args:
        default: Value in the preset `forest`.
        title: Label on the dashboard.
    """
    return Field(default=default, title=title)


# --- one scan -------------------------------------------------------------------------------------


class Acquisition(Stage):
    """Acquisition: which returns of the sensor are used (Eq. 1)."""

    ascending = (("range_min", "range_max"),)

    level: Literal["none", "imu"] = choice("imu", "Level the scan")
    """Rotate the scan by the tilt that the IMU or the pose reports."""

    deskew: bool = choice(True, "De-skew")
    """Compensate the motion of the robot during the sweep for each point."""

    gyro: bool = choice(True, "Gyroscope")
    """Use the gyroscope of the IMU for the yaw rate of the robot."""

    range_min: float = number(0.5, "Minimum range", "m", 0.0, 10.0, 0.1)
    """Closer returns are not mapped; obstacle detection uses them."""

    range_max: float = number(40.0, "Maximum range", "m", 1.0, 250.0, 1.0)
    """Farther returns are not used."""


class Filters(Stage):
    """Filters: the pass-through box in the sensor frame and the voxel grid (Eq. 2)."""

    ascending = (("x_min", "x_max"), ("y_min", "y_max"), ("z_min", "z_max"))

    x_min: float = number(-40.0, "x min", "m", -100.0, 100.0, 0.1, (-50.0, 50.0), main=True)
    """Rear face of the pass-through box."""

    x_max: float = number(40.0, "x max", "m", -100.0, 100.0, 0.1, (-50.0, 50.0), main=True)
    """Front face of the pass-through box."""

    y_min: float = number(-40.0, "y min", "m", -100.0, 100.0, 0.1, (-50.0, 50.0), main=True)
    """Right face of the pass-through box."""

    y_max: float = number(40.0, "y max", "m", -100.0, 100.0, 0.1, (-50.0, 50.0), main=True)
    """Left face of the pass-through box."""

    z_min: float = number(-20.0, "z min", "m", -50.0, 50.0, 0.05, (-20.0, 20.0), main=True)
    """Lower face of the pass-through box."""

    z_max: float = number(20.0, "z max", "m", -50.0, 50.0, 0.05, (-20.0, 20.0), main=True)
    """Upper face of the pass-through box."""

    voxel_size: float = number(0.01, "Voxel size", "m", 0.0, 1.0, 0.001, (0.005, 0.2), main=True)
    """Points in a cube of this edge length are replaced by their mean; 0 turns the filter off."""


class Ground(Stage):
    """Ground: the terrain model and the height band above it that is searched for trunks."""

    ascending = (("height_min", "height_max"),)

    method: Literal["none", "polar"] = choice("polar", "Ground model")
    """polar: ground surface on a polar grid with a maximum slope; none: no ground."""

    height_min: float = number(0.3, "Minimum height", "m", -1.0, 10.0, 0.05)
    """Points lower above the ground are removed."""

    height_max: float = number(3.0, "Maximum height", "m", 0.1, 30.0, 0.05)
    """Points higher above the ground are removed."""

    slope_max: float = number(35.0, "Maximum slope", "deg", 1.0, 80.0, 1.0)
    """Maximum slope of the terrain."""


class Clustering(Stage):
    """Clustering: DBSCAN, or cuts at range jumps for a planar laser."""

    method: Literal["dbscan", "range_jump"] = choice("dbscan", "Method")
    """dbscan: density of the points; range_jump: a cut where the range of neighbouring beams jumps."""

    engine: Literal["grid", "sklearn", "open3d"] = choice("grid", "DBSCAN engine")
    """The compiled grid of stemmap, scikit-learn or Open3D; core points and noise are identical."""

    dimensions: int = count(2, "Dimensions", "", 2, 3)
    """2 clusters the horizontal projection, 3 the 3D points."""

    eps: float = number(0.15, "Radius eps", "m", 0.01, 5.0, 0.01, (0.05, 1.0), main=True)
    """Maximum distance between neighbouring points (DBSCAN eps); a sensor with returns a degree apart uses at
    least 0.2 m."""

    min_points: int = count(8, "Minimum points", "", 1, 500, main=True)
    """Neighbours, including the point itself, that make a point a core point (DBSCAN min_samples)."""

    stem_area: float = number(0.1, "Stem area", "m²", 0.0, 10.0, 0.01)
    """Far stems return few points: where a stem surface of this area returns fewer points than a core point
    needs, each point counts more; 0 turns this off."""

    weight_max: int = count(2, "Maximum weight", "", 1, 100)
    """Maximum weight of one point."""


class Shape(Stage):
    """Shape: covariance and eccentricity of a cluster (Eq. 3-4) and the circle of a trunk."""

    centre: Literal["centroid", "circle"] = choice("circle", "Trunk centre")
    """centroid: mean of the visible arc, as in the paper; circle: centre of a fitted circle."""

    split_slices: int = count(4, "Slices that agree", "", 0, 8)
    """Height slices of 0.2 m that must show the same circle to separate a trunk from a larger cluster; 0
    turns the separation off."""


class Detection(Stage):
    """Detection: which clusters are trees, and the reason why the others are not."""

    ascending = (("e_min", "e_max"), ("radius_min", "radius_max"))

    whole: bool = choice(True, "Whole trunks only")
    """Reject clusters that are cut off by the box, the range limit or the edge of the field of view."""

    e_min: float = number(1.0, "Minimum eccentricity", "", 1.0, 1000.0, 0.1, (1.0, 30.0), main=True)
    """Clusters with a smaller lambda1 / lambda2 are rejected as too round."""

    e_max: float = number(60.0, "Maximum eccentricity", "", 1.0, 1000.0, 0.5, (3.0, 300.0), main=True)
    """Clusters with a larger lambda1 / lambda2 are rejected as too long."""

    cylindrical_stddev_thresh: float = number(
        0.06, "Maximum radial deviation", "m", 0.001, 2.0, 0.005, main=True
    )
    """Maximum standard deviation of the distances to the stem axis."""

    radius_min: float = number(0.04, "Minimum radius", "m", 0.0, 2.0, 0.01)
    """Thinner stems are rejected as poles or stakes."""

    radius_max: float = number(0.6, "Maximum radius", "m", 0.01, 5.0, 0.01)
    """Thicker stems are rejected."""

    cloud_radius_max: float = number(1.25, "Maximum radius in a cloud", "m", 0.01, 5.0, 0.01)
    """Thicker stems of a whole cloud are rejected. The limit exceeds that of a scan because a whole cloud
    shows stems from several sides, and few trees have a diameter above 2.5 m."""

    height_extent_min: float = number(0.5, "Minimum visible height", "m", 0.0, 10.0, 0.05)
    """Clusters of a smaller height extent are rejected."""

    size_max: float = number(1.2, "Maximum width", "m", 0.05, 20.0, 0.05)
    """Wider clusters are rejected."""

    arc_min: float = number(40.0, "Minimum visible arc", "deg", 0.0, 360.0, 5.0)
    """Circles with a smaller visible arc are rejected."""

    sigma_range: float = number(0.05, "Range sigma", "m", 0.001, 5.0, 0.005)
    """Standard deviation of the range to a trunk centre, added to the covariance of the fit."""

    sigma_bearing: float = number(0.4, "Bearing sigma", "deg", 0.01, 20.0, 0.05)
    """Standard deviation of the bearing to a trunk centre, added to the covariance of the fit."""


# --- the pose -------------------------------------------------------------------------------------


class Slam(Stage):
    """SLAM: FastSLAM with a map per particle (Eq. 5-7), and a graph of keyframes that corrects it."""

    method: Literal["fastslam1", "fastslam2"] = choice("fastslam2", "Method")
    """FastSLAM 1.0 (odometry proposal) or 2.0 (odometry and scan proposal)."""

    particles: int = count(100, "Particles", "", 1, 5000)
    """Number of particles (hypotheses of the path)."""

    noise_distance: float = number(0.03, "Position noise", "m/√m", 0.0, 1.0, 0.005)
    """Standard deviation of the odometry position after 1 m; it grows with the root of the distance."""

    noise_turn_distance: float = number(0.4, "Heading noise", "deg/√m", 0.0, 30.0, 0.1)
    """Standard deviation of the odometry heading after 1 m; it grows with the root of the distance."""

    noise_turn: float = number(2.0, "Turn noise", "deg/√rad", 0.0, 60.0, 0.1)
    """Standard deviation of the odometry heading after a turn of 1 rad; it grows with the root of it."""

    gate: float = number(3.5, "Association gate", "sigma", 0.5, 20.0, 0.1)
    """Maximum Mahalanobis distance between a detection and its landmark."""

    distance_max: float = number(1.0, "Association distance", "m", 0.05, 20.0, 0.05)
    """Maximum Euclidean distance between a detection and its landmark."""

    hits_to_weigh: int = count(3, "Hits to weigh", "", 1, 50)
    """Landmarks with fewer hits do not contribute to the particle weights."""

    view_range: float = number(15.0, "View range", "m", 0.0, 100.0, 0.5)
    """A landmark within this range, in free view and not detected, counts as missed; 0 turns misses off."""

    misses_per_hit: int = count(3, "Misses per hit", "", 1, 100)
    """Misses that cancel one hit; a landmark without hits is removed."""

    miss_weight: float = number(0.0, "Weight of a miss", "", 0.0, 5.0, 0.05)
    """Subtracted from the log weight of a particle for each well-known landmark that is missed."""

    weight_power: float = number(0.1, "Weight power", "", 0.01, 1.0, 0.05)
    """Exponent of the scan likelihood in the particle weights; 1 treats successive views as independent."""

    merge_gate: float = number(1.0, "Merge gate", "sigma", 0.0, 10.0, 0.1)
    """Landmarks within this Mahalanobis distance of which a scan shows only one are merged; 0 is off."""

    resample_below: float = number(0.5, "Resampling threshold", "", 0.0, 1.0, 0.05, (0.0, 1.0))
    """The filter resamples when N_eff falls below this fraction of the particles."""

    update_distance: float = number(0.25, "Update distance", "m", 0.0, 10.0, 0.05)
    """Motion between two scans that update the filter, whose views share fewer errors; 0 uses every scan."""

    update_interval: float = number(1.0, "Update interval", "s", 0.0, 60.0, 0.1)
    """Maximum time between two updates of a robot that hardly moves or has stuck wheels; 0 is no limit."""

    keyframe_distance: float = number(1.0, "Keyframe distance", "m", 0.1, 100.0, 0.1)
    """Motion between two keyframes of the graph that corrects path and map; 1 rad of turn counts as 1 m."""


class Relocalisation(Stage):
    """Relocalisation: finding a lost robot and closing loops from the constellation of stems."""

    method: Literal["none", "constellation"] = choice("constellation", "Lost robot and loops")
    """constellation: search the map for the visible stems by their pairwise distances; none: both off."""

    stems_min: int = count(6, "Minimum agreeing stems", "", 4, 100)
    """Stems that must agree with a pose before it is accepted."""

    slack: float = number(0.1, "Map distortion", "m", 0.0, 1.0, 0.01)
    """Standard deviation of the distortion of a map over the extent of a constellation."""


# --- the trees ------------------------------------------------------------------------------------


class Classification(Stage):
    """Classification: the verdict on a tree from the voxel columns accumulated over all scans."""

    method: Literal["none", "columns"] = choice("columns", "Method")
    """columns: class of the voxel column of a tree; none: number of hits of a tree."""

    range_max: float = number(25.0, "Maximum range", "m", 1.0, 100.0, 1.0)
    """Farther returns are not accumulated in the voxel map."""

    interval: float = number(0.4, "Update interval", "s", 0.0, 60.0, 0.1)
    """Time between two scans that are added to the voxel map; those of the first second are always added."""

    voxels_log2: int = count(19, "Memory (log2 voxels)", "", 12, 24)
    """Binary logarithm of the maximum number of voxels; the oldest half is removed when the map is full."""

    tree_share: float = number(0.4, "Tree threshold", "", 0.0, 1.0, 0.05, (0.0, 1.0))
    """Minimum share of votes for tree that makes a column a tree."""

    forest: str = name("package", "Classifier", r"^(package|[0-9a-f]{16})$")
    """The classifier of the package, or the name of one that was trained from annotations."""


class Tracking(Stage):
    """Tracking: a Kalman filter per tree (Eq. 10) on the data association of SLAM."""

    engine: Literal["compiled", "filterpy"] = choice("compiled", "Kalman engine")
    """The compiled filter of stemmap or filterpy; both give the same numbers."""

    velocity_sigma: float = number(0.0, "Velocity sigma", "m/s", 0.0, 5.0, 0.01)
    """Initial standard deviation of a tree's velocity; 0 fixes trees in place."""

    acceleration_sigma: float = number(0.0, "Acceleration sigma", "m/s²", 0.0, 5.0, 0.001)
    """Process noise of a tree's velocity."""

    proximity_radius: float = number(0.4, "Proximity radius", "m", 0.0, 10.0, 0.05)
    """Trees closer to each other than this are merged; a new landmark this close to a tree begins none."""

    hits_to_confirm: int = count(3, "Hits to confirm", "", 1, 200)
    """Detections after which a tree is shown and exported, unless its voxel column confirms it earlier."""

    # A person who walks at 0.5 m/s leaves the proximity radius in 0.8 s, and the track ends.
    confirm_time: float = number(1.0, "Time to confirm", "s", 0.0, 60.0, 0.1)
    """Minimum time between the first and the last of these detections."""

    dbh_arc_min: float = number(180.0, "Minimum arc for DBH", "deg", 0.0, 360.0, 10.0)
    """Minimum observed arc of the trunk for which a diameter is reported."""

    dbh_sigma_max: float = number(0.03, "Maximum sigma of DBH", "m", 0.005, 0.5, 0.005)
    """Largest standard deviation of a reported diameter of up to 30 cm; in proportion to the diameter above.
    A tree with a larger one has no diameter."""

    breast_height: float = number(1.3, "Breast height", "m", 0.1, 5.0, 0.05)
    """Height above the ground of the reported diameter."""

    out_of_round: float = number(0.025, "Out-of-roundness", "", 0.0, 0.2, 0.005)
    """Standard deviation of the diameters of a stem in all directions as a fraction of its DBH. It decides
    the DBH sigma of stems that were seen from one side."""

    taper_sigma: float = number(0.02, "Taper sigma", "m/m", 0.0, 0.1, 0.005)
    """Standard deviation of the taper: change of the diameter per metre of height."""


# --- safety and evaluation ------------------------------------------------------------------------


class Obstacles(Stage):
    """Obstacles: returns in the path of the robot, and the zones in which it should slow down and stop."""

    ascending = (("height_min", "height_max"), ("stop_distance", "slow_distance"))

    method: Literal["none", "way"] = choice("way", "Obstacle detection")
    """way: search the path that results from the current velocities; none: off."""

    width: float = number(0.9, "Path width", "m", 0.1, 10.0, 0.05)
    """Width of the robot including the lateral clearance."""

    reach: float = number(0.4, "Robot overhang", "m", 0.0, 5.0, 0.05)
    """Extent of the robot in front of and behind its base frame, at least to the sensor."""

    height_min: float = number(0.25, "Minimum obstacle height", "m", -10.0, 5.0, 0.05)
    """Lower returns above the ground are ignored."""

    height_max: float = number(1.5, "Robot height", "m", 0.1, 10.0, 0.05)
    """Higher returns above the ground are ignored."""

    stop_distance: float = number(1.0, "Stop distance", "m", 0.1, 20.0, 0.1)
    """An obstacle closer than this requests a stop."""

    slow_distance: float = number(3.0, "Slow distance", "m", 0.2, 40.0, 0.1)
    """An obstacle closer than this requests slow driving."""

    min_points: int = count(5, "Minimum returns", "", 1, 100)
    """Returns within half a metre that make an obstacle; fewer returns are rain or insects."""


class Evaluation(Stage):
    """Evaluation: the comparison of the map with the ground truth."""

    match_distance: float = number(0.5, "Match distance", "m", 0.05, 5.0, 0.05)
    """Maximum distance between a mapped tree and its ground truth tree."""

    reach: float = number(10.0, "Reach", "m", 1.0, 200.0, 0.5)
    """Ground truth farther from every point of the path is not scored."""
