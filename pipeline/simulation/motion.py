"""Where the robot truly is at any time: its drive laid on the terrain, with a little vibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.simulation.trajectory import RATE_HZ, Drive
from pipeline.types.records import Float

_VIBRATION_HZ = np.array([1.3, 2.9, 5.3, 8.7])
_VIBRATION_ANGLE = np.radians(np.array([0.20, 0.10, 0.06, 0.03]))


class Ground(Protocol):
    """What the robot stands on."""

    def evaluate(self, x: Float, y: Float) -> Float:
        """Height, dz/dx and dz/dy at places of shape (N,) [m]; shape (N, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The true pose of the base at 200 Hz; columns of length T. The base lies on the ground.

    Attributes:
        drive: The planar part.
        z: Height [m] in the world.
        roll, pitch: Tilt of the base [rad], R = Rz(yaw) Ry(pitch) Rx(roll).
    """

    drive: Drive
    z: Float
    roll: Float
    pitch: Float

    def at(self, t: Float) -> tuple[Float, Float]:
        """Rotations (N, 3, 3) and positions (N, 3) [m] of the base in the world at times (N,) [s]."""
        first = max(int(t[0] * RATE_HZ) - 1, 0)
        part = slice(first, int(np.ceil(t[-1] * RATE_HZ)) + 2)
        d = self.drive
        grid = d.t[part]
        x, y, z, roll, pitch, yaw = (
            np.interp(t, grid, column[part]) for column in (d.x, d.y, self.z, self.roll, self.pitch, d.yaw)
        )
        return rotations(roll, pitch, yaw), np.stack([x, y, z], axis=1)

    def sensor_at(self, t: Float, T_base_lidar: Pose3) -> tuple[Float, Float]:
        """The same of a sensor that is mounted on the base."""
        R, p = self.at(t)
        return np.ascontiguousarray(R @ T_base_lidar.R), p + R @ T_base_lidar.t


def lay_on_terrain(drive: Drive, terrain: Ground, rng: np.random.Generator) -> Motion:
    """The base stands on the ground, upright to it, and shakes while it moves."""
    z, gx, gy = terrain.evaluate(drive.x, drive.y).T
    c, s = np.cos(drive.yaw), np.sin(drive.yaw)
    ahead, left = gx * c + gy * s, gy * c - gx * s
    moving = np.clip(drive.speed / 0.5, 0.0, 1.0)
    shake = [_vibration(drive.t, rng) * moving for _ in range(2)]
    return Motion(
        drive=drive,
        z=z,
        roll=np.arcsin(left / np.sqrt(1.0 + ahead**2 + left**2)) + shake[0],
        pitch=-np.arctan(ahead) + shake[1],
    )


def rotations(roll: Float, pitch: Float, yaw: Float) -> Float:
    """R = Rz(yaw) Ry(pitch) Rx(roll), shape (N, 3, 3), of angles (N,) [rad]."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _vibration(t: Float, rng: np.random.Generator) -> Float:
    phase = rng.uniform(0.0, 2.0 * np.pi, _VIBRATION_HZ.size)
    waves = np.sin(2.0 * np.pi * np.outer(t, _VIBRATION_HZ) + phase)
    shaken: Float = waves @ _VIBRATION_ANGLE / np.sqrt(2.0)
    return shaken
