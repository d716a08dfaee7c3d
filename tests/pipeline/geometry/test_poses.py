"""Poses: group laws, wrapped angles, and conversion of quaternions and Euler angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Pose2, Pose3, euler_rotation, interpolate, wrap_angle
from tests.pipeline.strategies import angles, poses2, poses3


def _same2(a: Pose2, b: Pose2) -> None:
    np.testing.assert_allclose([a.x, a.y], [b.x, b.y], atol=1e-9)
    assert abs(float(wrap_angle(a.yaw - b.yaw + 1.0)) - 1.0) < 1e-9


def _same3(a: Pose3, b: Pose3) -> None:
    np.testing.assert_allclose(a.R, b.R, atol=1e-9)
    np.testing.assert_allclose(a.t, b.t, atol=1e-9)


@given(poses2, poses2, poses2)
def test_poses_in_the_plane_form_a_group(a, b, c):
    _same2((a @ b) @ c, a @ (b @ c))
    _same2(a @ a.inverse(), Pose2())
    _same2(a.inverse() @ a, Pose2())
    _same2(a @ Pose2(), a)
    _same2((a @ b).inverse(), b.inverse() @ a.inverse())


@given(poses3, poses3, poses3)
def test_poses_in_space_form_a_group(a, b, c):
    _same3((a @ b) @ c, a @ (b @ c))
    _same3(a @ a.inverse(), Pose3.identity())
    _same3(a.inverse() @ a, Pose3.identity())
    _same3(a @ Pose3.identity(), a)


@given(poses2, poses2)
def test_composing_poses_is_applying_them_in_turn(a, b):
    points = np.array([[0.0, 0.0], [1.0, 2.0], [-3.0, 0.5]])
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-9)
    np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, atol=1e-9)


@given(poses3, poses3)
def test_composing_poses_in_space_is_applying_them_in_turn(a, b):
    points = np.array([[0.0, 0.0, 1.0], [1.0, 2.0, -4.0]])
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-9)


@given(angles)
def test_a_wrapped_angle_is_the_same_direction_in_one_turn(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-12)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-12)


def test_the_range_of_wrapped_angles_is_half_open_to_the_last_bit():
    edge = np.array([np.pi, -np.pi, np.nextafter(-np.pi, -4.0), np.nextafter(np.pi, 4.0)])
    wrapped = wrap_angle(edge)
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi)), wrapped


@given(poses3)
def test_a_rotation_comes_back_from_its_quaternion_and_its_angles(pose):
    q = pose.quaternion()
    assert np.linalg.norm(q) == pytest.approx(1.0)
    assert q[0] >= 0.0
    _same3(Pose3.from_quaternion(pose.t, q), pose)
    _same3(Pose3.from_quaternion(pose.t, -7.0 * q), pose)
    _same3(Pose3.from_euler(pose.t, *pose.euler()), pose)
    np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-12)


def test_euler_angles_of_one_pose_and_of_many_are_those_of_scipy():
    given_angles = np.random.default_rng(1).uniform(-3.0, 3.0, (20, 3))
    expected = Rotation.from_euler("ZYX", given_angles[:, ::-1]).as_matrix()
    many = euler_rotation(*given_angles.T)
    np.testing.assert_allclose(many, expected, atol=1e-15)
    for each, R in zip(given_angles, many, strict=True):
        np.testing.assert_allclose(euler_rotation(*each), R, atol=1e-15)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_have_a_quaternion(axis):
    wxyz = np.zeros(4)
    wxyz[1 + axis] = 1.0
    pose = Pose3.from_quaternion(np.zeros(3), wxyz)
    np.testing.assert_allclose(np.abs(pose.quaternion()), wxyz, atol=1e-12)


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 0]])
def test_an_invalid_quaternion_raises(bad):
    with pytest.raises(ValueError, match="quaternion"):
        Pose3.from_quaternion(np.zeros(3), bad)


def test_angles_are_those_of_rotations_about_the_axes():
    roll = Pose3.from_euler(np.zeros(3), 0.1, 0.0, 0.0).apply(np.array([[0.0, 1.0, 0.0]]))
    pitch = Pose3.from_euler(np.zeros(3), 0.0, 0.1, 0.0).apply(np.array([[1.0, 0.0, 0.0]]))
    yaw = Pose3.from_euler(np.zeros(3), 0.0, 0.0, 0.1).apply(np.array([[1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(roll, [[0.0, np.cos(0.1), np.sin(0.1)]])
    np.testing.assert_allclose(pitch, [[np.cos(0.1), 0.0, -np.sin(0.1)]])
    np.testing.assert_allclose(yaw, [[np.cos(0.1), np.sin(0.1), 0.0]])


@given(poses2, poses2, st.floats(0.0, 1.0))
def test_interpolation_includes_its_ends_and_turns_the_shorter_way(a, b, fraction):
    _same2(interpolate(a, b, 0.0), a)
    _same2(interpolate(a, b, 1.0), b)
    turn = abs(float(wrap_angle(b.yaw - a.yaw)))
    part = abs(float(wrap_angle(interpolate(a, b, fraction).yaw - a.yaw)))
    assert part == pytest.approx(fraction * turn, abs=1e-9)


def test_a_correction_by_a_turn_alone_displaces_what_is_far():
    correction = PathCorrection(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.02]]))
    assert correction.largest(0.0) == 0.0
    assert correction.largest(25.0) == pytest.approx(0.5)
    place = np.array([[25.0, 0.0]])
    moved, _ = correction.moved(place, np.array([0]))
    assert np.hypot(*(moved - place)[0]) <= correction.largest(25.0)
    both = PathCorrection(np.zeros((2, 3)), np.array([[0.3, 0.4, 0.0], [0.1, 0.0, -0.02]]))
    assert both.largest(10.0) == pytest.approx(0.5)
    assert PathCorrection(np.zeros((0, 3)), np.zeros((0, 3))).largest(25.0) == 0.0
