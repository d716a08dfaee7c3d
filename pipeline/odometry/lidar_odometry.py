"""LiDAR odometry: motion of the robot from the registration of its scans.

Each scan is registered to a map of the scans before it by voxelised GICP (Koide et al., ICRA 2021;
`small_gicp`), from coarse voxels to fine ones. The initial guess is the step of the wheels where the source
has them, else constant velocity.

Without gravity, the frame of the odometry would have the slope of the ground on which the robot started.
Trunks grow against gravity: nearly all normals of bark are perpendicular to it, so the vertical is the
direction in which the normals of a scan vary least (`vertical_of`). It levels the frame to about one degree.

Rings on the ground move with the sensor and pull the pose backwards, so the points above the ground determine
x, y and yaw. Where the view leaves the trees, they are few and their registration ends in a false minimum.
So it is weighted with that of the whole cloud (`fused`).

A registration gives the pose of a scan in the middle of its sweep: an error of the velocity with which the
scan was de-skewed moves the points before and after the middle in opposite directions. De-skewed to another
time, the error of the velocity would displace the pose, and the pose the next velocity. With the start of
the sweep as reference, this feedback has the eigenvalue -1: the error e_k = -(e_(k-1) - e_(k-2)) / 2 of a
step never decays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from pipeline.config.stages import Ground
from pipeline.geometry.poses import Float, Pose3
from pipeline.ground.scan_ground import find_terrain, height_above
from pipeline.io.readers.base import count_loss
from pipeline.odometry.registration_covariance import registration_covariance, step_covariance
from pipeline.types.records import Bool, Float32, Int, Notice, Odometry, Record, Scan, Sensor

#: Largest and smallest range of a point [m]; nearer ones are of the robot.
RANGE_MAX, RANGE_MIN = 60.0, 1.0
#: Sides of the coarsest and finest voxels of the map, and of the cells of which a scan keeps one point [m].
VOXEL, FINEST, CELL = 1.0, 0.25, 0.25
#: A voxel is at least as large as the distance of so many beams at this range [m], a usual distance to trees:
#: its normal distribution is that of the surface only where several beams hit it.
BEAMS, BEAMS_AT = 3.0, 10.0
#: Points lower than this above the ground are ground [m].
GROUND = 0.3
#: Smallest vertical component of a normal of the ground. Neighbours on the ground are of one ring, which
#: moves with the sensor; where their normal is not vertical, they would pull the pose backwards.
UPRIGHT = 0.95
#: Number of neighbours from which the normal of a point is computed.
NEIGHBOURS = 10
#: Least spread of the neighbours of a point in their second direction, as a share of that in the first one.
#: Neighbours on one ring lie on a line and have no normal; a ring on foliage moves with the sensor and pulls
#: the pose backwards.
LINE = 0.1
#: Covariance x, y [m^2], yaw [rad^2] of the registration of the whole cloud. Where the points above ground
#: determine the pose well, its difference from theirs has an RMS of 2 cm and 1 to 3 mrad in simulated drives;
#: twice that, because the pull of the rings is the same in successive scans, which no mean reduces.
WHOLE = np.diag([0.05, 0.05, 0.005]) ** 2
#: Largest distance between a point and the mean of its voxel [m], and maximum number of iterations.
CORRESPONDENCE, ITERATIONS = 1.0, 30
#: Height above the ground of the points that show the vertical [m]: bark, without most of the undergrowth
#: and crowns.
BARK = (0.5, 3.5)
#: Side of the cells from which their normals are computed [m].
FINE = 0.1
#: Largest components of normals along the vertical, in the first iterations and in the last ones.
LEVEL = (0.5, 0.5, 0.5, 0.25, 0.25, 0.25, 0.25)
#: Least share of the normals that are level. Of random normals, a quarter is (the last of LEVEL).
BARK_SHARE = 0.4
#: Number of scans over which the vertical is averaged.
SCANS_AVERAGED = 100
#: A registration fails if a smaller share of the points above the ground lies in a voxel of the map. The
#: smallest share in a real drive at 4 m/s, a Livox recording and simulated forests is 0.84; scans of two
#: places share 0.1 to 0.6.
SHARED = 0.6
#: It also fails if the robot would have moved faster [m/s, rad/s].
FASTEST, FASTEST_TURN = 15.0, 6.0
#: Covariance of the unknown velocity x, y [m/s], yaw [rad/s] while the registration fails; see WALK_SPEED of
#: the synchroniser. The sigmas of successive scans add up, because their errors are those of one velocity.
UNKNOWN = np.diag([0.5, 0.5, 0.2]) ** 2
#: Largest share of the variance of the guess that a registration leaves in any direction. With a larger share
#: the scans do not determine the motion, as in an open field or a corridor.
DETERMINED = 0.5
#: The map is wrong if no scan was registered for this time [ns].
LOST_NS = 500_000_000
#: Largest variance x, y [m^2], yaw [rad^2] of a registration that shows the motion: the velocity from two of
#: them, LOST_NS apart, is better known than without registration.
SHOWN = 0.5 * DETERMINED * np.diag(UNKNOWN) * (1e-9 * LOST_NS) ** 2
#: The map is wrong if no registration of the points above the ground has shown the motion for this time [ns].
#: The ground alone pulls the pose back by up to 7 % of the path: 0.3 m at 2 m/s, half the distance of two
#: trees that stand close.
HIDDEN_NS = 2_000_000_000
#: First words of the notice that gives the time from which the map is wrong.
LOST = "LiDAR odometry is lost"
#: Largest disagreement of the surfaces of scans: 99.9 % of the values of chi-square with 3 degrees of freedom
#: are smaller.
CONTRADICTED = 16.3
#: Fewest points for a registration.
FEWEST = 100
#: Older odometry of the wheels gives no initial guess [ns].
STALE_NS = 300_000_000
#: After a longer pause the previous velocity is not used [ns].
PAUSE_NS = 1_000_000_000


class LidarOdometry:
    """Estimator of odometry: each scan gets the pose of the base as an Odometry record before it.

    A scan keeps its first pose, so reading again gives the same poses.

    Args:
        T_base_lidar: Extrinsics of the LiDAR.
        sensor: Its beams, which decide how fine the map is (`voxel_sides`); None for the coarsest.
        height_above_ground: Returns the height above the ground [m], shape (N,), of points with the axes of
            the base and the origin in the sensor, float32, shape (N, 3) [m]; None for the ground
            segmentation of the pipeline.

    Attributes:
        losses: Dict from reasons to numbers of scans: those with too few points for a pose, those whose
            sweep is not later than the last one, and those whose pose is only the initial guess, because the
            registration failed. Scans with a late stamp, which have no pose either, are not counted.
    """

    def __init__(
        self,
        T_base_lidar: Pose3,
        sensor: Sensor | None = None,
        height_above_ground: Callable[[Float32], Float32] | None = None,
    ) -> None:
        """Create an estimator without a map; imports small_gicp."""
        import small_gicp

        self._gicp: Any = small_gicp
        self._sides = voxel_sides(sensor)
        self._maps = self._empty_maps()
        self._T_base_lidar = T_base_lidar
        self._height_above_ground = height_above_ground or _height_above_terrain
        self._T_odom_base: Float = np.eye(4)
        self._vertical: Float = np.array([0.0, 0.0, 1.0])  # mean in the odometry frame
        self._verticals = 0  # scans in this mean
        self._step: Float = np.eye(4)
        self._step_ns = 0  # its duration; 0 before the first step
        self._known: dict[int, Odometry | None] = {}
        self._newest_ns: int | None = None
        self._wheels: Odometry | None = None
        self._wheels_before: Odometry | None = None
        self._first_ns = 0  # middle of the first scan
        self._registered_ns = 0  # middle of the newest scan whose registration did not fail
        self._shown_ns = 0  # middle of the newest scan whose points above the ground showed the motion
        self._was_hidden = False  # whether no scan had shown the motion for HIDDEN_NS at the last one
        self._disagreement = 0.0  # chi-square of 3, see registration_covariance; mean over about LOST_NS
        self._was_contradicted = False  # whether the last scan had a disagreement above CONTRADICTED
        self._reported_ns: int | None = None  # _registered_ns of the failure that was reported last
        self.losses: dict[str, int] = {}

    @property
    def poses(self) -> list[tuple[int, Pose3]]:
        """Times [ns] and poses of the LiDAR, T_odom_lidar, in the order of time."""
        known = [odometry for odometry in self._known.values() if odometry is not None]
        return [(each.stamp_ns, each.T_odom_base @ self._T_base_lidar) for each in known]

    def end(self) -> None:
        """Do nothing; nothing is counted at the end."""

    def add(self, record: Record) -> Iterator[Record]:
        """Yield the records that replace one record: nothing for odometry, which is stored as the initial
        guess; the pose (if it is known) and the scan for a scan of points; the record itself for all others.
        The scan is registered when the iterator is consumed. Its pose is that in the middle of its sweep. A
        notice reports a failure of the registration."""
        if isinstance(record, Odometry):
            self._wheels = record
            return
        if isinstance(record, Scan) and record.stems is None:
            odometry = self._odometry_of(record)
            if odometry is not None:
                yield odometry
                yield from self._failures(odometry.stamp_ns)
        yield record

    def _failures(self, now_ns: int) -> Iterator[Notice]:
        """Yield a notice with the time from which the map is wrong: once for each failure of the registration
        that lasts for LOST_NS, once whenever the scans have not shown the motion for HIDDEN_NS, and once
        whenever surfaces begin to contradict it."""
        if self._is_lost and self._registered_ns != self._reported_ns:
            self._reported_ns = self._registered_ns
            why = "the scans do not fit to those before or show no motion"
            yield self._notice(now_ns, self._registered_ns, why)
        hidden = not self._is_lost and now_ns - self._shown_ns >= HIDDEN_NS
        if hidden and not self._was_hidden:
            why = "too little above the ground shows the motion, as in grass without trees"
            yield self._notice(now_ns, self._shown_ns, why)
        self._was_hidden = hidden
        contradicted = self._disagreement > CONTRADICTED
        if contradicted and not self._was_contradicted:
            why = "surfaces move against one another, as where a vehicle drives beside the robot"
            yield self._notice(now_ns, now_ns - LOST_NS, why)
        self._was_contradicted = contradicted

    def _notice(self, now_ns: int, since_ns: int, why: str) -> Notice:
        """Return the notice that the map is wrong from a time [ns]."""
        since_s = max(since_ns - self._first_ns, 0) * 1e-9
        return Notice(now_ns, f"{LOST} since {since_s:.1f} s: {why}. The map is wrong from there on")

    @property
    def _is_lost(self) -> bool:
        """Whether no scan was registered for LOST_NS; each scan then starts a new map."""
        return self._newest_ns is not None and self._newest_ns - self._registered_ns >= LOST_NS

    def _odometry_of(self, scan: Scan) -> Odometry | None:
        """Return T_odom_base of a scan: the known one for a time that was registered before, else by
        registration. None for a new scan that is not later than the newest one, and where `_register` has
        none."""
        if scan.stamp_ns in self._known:
            return self._known[scan.stamp_ns]
        if self._newest_ns is not None and scan.stamp_ns <= self._newest_ns:
            return None  # late; the synchroniser counts it
        odometry = self._register(scan)
        self._known[scan.stamp_ns] = odometry
        return odometry

    def _register(self, scan: Scan) -> Odometry | None:
        """Register a scan to the map, add it to the map, and return its pose. None, counted in `losses`, with
        fewer than FEWEST useful points, and if the middle of the sweep is not later than that of the last
        one. If the registration fails (SHARED, DETERMINED, FASTEST), the initial guess is the pose, and the
        scan is not added unless it starts a new map; this is counted too."""
        points, offset_s = self._useful(scan)
        if len(points) < FEWEST:
            count_loss(self.losses, "poses of scans with too few points for LiDAR odometry")
            return None
        middle_ns = scan.stamp_ns
        if offset_s is not None:
            middle_s = 0.5 * (float(offset_s.min()) + float(offset_s.max()))
            middle_ns, offset_s = scan.stamp_ns + round(1e9 * middle_s), offset_s - middle_s
        before_ns = self._newest_ns
        if before_ns is not None and middle_ns <= before_ns:
            count_loss(self.losses, "poses of scans whose sweep is not later than that of the scan before")
            return None
        self._newest_ns = middle_ns
        sensor = (scan.T_base_lidar or self._T_base_lidar).t
        height = self._height_above_ground((points - sensor).astype(np.float32))
        ground = height < GROUND
        covariance = np.zeros((3, 3))
        vertical = vertical_of(points[(height > BARK[0]) & (height < BARK[1])])
        if before_ns is None:
            self._first_ns = self._registered_ns = self._shown_ns = middle_ns
            if vertical is not None:
                self._T_odom_base[:3, :3] = levelling(vertical)
            self._insert(self._clouds(points, ground)[0], self._T_odom_base)
        else:
            step = self._expected_step(middle_ns - before_ns)
            points = undistorted(points, offset_s, step, middle_ns - before_ns)
            cloud, upright = self._clouds(points, ground)
            guess = self._T_odom_base @ step
            T, shared = self._aligned(cloud, guess)
            above = T
            if upright.size() >= FEWEST:
                planar, shared = self._aligned(upright, T)
                above = _planar_of(T, planar)
            span_s = (middle_ns - before_ns) * 1e-9
            largest = np.array([FASTEST, FASTEST, FASTEST_TURN]) * span_s
            of_scan, disagreement = self._covariance(upright, above, largest)
            self._disagreement += (disagreement - self._disagreement) * min(span_s * 1e9 / LOST_NS, 1.0)
            doubt = max(self._disagreement / 3.0, 1.0)
            is_shown = bool((doubt * np.diag(of_scan) < SHOWN).all()) and self._disagreement <= CONTRADICTED
            T, difference = fused(T, above, of_scan, is_shown=is_shown)
            of_scan *= doubt
            if difference is not None:  # the covariance is that of the pose that is not used
                of_scan = WHOLE + np.outer(difference, difference)
            step = np.linalg.inv(self._T_odom_base) @ T
            is_determined = bool((np.diag(of_scan) < DETERMINED * largest**2).all())
            if shared >= SHARED and is_determined and _is_possible(step, middle_ns - before_ns):
                covariance = step_covariance(of_scan, step, largest)
                self._registered_ns = middle_ns
                if difference is None and (np.diag(of_scan) < SHOWN).all():
                    self._shown_ns = middle_ns
            else:
                count_loss(self.losses, "poses of scans that LiDAR odometry could not place")
                failing_s = (middle_ns - self._registered_ns) * 1e-9
                covariance = UNKNOWN * (failing_s**2 - (failing_s - span_s) ** 2)
                T, step = guess, np.linalg.inv(self._T_odom_base) @ guess
            self._step, self._step_ns, self._T_odom_base = step, middle_ns - before_ns, T
            if self._is_lost:
                self._maps = self._empty_maps()
            if self._registered_ns == middle_ns or self._is_lost:
                self._insert(cloud, T)
        self._wheels_before = self._wheels
        if vertical is not None:
            self._average_vertical(vertical)
        level = levelling(self._vertical)
        pose = Pose3(level @ self._T_odom_base[:3, :3], level @ self._T_odom_base[:3, 3])
        return Odometry(middle_ns, pose, covariance)

    def _useful(self, scan: Scan) -> tuple[Float, Float | None]:
        """Return the points to register in the base frame, shape (N, 3) [m], without those too near or too
        far, and their times after the stamp, shape (N,) [s]; the times are None if the scan has none."""
        points = scan.points.astype(np.float64)
        reach = np.sqrt(np.einsum("ij,ij->i", points, points))
        keep = (reach > RANGE_MIN) & (reach < RANGE_MAX)
        offset_s = None if scan.offset_ns is None else scan.offset_ns[keep] * 1e-9
        return (scan.T_base_lidar or self._T_base_lidar).apply(points[keep]), offset_s

    def _average_vertical(self, vertical: Float) -> None:
        """Add the vertical of a scan, in the base frame, to the mean of the last SCANS_AVERAGED scans."""
        self._verticals = min(self._verticals + 1, SCANS_AVERAGED)
        mean = self._vertical + (self._T_odom_base[:3, :3] @ vertical - self._vertical) / self._verticals
        self._vertical = mean / np.linalg.norm(mean)

    def _empty_maps(self) -> list[Any]:
        """Return a map without scans, from the coarsest voxels to the finest."""
        return [self._gicp.GaussianVoxelMap(side) for side in self._sides]

    def _insert(self, cloud: Any, T_odom_base: Float) -> None:  # noqa: ANN401
        """Add a cloud at a pose to the map."""
        for voxels in self._maps:
            voxels.insert(cloud, T_odom_base)

    def _aligned(self, cloud: Any, guess: Float) -> tuple[Float, float]:  # noqa: ANN401
        """Return T_odom_base of a cloud by registration to the map, from the coarsest voxels to the finest,
        and the share of its points that lie in one of the coarsest."""
        T, partners = guess, list[int]()
        for voxels in self._maps:
            result = self._gicp.align(
                voxels, cloud, T, max_correspondence_distance=CORRESPONDENCE, num_threads=1,
                max_iterations=ITERATIONS,
            )  # fmt: skip
            T = result.T_target_source
            partners.append(result.num_inliers)
        return T, partners[0] / max(cloud.size(), 1)

    def _covariance(self, cloud: Any, T_odom_base: Float, largest: Float) -> tuple[Float, float]:  # noqa: ANN401
        """Return the covariance of the registration of a cloud to the finest map, and how far its surfaces
        disagree; see `registration_covariance`."""
        voxels = self._maps[-1]
        points, normals = (np.asarray(rows)[:, :3] for rows in (cloud.points(), cloud.normals()))
        means = np.asarray(voxels.voxel_points())[:, :3]
        R, placed = T_odom_base[:3, :3], points @ T_odom_base[:3, :3].T + T_odom_base[:3, 3]
        row = rows_of_cells(np.floor(means / self._sides[-1]), np.floor(placed / self._sides[-1]))
        found = row >= 0
        row, placed, across = row[found], placed[found], normals[found] @ R.T
        residual = np.einsum("ni,ni->n", across, placed - means[row])
        column = np.unique(np.floor(placed[:, :2] / VOXEL), axis=0, return_inverse=True)[1].ravel()
        return registration_covariance(points[found], normals[found], residual, column, largest)

    def _clouds(self, points: Float, ground: Bool) -> tuple[Any, Any]:
        """Return the cloud to register, with covariances: points above the ground, and those of the ground
        whose normal is vertical; and the cloud of the points above the ground alone."""
        gicp = self._gicp
        above = self._with_normals(points[~ground])
        rows = [np.asarray(above.points()).reshape(-1, 4)]
        if ground.any():
            below = gicp.preprocess_points(points[ground], 2.0 * CELL, NEIGHBOURS, 1)[0]
            flat = np.abs(np.asarray(below.normals()).reshape(-1, 4)[:, 2]) > UPRIGHT
            rows.append(np.asarray(below.points()).reshape(-1, 4)[flat])
        cloud = gicp.PointCloud(np.vstack(rows)[:, :3])
        if not cloud.size():
            return cloud, above
        gicp.estimate_normals_covariances(cloud, gicp.KdTree(cloud), NEIGHBOURS, 1)
        return cloud, above

    def _with_normals(self, points: Float) -> Any:  # noqa: ANN401
        """Return the cloud of one point in each cell of CELL whose neighbours do not lie on a line (LINE),
        with covariances. `points` has the shape (N, 3) [m]."""
        gicp = self._gicp
        if len(points) < NEIGHBOURS:
            return gicp.PointCloud(np.zeros((0, 3)))
        cloud, tree, *_ = gicp.preprocess_points(points, CELL, NEIGHBOURS, 1)
        if cloud.size() < NEIGHBOURS:
            return cloud
        at = np.asarray(cloud.points())[:, :3]
        near = at[np.asarray(tree.batch_knn_search(at, NEIGHBOURS)[0], np.int64)]
        away = near - near.mean(axis=1, keepdims=True)
        variance = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", away, away))
        cloud = gicp.PointCloud(at[variance[:, 1] > LINE**2 * variance[:, 2]])
        gicp.estimate_normals_covariances(cloud, gicp.KdTree(cloud), NEIGHBOURS, 1)
        return cloud

    def _expected_step(self, span_ns: int) -> Float:
        """Return the predicted step since the last scan, shape (4, 4): by the wheels if their readings at the
        two scans are less than 2 `span_ns` + STALE_NS apart, else with the velocity of the last step, or no
        motion after a pause (PAUSE_NS). `span_ns` is the time since the last scan [ns]."""
        now, before = self._wheels, self._wheels_before
        if (
            now is not None
            and before is not None
            and 0 < now.stamp_ns - before.stamp_ns < 2 * span_ns + STALE_NS
        ):
            step = before.T_odom_base.inverse() @ now.T_odom_base
            delta = np.eye(4)
            delta[:3, :3], delta[:3, 3] = step.R, step.t
            if np.isfinite(delta).all():
                return delta
        if span_ns > PAUSE_NS or not self._step_ns:
            return np.eye(4)
        return scaled(self._step, span_ns / self._step_ns)


def voxel_sides(sensor: Sensor | None) -> list[float]:
    """Return the sides of the voxels of the map [m], from VOXEL, each half of the one before; see BEAMS.

    Scans of dense beams need the finer ones: in voxels of 1 m, trunks and undergrowth are one distribution,
    and a narrow view turns too little.
    """
    if sensor is None:
        return [VOXEL]
    least = max(BEAMS * BEAMS_AT * max(sensor.ring_step, sensor.azimuth_step), FINEST)
    return [VOXEL / 2**k for k in range(1 + max(int(math.log2(VOXEL / least)), 0))]


def rows_of_cells(cells: Float, wanted: Float) -> Int:
    """Return the row in `cells`, different rows of whole numbers, shape (M, 3), of each wanted row, shape (N,
    3); -1 for one that is not there. int64, shape (N,)."""
    both = np.concatenate([cells, wanted]).astype(np.int64)
    both -= both.min(axis=0, initial=0)
    key = np.ravel_multi_index(tuple(both.T), tuple(both.max(axis=0, initial=0) + 1))
    if not len(cells):
        return np.full(len(wanted), -1)
    order = np.argsort(key[: len(cells)])
    row = order[np.minimum(np.searchsorted(key[order], key[len(cells) :]), len(cells) - 1)]
    return np.where(key[row] == key[len(cells) :], row, -1)


def _height_above_terrain(points: Float32) -> Float32:
    """Return the height of points above the ground of their scan, shape (N,) [m]; see `LidarOdometry`."""
    return height_above(points, find_terrain(points, Ground()))


def vertical_of(points: Float) -> Float | None:
    """Return the vertical by the bark of a scan: the direction in which the normals of its points vary
    least, a unit vector, shape (3,), upwards. None if fewer than FEWEST points have normals, or less than
    BARK_SHARE of them are level.

    Normals that are not level are left out in turns with the estimation.

    Args:
        points: Points above the ground, in a frame whose z axis is within 30 degrees of the vertical, shape
            (N, 3) [m].
    """
    import small_gicp

    if len(points) < FEWEST:
        return None
    normals = np.asarray(small_gicp.preprocess_points(points, FINE, NEIGHBOURS, 1)[0].normals())[:, :3]
    up, level = np.array([0.0, 0.0, 1.0]), np.zeros(len(normals), np.bool_)
    for largest in LEVEL:
        level = np.abs(normals @ up) < largest
        up = np.linalg.eigh(normals[level].T @ normals[level])[1][:, 0]
        up *= np.sign(up[2])
    if np.count_nonzero(level) < max(BARK_SHARE * len(normals), FEWEST):
        return None
    return up


def levelling(vertical: Float) -> Float:
    """Return the smallest rotation that turns a vertical, shape (3,), upwards, to the z axis, shape (3,
    3)."""
    x, y, z = vertical.tolist()
    share = 1.0 / (1.0 + z)
    return np.array(
        [[1.0 - share * x * x, -share * x * y, -x], [-share * x * y, 1.0 - share * y * y, -y], [x, y, z]]
    )


def _is_possible(step: Float, span_ns: int) -> bool:
    """Return whether a robot can move by a step, shape (4, 4), in a time above 0 [ns]; False for NaN."""
    angle = math.acos(min(max(0.5 * (float(np.trace(step[:3, :3])) - 1.0), -1.0), 1.0))
    span_s = span_ns * 1e-9
    return bool(np.linalg.norm(step[:3, 3]) < FASTEST * span_s) and angle < FASTEST_TURN * span_s


def _planar_of(T: Float, planar: Float) -> Float:
    """Return a pose with height, roll and pitch of the first pose and x, y and yaw of the second one, shape
    (4, 4)."""
    roll, pitch, _ = Pose3(T[:3, :3], T[:3, 3]).euler()
    yaw = Pose3(planar[:3, :3], planar[:3, 3]).euler()[2]
    both = Pose3.from_euler(np.array([planar[0, 3], planar[1, 3], T[2, 3]]), roll, pitch, yaw)
    combined = np.eye(4)
    combined[:3, :3], combined[:3, 3] = both.R, both.t
    return combined


def fused(whole: Float, above: Float, covariance: Float, *, is_shown: bool) -> tuple[Float, Float | None]:
    """Return the mean of two poses that differ in x, y and yaw, weighted by their inverse covariances, and
    None.

    If they contradict each other (CONTRADICTED), one of them is returned: the second one and None if it shows
    the motion, because the rings on the ground, which move with the sensor, then pull the first one. Those of
    a tilted LiDAR are no circles around it and pull its yaw, too. Else the first one, and their difference
    x, y [m], yaw [rad] in its frame, shape (3,).

    Args:
        whole: Pose by the whole cloud, with the covariance WHOLE, shape (4, 4).
        above: Pose by the points above the ground, shape (4, 4).
        covariance: Its covariance, shape (3, 3), of x, y [m], yaw [rad] in the frame of `whole`.
        is_shown: Whether the points above the ground show the motion (SHOWN), and their surfaces one motion.
    """
    apart = np.linalg.inv(whole) @ above
    d = np.array([apart[0, 3], apart[1, 3], np.arctan2(apart[1, 0], apart[0, 0])])
    weighted = np.linalg.solve(WHOLE + covariance, d)
    if float(d @ weighted) > CONTRADICTED:
        return (above, None) if is_shown else (whole, d)
    x, y, yaw = (WHOLE @ weighted).tolist()
    share = Pose3.from_euler(np.array([x, y, 0.0]), 0.0, 0.0, yaw)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = share.R, share.t
    return _planar_of(whole, whole @ T), None


def scaled(step: Float, share: float) -> Float:
    """Return a share of a motion with constant velocity: the angle of the rotation and the translation are
    multiplied. `step` and the result have the shape (4, 4)."""
    axis, angle = _axis_angle(step[:3, :3])
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    out = np.eye(4)
    out[:3, :3] += math.sin(share * angle) * K + (1.0 - math.cos(share * angle)) * K @ K
    out[:3, 3] = share * step[:3, 3]
    return out


def _axis_angle(R: Float) -> tuple[Float, float]:
    """Return the axis, a unit vector, shape (3,), and the angle [rad] of a rotation by less than pi, shape
    (3, 3); zeros for none."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.zeros(3), 0.0
    return axis / sine, math.atan2(sine, 0.5 * (float(np.trace(R)) - 1.0))


def undistorted(points: Float, offset_s: Float | None, step: Float, span_ns: int) -> Float:
    """Return the points in the base frame at the reference time, shape (N, 3) [m], with constant velocity:
    p' = exp(w t) p + v t, where the velocity v is that of the straight line.

    Args:
        points: Points in the base frame at their own times, shape (N, 3) [m].
        offset_s: Time of each point after the reference time [s], shape (N,); None returns the points
            unchanged (the same array).
        step: Motion of the base in `span_ns`, shape (4, 4).
        span_ns: Duration of the motion, above 0 [ns].
    """
    if offset_s is None:
        return points
    share = offset_s[:, None] / (span_ns * 1e-9)
    axis, turn = _axis_angle(step[:3, :3])
    angle = share * turn
    turned = (
        np.cos(angle) * points
        + np.sin(angle) * np.cross(axis, points)
        + (1.0 - np.cos(angle)) * (points @ axis)[:, None] * axis
    )
    moved: Float = turned + share * step[:3, 3]
    return moved
