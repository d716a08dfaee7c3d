"""Synchroniser: each scan is joined with motion and tilt at its time; records left out are counted."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.poses import Pose2, Pose3, wrap_angle
from pipeline.odometry.synchroniser import MOST_WAITING, steps
from pipeline.types.records import Imu, Odometry, Step
from tests.pipeline.strategies import scan

MS = 1_000_000
START = 1_700_000_000_000_000_000  # nanoseconds do not fit a float: only their differences may become one


def pose_of(step: Step) -> Pose2:
    """The pose of a step that has one."""
    assert step.T_odom_base is not None
    return step.T_odom_base


def odometry(ms, x=0.0, y=0.0, yaw=0.0, roll=0.0, pitch=0.0):
    """A pose of the wheels."""
    return Odometry(START + round(ms * MS), Pose3.from_euler(np.array([x, y, 0.0]), roll, pitch, yaw))


def imu(ms, roll, pitch):
    """A reading that knows its tilt."""
    q = Pose3.from_euler(np.zeros(3), roll, pitch, 0.3).quaternion()
    return Imu(START + round(ms * MS), np.zeros(3), np.array([0, 0, 9.81]), q)


def at(ms):
    """An empty scan."""
    return scan(START + round(ms * MS))


@given(st.floats(0.1, 200.0), st.floats(-2, 2), st.floats(-3, 3))
def test_the_pose_is_interpolated_to_the_time_of_the_scan(ms, speed, turn):
    readings = [odometry(t, speed * t * 1e-3, 0.0, turn * t * 1e-3) for t in range(0, 220, 20)]
    records = sorted([*readings, at(ms)], key=lambda r: r.stamp_ns)
    (step,) = steps(records)
    assert pose_of(step).x == pytest.approx(speed * ms * 1e-3, abs=1e-7)
    assert abs(float(wrap_angle(pose_of(step).yaw - turn * ms * 1e-3))) < 1e-7
    # A chord stands for the arc between two readings.
    assert np.hypot(*step.twist[:2]) == pytest.approx(abs(speed), rel=1e-3, abs=1e-6)
    assert step.twist[2] == pytest.approx(turn, rel=1e-6, abs=1e-6)
    assert step.warnings == ()


@given(st.floats(0.0, 40.0), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_the_tilt_of_the_pose_is_that_of_the_time_of_the_scan(ms, roll, pitch):
    records = [odometry(0, roll=0.1), at(ms), odometry(40, 0.02, roll=roll, pitch=pitch)]
    (step,) = steps(records)
    assert step.tilt_known
    assert step.roll == pytest.approx(0.1 + (roll - 0.1) * ms / 40, abs=1e-6)
    assert step.pitch == pytest.approx(pitch * ms / 40, abs=1e-6)


def test_the_twist_is_in_the_frame_of_the_robot():
    (step,) = steps([odometry(0, 0, 0, np.pi / 2), at(50), odometry(100, 0.0, 0.2, np.pi / 2)])
    np.testing.assert_allclose(step.twist, [2.0, 0.0, 0.0], atol=1e-9)


def test_the_turn_goes_the_shorter_way_over_the_edge():
    (step,) = steps([odometry(0, yaw=3.1), at(50), odometry(100, yaw=-3.1)])
    assert abs(pose_of(step).yaw) == pytest.approx(np.pi)
    assert step.twist[2] == pytest.approx((2 * np.pi - 6.2) / 0.1)


def test_a_scan_waits_for_the_odometry_that_follows_it():
    given_out = []

    def records():
        for record in (odometry(0), at(10), odometry(5, 0.5), odometry(20, 2.0), at(30)):
            yield record
            given_out.append(record)

    first = next(steps(records()))
    assert pose_of(first).x == pytest.approx(0.5 + 1.5 * 5 / 15)
    assert len(given_out) == 3, "not before the reading at 20 ms"


def test_after_five_scans_the_last_pose_stands_for_what_does_not_come():
    told = list(steps([odometry(0), odometry(10, 1.0), *(at(20 + 100 * k) for k in range(9))]))
    assert [s.index for s in told] == list(range(9))
    assert all(pose_of(s).x == 1.0 for s in told)


def test_without_odometry_every_scan_comes_and_has_no_pose():
    told = list(steps(at(100 * k) for k in range(9)))
    assert len(told) == 9
    assert all(s.T_odom_base is None and s.twist == (0.0, 0.0, 0.0) for s in told)


def test_static_leaves_poses_aside_and_does_not_wait():
    stream = steps(iter([odometry(0, 5.0), at(10), odometry(20, 9.0), at(30)]), odometry="static")
    told = list(stream)
    assert [s.T_odom_base for s in told] == [None, None]


@pytest.mark.parametrize("late", [5, 10])
def test_a_scan_that_is_not_later_is_left_out_and_counted(late):
    losses = Counter[str]()
    told = list(steps([at(10), at(late), at(late), at(20), at(30)], odometry="static", losses=losses))
    assert [(s.scan.stamp_ns - START) // MS for s in told] == [10, 20, 30]
    assert [s.index for s in told] == [0, 1, 2]
    assert losses.total() == 2
    assert sum("not later" in w for s in told for w in s.warnings) == 1


def test_what_is_left_out_at_the_end_is_counted_too():
    losses = Counter[str]()
    list(steps([at(10), at(5)], odometry="static", losses=losses))
    assert losses.total() == 1


def test_odometry_out_of_order_or_without_numbers_is_left_out_and_counted():
    losses = Counter[str]()
    bad = Odometry(START + 15 * MS, Pose3(np.eye(3), np.array([np.nan, 0, 0])))
    twisted = Odometry(START + 16 * MS, Pose3(np.full((3, 3), np.inf), np.zeros(3)))
    rows = [odometry(0), odometry(10, 0.1), odometry(5, 50.0), bad, twisted, at(20), odometry(30, 0.3)]
    (step,) = steps(rows, losses=losses)
    assert pose_of(step).x == pytest.approx(0.2)
    assert losses.total() == 3
    assert len(step.warnings) == 2


def test_a_jump_is_said_and_not_taken_as_motion():
    told = list(steps([odometry(0), at(10), odometry(20, 30.0), at(30), odometry(40, 30.1)]))
    assert "30.0 m" in " ".join(told[0].warnings)
    assert told[0].twist == (0.0, 0.0, 0.0)
    assert pose_of(told[0]).x == 0.0
    assert pose_of(told[1]).x == pytest.approx(0.05)


def test_a_flip_of_the_heading_is_no_turn_and_motion_goes_on_along_the_old_heading():
    flipped = [
        Odometry(START + t * MS, Pose3.from_euler([-x, 0, 0], 0, 0, np.pi)) for t, x in ((20, 0.0), (40, 0.2))
    ]
    (step,) = steps([odometry(0), *flipped, at(40)])
    assert pose_of(step).yaw == pytest.approx(0.0)
    assert pose_of(step).x == pytest.approx(0.2)
    assert any("180 degrees" in warning for warning in step.warnings)


def test_odometry_that_ends_gives_no_velocity_and_is_said():
    told = list(steps([odometry(0), odometry(100, 0.1), *(at(t) for t in range(50, 2000, 50))]))
    assert told[0].twist[0] == pytest.approx(1.0)
    assert told[-1].twist == (0.0, 0.0, 0.0)
    assert pose_of(told[-1]).x == pytest.approx(0.1)
    assert any("no odometry" in warning for warning in told[-1].warnings)


def test_a_tilt_of_long_ago_is_not_known_and_is_said():
    told = list(steps([imu(0, 0.1, 0.0), at(10), at(900)], odometry="static"))
    assert told[0].tilt_known
    assert not told[1].tilt_known
    assert any("no IMU" in warning for warning in told[1].warnings)


def test_the_tilt_is_that_of_the_nearest_reading():
    readings = [odometry(0), imu(0, 0.1, 0.0), imu(40, 0.0, 0.2), imu(60, -0.1, 0.05), at(50), odometry(60)]
    (step,) = steps([*readings[:3], readings[4], readings[3], readings[5]])
    assert step.tilt_known
    assert (step.roll, step.pitch) == pytest.approx((0.0, 0.2))


def test_a_pose_in_space_tells_the_tilt_where_no_imu_does():
    (step,) = steps([odometry(0, roll=0.1, pitch=-0.2), at(10), odometry(20, roll=0.1, pitch=-0.2)])
    assert (step.roll, step.pitch) == pytest.approx((0.1, -0.2))
    (flat,) = steps([odometry(0), at(10), odometry(20)])
    assert not flat.tilt_known


@pytest.mark.parametrize("orientation", [None, np.zeros(4), np.full(4, np.nan)])
def test_an_imu_that_knows_no_tilt_gives_none(orientation):
    blind = Imu(START, np.zeros(3), np.zeros(3), orientation)
    (step,) = steps([blind, at(10)])
    assert not step.tilt_known


def test_memory_does_not_grow_with_the_run():
    def records():
        for k in range(3000):
            yield odometry(20 * k)
            yield imu(20 * k + 1, 0.0, 0.0)
            if k % 5 == 0:
                yield at(20 * k)

    stream: Any = steps(records())
    for _ in range(500):
        next(stream)
    joiner = stream.gi_frame.f_locals["joiner"]
    assert len(joiner._odometry._readings) < 300
    assert len(joiner._imu) < 300


def test_few_scans_wait_when_their_stamps_are_nearly_equal():
    given_out = []

    def records():
        yield odometry(0)
        for k in range(1000):
            given_out.append(k)
            yield at(10 + 1e-3 * k)

    stream = steps(records())
    next(stream)
    assert len(given_out) == MOST_WAITING + 1
    assert len(list(stream)) == 999


def test_the_motion_of_a_gap_is_reported_apart_when_the_odometry_returns():
    readings = [odometry(t, t * 1e-3) for t in range(0, 4000, 20) if t not in range(1000, 3000)]
    records = sorted([*readings, *(at(t) for t in range(0, 3500, 100))], key=lambda r: r.stamp_ns)
    made = list(steps(records))
    (back,) = [step for step in made if step.unreported is not None]
    seconds = (back.scan.stamp_ns - START) * 1e-9
    assert 1.5 < seconds <= 3.0, "some scans wait for the odometry"
    assert back.unreported is not None
    assert back.unreported.x == pytest.approx(seconds - 0.1 - 0.98, abs=1e-6), "after 0.98 m before the gap"
    assert pose_of(back).x == pytest.approx(seconds, abs=1e-6)


def test_a_gap_without_scans_has_no_unreported_motion():
    readings = [odometry(t, t * 1e-3) for t in (0, 20, 3000, 3020)]
    records = sorted([*readings, at(10), at(3010)], key=lambda r: r.stamp_ns)
    assert [step.unreported for step in steps(records)] == [None, None]


@pytest.mark.parametrize("hz", [5, 10, 20, 40])
@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_what_is_due_after_an_interval_does_not_depend_on_the_rate(hz, delay):
    joined = list(steps([at(1000.0 * k / hz) for k in range(20 * hz)], odometry="static"))
    due = [step.elapsed_ns * 1e-9 for step in joined if step.is_due(0.4, delay)]
    first = [t for t in due if t < 1.0]
    assert len(first) == hz, "all scans of the first second"
    wanted = np.arange(delay, 20.0, 0.4)
    np.testing.assert_allclose(due[len(first) :], wanted[wanted > 0.99], atol=1.0 / hz)


@pytest.mark.parametrize(("hz", "wanted"), [(1, 1), (5, 5), (10, 10), (12, 12), (20, 10), (40, 10)])
def test_views_are_no_more_frequent_than_the_scans_of_a_usual_sensor(hz, wanted):
    joined = list(steps([at(1000.0 * k / hz) for k in range(10 * hz)], odometry="static"))
    assert sum(step.is_view for step in joined) == 10 * wanted


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_each_part_of_a_turn_that_is_written_by_itself_is_viewed_and_due_as_often_as_a_whole_turn(parts):
    rng = np.random.default_rng(0)
    whole = rng.uniform(-np.pi, np.pi, 6000)
    scans = []
    for k in range(100 * parts):  # 10 turns a second
        low = -np.pi + 2.0 * np.pi * (k % parts) / parts
        turn = whole[(whole >= low) & (whole < low + 2.0 * np.pi / parts)]
        points = 8.0 * np.stack([np.cos(turn), np.sin(turn), 0.1 * turn], axis=1)
        scans.append(scan(START + round(k * 100 * MS / parts), points))
    joined = list(steps(scans, odometry="static"))
    for part in range(parts):
        own = joined[part::parts]
        assert all(step.is_view for step in own)
        late = [step for step in own if step.elapsed_ns >= 1_000_000_000]
        assert sum(step.is_due(0.4) for step in late) in (22, 23)


def test_a_jitter_of_the_stamps_loses_no_view():
    jitter = np.random.default_rng(0).uniform(-9.0, 9.0, 50)
    joined = steps([at(100.0 * k + jitter[k]) for k in range(50)], odometry="static")
    assert all(step.is_view for step in joined)
