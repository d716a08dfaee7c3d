"""Simulated drives for the motion from the LiDAR alone: a run whose robot drives faster and slower than its
scenario does, turns at up to 60 degrees/s and stands for 10 s."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from pipeline.io.readers.simulated import SimulatedSource
from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar
from pipeline.simulation.robot_motion import (
    ACCELERATION,
    RATE_HZ,
    Drive,
    drive_course,
    inertial_readings,
    lay_course,
    lay_on_terrain,
)
from pipeline.simulation.run import INERTIAL, SHAKE, odometry_of, open_run, random_stream
from pipeline.simulation.scenarios import parse_uri
from pipeline.simulation.terrain import WheelContact
from pipeline.types.records import Float, Imu, Odometry, Record

STANDSTILL_S = 10.0
TURN_S = 6.0  # s, duration of the turn on the spot
TURN_RATE = np.radians(60.0)  # rad/s
TURN = TURN_RATE * TURN_S / np.pi  # rad, 115 degrees
WILD = "wild"


def lidar_drive(
    name: str, seed: int, speed: float, duration_s: float, *, one_way: bool = False
) -> SimulatedSource:
    """Return a run of a scenario that is driven at a speed [m/s], with two standstills of 10 s.

    The course is that of the scenario. In the second standstill the robot turns on the spot by 115 degrees
    and back, at up to 60 degrees/s.

    Args:
        name: Name of the scenario.
        seed: Seed of the scene and of all noise.
        speed: Speed on the straight [m/s].
        duration_s: Duration [s].
        one_way: Whether the sensor is a solid-state LiDAR with a field of view of 70 degrees and not a
            VLP-16.
    """
    run = open_run(parse_uri(f"sim:{name}?seed={seed}&duration={duration_s}"))
    scenario = run.request.scenario
    course = lay_course(np.array(scenario.waypoints), scenario.closed)
    pace = speed / scenario.speed
    usual = drive_course(course, scenario.speed, duration_s * max(pace, 1.0) + 1.0)
    ground = WheelContact(run.scene.terrain) if name == WILD else run.scene.terrain
    drive = _turned(
        _stretched(usual, _paces(pace, duration_s, ACCELERATION / scenario.speed)), 0.5 * duration_s + 3.0
    )
    motion = lay_on_terrain(drive, ground, random_stream(SHAKE, run.request))
    sigma = run.lidar.range_sigma
    lidar: SpinningLidar = SpinningLidar(range_sigma=sigma)
    if one_way:
        lidar = SolidStateLidar(range_sigma=sigma, pattern=seed)
    run = replace(
        run,
        lidar=lidar,
        motion=motion,
        odometry=odometry_of(motion, run.request),
        inertial=inertial_readings(motion, random_stream(INERTIAL, run.request)),
        scans=round(duration_s * 1e9) // lidar.period_ns,
    )
    return SimulatedSource(f"sim:{name}?seed={seed}", run)


def lidar_records(records: Iterable[Record], *, imu: bool = False) -> Iterator[Record]:
    """Yield the scans among the records of a run, with the readings of the IMU on request, and no
    odometry."""
    for record in records:
        if not isinstance(record, Odometry) and (imu or not isinstance(record, Imu)):
            yield record


def _paces(pace: float, duration_s: float, gain: float) -> Float:
    """Return how fast the time of the usual drive passes at each tick of RATE_HZ: `pace`, and 0 during the
    standstills, which begin at 2 s and at the middle; it changes by at most `gain` per second."""
    t = np.arange(int((duration_s + 0.5) * RATE_HZ) + 1) / RATE_HZ
    wanted = np.full(len(t), pace)
    for begin in (2.0, 0.5 * duration_s):
        wanted[(t >= begin) & (t < begin + STANDSTILL_S)] = 0.0
    reached = np.empty(len(t))
    reached[0] = now = min(pace, 1.0)
    for k in range(1, len(t)):
        now += float(np.clip(wanted[k] - now, -gain / RATE_HZ, gain / RATE_HZ))
        reached[k] = now
    return reached


def _turned(drive: Drive, begin_s: float) -> Drive:
    """Return a drive that turns on the spot by TURN and back from a time of its standstill onwards, with
    TURN_RATE at most."""
    since = np.clip((drive.t - begin_s) / TURN_S, 0.0, 1.0)
    yaw = drive.yaw + 0.5 * TURN * (1.0 - np.cos(2.0 * np.pi * since))
    rate = np.where((since > 0.0) & (since < 1.0), TURN_RATE * np.sin(2.0 * np.pi * since), 0.0)
    return replace(drive, yaw=yaw, yaw_rate=drive.yaw_rate + rate)


def _stretched(drive: Drive, pace: Float) -> Drive:
    """Return a drive whose time passes at another pace."""
    at = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]))]) / RATE_HZ
    x, y, yaw, speed, rate = (
        np.interp(at, drive.t, column)
        for column in (drive.x, drive.y, drive.yaw, drive.speed, drive.yaw_rate)
    )
    return Drive(np.arange(len(pace)) / RATE_HZ, x, y, yaw, speed * pace, rate * pace)
