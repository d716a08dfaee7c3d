"""LiDAR odometry: what registration assumes, the vertical by bark, and failures that are told."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from pipeline.geometry.poses import Float, Pose2, Pose3, wrap_angle
from pipeline.io.readers import open_source
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.odometry.lidar_odometry import (
    CONTRADICTED,
    FINEST,
    LOST,
    VOXEL,
    WHOLE,
    LidarOdometry,
    fused,
    levelling,
    scaled,
    undistorted,
    vertical_of,
    voxel_sides,
)
from pipeline.slam.motion import compound
from pipeline.types.records import Float32, Notice, Odometry, Record, Scan, Sensor, TruthPath
from tests.benchmarks.lidar_drives import lidar_drive

PERIOD_NS = 100_000_000
angles = st.floats(-0.4, 0.4)


def stand() -> SimulatedSource:
    source = open_source("sim:stand?duration=6&seed=3")
    assert isinstance(source, SimulatedSource)
    return source


def told(scans: Iterator[Scan], source: SimulatedSource) -> list[Record]:
    motion = LidarOdometry(source.description.T_base_lidar)
    return [record for scan in scans for record in motion.add(scan)]


def test_a_robot_that_stands_is_not_moved_by_the_times_of_its_points():
    """De-skewed to the start of the sweep, the same scans drifted by 12.7 m in 6 s."""
    source = stand()
    views = [source.run.sweep(k).scan for k in range(3)]  # at rest, with other noise each
    scans = (replace(views[k % 3], stamp_ns=k * PERIOD_NS) for k in range(27))
    poses = [r.T_odom_base.t for r in told(scans, source) if isinstance(r, Odometry)]
    assert len(poses) == 27
    assert np.linalg.norm(np.array(poses)[:, :2] - poses[0][:2], axis=1).max() < 0.05


def test_the_pose_is_that_in_the_middle_of_the_sweep():
    source = stand()
    scan = source.run.sweep(0).scan
    (odometry, same) = told(iter([scan]), source)
    assert isinstance(odometry, Odometry)
    assert same is scan
    assert abs(odometry.stamp_ns - scan.stamp_ns - PERIOD_NS // 2) < PERIOD_NS // 100


def test_the_path_of_a_drive_is_right_without_wheels():
    source = stand()
    poses = list(told((r for r in source.records() if isinstance(r, Scan)), source))
    odometry = [r for r in poses if isinstance(r, Odometry)]
    path = source.truth().path
    assert path is not None
    stamps = [r.stamp_ns for r in odometry]
    x, y = (np.interp(stamps, path.stamp_ns, axis) for axis in (path.x, path.y))
    found = np.array([r.T_odom_base.t[:2] for r in odometry])
    assert np.hypot(found[:, 0] - x, found[:, 1] - y).max() < 0.1
    squares = list(step_squares(odometry, path, way=1.0))
    # 99 % of the sums of so many values of chi-square with 3 degrees of freedom, and a factor of 3 for a
    # model that knows one number for all stands.
    assert chi2.ppf(0.005, 3 * len(squares)) / 3.0 < sum(squares) < 3.0 * chi2.ppf(0.995, 3 * len(squares))


def step_squares(odometry: list[Odometry], path: TruthPath, way: float) -> Iterator[float]:
    """e^T C^-1 e of the motion over each stretch of at least `way` [m]."""
    yaw = np.unwrap(path.yaw)
    true = [
        Pose2(*(float(np.interp(r.stamp_ns, path.stamp_ns, axis)) for axis in (path.x, path.y, yaw)))
        for r in odometry
    ]
    begin, motion, spread = 0, np.zeros(3), np.zeros((3, 3))
    for k in range(1, len(odometry)):
        step = odometry[k - 1].T_odom_base.planar().inverse() @ odometry[k].T_odom_base.planar()
        noise = odometry[k].covariance
        assert noise is not None
        motion, spread = compound(motion, spread, step, noise)
        if np.hypot(*motion[:2]) >= way:
            error = motion - (true[begin].inverse() @ true[k]).as_array()
            error[2] = wrap_angle(error[2])
            yield float(error @ np.linalg.solve(spread, error))
            begin, motion, spread = k, np.zeros(3), np.zeros((3, 3))


def trunks(rng: np.random.Generator) -> Float:
    """Points on the visible halves of trunks around a sensor, in rings."""
    points = []
    for _ in range(12):
        x, y = rng.uniform(-12.0, 12.0, 2)
        if np.hypot(x, y) < 3.0:
            continue
        towards = np.arctan2(-y, -x)
        for z in np.arange(-0.5, 3.0, 0.15):
            a = towards + np.linspace(-1.2, 1.2, 14)
            ring = np.stack([x + 0.2 * np.cos(a), y + 0.2 * np.sin(a), np.full(14, z)], axis=1)
            points.append(ring + rng.normal(0.0, 0.005, ring.shape))
    return np.concatenate(points)


@given(roll=angles, pitch=angles)
def test_the_vertical_is_that_of_the_trunks(roll: float, pitch: float):
    R_level_base = Pose3.from_euler(np.zeros(3), roll, pitch, 0.0).R
    found = vertical_of(trunks(np.random.default_rng(5)) @ R_level_base)
    assert found is not None
    assert np.degrees(np.arccos(min(float(found @ R_level_base[2]), 1.0))) < 1.0


def test_leaves_have_no_vertical():
    rng = np.random.default_rng(1)
    assert vertical_of(rng.uniform(-4.0, 4.0, (4000, 3))) is None
    assert vertical_of(np.zeros((5, 3))) is None


@given(roll=angles, pitch=angles)
def test_levelling_is_the_smallest_rotation_that_raises_the_vertical(roll: float, pitch: float):
    vertical = Pose3.from_euler(np.zeros(3), roll, pitch, 0.0).R[2]
    R = levelling(vertical)
    np.testing.assert_allclose(R @ vertical, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    angle = np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))
    assert angle == pytest.approx(np.arccos(np.clip(vertical[2], -1.0, 1.0)), abs=1e-6)


def test_points_are_moved_to_the_reference_time():
    turned = Pose3.from_euler(np.array([1.0, 0.2, 0.0]), 0.0, 0.1, 0.6)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = turned.R, turned.t
    seen = np.array([[5.0, 2.0, 1.0], [5.0, 2.0, 1.0], [5.0, 2.0, 1.0]])
    found = undistorted(seen, np.array([0.1, 0.0, -0.1]), step, PERIOD_NS)
    np.testing.assert_allclose(found[0], turned.apply(seen[:1])[0], atol=1e-12)
    np.testing.assert_allclose(found[1], seen[1], atol=1e-12)
    assert undistorted(seen, None, step, PERIOD_NS) is seen


@given(turn=st.floats(-1.0, 1.0), pitch=angles, share=st.floats(0.0, 3.0))
def test_a_share_of_a_motion_has_its_velocity(turn: float, pitch: float, share: float):
    whole = Pose3.from_euler(np.array([0.5, 0.1, -0.2]), 0.0, pitch, turn)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = whole.R, whole.t
    part = scaled(step, share)
    points = np.array([[5.0, 2.0, 1.0], [-1.0, 3.0, 0.0]])
    at_part = np.full(2, share * PERIOD_NS * 1e-9)
    np.testing.assert_allclose(
        points @ part[:3, :3].T + part[:3, 3], undistorted(points, at_part, step, PERIOD_NS), atol=1e-9
    )
    np.testing.assert_allclose(scaled(step, 1.0), step, atol=1e-9)


@given(missing=st.integers(0, 8), turn=st.floats(-0.1, 0.1))
def test_the_velocity_lasts_over_missing_scans(missing: int, turn: float):
    whole = Pose3.from_euler(np.array([0.5, 0.0, 0.0]), 0.0, 0.0, turn)
    motion = LidarOdometry(Pose3.identity())
    motion._step[:3, :3], motion._step[:3, 3] = whole.R, whole.t
    motion._step_ns = PERIOD_NS
    guess = motion._expected_step((missing + 1) * PERIOD_NS)
    np.testing.assert_allclose(guess[:3, 3], (missing + 1) * whole.t, atol=1e-9)
    assert Pose3(guess[:3, :3], guess[:3, 3]).euler()[2] == pytest.approx((missing + 1) * turn, abs=1e-9)


@given(st.floats(0.0, 0.2), st.floats(0.0005, 0.2))
def test_voxels_are_halved_while_three_beams_hit_each(ring_step: float, azimuth_step: float):
    sides = voxel_sides(Sensor(ring_step=ring_step, azimuth_step=azimuth_step))
    assert sides[0] == VOXEL
    assert all(fine == coarse / 2 for coarse, fine in pairwise(sides))
    least = max(3 * 10 * max(ring_step, azimuth_step), FINEST)
    assert sides[-1] == VOXEL or least <= sides[-1]
    assert sides[-1] / 2 < least
    assert voxel_sides(None) == [VOXEL]


@pytest.mark.slow
def test_a_sensor_that_sees_a_part_of_the_stand_turns_with_the_robot():
    """In voxels of 1 m alone, the turn is 4.4 degrees too small after 12 s."""
    source = open_source("sim:stand?duration=12&seed=3&lidar=solid")
    assert isinstance(source, SimulatedSource)
    motion = LidarOdometry(source.description.T_base_lidar, source.description.sensor)
    found = [
        r for s in source.records() if isinstance(s, Scan) for r in motion.add(s) if isinstance(r, Odometry)
    ]
    path = source.truth().path
    assert path is not None
    turned = [r.T_odom_base.planar().yaw for r in (found[0], found[-1])]
    true = np.interp([found[0].stamp_ns, found[-1].stamp_ns], path.stamp_ns, np.unwrap(path.yaw))
    assert abs(wrap_angle(np.diff(turned) - np.diff(true))[0]) < np.radians(1.0)


@pytest.mark.slow
def test_a_view_that_leaves_the_stand_does_not_end_in_a_false_minimum():
    """In the bend, a view of 70 degrees has some hundred points above the ground. Registered alone, they
    displaced the path by 0.74 m."""
    source = lidar_drive("stand", 10, 2.0, 40.0, one_way=True)
    motion = LidarOdometry(source.description.T_base_lidar, source.description.sensor)
    scans = (source.run.sweep(k).scan for k in range(185, 222))
    found = [r for scan in scans for r in motion.add(scan) if isinstance(r, Odometry)]
    path = source.truth().path
    assert path is not None
    axes = (path.x, path.y, np.unwrap(path.yaw))
    true = [Pose2(*(float(np.interp(r.stamp_ns, path.stamp_ns, axis)) for axis in axes)) for r in found]
    T_true_found = true[0] @ found[0].T_odom_base.planar().inverse()
    placed = [T_true_found @ r.T_odom_base.planar() for r in found]
    assert max(np.hypot(a.x - b.x, a.y - b.y) for a, b in zip(placed, true, strict=True)) < 0.3


def test_a_scan_whose_middle_is_not_later_than_that_before_has_no_pose():
    """The first scan has no times of points; those of the second one place its middle at the first stamp."""
    source = stand()
    first, second, third = (source.run.sweep(k).scan for k in range(3))
    first = replace(first, offset_ns=None)
    middle_ns = first.stamp_ns - second.stamp_ns
    for shift_ns in (0, -1_000_000):
        at_ns = np.linspace(2 * (middle_ns + shift_ns), 0, len(second.points)).astype(np.int32)
        motion = LidarOdometry(source.description.T_base_lidar)
        scans = (first, replace(second, offset_ns=at_ns), third)
        odometry = [r for scan in scans for r in motion.add(scan) if isinstance(r, Odometry)]
        assert len(odometry) == 2
        assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(odometry))
        assert motion.losses == {"poses of scans whose sweep is not later than that of the scan before": 1}


def test_points_of_a_single_ring_have_no_normal_and_are_left_out():
    rng = np.random.default_rng(4)
    angle = np.arange(0.0, 6.0, 0.01)
    ring = np.stack([9.0 * np.cos(angle), 9.0 * np.sin(angle), np.full(len(angle), 4.0)], axis=1)
    wall = np.stack([np.full(900, 6.0), rng.uniform(-3.0, 3.0, 900), rng.uniform(0.5, 3.0, 900)], axis=1)
    odometry = LidarOdometry(Pose3.identity())
    points = np.concatenate([ring + rng.normal(0.0, 0.003, ring.shape), wall])
    cloud, above = odometry._clouds(points, np.zeros(len(points), np.bool_))
    for found in (np.asarray(cloud.points()), np.asarray(above.points())):
        assert len(found) > 100
        np.testing.assert_allclose(found[:, 0], 6.0, atol=1e-9)


def test_scans_of_another_place_are_told_as_lost():
    """After 1.2 s the scans are those of another stand, each turned and stretched otherwise."""
    here, there = stand(), open_source("sim:dense?duration=6&seed=4")
    assert isinstance(there, SimulatedSource)
    scans = [here.run.sweep(k).scan for k in range(12)]
    for k in range(12, 30):
        other = there.run.sweep(k - 12).scan
        turn = Pose3.from_euler(np.zeros(3), 0.0, 0.0, 2.4 * k)
        points = turn.apply(other.points.astype(np.float64)) * [1.0 + 0.1 * (k % 5), 1.0, 1.0]
        stamp_ns = scans[0].stamp_ns + k * PERIOD_NS
        scans.append(replace(other, points=points.astype(np.float32), stamp_ns=stamp_ns))
    motion = LidarOdometry(here.description.T_base_lidar)
    records = [record for scan in scans for record in motion.add(scan)]
    notices = [r.text for r in records if isinstance(r, Notice)]
    assert len(notices) == 1
    assert notices[0].startswith("LiDAR odometry is lost since 1.1 s")
    assert motion.losses["poses of scans that LiDAR odometry could not place"] >= 6


def test_an_open_field_shows_no_motion_and_is_told():
    """The rings of the ground move with the sensor, so each scan fits to the one before."""
    rng = np.random.default_rng(7)
    angle, reach = np.meshgrid(
        np.arange(0.0, 6.28, 0.02), 0.8 / np.tan(np.radians(np.arange(3.0, 16.0, 2.0)))
    )
    ground = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.full(angle.shape, -0.8)], axis=-1)
    motion = LidarOdometry(Pose3.identity())
    records = list[Record]()
    for k in range(8):
        points = ground.reshape(-1, 3) + rng.normal(0.0, 0.01, (angle.size, 3))
        records += motion.add(Scan((k + 1) * PERIOD_NS, points.astype(np.float32)))
    notices = [r.text for r in records if isinstance(r, Notice)]
    assert len(notices) == 1
    assert notices[0].startswith(LOST)
    assert motion.losses == {"poses of scans that LiDAR odometry could not place": 7}
    sigma = [
        np.sqrt(np.diag(r.covariance))
        for r in records[2:]
        if isinstance(r, Odometry) and r.covariance is not None
    ]
    np.testing.assert_allclose(np.linalg.norm(sigma, axis=0)[:2], 0.35, rtol=0.01)  # 0.5 m/s for 0.7 s


def grass(rng: np.random.Generator, lidar: float, height: float, depth: float) -> Float:
    """Points of a VLP-16 at a height above the ground in grass [m], whose blades end the rays after `depth`
    in the mean [m]."""
    down, azimuth = np.meshgrid(np.radians(np.arange(1.0, 16.0, 2.0)), np.arange(-np.pi, np.pi, 0.007))
    within = rng.exponential(depth, down.shape)
    reach = np.minimum((lidar - min(height, lidar)) / np.sin(down) + within, lidar / np.sin(down))
    level = reach * np.cos(down)
    points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -reach * np.sin(down)], axis=-1)
    near: Float = points[reach < 40.0] + rng.normal(0.0, 0.02, (np.count_nonzero(reach < 40.0), 3))
    return near


@pytest.mark.parametrize(("lidar", "height", "depth"), [(0.8, 0.6, 1.0), (1.0, 1.2, 1.0)])
def test_grass_without_trees_shows_no_motion_and_is_told(lidar: float, height: float, depth: float):
    """Other blades return the rays of each scan, so each scan fits to those before."""
    rng = np.random.default_rng(3)
    motion = LidarOdometry(Pose3.identity())
    scans = [
        Scan((k + 1) * PERIOD_NS, grass(rng, lidar, height, depth).astype(np.float32)) for k in range(28)
    ]
    notices = [r.text for scan in scans for r in motion.add(scan) if isinstance(r, Notice)]
    assert len(notices) == 1
    assert notices[0].startswith(f"{LOST} since 0.")


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.05, 0.05), st.floats(0.001, 10.0))
def test_registrations_of_a_scan_are_weighted_and_the_whole_cloud_is_kept_where_they_contradict(
    x: float, y: float, yaw: float, scale: float
):
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = Pose3.from_euler(np.zeros(3), 0.1, -0.2, 0.7).R, (1.0, 2.0, 3.0)
    above = whole.copy()
    turn = Pose3.from_euler(np.zeros(3), 0.0, 0.0, yaw)
    above[:3, :3], above[:2, 3] = turn.R @ whole[:3, :3], whole[:2, 3] + (x, y)
    found, difference = fused(whole, above, scale * WHOLE, is_shown=False)
    d = np.linalg.inv(whole) @ above
    apart = np.array([d[0, 3], d[1, 3], np.arctan2(d[1, 0], d[0, 0])])
    contradicted = apart @ np.linalg.solve((1.0 + scale) * WHOLE, apart) > CONTRADICTED
    assert (difference is not None) == contradicted
    if difference is not None:  # then it is not known which of the two is right
        np.testing.assert_allclose(difference, apart)
    share = 0.0 if contradicted else 1.0 / (1.0 + scale)
    np.testing.assert_allclose(found[:2, 3], whole[:2, 3] + share * np.array([x, y]), atol=0.03)
    np.testing.assert_allclose(found[2], whole[2], atol=1e-9)  # height and tilt are those of the whole cloud
    turned = Pose3(found[:3, :3], found[:3, 3]).euler()[2] - 0.7
    assert abs(turned - share * yaw) < 0.005
    shown, difference = fused(whole, above, scale * WHOLE, is_shown=True)
    assert difference is None
    np.testing.assert_array_equal(shown, above if contradicted else found)


def test_the_rings_of_a_tilted_lidar_on_flat_ground_do_not_turn_the_path():
    """They move with the sensor, and those of a tilted one are no circles: among few stems, a registration
    with them lost 0.4 of 0.45 rad."""
    rng = np.random.default_rng(3)
    stems = np.column_stack([rng.uniform(-12.0, 16.0, 15), rng.uniform(-14.0, 14.0, 15)])
    stems = stems[np.abs(stems[:, 1]) > 2.0]
    T_base_lidar = Pose3.from_euler(np.array([0.0, 0.0, 1.2]), 0.0, math.radians(15.0), math.pi)
    motion = LidarOdometry(T_base_lidar)
    error = list[float]()
    for k in range(45):
        t = 0.1 * k
        yaw = 0.45 * math.sin(0.55 * t) ** 2
        T_world_base = Pose3.from_euler(np.array([t, 0.3 * math.sin(t), 0.0]), 0.0, 0.0, yaw)
        points = _flat_stand(T_world_base @ T_base_lidar, stems, rng)
        for record in motion.add(Scan(k * PERIOD_NS, points)):
            if isinstance(record, Odometry):
                error.append(record.T_odom_base.planar().yaw - yaw)
    assert max(map(abs, error)) < 0.1


def _flat_stand(T_world_lidar: Pose3, stems: Float, rng: np.random.Generator) -> Float32:
    """Return a scan of 16 rings of stems of 0.3 m on level ground, shape (N, 3) [m], with noise of 1 cm."""
    turn, rise = np.meshgrid(np.arange(0.0, 2.0 * np.pi, 0.007), np.radians(np.arange(-15.0, 16.0, 2.0)))
    rays = np.column_stack([np.cos(rise.ravel()) * np.cos(turn.ravel()),
                            np.cos(rise.ravel()) * np.sin(turn.ravel()), np.sin(rise.ravel())])  # fmt: skip
    o, d = T_world_lidar.t, rays @ T_world_lidar.R.T
    with np.errstate(divide="ignore"):
        reach = np.where(d[:, 2] < 0.0, -o[2] / d[:, 2], np.inf)
    flat = np.hypot(d[:, 0], d[:, 1])
    for stem in stems - o[:2]:
        along = (d[:, :2] @ stem) / flat  # distance on the ground to the foot of the perpendicular
        gap2 = stem @ stem - along**2
        depth = (along - np.sqrt(np.maximum(0.15**2 - gap2, 0.0))) / flat
        height = o[2] + depth * d[:, 2]
        hit = (gap2 < 0.15**2) & (along > 0.0) & (height > 0.0) & (height < 8.0)
        reach = np.where(hit, np.minimum(reach, depth), reach)
    seen = reach < 60.0
    noisy = reach[seen] + rng.normal(0.0, 0.01, np.count_nonzero(seen))
    points: Float32 = (noisy[:, None] * rays[seen]).astype(np.float32)
    return points


def test_a_place_after_a_gap_is_told_and_the_map_begins_anew():
    """Scans of 3 s are missing while the robot drives: the next ones do not fit, then they fit again."""
    source = open_source("sim:stand?duration=14&seed=3")
    assert isinstance(source, SimulatedSource)
    there = open_source("sim:dense?duration=6&seed=4")
    assert isinstance(there, SimulatedSource)
    scans = [source.run.sweep(k).scan for k in range(4)]
    later = [there.run.sweep(k).scan for k in range(14)]
    scans += [replace(s, stamp_ns=scans[0].stamp_ns + (34 + k) * PERIOD_NS) for k, s in enumerate(later)]
    motion = LidarOdometry(source.description.T_base_lidar)
    notices = [r.text for scan in scans for r in motion.add(scan) if isinstance(r, Notice)]
    assert len(notices) == 1
    assert notices[0].startswith(f"{LOST} since 0.3 s")
    assert motion.losses == {"poses of scans that LiDAR odometry could not place": 1}
