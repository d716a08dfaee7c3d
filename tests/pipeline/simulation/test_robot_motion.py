"""Motion of the simulated robot: path, tilt on the terrain, wheels and inertial unit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.poses import Pose3, euler_rotation
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.robot_motion import (
    ACCELERATION,
    GRAVITY,
    RATE_HZ,
    YAW_GAIN,
    YAW_RATE,
    Course,
    Spin,
    drive_course,
    inertial_readings,
    lap_time,
    lay_course,
    lay_on_terrain,
    sharp_cells,
    wheel_odometry,
    within_gains,
)
from pipeline.simulation.scenarios import QUALITIES, SCENARIOS, Scenario
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Float

FLAT = SimulatedTerrain(np.zeros((1, 4)))


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
    terrain = SimulatedTerrain.grow(0.2, 0.3, 9.0, rng)
    course, _ = course_of("slope")
    motion = lay_on_terrain(drive_course(course, 0.8, 60.0), terrain, rng)
    d = motion.drive
    z, gx, gy = terrain.evaluate(d.x, d.y).T
    normal = np.stack([-gx, -gy, np.ones_like(gx)], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    up = euler_rotation(motion.roll, motion.pitch, d.yaw)[:, :, 2]
    angle = np.degrees(np.arccos(np.clip(np.sum(up * normal, axis=1), -1.0, 1.0)))
    assert angle.max() < 0.8  # vibration
    assert angle[0] < 1e-5  # none when it stands
    np.testing.assert_array_equal(motion.z, z)
    assert np.degrees(np.abs(motion.pitch)).max() > 8.0
    # Uphill the nose points up, which is a negative pitch.
    climbing = np.gradient(z) > 1e-3
    assert np.all(motion.pitch[climbing] < 0.0)


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
    steep = SimulatedTerrain(np.array([[np.tan(np.radians(20.0)), 0.0, 0.0, 0.0]]))
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
    terrain = SimulatedTerrain(np.array([[np.tan(slope), 0.0, 0.0, 0.0]]))
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


SPEED = 0.6
WAYS = {
    "a dead end": [(0, 0), (2, 0.3), (4, 0), (6, 0.2), (4, 0.1), (2, 0.2), (0, 2), (-2, 1)],
    "two dead ends": [(0, 0), (0, 3), (0.1, 0), (3, 0), (5, 0), (3, 0.1), (2, -2), (0, -2)],
    "a narrow bend": [(0, 0), (4, 0), (4.2, 0.2), (4, 0.4), (0, 0.4), (-1, 0.2)],
    "a dead end at the begin": [(0, 0), (2, 0.1), (4, 1), (4, 3), (2, 1), (1, 0.1)],
    "no dead end": [(0, 0), (3, -1), (6, 0), (6, 4), (3, 5), (0, 4)],
}


def laps(name, count=2.2):
    """A course, and a drive of some laps, over its seam."""
    course = lay_course(np.array(WAYS[name], np.float64), closed=True)
    return course, drive_course(course, SPEED, count * lap_time(course, SPEED))


@pytest.mark.parametrize("name", WAYS)
def test_neither_speed_nor_turn_rate_changes_suddenly(name):
    """At the rate of the samples, which is that of the wheels and of the inertial unit."""
    _, drive = laps(name)
    assert np.abs(np.diff(drive.speed)).max() * RATE_HZ <= 1.03 * ACCELERATION
    assert np.abs(np.diff(drive.yaw_rate)).max() * RATE_HZ <= 1.05 * YAW_GAIN
    assert np.abs(drive.yaw_rate).max() <= 1.01 * YAW_RATE
    assert drive.speed.min() >= 0.0
    assert 0.9 * SPEED < drive.speed.max() <= SPEED + 1e-9


@pytest.mark.parametrize("name", WAYS)
def test_speed_and_turn_rate_are_those_of_the_poses(name):
    course, drive = laps(name)
    told = np.cumsum(0.5 * (drive.yaw_rate[1:] + drive.yaw_rate[:-1])) / RATE_HZ
    assert np.abs(told - drive.yaw[1:]).max() < 0.06, "a gyroscope tells what the robot did"
    way = np.cumsum(0.5 * (drive.speed[1:] + drive.speed[:-1])) / RATE_HZ
    moved = np.cumsum(np.hypot(np.diff(drive.x), np.diff(drive.y)))
    assert np.abs(way - moved).max() < 0.01 * moved[-1]
    assert moved[-1] > 2.0 * course.s[-1]


@pytest.mark.parametrize("name", WAYS)
def test_the_robot_looks_where_it_goes_but_where_it_turns_on_the_spot(name):
    course, drive = laps(name)
    dx, dy = np.diff(drive.x), np.diff(drive.y)
    middle = 0.5 * (drive.yaw[1:] + drive.yaw[:-1])
    aside = np.abs(np.cos(middle) * dy - np.sin(middle) * dx)
    goes = drive.speed[1:] > 0.1  # m/s; on the spot it creeps at most
    assert (aside[goes] / np.hypot(dx, dy)[goes]).max() < 0.06
    assert aside[~goes].sum() < 0.1 * max(sharp_cells(course.s, course.yaw).sum(), 1)


@pytest.mark.parametrize("name", ["a dead end", "two dead ends"])
def test_where_its_way_goes_back_on_itself_the_robot_stops_and_turns(name):
    course, drive = laps(name, 1.0)
    assert sharp_cells(course.s, course.yaw).any()
    spins = np.abs(drive.yaw_rate) > 0.98 * YAW_RATE
    assert spins.any()
    assert drive.speed[spins].min() < 0.02


def test_a_way_without_sharp_turns_has_no_turns_on_the_spot():
    course, drive = laps("no dead end", 1.0)
    assert not sharp_cells(course.s, course.yaw).any()
    assert (drive.speed[drive.t > 2.0] > 0.2).all()


# In steps, because the square of a speed that is limited by a difference of 1e-300 overflows.
CURVATURE = st.floats(-8.0, 8.0).map(lambda k: round(k, 6))


@given(
    st.lists(st.tuples(st.floats(0.0, 2.0), CURVATURE), min_size=2, max_size=40),
    st.floats(0.01, 0.5),
)
def test_speeds_are_the_fastest_between_which_a_robot_can_change(samples, ds):
    """By going over all pairs again and again until none is too fast."""
    v, k = np.array(samples).T
    s = np.arange(v.size) * ds
    told = within_gains(v, s, k)
    slow = v.copy()
    for i in range(v.size - 1):
        bend = np.abs(k[i + 1] - k[i]) / ds
        if bend > 0.0:
            slow[i : i + 2] = np.minimum(slow[i : i + 2], np.sqrt(0.5 * YAW_GAIN / bend))
    for _ in range(v.size):
        for i in range(v.size - 1):
            sharpest = max(abs(k[i]), abs(k[i + 1]))
            gain = ACCELERATION if sharpest == 0.0 else min(ACCELERATION, 0.5 * YAW_GAIN / sharpest)
            slow[i + 1] = min(slow[i + 1], np.sqrt(slow[i] ** 2 + 2.0 * gain * ds))
            slow[i] = min(slow[i], np.sqrt(slow[i + 1] ** 2 + 2.0 * gain * ds))
    np.testing.assert_allclose(told, slow, atol=1e-6)


@given(st.floats(0.01, 0.3), st.floats(-7.0, 7.0))
def test_a_turn_on_the_spot_goes_from_rest_to_rest(way, turn):
    spin = Spin.over(0.0, way, 0.0, turn)
    t = np.linspace(0.0, spin.takes, 20001)
    part, pace = spin.at(t)
    assert (part[0], pace[0]) == (0.0, 0.0)
    assert part[-1] == pytest.approx(1.0)
    assert pace[-1] == pytest.approx(0.0, abs=1e-9)
    dt = t[1]
    np.testing.assert_allclose(np.diff(part) / dt, 0.5 * (pace[1:] + pace[:-1]), atol=1e-3 * pace.max())
    assert pace.max() * abs(turn) <= YAW_RATE * (1.0 + 1e-9)
    assert np.abs(np.diff(pace)).max() / dt * abs(turn) <= YAW_GAIN * (1.0 + 1e-6)
    assert np.abs(np.diff(pace)).max() / dt * way <= ACCELERATION * (1.0 + 1e-6)
