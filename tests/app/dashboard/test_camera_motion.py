"""How far the robot moved between a scan and its picture: closed forms of arcs, and laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.dashboard.camera_view import motion
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Path

SECOND = 1_000_000_000
TIMES = st.integers(-SECOND, 4 * SECOND)


def arc(speed: float, rate: float, t_s: float) -> Pose2:
    """Of constant velocities [m/s, rad/s], from the origin along x."""
    turn = rate * t_s
    reach = speed * t_s * np.sinc(0.5 * turn / np.pi)
    return Pose2(reach * np.cos(0.5 * turn), reach * np.sin(0.5 * turn), turn)


def drive(speed: float, rate: float, scans: int = 31) -> Path:
    """Three seconds at 10 Hz."""
    poses = np.array([arc(speed, rate, 0.1 * k).as_array() for k in range(scans)]).reshape(-1, 3)
    stamps = np.arange(scans, dtype=np.int64) * (SECOND // 10)
    return Path(stamps, poses[:, 0], poses[:, 1], poses[:, 2], np.zeros(scans))


@given(st.floats(0.0, 2.0), st.floats(-0.6, 0.6), TIMES, st.integers(-SECOND, SECOND))
def test_an_arc_is_followed_between_the_scans_and_beyond_them(speed, rate, from_ns, wait_ns):
    moved = motion(drive(speed, rate), from_ns, from_ns + wait_ns)
    wanted = arc(speed, rate, 1e-9 * wait_ns)
    np.testing.assert_allclose(moved.as_array(), wanted.as_array(), atol=0.02)


@given(TIMES, TIMES)
def test_there_and_back_is_nowhere(from_ns, to_ns):
    path = drive(1.0, 0.4)
    nowhere = motion(path, from_ns, to_ns) @ motion(path, to_ns, from_ns)
    np.testing.assert_allclose(nowhere.as_array(), 0.0, atol=1e-9)


def test_a_correction_of_the_last_pose_is_not_taken_for_speed():
    path = drive(1.0, 0.0)
    path.x[-1] += 0.05
    last_ns = int(path.stamp_ns[-1])
    assert motion(path, last_ns, last_ns + SECOND // 4).x == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize("path", [None, drive(1.0, 0.1, 0), drive(1.0, 0.1, 1)])
def test_who_has_no_path_has_not_moved(path: Path | None):
    assert motion(path, 0, SECOND) == Pose2()


def test_two_poses_are_enough():
    assert motion(drive(1.0, 0.0, 2), 0, SECOND).x == pytest.approx(1.0)
