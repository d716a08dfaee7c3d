"""What was driven, by one drive or by several on one path."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import app.sources  # noqa: F401 - adds the formats of packets
from app.batch.saved_run import RunSource
from app.batch.summary import breaks_of, driven, left_out_warning, unread_scans
from pipeline.io.readers.base import RecordedTopic
from pipeline.types.records import Path

STEP = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.integers(1, 10**10))


def path_of(steps):
    """A path from the origin by steps x, y [m], time [ns]."""
    rows = np.cumsum([(0.0, 0.0), *((x, y) for x, y, _ in steps)], axis=0)
    stamps = np.cumsum([0, *(t for _, _, t in steps)])
    still = np.zeros(len(rows))
    return Path(stamps, rows[:, 0], rows[:, 1], still, still)


@given(st.lists(STEP, max_size=20), st.lists(STEP, max_size=20), STEP)
def test_two_drives_are_as_long_as_each_of_them(first, second, jump):
    both = driven(path_of([*first, jump, *second]), [len(first) + 1])
    apart = np.add(driven(path_of(first)), driven(path_of(second)))
    assert both == pytest.approx(apart, abs=1e-9)


@given(st.lists(STEP, max_size=20), st.lists(st.integers(-1, 25), max_size=3))
def test_the_parts_of_a_long_drive_make_the_whole(steps, breaks):
    whole = driven(path_of(steps), breaks)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("app.batch.summary._ROWS", 3)
        assert driven(path_of(steps), breaks) == pytest.approx(whole, abs=1e-9)


def test_a_long_drive_is_added_up_without_copies_of_it():
    rows = np.arange(1_000_000)
    still = np.zeros(len(rows))
    path = Path(rows * 10**8, np.linspace(0.0, 99_999.9, len(rows)), still, still, still)
    tracemalloc.start()
    try:
        assert driven(path) == pytest.approx((99_999.9, 99_999.9))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000  # a copy of a column has 8 MB
    finally:
        tracemalloc.stop()


def test_a_pose_that_is_set_elsewhere_is_not_driven():
    drive = [(0.1, 0.0, 10**8)] * 30
    begun_anew, found = (-3.0, 0.0, 76 * 10**9), (16.4, 0.0, 10**8)
    assert driven(path_of([*drive, begun_anew, *drive, found, *drive]))[1] == pytest.approx(9.0)
    scans_lost = (12.0, 0.0, 6 * 10**9)
    assert driven(path_of([*drive, scans_lost]))[1] == pytest.approx(15.0), "the odometry went on"


def test_a_robot_that_stops_for_each_scan_has_driven():
    assert driven(path_of([(5.0, 0.0, 60 * 10**9)] * 10))[1] == pytest.approx(50.0)


def test_the_same_drive_that_goes_on_is_one():
    starts = ("origin", "resume", "constellation", "given", "last", "merged")
    sources = [RunSource("run", "", 10 * k, start, (0, 0, 0), 0, 0) for k, start in enumerate(starts)]
    assert breaks_of(sources) == [20, 30, 40, 50]


def test_no_path_is_no_drive():
    nothing = np.zeros(0)
    assert driven(Path(nothing.astype(np.int64), nothing, nothing, nothing, nothing)) == (0.0, 0.0)


def test_only_scans_that_are_not_mapped_count_as_left_out():
    """LiDAR odometry may not place a scan; the scan is mapped nevertheless."""
    assert left_out_warning({"poses of scans that LiDAR odometry could not place": 2}, 4) == ""
    assert "2 of 6 scans" in left_out_warning({"scans without points": 2}, 4)


def test_a_second_lidar_that_is_not_read_is_named():
    points, cloud = ("sensor_msgs/msg/PointCloud2", 100), RecordedTopic
    read, second = cloud("/front/points", *points, "scan", "scan"), cloud("/rear/points", *points, "", "scan")
    empty = cloud("/old/points", points[0], 0, "", "scan")
    assert unread_scans([read, empty]) == []
    (line,) = unread_scans([read, second, empty])
    assert line.startswith("not read: /rear/points, ")
    assert "--topic scan=NAME" in line


def test_topics_of_the_lidar_that_is_read_are_no_further_ones():
    cloud = RecordedTopic("/points", "sensor_msgs/msg/PointCloud2", 100, "scan", "scan", frame="lidar")
    packets = RecordedTopic("/packets", "velodyne_msgs/msg/VelodyneScan", 100, "", "scan", frame="lidar")
    assert unread_scans([cloud, packets]) == []


def test_packets_beside_a_planar_lidar_are_named():
    planar = RecordedTopic("/scan", "sensor_msgs/msg/LaserScan", 100, "scan", "scan", frame="laser")
    packets = RecordedTopic("/ouster/lidar_packets", "ouster_ros/msg/PacketMsg", 1000, "", "")
    (line,) = unread_scans([planar, packets])
    assert "/ouster/lidar_packets" in line
    assert unread_scans([replace(planar, type="sensor_msgs/msg/PointCloud2"), packets]) == []
