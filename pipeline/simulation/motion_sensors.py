"""Simulated wheel odometry and IMU, with the errors of real ones.

Wheels have a wrong radius and track width, slip on slopes, and noise. The IMU measures turn rates, specific
force, and an attitude whose yaw drifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.simulation.robot_motion import RATE_HZ, TrueMotion
from pipeline.simulation.scenarios import WheelQuality
from pipeline.types.records import Float

ODOMETRY_HZ = 50
SPIN, SPIN_TURN = (0.02, 0.15), np.radians(1.0)  # m and rad that spinning wheels measure too much


def wheel_odometry(motion: TrueMotion, quality: WheelQuality, rng: np.random.Generator) -> Float:
    """Return x, y [m] and yaw [rad, not wrapped] by the wheels at 50 Hz, shape (N, 3), from the start of the
    motion; the first row is zero.

    The distance is measured along the ground. On a slope it is longer than its projection on the map, so
    planar odometry is wrong there even without noise.

    Args:
        motion: True motion.
        quality: Sizes of the errors.
        rng: Source of the errors.
    """
    step = RATE_HZ // ODOMETRY_HZ
    d = motion.drive
    x, y, z, yaw, pitch = (column[::step] for column in (d.x, d.y, motion.z, d.yaw, motion.pitch))
    distance = np.sqrt(np.diff(x) ** 2 + np.diff(y) ** 2 + np.diff(z) ** 2)
    turn = np.diff(yaw)
    # Each error is within 15 % of its nominal size, so that "poor" is never good by chance.
    signs = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.85, 1.15, 3)
    uphill = -np.sin(0.5 * (pitch[1:] + pitch[:-1]))
    root = np.sqrt(distance)
    measured = distance * (1.0 + signs[0] * quality.scale + quality.slip * uphill)
    measured += quality.distance_noise * root * rng.standard_normal(distance.size)
    turned = turn * (1.0 + signs[1] * quality.turn_scale) + signs[2] * quality.turn_bias * distance
    turned += quality.turn_noise * root * rng.standard_normal(distance.size)
    if quality.spins > 0.0:
        first = np.flatnonzero(rng.random(distance.size) < quality.spins * distance)
        for begin in first:
            during = slice(begin, begin + ODOMETRY_HZ // 2)  # half a second
            measured[during] += rng.uniform(*SPIN) / (ODOMETRY_HZ // 2)
            turned[during] += rng.normal(0.0, SPIN_TURN) / (ODOMETRY_HZ // 2)
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    return np.stack(
        [
            np.concatenate([[0.0], np.cumsum(measured * np.cos(middle))]),
            np.concatenate([[0.0], np.cumsum(measured * np.sin(middle))]),
            heading,
        ],
        axis=1,
    )


IMU_HZ = 100
GRAVITY = 9.81
_GYRO_NOISE, _GYRO_BIAS = 0.004, 0.0008
_FORCE_NOISE, _FORCE_BIAS = 0.06, 0.03
_TILT_BIAS, _TILT_WANDER = np.radians(0.2), np.radians(0.2)
_WANDER_S = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Readings at 100 Hz in the base frame; columns of length N.

    Attributes:
        angular_velocity: shape (N, 3) [rad/s].
        linear_acceleration: shape (N, 3) [m/s^2], +9.81 along z at rest on level ground.
        attitude: Roll, pitch and yaw, shape (N, 3) [rad]; yaw starts at 0 and drifts.
    """

    angular_velocity: Float
    linear_acceleration: Float
    attitude: Float

    def orientation(self, n: int) -> Float:
        """Return the measured attitude of reading n as a unit quaternion w, x, y, z, shape (4,): the rotation
        from the base frame to the level frame in which `attitude` is measured."""
        roll, pitch, yaw = self.attitude[n]
        return Pose3.from_euler(np.zeros(3), roll, pitch, yaw).quaternion()


def inertial_readings(motion: TrueMotion, rng: np.random.Generator) -> Inertial:
    """Return rates, forces and attitude of the IMU at 100 Hz from the start of a motion, with bias and noise.

    Args:
        motion: True motion.
        rng: Source of the errors.
    """
    step, dt = RATE_HZ // IMU_HZ, 1.0 / RATE_HZ
    d = motion.drive
    roll, pitch = motion.roll, motion.pitch
    roll_rate, pitch_rate = np.gradient(roll, dt), np.gradient(pitch, dt)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turn_rate = np.stack(
        [
            roll_rate - d.yaw_rate * sp,
            pitch_rate * cr + d.yaw_rate * cp * sr,
            -pitch_rate * sr + d.yaw_rate * cp * cr,
        ],
        axis=1,
    )[::step]
    ahead, left = np.gradient(d.speed, dt), d.speed * d.yaw_rate
    up = GRAVITY + np.gradient(np.gradient(motion.z, dt), dt)
    # Rx(roll)^T Ry(pitch)^T of the force in the level frame with x ahead.
    low = ahead * sp + up * cp
    force = np.stack([ahead * cp - up * sp, left * cr + low * sr, low * cr - left * sr], axis=1)[::step]
    count = turn_rate.shape[0]
    gyro_bias = _GYRO_BIAS * rng.standard_normal(3)
    measured_rate = turn_rate + gyro_bias + _GYRO_NOISE * rng.standard_normal((count, 3))
    measured_force = (
        force + _FORCE_BIAS * rng.standard_normal(3) + _FORCE_NOISE * rng.standard_normal((count, 3))
    )
    attitude = np.stack([roll[::step], pitch[::step], d.yaw[::step]], axis=1)
    attitude[:, :2] += _TILT_BIAS * rng.standard_normal(2) + _wander(count, rng)
    walk = _GYRO_NOISE / np.sqrt(IMU_HZ) * np.sqrt(1.0 / IMU_HZ) * np.cumsum(rng.standard_normal(count))
    attitude[:, 2] += gyro_bias[2] * np.arange(count) / IMU_HZ + walk - walk[0]
    return Inertial(measured_rate, measured_force, attitude)


def _wander(count: int, rng: np.random.Generator) -> Float:
    """Return a slow error of roll and pitch, shape (count, 2) [rad]: random knots, smoothly interpolated."""
    knots = int(count / IMU_HZ / _WANDER_S) + 3
    values = _TILT_WANDER * rng.standard_normal((knots, 2))
    at = np.arange(count) / IMU_HZ / _WANDER_S
    low = at.astype(np.int64)
    blend = (0.5 - 0.5 * np.cos(np.pi * (at - low)))[:, None]
    wandered: Float = (1.0 - blend) * values[low] + blend * values[low + 1]
    return wandered
