"""Height, roll and pitch of one map in another."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.extensions.maps.localisation.heights import align_heights
from pipeline.geometry.poses import Pose2, Pose3


def cells(side=20.0, cell=0.5):
    """Centres of cells around the origin, shape (K, 2) [m]."""
    axis = np.arange(-side, side, cell) + 0.5 * cell
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def ground(place):
    """A hill, heights of shape (K,) [m]."""
    return 0.1 * place[:, 0] + 0.5 * np.sin(0.3 * place[:, 1])


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_height_and_tilt_are_found(yaw):
    truth = Pose3.from_euler(np.array([3.0, -2.0, 0.7]), 0.01, -0.02, yaw)
    stored = np.column_stack([cells(), ground(cells())])
    inverse = truth.inverse()
    local = inverse.apply(stored) + np.random.default_rng(1).normal(0.0, 0.01, stored.shape) * [0.0, 0.0, 1.0]
    planar = Pose2(3.0, -2.0, yaw)
    found = align_heights(planar, local, cKDTree(stored[:, :2]), stored[:, 2], np.array([3.0, -2.0]))
    assert found is not None
    full = found.pose3(planar)
    assert full.t[2] == pytest.approx(0.7, abs=0.03)
    roll, pitch, _ = full.euler()
    assert roll == pytest.approx(0.01, abs=0.003)
    assert pitch == pytest.approx(-0.02, abs=0.003)


def test_little_common_ground_tells_nothing():
    stored = np.column_stack([cells(), ground(cells())])
    tree = cKDTree(stored[:, :2])
    far = Pose2(500.0, 0.0, 0.0)
    assert align_heights(far, stored, tree, stored[:, 2], np.array([500.0, 0.0])) is None
    assert align_heights(Pose2(), np.zeros((0, 3)), tree, stored[:, 2], np.zeros(2)) is None
    assert align_heights(Pose2(), stored, None, stored[:, 2], np.zeros(2)) is None
