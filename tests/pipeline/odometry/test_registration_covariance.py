"""The covariance of a registration: closed forms, directions without information, and chi-square."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.poses import Float
from pipeline.odometry.lidar_odometry import CONTRADICTED
from pipeline.odometry.registration_covariance import RENEWED, registration_covariance, step_covariance
from pipeline.types.records import Int

LARGEST = np.array([1.5, 1.5, 0.6])
SIGMA = 0.02


def walls(rng: np.random.Generator, normals: Float, cells: int = 60) -> tuple[Float, Float]:
    """Points up to 10 m away with one of the given normals each, in turns."""
    points = np.column_stack([rng.uniform(-10.0, 10.0, (cells, 2)), rng.uniform(-1.0, 2.0, cells)])
    return points, normals[np.arange(cells) % len(normals)]


def covariance(points: Float, normals: Float, residual: Float, cell: Int) -> Float:
    return registration_covariance(points, normals, residual, cell, LARGEST)[0]


def test_two_pairs_of_walls_have_the_variance_of_a_mean():
    """x is the mean of the distances of 2 N points, and so is y; a turn moves them by their lever of 5 m."""
    along = np.tile(np.array([-5.0, 5.0]), 20)
    zero = np.zeros(40)
    x_walls = np.column_stack([np.repeat([-8.0, 8.0], 20), along, zero])
    points = np.concatenate([x_walls, x_walls[:, [1, 0, 2]]])
    normals = np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 40, axis=0)
    residual = SIGMA * np.resize([1.0, -1.0, -1.0, 1.0], 80)
    found = covariance(points, normals, residual, np.arange(80))
    expected = SIGMA**2 / np.array([40.0, 40.0, 80.0 * 5.0**2])
    np.testing.assert_allclose(found, np.diag(expected), rtol=1e-3, atol=1e-9)


def test_walls_of_a_corridor_say_nothing_of_the_way_along_it():
    points, normals = walls(np.random.default_rng(1), np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))
    found = covariance(points, normals, np.full(60, SIGMA), np.arange(60))
    assert found[0, 0] == pytest.approx(LARGEST[0] ** 2)
    assert np.sqrt(found[1, 1]) < SIGMA
    assert np.sqrt(found[2, 2]) < SIGMA


def test_an_open_field_says_nothing():
    points, normals = walls(np.random.default_rng(2), np.array([[0.0, 0.0, 1.0]]))
    found = covariance(points, normals, np.full(60, SIGMA), np.arange(60))
    np.testing.assert_allclose(found, np.diag(LARGEST**2))
    nothing = np.zeros(0)
    none = covariance(np.zeros((0, 3)), np.zeros((0, 3)), nothing, nothing.astype(np.int64))
    np.testing.assert_allclose(none, np.diag(LARGEST**2))


def test_more_points_of_the_same_cell_are_no_more_evidence():
    rng = np.random.default_rng(3)
    points, normals = walls(rng, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    residual, cell = rng.normal(0.0, SIGMA, 60), np.arange(60)
    once = covariance(points, normals, residual, cell)
    row = np.repeat(np.arange(60), 3)
    thrice = covariance(points[row], normals[row], residual[row], cell[row])
    np.testing.assert_allclose(once, thrice, rtol=1e-9)


def test_errors_of_registrations_are_those_of_their_covariances():
    """60 observations with errors of their own are fitted 400 times: x^T C^-1 x is chi-square of 3."""
    rng = np.random.default_rng(4)
    angle = rng.uniform(0.0, 2.0 * np.pi, 60)
    points, normals = walls(rng, np.column_stack([np.cos(angle), np.sin(angle), np.zeros(60)]))
    J = np.column_stack([normals[:, :2], points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]])
    squares = []
    for _ in range(400):
        noise = rng.normal(0.0, SIGMA, 60)
        error = np.linalg.lstsq(J, noise, rcond=None)[0]
        C = covariance(points, normals, noise - J @ error, np.arange(60))
        squares.append(error @ np.linalg.solve(C, error))
    # Mean of 400 values of chi-square with 3 degrees of freedom, 99.9 %; the residuals of a fit of 3 numbers
    # to 60 are smaller by 5 %.
    assert 3.0 - 3.3 * np.sqrt(6.0 / 400) < np.mean(squares) < 1.06 * (3.0 + 3.3 * np.sqrt(6.0 / 400))


def test_a_large_surface_that_moves_with_the_robot_disagrees_with_the_others():
    """Three of 43 cells have 600 of 680 points, so that their motion is nearly that of all points."""
    rng = np.random.default_rng(5)
    for moved, told in ((0.15, True), (0.0, False)):
        cell = np.concatenate([np.repeat(np.arange(40), 2), np.repeat(np.arange(40, 43), 200)])
        angle = np.where(cell < 40, rng.uniform(0.0, 2.0 * np.pi, 43)[cell], 0.0)
        normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(680)])
        points = np.column_stack([rng.uniform(-9.0, 9.0, (43, 2)), np.ones(43)])[cell]
        residual = rng.normal(0.0, 2.0 * SIGMA, 680) - moved * normals[:, 0] * (cell < 40)
        J = np.column_stack([normals[:, :2], points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]])
        residual -= J @ np.linalg.lstsq(J, residual, rcond=None)[0]
        assert (registration_covariance(points, normals, residual, cell, LARGEST)[1] > CONTRADICTED) is told


def test_a_robot_that_stands_does_not_drift_and_one_that_drives_has_new_errors():
    P = np.diag([0.02, 0.01, 0.002]) ** 2
    steps = []
    for way in (0.0, 0.5 * RENEWED, RENEWED, 4.0 * RENEWED):
        steps.append(np.eye(4))
        steps[-1][0, 3] = way
    none, half, whole, far = (step_covariance(P, step, LARGEST) for step in steps)
    assert np.sqrt(np.diag(none)).max() < 0.02 * np.sqrt(np.diag(P)).max()
    np.testing.assert_allclose(half, 0.5 * P, rtol=0.01)
    np.testing.assert_allclose(whole, P, rtol=0.01)
    np.testing.assert_array_equal(whole, far)


def test_a_step_that_is_only_the_guess_is_as_uncertain_as_the_guess():
    unknown = np.diag(LARGEST**2.0)
    np.testing.assert_allclose(step_covariance(unknown, np.eye(4), LARGEST), unknown)


def test_the_covariance_of_a_step_is_in_the_frame_in_which_the_step_begins():
    """A scan that has turned to the left by 90 degrees sees the y axis of the first one along its x axis."""
    P = np.diag([0.02, 0.01, 0.002]) ** 2
    step = np.eye(4)
    step[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    found = step_covariance(P, step, LARGEST)
    np.testing.assert_allclose(found, np.diag([0.01, 0.02, 0.002]) ** 2, rtol=0.01, atol=1e-12)
