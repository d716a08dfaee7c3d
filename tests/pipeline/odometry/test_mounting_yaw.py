"""Yaw of a mounting by the motion of the scans."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from pipeline.odometry.mounting_yaw import better_yaw


@pytest.mark.parametrize(
    ("true", "error"),
    [*product([0.0, 90.0, 180.0, 30.0, -20.0], [-9.0, 0.0, 9.0]), (5.0, 0.0), (6.0, 0.0), (84.0, 0.0)],
)
def test_a_right_angle_replaces_a_yaw_of_a_bad_registration_if_the_scans_overlap_more(
    true: float, error: float
):
    rng = np.random.default_rng(4)
    odometry = np.column_stack([np.linspace(0.0, 5.0, 20), np.zeros(20), np.zeros(20)])
    trees = rng.uniform([-15.0, -15.0], [20.0, 15.0], (60, 2))
    trunk = rng.normal(0.0, 0.05, (60, 20, 2))
    c, s = np.cos(np.radians(true)), np.sin(np.radians(true))
    scans = [
        np.column_stack(
            [((trees[:, None] + trunk).reshape(-1, 2) - [x, 0.0]) @ [[c, -s], [s, c]], np.ones(1200)]
        )
        for x in odometry[:, 0]
    ]
    found = np.degrees(better_yaw(np.radians(true + error), odometry, scans)) % 360.0
    assert found == pytest.approx((true if true % 90.0 == 0.0 else true + error) % 360.0, abs=1e-6)
