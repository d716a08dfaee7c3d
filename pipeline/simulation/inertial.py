"""The inertial unit: turn rates, specific force, and an attitude whose yaw drifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.simulation.motion import Motion
from pipeline.simulation.trajectory import RATE_HZ
from pipeline.types.records import Float

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
        linear_acceleration: shape (N, 3) [m/s^2], +9.81 along z when it stands level.
        attitude: Roll, pitch and yaw, shape (N, 3) [rad]; yaw starts at 0 and drifts.
    """

    angular_velocity: Float
    linear_acceleration: Float
    attitude: Float

    def orientation(self, n: int) -> Float:
        """Quaternion w, x, y, z of reading n."""
        roll, pitch, yaw = self.attitude[n]
        return Pose3.from_euler(np.zeros(3), roll, pitch, yaw).quaternion()


def inertial_readings(motion: Motion, rng: np.random.Generator) -> Inertial:
    """What the unit tells of a motion."""
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
    # Rx(roll)^T Ry(pitch)^T of the force in the level frame that looks ahead.
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
    """A slow error of roll and pitch, shape (count, 2) [rad]: random knots, smoothly joined."""
    knots = int(count / IMU_HZ / _WANDER_S) + 3
    values = _TILT_WANDER * rng.standard_normal((knots, 2))
    at = np.arange(count) / IMU_HZ / _WANDER_S
    low = at.astype(np.int64)
    blend = (0.5 - 0.5 * np.cos(np.pi * (at - low)))[:, None]
    wandered: Float = (1.0 - blend) * values[low] + blend * values[low + 1]
    return wandered
