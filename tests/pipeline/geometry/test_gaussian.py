"""Kernels of Gaussians agree with the formulas of the textbook in matrices."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, draw

A = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.05, 0.04, 0.06]])
SIGMA = A @ A.T


def test_the_correction_by_a_landmark_is_that_of_a_kalman_filter() -> None:
    mu, (ax, ay) = np.array([1.0, -2.0, 0.4]), (3.0, -1.5)
    R, y = np.array([[0.02, 0.004], [0.004, 0.03]]), np.array([0.11, -0.07])
    J = np.array([[1.0, 0.0, -ay], [0.0, 1.0, ax]])
    S = J @ SIGMA @ J.T + R
    K = SIGMA @ J.T @ np.linalg.inv(S)
    P = SIGMA
    pose = Pose(mu[0], mu[1], mu[2], P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
    pose = corrected(pose, ax, ay, S[0, 0], S[0, 1], S[1, 1], y[0], y[1])
    np.testing.assert_allclose([pose.x, pose.y, pose.yaw], mu + K @ y)
    P = SIGMA - K @ J @ SIGMA
    upper = [pose.xx, pose.xy, pose.xt, pose.yy, pose.yt, pose.tt]
    np.testing.assert_allclose(upper, P[np.triu_indices(3)], atol=1e-15)


def test_a_drawn_pose_is_the_mean_and_the_root_of_the_covariance_times_the_noise() -> None:
    mu, noise, out = np.array([1.0, 2.0, 3.0]), np.array([[0.0] * 3, [0.5, -1.2, 2.0]]), np.zeros((2, 3))
    draw(mu, SIGMA, noise, 1, out)
    expected = mu + np.linalg.cholesky(SIGMA) @ noise[1]
    expected[2] = np.angle(np.exp(1j * expected[2]))
    np.testing.assert_allclose(out, [[0.0] * 3, expected])
    draw(mu, np.zeros((3, 3)), noise, 0, out)
    np.testing.assert_allclose(out[0], mu)
