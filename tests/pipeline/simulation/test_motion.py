"""The drive, the tilt on the terrain, the wheels and the inertial unit."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.motion_sensors import GRAVITY, inertial_readings, wheel_odometry
from pipeline.simulation.robot_motion import (
    RATE_HZ,
    Course,
    drive_course,
    lap_time,
    lay_course,
    lay_on_terrain,
    rotations,
)
from pipeline.simulation.scenarios import QUALITIES, SCENARIOS, Scenario
from pipeline.simulation.terrain import Terrain
from pipeline.types.records import Float

FLAT = Terrain(np.zeros((1, 4)))


def course_of(name: str) -> tuple[Course, Scenario]:
    plan = SCENARIOS[name]
    return lay_course(np.array(plan.waypoints), plan.closed), plan


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_course_begins_at_the_origin_along_x(name):
    course, _ = course_of(name)
    assert (course.x[0], course.y[0], course.yaw[0]) == (0.0, 0.0, 0.0)
    heading = np.arctan2(np.diff(course.y), np.diff(course.x))
    middle = 0.5 * (course.yaw[1:] + course.yaw[:-1])
    assert np.abs((heading - middle + np.pi) % (2.0 * np.pi) - np.pi).max() < 0.01
    turned = np.sum(0.5 * (course.curvature[1:] + course.curvature[:-1]) * np.diff(course.s))
    assert turned == pytest.approx(course.yaw[-1], abs=0.01)


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_drive_keeps_its_limits(name):
    course, plan = course_of(name)
    drive = drive_course(course, plan.speed, plan.duration_s)
    assert drive.t[-1] >= plan.duration_s
    assert drive.speed[0] == 0.0
    assert drive.speed.max() <= plan.speed + 1e-9
    assert np.abs(drive.yaw_rate).max() <= 0.5
    assert np.abs(np.diff(drive.speed)).max() * RATE_HZ < 0.8
    moved = np.hypot(np.diff(drive.x), np.diff(drive.y)).sum()
    assert moved == pytest.approx(np.sum(drive.speed) / RATE_HZ, rel=0.01)


def test_the_long_run_closes_its_loop_twice():
    course, plan = course_of("long")
    assert 120.0 <= course.s[-1] <= 150.0
    drive = drive_course(course, plan.speed, plan.duration_s)
    assert plan.duration_s == 600.0
    laps = drive.yaw[-1] / (2.0 * np.pi)
    assert laps > 2.2


def test_an_open_course_ends_standing_still():
    course, plan = course_of("paper")
    drive = drive_course(course, plan.speed, 60.0)
    assert drive.speed[-1] == 0.0
    assert drive.x[-1] == pytest.approx(course.x[-1], abs=0.02)


@pytest.mark.parametrize("name", ["stand", "slope", "long"])
def test_a_lap_takes_the_robot_back_to_where_it_began(name):
    course, plan = course_of(name)
    lap = lap_time(course, plan.speed)
    drive = drive_course(course, plan.speed, lap)
    at = np.searchsorted(drive.t, lap)
    assert np.hypot(drive.x[at], drive.y[at]) < 0.02
    assert drive.yaw[at] == pytest.approx(course.yaw[-1], abs=0.01)


def test_the_base_stands_upright_to_the_ground():
    rng = np.random.default_rng(0)
    terrain = Terrain.grow(0.2, 0.3, 9.0, rng)
    course, _ = course_of("slope")
    motion = lay_on_terrain(drive_course(course, 0.8, 60.0), terrain, rng)
    d = motion.drive
    z, gx, gy = terrain.evaluate(d.x, d.y).T
    normal = np.stack([-gx, -gy, np.ones_like(gx)], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    up = rotations(motion.roll, motion.pitch, d.yaw)[:, :, 2]
    angle = np.degrees(np.arccos(np.clip(np.sum(up * normal, axis=1), -1.0, 1.0)))
    assert angle.max() < 0.8  # vibration
    assert angle[0] < 1e-5  # none when it stands
    np.testing.assert_array_equal(motion.z, z)
    assert np.degrees(np.abs(motion.pitch)).max() > 8.0
    # Uphill the nose points up, which is a negative pitch.
    climbing = np.gradient(z) > 1e-3
    assert np.all(motion.pitch[climbing] < 0.0)


def test_rotations_are_those_of_the_geometry():
    rng = np.random.default_rng(1)
    angles = rng.uniform(-1.0, 1.0, (20, 3))
    for (roll, pitch, yaw), R in zip(angles, rotations(*angles.T), strict=True):
        np.testing.assert_allclose(R, Pose3.from_euler(np.zeros(3), roll, pitch, yaw).R, atol=1e-15)


def odometry_errors(quality: str, seeds: int) -> Float:
    """Distance from the truth at 50 Hz over the long run, a row a seed."""
    run = open_simulated(f"sim:long?odometry={quality}").run
    d = run.motion.drive
    step = RATE_HZ // 50
    errors = []
    for seed in range(seeds):
        told = wheel_odometry(run.motion, QUALITIES[quality], np.random.default_rng(seed))
        errors.append(np.hypot(told[:, 0] - d.x[::step], told[:, 1] - d.y[::step]))
    return np.array(errors)


def test_poor_wheels_are_nine_metres_off_on_the_long_run():
    rms = np.sqrt(np.mean(odometry_errors("poor", 40) ** 2, axis=1))
    assert rms.min() >= 9.0
    run = open_simulated("sim:long?odometry=poor&seed=7").run
    d = run.motion.drive
    error = run.odometry[:, :2] - np.stack([d.x, d.y], axis=1)[:: RATE_HZ // 50]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) >= 9.0


def test_better_wheels_drift_less_and_all_drift_more_with_the_way():
    median = {}
    for quality in QUALITIES:
        errors = odometry_errors(quality, 12)
        early = np.median(errors[:, : errors.shape[1] // 20].max(axis=1))
        median[quality] = np.median(errors.max(axis=1))
        assert early < 0.25 * median[quality]
    assert median["good"] < 0.5 * median["normal"] < 0.25 * median["poor"]


def test_exact_odometry_is_the_true_pose():
    run = open_simulated("sim:slope?odometry=exact").run
    for n in (0, 100, 777):
        pose = run.odometry_record(n).T_odom_base
        R, p = run.motion.at(np.array([n / 50.0]))
        np.testing.assert_array_equal(pose.t, p[0])
        np.testing.assert_array_equal(pose.R, R[0])
    assert np.abs(run.odometry_record(1000).T_odom_base.t[2]) > 0.1


def test_wheels_that_stand_tell_no_motion():
    course, _ = course_of("paper")
    rng = np.random.default_rng(4)
    motion = lay_on_terrain(drive_course(course, 0.8, 90.0), FLAT, rng)
    told = wheel_odometry(motion, QUALITIES["poor"], rng)
    np.testing.assert_array_equal(np.ptp(told[-500:], axis=0), 0.0)


def test_wheels_on_a_slope_measure_the_way_on_the_ground():
    course = lay_course(np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]]), closed=False)
    steep = Terrain(np.array([[np.tan(np.radians(20.0)), 0.0, 0.0, 0.0]]))
    rng = np.random.default_rng(0)
    motion = lay_on_terrain(drive_course(course, 0.8, 40.0), steep, rng)
    quality = QUALITIES["good"]
    told = wheel_odometry(motion, quality, rng)
    uphill = np.sin(np.radians(20.0))
    expected = 20.0 / np.cos(np.radians(20.0)) * (1.0 + quality.slip * uphill)
    assert told[-1, 0] == pytest.approx(expected, abs=0.15)
    assert told[-1, 0] > 20.5


def test_an_inertial_unit_at_rest_feels_gravity_along_its_own_up():
    course, _ = course_of("paper")
    slope = np.radians(12.0)
    terrain = Terrain(np.array([[np.tan(slope), 0.0, 0.0, 0.0]]))
    rng = np.random.default_rng(2)
    motion = lay_on_terrain(drive_course(course, 0.8, 90.0), terrain, rng)
    unit = inertial_readings(motion, rng)
    resting = unit.linear_acceleration[-1000:].mean(axis=0)
    # It looks uphill: the specific force has a part along the nose.
    heading = motion.drive.yaw[-1]
    ahead = np.arctan(np.tan(slope) * np.cos(heading))
    assert resting[0] == pytest.approx(GRAVITY * np.sin(ahead), abs=0.15)
    assert np.linalg.norm(resting) == pytest.approx(GRAVITY, abs=0.15)


def test_turn_rates_add_up_to_the_turn_and_the_attitude_to_the_tilt():
    run = open_simulated("sim:slope?seed=2").run
    unit, motion = run.inertial, run.motion
    step = RATE_HZ // 100
    roll, pitch, yaw = motion.roll[::step], motion.pitch[::step], motion.drive.yaw[::step]
    _, wy, wz = unit.angular_velocity.T
    turned = np.cumsum((np.sin(roll) * wy + np.cos(roll) * wz) / np.cos(pitch)) / 100.0
    assert np.abs(turned - yaw).max() < 0.25
    tilt_error = np.degrees(unit.attitude[:, :2] - np.stack([roll, pitch], axis=1))
    assert 0.02 < np.sqrt(np.mean(tilt_error**2)) < 0.8
    drift = unit.attitude[:, 2] - yaw
    assert drift[0] == pytest.approx(0.0, abs=1e-4)
    assert 1e-3 < np.abs(drift).max() < 0.3
    R = Pose3.from_quaternion(np.zeros(3), unit.orientation(500)).euler()
    np.testing.assert_allclose(R, unit.attitude[500], atol=1e-9)
