"""Recordings in which a clock was set: nothing crashes, and records left out are counted."""

from __future__ import annotations

from pathlib import Path

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
    stamps = [record.stamp_ns for record in source.records() if isinstance(record, Scan)]
    assert stamps == sorted(stamps)
    assert len(stamps) + sum(source.losses.values()) == SCANS
    if recorder_too:  # the times of both agree, so that all is kept
        assert len(stamps) == SCANS
    else:
        assert source.losses == {"messages with an impossible time stamp": SCANS - CHANGE}
