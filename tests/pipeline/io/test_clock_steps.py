"""Recordings in which a clock was set: nothing crashes, and records left out are counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, Write, points_of, write_recording

HOUR_NS = 3_600_000_000_000
SCANS, CHANGE = 12, 6


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, -START_NS + 10**9], ids=["+1h", "-1h", "1970"])
@pytest.mark.parametrize("recorder_too", [True, False])
def test_a_clock_that_is_set_on_the_way(
    kind: str, step_ns: int, recorder_too: bool, tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        for index in range(SCANS):
            shift = step_ns if index >= CHANGE else 0
            stamp_ns = START_NS + index * STEP_NS + shift
            log_ns = stamp_ns if recorder_too else stamp_ns - shift
            cloud = author.cloud(stamp_ns, points_of(index))
            write("/points", "sensor_msgs/msg/PointCloud2", log_ns, cloud)

    source = opened(write_recording(kind, tmp_path, fill))
    scans = [record for record in source.records() if isinstance(record, Scan)]
    reach = [float(np.linalg.norm(scan.points[0])) for scan in scans]
    np.testing.assert_allclose(reach, 5.0 + np.arange(SCANS), atol=0.01)  # in the order of the file
    stamps = np.array([scan.stamp_ns for scan in scans])
    if recorder_too and step_ns > 0:  # nothing shows that an hour did not pass
        stamps[CHANGE:] -= step_ns
    np.testing.assert_array_equal(stamps, START_NS + STEP_NS * np.arange(SCANS))
    assert not source.losses
    assert any("clock" in warning for warning in source.description.warnings) == (
        not recorder_too or step_ns < 0
    )


def test_behind_a_step_the_times_go_on_in_the_clock_of_the_sensor(tmp_path: Path, opened: Opened):
    begun_ns = 10**12  # the clock of the sensor counts from its start

    def fill(author: Author, write: Write) -> None:
        for index in range(SCANS):
            stamp_ns = begun_ns + index * STEP_NS + (HOUR_NS if index >= CHANGE else 0)
            log_ns = START_NS + index * STEP_NS
            write("/points", "sensor_msgs/msg/PointCloud2", log_ns, author.cloud(stamp_ns, points_of(index)))

    source = opened(write_recording("mcap", tmp_path, fill))
    stamps = [record.stamp_ns for record in source.records()]
    assert stamps == [begun_ns + k * STEP_NS for k in range(SCANS)]


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_topics_that_were_written_one_after_the_other_are_no_step(kind: str, tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for index in range(200):
            stamp_ns = START_NS + index * STEP_NS
            write("/odom", "nav_msgs/msg/Odometry", stamp_ns, author.odometry(stamp_ns, 0.1 * index, 0.0))
        for index in range(200):
            stamp_ns = START_NS + index * STEP_NS
            write(
                "/points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, points_of(index))
            )

    source = opened(write_recording(kind, tmp_path, fill))
    stamps = [record.stamp_ns for record in source.records()]
    assert stamps == sorted([START_NS + k * STEP_NS for k in range(200)] * 2)
    assert not any("clock" in warning for warning in source.description.warnings)
