"""Gyroscope: integrals and biases in closed form, correction of the wheels' turns, and detection of slip."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.odometry.gyro import BIAS_UNKNOWN, MIRRORED, NOISE, SLIPPED, WANDERS, Gyro, fused
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing import acquire
from pipeline.slam.motion import Motion, accumulated
from pipeline.types.records import Imu, Odometry, Scan, Sensor, Step, Turn
from tests.pipeline.strategies import scan, seeds

MS = 1_000_000
START = 1_700_000_000_000_000_000
FOREST = preset("forest")


def reading(ms, rate, tilt=(0.0, 0.0)):
    """What a base that is tilted so measures of a turn about the vertical."""
    R = Pose3.from_euler(np.zeros(3), tilt[0], tilt[1], 0.0).R
    q = Pose3.from_euler(np.zeros(3), tilt[0], tilt[1], 0.7).quaternion()
    return Imu(START + round(ms * MS), R.T @ np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, 9.81]), q)


def shaken(ms, rate):
    """The same with the last digits that a real one has."""
    return reading(ms, rate + 1e-9 * (ms % 7))


def gyro_of(rate_at, until_ms, *, standing=False, tilt=(0.0, 0.0)):
    gyro = Gyro()
    for ms in range(0, until_ms, 10):
        record = reading(ms, rate_at(ms * 1e-3) + 1e-9 * (ms % 70), tilt)
        gyro.add(record, tilt, standing=standing, needed_ns=START)
    return gyro


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.integers(5, 180), st.integers(50, 200))
def test_a_turn_is_the_integral_of_its_rate(a, b, first, span):
    gyro = gyro_of(lambda t: a + b * t, 500)
    turn = gyro.turn(START + first * MS, START + (first + span) * MS)
    assert turn is not None
    t0, t1 = first * 1e-3, (first + span) * 1e-3
    assert turn.angle == pytest.approx(a * (t1 - t0) + 0.5 * b * (t1**2 - t0**2), abs=1e-6)
    assert turn.sigma > 0.0


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-1.0, 1.0))
def test_only_the_turn_about_the_vertical_counts(roll, pitch, rate):
    measured = gyro_of(lambda _: rate, 200, tilt=(roll, pitch)).rate(START + 100 * MS)
    assert measured == pytest.approx(rate, abs=1e-6)


def test_a_bias_is_learnt_while_the_robot_stands_and_never_while_it_moves():
    moving, standing = gyro_of(lambda _: 0.02, 2000), gyro_of(lambda _: 0.02, 2000, standing=True)
    assert moving.rate(START + 1000 * MS) == pytest.approx(0.02, abs=1e-6)
    assert standing.rate(START + 1000 * MS) == pytest.approx(0.0, abs=1e-6)
    before, after = moving.turn(START, START + 100 * MS), standing.turn(START, START + 100 * MS)
    assert before is not None
    assert after is not None
    assert after.angle == pytest.approx(0.0, abs=1e-6)
    assert after.sigma < 0.1 * before.sigma


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("blocks", [1, 10])
def test_the_sigma_of_a_turn_knows_how_well_the_bias_was_learnt(blocks):
    z = []
    for seed in range(40):
        gyro, rates = Gyro(), 0.02 * np.random.default_rng(seed).standard_normal(50 * blocks + 400)
        for k, rate in enumerate(rates):
            gyro.add(reading(10 * k, rate), (0.0, 0.0), standing=k < 50 * blocks, needed_ns=START)
        first = START + 500 * blocks * MS
        turn = gyro.turn(first, first + 3900 * MS)
        assert turn is not None
        z.append(turn.angle / turn.sigma)
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize("steps", [1, 10, 50])
def test_the_scale_error_is_the_same_in_all_steps_of_a_turn(steps):
    """One percent of 90 degrees is 0.9 degrees, however many scans the turn takes."""
    gyro = gyro_of(lambda _: np.radians(90.0) / 5.0, 5100)
    times = [START + 5000 * MS * k // steps for k in range(steps + 1)]
    turns = [gyro.turn(*pair) for pair in pairwise(times)]
    others = NOISE**2 * 5.0 + steps * BIAS_UNKNOWN**2 * (5.0 / steps) * max(5.0 / steps, WANDERS)
    scale = np.sqrt(sum(turn.sigma**2 for turn in turns) - others)
    assert np.degrees(scale) == pytest.approx(0.9, rel=0.02)


def test_a_robot_that_is_turned_by_hand_teaches_no_bias():
    for rate_at in (lambda _: 0.5, lambda t: 0.09 * np.sign(np.sin(40 * t))):
        by_hand, driven = gyro_of(rate_at, 2000, standing=True), gyro_of(rate_at, 2000)
        assert by_hand.turn(START, START + 1000 * MS) == driven.turn(START, START + 1000 * MS)


def test_holes_and_dead_units_tell_nothing():
    gyro = gyro_of(lambda _: 0.1, 300)
    assert gyro.turn(START + 200 * MS, START + 500 * MS) is None
    assert gyro.turn(START + 200 * MS, START + 200 * MS) is None
    assert gyro.rate(START + 900 * MS) is None
    assert Gyro().turn(START, START + MS) is None
    dead = Gyro()
    for ms in range(0, 500, 10):
        dead.add(reading(ms, 0.0), (0.0, 0.0), standing=True, needed_ns=START)
    assert dead.turn(START, START + 100 * MS) is None
    assert dead.rate(START + 400 * MS) is None


# --- wheels and gyroscope -------------------------------------------------------------------------


@given(seeds, st.floats(1e-4, 0.1), st.floats(1e-4, 0.1))
def test_turns_that_agree_are_weighed_by_their_variances(seed, a, b):
    rng = np.random.default_rng(seed)
    step = Pose2(*rng.uniform(-0.3, 0.3, 3))
    turn = Turn(step.yaw + rng.uniform(-1, 1) * np.hypot(a, b), b)
    joined, sigma, slack, doubt = fused(step, a, (0.1, 0.0), turn)
    weights = np.array([a**-2, b**-2])
    assert joined.yaw == pytest.approx(weights @ [step.yaw, turn.angle] / weights.sum(), abs=1e-9)
    assert sigma == pytest.approx(weights.sum() ** -0.5)
    assert (slack, doubt) == ((0.1, 0.0), "")


@given(st.floats(-0.5, 0.5), st.floats(0.01, 0.5), st.floats(-0.3, 0.3))
def test_a_sure_gyroscope_puts_the_robot_on_its_true_arc(turn, way, wrong):
    def chord(angle):
        return Pose2(way * np.cos(angle / 2), way * np.sin(angle / 2), angle)

    joined, _, _, _ = fused(chord(turn + wrong), 10.0, (0.0, 0.0), Turn(turn, 1e-9))
    np.testing.assert_allclose(joined.as_array(), chord(turn).as_array(), atol=1e-9)


def test_wheels_that_contradict_the_gyroscope_are_said_to_slip():
    joined, sigma, slack, doubt = fused(Pose2(0.1, 0.0, 0.2), 0.003, (0.0, 0.0), Turn(0.0, 0.001))
    assert doubt == SLIPPED
    assert (joined.yaw, sigma) == (0.0, 0.001)
    np.testing.assert_allclose(slack, (0.1, 0.0))  # half a track of one metre times the angle


def test_the_gyroscope_closes_a_gap_of_the_odometry():
    joined, sigma, slack, doubt = fused(Pose2(), 0.0, (0.5, 0.2), Turn(0.3, 0.001))
    assert joined.yaw == pytest.approx(0.3, abs=1e-4)
    assert sigma == pytest.approx(0.001, rel=1e-3)
    assert (slack, doubt) == ((0.5, 0.0), "")


def test_a_known_turn_scatters_the_heading_by_its_own_sigma():
    step, p = Pose2(0.2, 0.0, 0.1), FOREST.slam
    moved = accumulated(np.zeros(3), np.zeros((3, 3)), np.zeros(2), Motion(step, turn_sigma=0.001), 1.0, p)
    assert moved is not None
    assert moved[1][2, 2] == pytest.approx(0.001**2)


# --- a run ----------------------------------------------------------------------------------------


def records_of_robot(wheel_turn, rate, *, bias=0.01):
    """Two seconds of standing and two of driving a circle of which the wheels tell another turn."""
    records = [shaken(ms, bias + (rate if ms > 2000 else 0.0)) for ms in range(0, 4000, 10)]
    for ms in range(0, 4001, 20):
        t = max(ms - 2000, 0) * 1e-3
        pose = Pose3.from_euler(np.array([0.5 * t, 0.0, 0.0]), 0.0, 0.0, wheel_turn * t)
        records.append(Odometry(START + ms * MS, pose))
    records += [scan(START + ms * MS) for ms in range(100, 3950, 100)]
    return sorted(records, key=lambda r: r.stamp_ns)


def run(wheel_turn, rate):
    return list(steps(records_of_robot(wheel_turn, rate)))


def headings(parameters, run_steps):
    mapper = Mapper(parameters, sensor=Sensor(), T_base_lidar=Pose3(np.eye(3), np.zeros(3)), seed=0)
    frames = [mapper.process(step) for step in run_steps]
    return np.array([f.estimate.T_map_base.yaw for f in frames]), frames


def test_the_heading_follows_the_gyroscope_where_the_wheels_err():
    driven = run(wheel_turn=0.32, rate=0.3)
    true = 0.3 * (3.9 - 2.0)
    assert abs(headings(FOREST, driven)[0][-1] - true) < 0.01
    off = FOREST.replace({"acquisition.gyro": False})
    assert abs(headings(off, driven)[0][-1] - true) > 0.025


def test_slipping_wheels_are_told():
    _, frames = headings(FOREST, run(wheel_turn=0.8, rate=0.3))
    assert any(f.estimate.health.reason == SLIPPED for f in frames)
    assert not any(f.estimate.health.reason == SLIPPED for f in frames[:19])


def test_a_robot_that_stands_does_not_turn_with_the_noise():
    yaw, _ = headings(FOREST, run(wheel_turn=0.3, rate=0.3))
    np.testing.assert_array_equal(yaw[:18], 0.0)


@pytest.mark.parametrize("seen", [-1.0, 0.0, 57.3], ids=["upside down", "on its side", "in degrees"])
def test_a_gyroscope_that_never_turned_as_the_wheels_is_not_asked(seen):
    driven = run(wheel_turn=0.3, rate=0.3 * seen)
    off = FOREST.replace({"acquisition.gyro": False})
    np.testing.assert_array_equal(headings(FOREST, driven)[0], headings(off, driven)[0])
    assert all(step.turn_rate is None for step in driven)


def mirror_warnings(lidar_turn, rate, *, up=9.81, by_lidar=True):
    """The warnings about a mirror image in 12 s on a circle with an IMU that measures the gravity `up`."""
    covariance = np.diag([1e-6, 1e-6, 1e-8]) if by_lidar else None
    records = [
        replace(shaken(ms, rate), linear_acceleration=np.array([0.1, 0.2, up]), orientation=None)
        for ms in range(0, 12000, 10)
    ]
    for ms in range(0, 12001, 100):
        t = ms * 1e-3
        pose = Pose3.from_euler(np.array([0.5 * t, 0.0, 0.0]), 0.0, 0.0, lidar_turn * t)
        records += [Odometry(START + ms * MS, pose, covariance), scan(START + ms * MS)]
    driven = steps(sorted(records, key=lambda r: r.stamp_ns))
    return {text for step in driven for text in step.warnings if MIRRORED in text}


@pytest.mark.parametrize(("lidar_turn", "rate"), [(0.3, -0.3), (-0.2, 0.19)])
def test_a_mirror_image_is_contradicted_by_gyroscope_and_gravity(lidar_turn, rate):
    assert len(mirror_warnings(lidar_turn, rate)) == 1
    assert len(mirror_warnings(lidar_turn, -rate, up=-9.81)) == 1


@pytest.mark.parametrize("up", [9.81, -9.81], ids=["upright", "upside down"])
@pytest.mark.parametrize("turn", [0.3, -0.3, 0.01])
def test_an_image_that_is_not_mirrored_is_not_called_so_in_any_attitude_of_the_unit(turn, up):
    assert mirror_warnings(turn, turn * np.sign(up), up=up) == set()


def test_without_gravity_or_with_wheels_nothing_shows_a_mirror_image():
    assert mirror_warnings(0.3, -0.3, up=0.0) == set()
    assert mirror_warnings(0.3, -0.3, by_lidar=False) == set()


def test_one_mad_reading_turns_no_robot():
    records = records_of_robot(0.3, 0.3)
    at = next(k for k, r in enumerate(records) if isinstance(r, Imu) and r.stamp_ns == START + 3000 * MS)
    records[at] = shaken(3000, 100.0)
    losses = Counter[str]()
    driven = list(steps(records, losses=losses))
    assert abs(headings(FOREST, driven)[0][-1] - 0.3 * 1.9) < 0.01
    assert list(losses.values()) == [1]


def test_a_unit_that_has_said_but_one_number_tells_nothing():
    gyro = Gyro()
    for ms in range(0, 100, 10):
        gyro.add(reading(ms, 0.0), (0.0, 0.0), standing=False, needed_ns=START)
    assert gyro.turn(START, START + 90 * MS) is None
    gyro.add(reading(100, 0.1), (0.0, 0.0), standing=False, needed_ns=START)
    assert gyro.turn(START, START + 100 * MS) is not None


@pytest.mark.parametrize("ahead_ms", [2_000, 86_400_000])
def test_a_reading_from_the_future_is_counted_and_silences_nobody(ahead_ms):
    records = records_of_robot(0.32, 0.3)
    k = next(i for i, r in enumerate(records) if isinstance(r, Imu) and r.stamp_ns > START + 2_000 * MS)
    wrong = replace(records[k], stamp_ns=records[k].stamp_ns + ahead_ms * MS)
    losses = Counter[str]()
    joined = list(steps([*records[:k], wrong, *records[k:]], losses=losses))
    assert losses == {"IMU readings that were ahead of their time": 1}
    whole = list(steps(records))
    later = [s.scan.stamp_ns > START + 2_300 * MS for s in whole]
    turns = [[s.turn for s, late in zip(run, later, strict=True) if late] for run in (joined, whole)]
    assert any(turn is not None for turn in turns[1])
    assert [t is None for t in turns[0]] == [t is None for t in turns[1]]


def test_an_imu_reading_that_comes_late_or_twice_is_counted():
    records = records_of_robot(0.32, 0.3)
    of_imu = [i for i, r in enumerate(records) if isinstance(r, Imu)]
    losses = Counter[str]()
    twice = [*records[: of_imu[60]], records[of_imu[40]], records[of_imu[59]], *records[of_imu[60] :]]
    found, wanted = list(steps(twice, losses=losses)), list(steps(records))
    assert losses == {"IMU readings that were not later than the one before": 2}
    assert [s.turn for s in found] == [s.turn for s in wanted]


def test_scans_are_deskewed_by_the_rate_of_the_gyroscope():
    points = np.array([[10.0, 0.0, 0.0]], np.float32)
    swept = Scan(START, points, offset_ns=np.array([50 * MS], np.int32))
    step = Step(0, swept, Pose2(), twist=(0.0, 0.0, 0.1), turn_rate=0.4)
    mounting = Pose3(np.eye(3), np.zeros(3))
    for p, rate in ((FOREST, 0.4), (FOREST.replace({"acquisition.gyro": False}), 0.1)):
        moved, _ = acquire(step, mounting, p.acquisition)
        assert float(np.arctan2(moved[0, 1], moved[0, 0])) == pytest.approx(rate * 0.05, abs=1e-6)
