"""Messages as they come become the records that a recording of them gives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import SourceOptions, open_source
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.live import OPENING_LIMIT, ArrivalReader
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.message_time import Clock, Opening
from pipeline.io.readers.topics import ODOMETRY, POINT_CLOUD
from pipeline.types.records import Notice, Odometry, PoseMeasurement, Record, Scan
from tests.app.robot.conftest import SCANS
from tests.pipeline.io.recordings import SCANS as WRITTEN
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, points_of, write_recording
from tests.pipeline.io.test_more_ros import straight
from tests.pipeline.io.test_ros import begin_with_nothing

SECOND = 1_000_000_000
SCAN, WHEELS = 1, 2


def read(channels: list[Channel], messages: Iterator[Message]) -> tuple[ArrivalReader, list[Record]]:
    reader = ArrivalReader("here", "live", channels, SourceOptions())
    records = [record for message in messages for record in reader.add(message)]
    return reader, records + reader.finish()


def test_a_row_of_messages_gives_the_records_of_its_file(drive: Path):
    with closing(McapFile(drive)) as container, closing(open_source(str(drive))) as source:
        numbers = [channel.number for channel in container.channels]
        reader, records = read(container.channels, container.messages(numbers, None, {}))
        assert reader.description is not None
        assert reader.description.has_odometry
        np.testing.assert_allclose(reader.description.T_base_lidar.t, source.description.T_base_lidar.t)
        assert reader.losses == {}
        ours = [record.stamp_ns for record in records if isinstance(record, Scan)]
        theirs = [record.stamp_ns for record in source.records() if isinstance(record, Scan)]
        assert ours == theirs
        assert len(ours) == SCANS
        assert not any(isinstance(record, Notice) for record in records)


def test_a_fixed_transform_after_the_first_scans_is_told_and_not_used(drive: Path):
    with closing(McapFile(drive)) as container:
        (fixed,) = [c.number for c in container.channels if c.topic.endswith("tf_static")]
        messages = list(container.messages([c.number for c in container.channels], None, {}))
    (mounting, *_) = [message for message in messages if message.channel == fixed]
    others = [message for message in messages if message.channel != fixed]
    late = [replace(mounting, log_ns=message.log_ns) for message in others[-2:]]  # it is sent twice
    for rest, warnings in (([*others, *late], 1), ([mounting, *others, *late], 0)):
        reader, records = read(container.channels, iter(rest))
        assert reader.description is not None
        assert (reader.description.T_base_lidar.t[2] == 0.9) == (warnings == 0)
        notices = [record.text for record in records if isinstance(record, Notice)]
        assert len(notices) == warnings
        assert all("arrived after the first scans and is not used" in notice for notice in notices)
    options = SourceOptions(T_base_lidar=Pose3.identity())
    reader = ArrivalReader("here", "live", container.channels, options)
    assert not any(isinstance(r, Notice) for message in [*others, *late] for r in reader.add(message))


def test_a_planar_laser_and_fixes_count_live_too(tmp_path: Path):
    drive = write_recording("mcap", tmp_path, lambda author, write: straight(author, write, metres=120.0))
    with closing(McapFile(next(drive.rglob("*.mcap")))) as container:
        numbers = [channel.number for channel in container.channels]
        reader, records = read(container.channels, container.messages(numbers, None, {}))
    assert reader.description is not None
    assert reader.description.preset == "laser2d"
    assert "driven far enough" in reader.description.gnss
    assert sum(isinstance(record, Scan) for record in records) == 60
    assert [n.text for n in records if isinstance(n, Notice) and "north is known" in n.text]
    measured = [record for record in records if isinstance(record, PoseMeasurement)]
    assert len(measured) >= 2
    for pose in measured:
        ahead = 120.0 * (pose.stamp_ns - START_NS) / STEP_NS / 59
        np.testing.assert_allclose([pose.T_map_base.x, pose.T_map_base.y], [ahead, 0.0], atol=1.0)


def test_fixes_beside_a_robot_that_stands_tell_nothing(tmp_path: Path):
    drive = write_recording("mcap", tmp_path, lambda author, write: straight(author, write, metres=3.0))
    with closing(McapFile(next(drive.rglob("*.mcap")))) as container:
        numbers = [channel.number for channel in container.channels]
        _, records = read(container.channels, container.messages(numbers, None, {}))
    assert not any(isinstance(record, PoseMeasurement) for record in records)


def test_nothing_is_known_before_a_scan_and_memory_is_bounded(drive: Path):
    with closing(McapFile(drive)) as container:
        wheels = next(c.number for c in container.channels if c.msgtype == ODOMETRY)
        reader = ArrivalReader("here", "live", container.channels, SourceOptions())
        (first, *_) = container.messages([wheels], None, {})
        for k in range(2 * OPENING_LIMIT):
            assert reader.add(replace(first, log_ns=k)) == []
        assert reader.description is None
        waiting = len(reader._opening)
        assert waiting <= OPENING_LIMIT
        assert reader.losses == {"messages that waited too long for scans": 2 * OPENING_LIMIT - waiting}


def test_scans_that_nobody_can_read_are_an_error_in_the_end():
    channel = Channel(1, "/points", POINT_CLOUD, "cdr")
    reader = ArrivalReader("here", "live", [channel], SourceOptions())

    def send() -> None:
        for k in range(200):
            reader.add(Message(1, k * SECOND // 10, b"\x00\x01\x00\x00" + bytes(40)))

    with pytest.raises(SourceError, match="cannot be read"):
        send()


def test_empty_scans_at_the_start_are_waited_out(tmp_path: Path):
    path = write_recording("mcap", tmp_path, begin_with_nothing)
    with closing(McapFile(next(path.rglob("*.mcap")))) as container:
        numbers = [channel.number for channel in container.channels]
        reader, records = read(container.channels, container.messages(numbers, None, {}))
    assert sum(isinstance(record, Scan) for record in records) == WRITTEN
    assert sum(reader.losses.values()) == 60


def test_a_run_of_empty_scans_alone_is_an_error_at_its_end():
    author = Author("mcap")
    cloud = author.store.serialize_cdr(author.cloud(0, points_of(0)[:0]), POINT_CLOUD)
    channel = Channel(1, "/points", POINT_CLOUD, "cdr")
    with pytest.raises(SourceError, match="no points"):
        read([channel], (Message(1, k * SECOND // 10, bytes(cloud)) for k in range(400)))


def clock(start_ns: int, late_ns: int = 0) -> Clock:
    """A clock of two topics, of which scans arrive late."""
    late, first = [(start_ns + late_ns, start_ns)], [(start_ns, start_ns)]
    return Clock([Opening("/points", frozenset({SCAN}), late), Opening("/odom", frozenset({WHEELS}), first)])


@given(st.integers(-2_000_000_000, 4 * 10**9), st.integers(1, 400), st.integers(-SECOND // 4, SECOND // 4))
def test_times_go_on_evenly_when_the_clock_is_set(step_s: int, delay_ms: int, jitter_ns: int):
    """Stamps of two topics at 10 Hz; after the tenth their clock is set, each message comes late by
    something of its own."""
    start = 2_000_000_000 * SECOND
    step_ns = step_s * SECOND
    late = delay_ms * 1_000_000
    ours = clock(start, late)
    times: dict[int, list[int]] = {SCAN: [], WHEELS: []}
    for k in range(30):
        true_ns = start + k * SECOND // 10
        stamp_ns = true_ns + (step_ns if k >= 10 else 0)
        for channel, extra in ((WHEELS, 0), (SCAN, late + (jitter_ns if k % 2 else 0) // 1000)):
            found = ours.time_of(stamp_ns, Message(channel, true_ns + extra, b""))
            assert found is not None
            times[channel].append(found)
    assert len(ours.notices) == (step_s != 0)
    # The step is measured by one arrival, whose lateness nobody knows.
    assert np.all(np.abs(np.diff(times[WHEELS]) - SECOND // 10) <= SECOND // 2)
    shift = np.array(times[SCAN]) - np.array(times[WHEELS])
    assert np.all(shift == 0), "both topics take the same shift"


def test_late_messages_are_no_step():
    start = 1_700_000_000 * SECOND
    ours = clock(start)
    arrivals = [0.0, 0.1, 0.2, 8.0, 8.001, 8.002, 8.1]  # the network stood still for eight seconds
    stamps = [0.0, 0.1, 0.2, 0.3, 4.0, 7.9, 8.1]
    for came, stamped in zip(arrivals, stamps, strict=True):
        stamp_ns = start + round(stamped * SECOND)
        assert ours.time_of(stamp_ns, Message(SCAN, start + round(came * SECOND), b"")) == stamp_ns
    assert ours.notices == []


def test_one_message_out_of_order_is_no_step():
    start = 1_700_000_000 * SECOND
    ours = clock(start)
    stamps = [0.0, 0.1, 0.2, 0.4, 0.5, 0.3, 0.6, 0.7, 0.8]
    arrivals = [0.0, 0.1, 0.2, 0.4, 0.5, 0.501, 0.62, 0.7, 0.8]
    times = [
        ours.time_of(start + round(s * SECOND), Message(SCAN, start + round(a * SECOND), b""))
        for s, a in zip(stamps, arrivals, strict=True)
    ]
    assert times[-3:] == [start + round(s * SECOND) for s in stamps[-3:]]


def test_stamps_that_became_zero_are_told_by_their_arrival():
    start = 1_700_000_000 * SECOND
    ours = clock(start)
    assert ours.time_of(start, Message(SCAN, start, b"")) == start
    assert ours.time_of(0, Message(SCAN, start + SECOND, b"")) == start + SECOND
    assert ours.time_of(None, Message(WHEELS, start + SECOND, b"")) == start + SECOND


def test_odometry_is_in_its_own_order(drive: Path):
    with closing(McapFile(drive)) as container:
        numbers = [channel.number for channel in container.channels]
        _, records = read(container.channels, container.messages(numbers, None, {}))
    stamps = [record.stamp_ns for record in records if isinstance(record, Odometry)]
    assert stamps == sorted(stamps)
    assert len(stamps) == 5 * SCANS + 1
