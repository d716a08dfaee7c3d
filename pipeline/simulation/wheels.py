"""Wheel odometry with the faults of real wheels: a wrong radius and base, slip on slopes, noise."""

from __future__ import annotations

import numpy as np

from pipeline.simulation.motion import Motion
from pipeline.simulation.odometry_quality import WheelQuality
from pipeline.simulation.trajectory import RATE_HZ
from pipeline.types.records import Float

ODOMETRY_HZ = 50


def wheel_odometry(motion: Motion, quality: WheelQuality, rng: np.random.Generator) -> Float:
    """x, y [m] and yaw [rad] as the wheels tell them at 50 Hz, shape (N, 3), the first all zero.

    The distance is that of the wheels on the ground, which is longer than its shadow on the map where
    the ground is steep: a planar odometry is wrong there even without noise.
    """
    step = RATE_HZ // ODOMETRY_HZ
    d = motion.drive
    x, y, z, yaw, pitch = (column[::step] for column in (d.x, d.y, motion.z, d.yaw, motion.pitch))
    distance = np.sqrt(np.diff(x) ** 2 + np.diff(y) ** 2 + np.diff(z) ** 2)
    turn = np.diff(yaw)
    # Each fault lies within 15 % of its nominal size, so that "poor" is never good by chance.
    signs = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.85, 1.15, 3)
    uphill = -np.sin(0.5 * (pitch[1:] + pitch[:-1]))
    root = np.sqrt(distance)
    told = distance * (1.0 + signs[0] * quality.scale + quality.slip * uphill)
    told += quality.distance_noise * root * rng.standard_normal(distance.size)
    turned = turn * (1.0 + signs[1] * quality.turn_scale) + signs[2] * quality.turn_bias * distance
    turned += quality.turn_noise * root * rng.standard_normal(distance.size)
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    return np.stack(
        [
            np.concatenate([[0.0], np.cumsum(told * np.cos(middle))]),
            np.concatenate([[0.0], np.cumsum(told * np.sin(middle))]),
            heading,
        ],
        axis=1,
    )
