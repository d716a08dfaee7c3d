"""A robot that looks where it drives: it slows down and stops for what stands in its way."""

from __future__ import annotations

import numpy as np

from pipeline.config import Parameters
from pipeline.detection.obstacles import find_clearance
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground.scan_ground import find_terrain
from pipeline.ground.terrain import shows_ground
from pipeline.preprocessing.acquisition import acquire, acquire_near
from pipeline.simulation.lidar import SpinningLidar, sweep_scene
from pipeline.simulation.motion import Motion, lay_on_terrain
from pipeline.simulation.scene import Scene
from pipeline.simulation.trajectory import RATE_HZ, Course, Drive, speed_limit
from pipeline.types.clearance import Clearance, Zone
from pipeline.types.records import Float, Step

#: Part of the speed that is driven in each zone.
SPEED = {Zone.CLEAR: 1.0, Zone.SLOW: 0.4, Zone.STOP: 0.0, Zone.UNKNOWN: 0.0}
_GAIN, _BRAKE = 0.5, 1.5  # m/s^2
#: Its own sensor is as coarse as this: what stands within a few metres is seen all the same.
_COLUMNS = 225


class ObeyingDrive:
    """Drives a course a sweep at a time: what a sweep shows decides how fast the next one is driven.

    Args:
        course: Where to drive; speed: on the straight [m/s].
        scene: What stands there.
        T_base_lidar: Mounting of the sensor.
        seed: Of the robot's own sensor.
    """

    def __init__(self, course: Course, speed: float, scene: Scene, T_base_lidar: Pose3, seed: int) -> None:
        self._course, self._scene, self._T_base_lidar, self._seed = course, scene, T_base_lidar, seed
        self._lidar = SpinningLidar(columns=_COLUMNS)
        self._parameters = Parameters()
        self._limit = speed_limit(course, speed)
        self._ticks = RATE_HZ * self._lidar.period_ns // 1_000_000_000
        self._speeds, self._along = [0.0], [0.0]
        self.clearances: list[Clearance] = []

    def run(self, duration_s: float) -> Drive:
        """The whole drive."""
        sweeps = int(np.ceil((duration_s + 0.5) * 1e9 / self._lidar.period_ns)) + 1
        for k in range(sweeps):
            self._advance(SPEED[self.clearances[-1].zone] if self.clearances else 0.0)
            self.clearances.append(self._look(k))
        return self._drive(0)

    def _advance(self, part: float) -> None:
        """Drive for one sweep at a part of the course's speed."""
        course, step = self._course, 1.0 / RATE_HZ
        v, s = self._speeds[-1], self._along[-1]
        for _ in range(self._ticks):
            here = s % course.s[-1] if course.closed else min(s, float(course.s[-1]))
            wanted = part * float(np.interp(here, course.s, self._limit))
            if not course.closed:
                wanted = min(wanted, float(np.sqrt(2.0 * _GAIN * max(course.s[-1] - s, 0.0))))
            v = min(max(wanted, v - _BRAKE * step), v + _GAIN * step)
            s += v * step
            self._speeds.append(v)
            self._along.append(s)

    def _drive(self, first: int) -> Drive:
        """The columns of the drive from a tick on."""
        course = self._course
        along, v = np.array(self._along[first:]), np.array(self._speeds[first:])
        lap, rest = np.divmod(along, course.s[-1]) if course.closed else (np.zeros_like(along), along)
        yaw = np.interp(rest, course.s, course.yaw) + lap * (course.yaw[-1] - course.yaw[0])
        return Drive(
            t=np.arange(first, first + along.size) / RATE_HZ,
            x=np.interp(rest, course.s, course.x),
            y=np.interp(rest, course.s, course.y),
            yaw=yaw,
            speed=v,
            yaw_rate=v * np.interp(rest, course.s, course.curvature),
        )

    def _look(self, k: int) -> Clearance:
        """What the robot's own sensor says of its way after sweep k."""
        first = k * self._ticks
        drive = self._drive(first)
        # The same phases each time, so that the pieces are those of one shaking.
        motion = lay_on_terrain(drive, self._scene.terrain, np.random.default_rng(self._seed))
        times = drive.t[0] + self._lidar.column_offsets_ns() * 1e-9
        R, o = _sensor_at(motion, times, self._T_base_lidar)
        solids = self._scene.solids_at(times, R, o)
        rng = np.random.default_rng([self._seed, k])
        swept = sweep_scene(self._lidar, solids, self._scene.terrain, R, o, 0, rng)
        twist = (float(drive.speed[-1]), 0.0, float(drive.yaw_rate[-1]))
        tilt = (float(motion.roll[0]), float(motion.pitch[0]))
        step = Step(k, swept.scan, Pose2(), *tilt, tilt_known=True, twist=twist)
        p = self._parameters
        points, sensor = acquire(step, self._T_base_lidar, p.acquisition)
        terrain = find_terrain(points, p.ground)
        seen = terrain if shows_ground(terrain) else None
        near = acquire_near(step, self._T_base_lidar, p.acquisition)
        found = find_clearance(points, near, seen, sensor, twist, p.obstacles)
        return found or Clearance(Zone.CLEAR)


def _sensor_at(motion: Motion, times: Float, T_base_lidar: Pose3) -> tuple[Float, Float]:
    """As `Motion.sensor_at`, of a motion that does not begin at time 0."""
    return motion.sensor_at(times - motion.drive.t[0], T_base_lidar)
