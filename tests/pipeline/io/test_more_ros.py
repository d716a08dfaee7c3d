"""Planar lasers in recordings, and the description of each topic by `info`; written by rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Geod

from app.cli import main
from pipeline.io.readers import SourceOptions
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, Write, points_of, write_recording

KINDS = ["bag", "db3", "mcap"]
BEAMS = 541
LATITUDE, LONGITUDE, BEARING = 61.5, 23.8, 37.0  # the robot begins there and looks so far from north [deg]
SIGMA = 0.3


def laser(author: Author, stamp_ns: int, **changes: Any) -> Any:
    """Half a circle and more of beams, 5 m each; the first too near, the last not a number."""
    ranges = np.full(BEAMS, 5.0, np.float32)
    ranges[0], ranges[-1] = 0.01, np.nan
    form = {
        "angle_min": -2.36, "angle_max": 2.36, "angle_increment": 4.72 / (BEAMS - 1), "time_increment": 1e-5,
        "scan_time": 0.1, "range_min": 0.1, "range_max": 30.0, "ranges": ranges,
        "intensities": np.ones(BEAMS, np.float32),
    }  # fmt: skip
    message = author.store.types["sensor_msgs/msg/LaserScan"]
    return message(author.header(stamp_ns, "laser"), *{**form, **changes}.values())


def fix(author: Author, stamp_ns: int, east_north: tuple[float, float], status: int = 0) -> Any:
    """A NavSatFix so many metres from where the robot began."""
    east, north = east_north
    azimuth, distance = np.degrees(np.arctan2(east, north)), np.hypot(east, north)
    longitude, latitude, _ = Geod(ellps="WGS84").fwd(LONGITUDE, LATITUDE, azimuth, distance)
    told = author.store.types["sensor_msgs/msg/NavSatStatus"](status, 1)
    covariance = np.diag([SIGMA**2, SIGMA**2, 1.0]).ravel()
    message = author.store.types["sensor_msgs/msg/NavSatFix"]
    return message(author.header(stamp_ns, "gps"), told, latitude, longitude, 100.0, covariance, 2)


def straight(author: Author, write: Write, *, metres: float = 40.0, odometry: bool = True) -> None:
    """A robot that drives along its x axis, with fixes twice a second and one message without a fix."""
    steps = 60
    rng = np.random.default_rng(1)
    for step in range(steps):
        stamp_ns, x = START_NS + step * STEP_NS, metres * step / (steps - 1)
        if odometry:
            write("/odom", "nav_msgs/msg/Odometry", stamp_ns, author.odometry(stamp_ns, x, 0.0))
        if step % 5 == 0:
            bearing = np.radians(BEARING)
            noise = rng.normal(0.0, 0.1, 2)
            east_north = (x * np.sin(bearing) + noise[0], x * np.cos(bearing) + noise[1])
            message = fix(author, stamp_ns, east_north, status=-1 if step == 50 else 0)
            write("/gps/fix", "sensor_msgs/msg/NavSatFix", stamp_ns, message)
        write("/scan", "sensor_msgs/msg/LaserScan", stamp_ns, laser(author, stamp_ns))


@pytest.mark.parametrize("kind", KINDS)
def test_a_planar_laser_is_a_source_with_its_preset(kind: str, tmp_path: Path, opened: Opened):
    source = opened(write_recording(kind, tmp_path, straight))
    known = source.description
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert (known.preset, known.sensor.rings, known.sensor.name) == ("laser2d", 1, "planar laser")
    assert known.sensor.azimuth_step == pytest.approx(4.72 / (BEAMS - 1), rel=1e-3)
    assert len(scans) == 60
    assert (len(scans[0].points), scans[0].dropped) == (BEAMS - 2, 2)
    np.testing.assert_allclose(np.linalg.norm(scans[0].points, axis=1), 5.0, rtol=1e-6)
    assert np.arctan2(scans[0].points[0, 1], scans[0].points[0, 0]) == pytest.approx(
        -2.36 + 4.72 / (BEAMS - 1)
    )
    assert scans[0].offset_ns is not None
    assert scans[0].offset_ns[0] == 10_000


def test_a_lidar_is_taken_before_the_bumper_and_info_says_why(
    tmp_path: Path, opened: Opened, capsys: pytest.CaptureFixture[str]
):
    def fill(author: Author, write: Write) -> None:
        straight(author, write)
        for step in range(12):
            stamp_ns = START_NS + step * STEP_NS
            cloud = author.cloud(stamp_ns, points_of(step))
            write("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, cloud)
            word = author.make("String", "hello")
            write("/talk", "std_msgs/msg/String", stamp_ns, word)

    path = write_recording("mcap", tmp_path, fill)
    source = opened(path)
    by_name = {topic.name: topic for topic in source.description.topics}
    assert (by_name["/points"].read_as, by_name["/gps/fix"].read_as) == ("scan", "gnss")
    assert by_name["/scan"].why_not == "/points sees in space"
    assert by_name["/talk"].why_not == "nothing is made of this type"
    chosen = opened(path, SourceOptions(topics={"scan": "/scan"}))
    assert chosen.description.sensor.rings == 1
    assert main(["info", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("/scan" in line and "not used: /points sees in space, could be scan" in line for line in lines)
    assert any("/points" in line and "10.0 Hz" in line and "used as scan" in line for line in lines)


@pytest.mark.parametrize(("turn_s", "timed"), [(0.0, False), (0.05, True), (1.9, True), (2.1, False)])
def test_beams_have_times_where_a_turn_takes_less_than_two_seconds(
    turn_s: float, timed: bool, tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        message = laser(author, START_NS, time_increment=turn_s / BEAMS)
        write("/scan", "sensor_msgs/msg/LaserScan", START_NS, message)

    source = opened(write_recording("mcap", tmp_path, fill))
    (scan,) = [record for record in source.records() if isinstance(record, Scan)]
    assert (scan.offset_ns is not None) == timed


@pytest.mark.parametrize(
    "changes",
    [
        {"angle_increment": 0.0}, {"angle_increment": float("nan")}, {"angle_min": float("inf")},
        {"angle_increment": 0.5}, {"ranges": np.full(BEAMS, np.inf, np.float32)}, {"time_increment": 1e9},
        {"intensities": np.ones(3, np.float32)},
    ],
)  # fmt: skip
def test_laser_scans_that_contradict_themselves_do_no_harm(
    changes: dict[str, Any], tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        for step in range(4):
            stamp_ns = START_NS + step * STEP_NS
            message = laser(author, stamp_ns, **(changes if step == 2 else {}))
            write("/scan", "sensor_msgs/msg/LaserScan", stamp_ns, message)

    source = opened(write_recording("mcap", tmp_path, fill))
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert len(scans) + sum(source.losses.values()) == 4
    assert all(np.isfinite(scan.points).all() for scan in scans)
