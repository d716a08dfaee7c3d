"""Ways that go back on themselves: the robot stops, turns on the spot, and changes its pace gently."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulation.robot_motion import (
    ACCELERATION,
    RATE_HZ,
    YAW_GAIN,
    YAW_RATE,
    Spin,
    drive_course,
    lap_time,
    lay_course,
    sharp_cells,
    within_gains,
)

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


@given(
    st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(-8.0, 8.0)), min_size=2, max_size=40),
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
