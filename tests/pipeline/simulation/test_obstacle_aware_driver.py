"""Obstacle-aware driver: the simulated robot slows down and stops for obstacles, and continues when the path
is free."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from pipeline.config import Parameters
from pipeline.front_end import segment
from pipeline.geometry.poses import Pose2
from pipeline.simulation.robot_motion import RATE_HZ
from pipeline.simulation.run import MOUNTING, SimulatedRun, open_run
from pipeline.simulation.scenarios import parse_uri
from pipeline.types.records import Step, Zone

P = Parameters().obstacles


@cache
def crossing() -> SimulatedRun:
    return open_run(parse_uri("sim:crossing?duration=32"))


def gap(run: SimulatedRun) -> np.ndarray:
    """From the middle of the robot's front to the nearest person or the trunk in its way, shape (T,) [m]."""
    drive = run.motion.drive
    front = np.stack([drive.x + P.reach * np.cos(drive.yaw), drive.y + P.reach * np.sin(drive.yaw)], axis=1)
    away = [np.hypot(*(front - [18.0, 0.05]).T) - 0.2]
    for person in run.scene.persons:
        at = np.array([person.place(float(t))[0] for t in drive.t])
        away.append(np.hypot(*(front - at).T) - 0.25)
    nearest: np.ndarray = np.min(away, axis=0)
    return nearest


def test_it_never_comes_near_anything_and_stops_for_good_before_the_trunk():
    run = crossing()
    drive = run.motion.drive
    # A person who steps onto the way within the stop zone is braked for, at 1.5 m/s^2.
    assert gap(run).min() > 0.15
    still = drive.speed < 1e-6
    assert still[-2 * RATE_HZ :].all()
    assert drive.x[-1] + P.reach == pytest.approx(18.0 - 0.2 - P.stop_distance, abs=0.25)


def test_it_waits_for_a_person_and_goes_on():
    drive = crossing().motion.drive
    stands = (drive.speed < 1e-6) & (drive.t > 1.0)
    begins = np.flatnonzero(np.diff(stands.astype(int)) == 1)
    assert len(begins) >= 2, "once for a person at least, and for the trunk"
    assert (drive.speed[begins[0] :] > 0.7).any()
    assert np.abs(np.diff(drive.speed)).max() * RATE_HZ <= 1.5 + 1e-6
    assert (np.diff(drive.x) >= -1e-6).all()


def test_the_pipeline_tells_the_same_of_the_standing_robot():
    run = crossing()
    swept = run.sweep(run.scans - 1).scan
    step = Step(0, swept, Pose2())
    clearance = segment(step, run.lidar.sensor, MOUNTING, Parameters()).clearance
    assert clearance is not None
    assert clearance.zone is Zone.STOP


def test_the_same_request_drives_the_same_path():
    request = parse_uri("sim:crossing?duration=3")
    first, second = open_run(request).motion.drive, open_run(request).motion.drive
    np.testing.assert_array_equal(first.x, second.x)
