"""A robot that slows down and stops for obstacles in its path, by the obstacle detection of the pipeline."""

from __future__ import annotations

import numpy as np

from pipeline.config import Parameters
from pipeline.front_end import segment
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.simulation.lidar import SpinningLidar, sweep_scene
from pipeline.simulation.robot_motion import RATE_HZ, Course, Drive, lay_on_terrain, on_course, speed_limit
from pipeline.simulation.scene import SimulatedScene
from pipeline.types.records import Step, Zone

#: Share of the speed in each zone.
SPEED = {Zone.CLEAR: 1.0, Zone.SLOW: 0.4, Zone.STOP: 0.0, Zone.UNKNOWN: 0.0}
_GAIN, _BRAKE = 0.5, 1.5  # m/s^2
#: A coarse sensor; it still sees obstacles within a few metres.
_LIDAR = SpinningLidar(columns=225)
_TICKS = RATE_HZ * _LIDAR.period_ns // 1_000_000_000  # per sweep


def obstacle_aware_drive(
    course: Course, speed: float, scene: SimulatedScene, T_base_lidar: Pose3, seed: int, duration_s: float
) -> Drive:
    """Drive a course one sweep at a time from rest; the clearance after a sweep, by the default parameters,
    decides the speed of the next one. Each sweep is simulated with a coarse LiDAR.

    Args:
        course: The course. An open one is driven to its end, where the robot stops; a closed one repeatedly.
        speed: Speed on the straight [m/s].
        scene: The scene.
        T_base_lidar: Extrinsics of the LiDAR.
        seed: Random seed of the sensor.
        duration_s: Duration [s]; the result is a little longer.
    """
    limit, step = speed_limit(course, speed), 1.0 / RATE_HZ
    speeds, along = [0.0], [0.0]
    zone = Zone.STOP
    for k in range(int(np.ceil((duration_s + 0.5) * 1e9 / _LIDAR.period_ns)) + 1):
        share = SPEED[zone]
        v, s = speeds[-1], along[-1]
        for _ in range(_TICKS):
            here = s % course.s[-1] if course.closed else min(s, float(course.s[-1]))
            wanted = share * float(np.interp(here, course.s, limit))
            if not course.closed:
                wanted = min(wanted, float(np.sqrt(2.0 * _GAIN * max(course.s[-1] - s, 0.0))))
            v = min(max(wanted, v - _BRAKE * step), v + _GAIN * step)
            s += v * step
            speeds.append(v)
            along.append(s)
        latest = _drive(course, along, speeds, k * _TICKS)
        zone = _zone(latest, scene, T_base_lidar, seed, k)
    return _drive(course, along, speeds, 0)


def _drive(course: Course, along: list[float], speeds: list[float], first: int) -> Drive:
    """Return the drive along a course from tick `first` onwards, at RATE_HZ.

    Args:
        course: The course.
        along: Distance driven at each tick since the start [m].
        speeds: Speed at each tick [m/s].
        first: First tick.
    """
    t = np.arange(first, len(along)) / RATE_HZ
    return on_course(course, t, np.array(along[first:]), np.array(speeds[first:]))


def _zone(drive: Drive, scene: SimulatedScene, T_base_lidar: Pose3, seed: int, k: int) -> Zone:
    """Return the zone of obstacle detection after sweep k; CLEAR if there is no clearance.

    Args:
        drive: Motion during the sweep.
        scene: The scene.
        T_base_lidar: Pose of the sensor on the robot.
        seed: Random seed of vibration and noise.
        k: Number of the sweep.
    """
    # The same phases in each sweep, so that the pieces belong to one vibration.
    motion = lay_on_terrain(drive, scene.terrain, np.random.default_rng(seed))
    offsets = _LIDAR.column_offsets_ns() * 1e-9
    times = drive.t[0] + offsets
    R, o = motion.sensor_at(times - drive.t[0], T_base_lidar)
    solids = scene.solids_at(times, R, o)
    sweep = sweep_scene(_LIDAR, solids, scene.terrain, R, o, 0, np.random.default_rng([seed, k]))
    twist = (float(drive.speed[-1]), 0.0, float(drive.yaw_rate[-1]))
    tilt = (float(motion.roll[0]), float(motion.pitch[0]))
    step = Step(k, sweep.scan, Pose2(), *tilt, tilt_known=True, twist=twist)
    clearance = segment(step, _LIDAR.sensor, T_base_lidar, Parameters()).clearance
    return Zone.CLEAR if clearance is None else clearance.zone
