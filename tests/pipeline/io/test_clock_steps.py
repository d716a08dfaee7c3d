"""Recordings in which a clock was set: nothing crashes, and records left out are counted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io.readers import Source
from pipeline.types.records import Odometry, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, Write, points_of, write_recording

HOUR_NS = 3_600_000_000_000
SCANS, CHANGE = 12, 6


@pytest.mark.slow_after(9)
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
    stamps = [record.stamp_ns for record in source.records() if isinstance(record, Scan)]
    assert stamps == [begun_ns + k * STEP_NS for k in range(SCANS)]


@pytest.mark.slow_after(1)
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


#: Periods of scans and odometry, and delays of their recording [ns].
SCAN_NS, WHEELS_NS = 100_000_000, 20_000_000
SCAN_DELAY_NS, WHEELS_DELAY_NS = 104_000_000, 2_000_000
DRIVE_NS = 8_000_000_000
STEPS_S = (-86_400.0, -3600.0, -12.0, -7.0, -4.0, -2.5, -1.0, -0.5, -0.3, 0.3, 0.5, 2.0, 4.0, 7.0, 3600.0)


def stepped_drive(which: str, steps: dict[int, float]) -> Callable[[Author, Write], None]:
    """Scans and odometry of 8 s; the clock of one or all of them is set at some times [ns] by steps [s]."""

    def fill(author: Author, write: Write) -> None:
        rng = np.random.default_rng(3)
        events = []
        for topic, period_ns, delay_ns in (
            ("/points", SCAN_NS, SCAN_DELAY_NS), ("/odom", WHEELS_NS, WHEELS_DELAY_NS)
        ):  # fmt: skip
            for index in range(DRIVE_NS // period_ns):
                taken_ns = index * period_ns
                arrived_ns = taken_ns + delay_ns + int(rng.exponential(0.05 * delay_ns))
                events.append((arrived_ns, topic, index, taken_ns))
        for arrived_ns, topic, index, taken_ns in sorted(events):
            set_ns, logged_ns = (
                sum(round(size * 1e9) for at_ns, size in steps.items() if time_ns >= at_ns)
                for time_ns in (taken_ns, arrived_ns)
            )
            stamp_ns = START_NS + taken_ns + (set_ns if which in (topic, "stamps", "all") else 0)
            log_ns = START_NS + arrived_ns + (logged_ns if which == "all" else 0)
            if topic == "/odom":
                # The number of a reading is its position.
                message: Any = author.odometry(stamp_ns, float(index), 0.0)
                write(topic, "nav_msgs/msg/Odometry", log_ns, message)
            else:
                # The number of a scan is its reach.
                message = author.cloud(stamp_ns, points_of(index))
                write(topic, "sensor_msgs/msg/PointCloud2", log_ns, message)

    return fill


def check_order(source: Source, *, gap_ns: int = 0) -> None:
    """No record is lost; scans and odometry are in the order of the file, and beside each other as they were
    taken, to 30 ms; `gap_ns` is the time that the clock was set forward by."""
    records = list(source.records())
    assert not source.losses
    scans = [record for record in records if isinstance(record, Scan)]
    wheels = [record for record in records if isinstance(record, Odometry)]
    reach = [float(np.linalg.norm(scan.points[0])) for scan in scans]
    assert len(reach) == DRIVE_NS // SCAN_NS
    assert (np.diff(reach) > 0.9).all()
    np.testing.assert_allclose([w.T_odom_base.t[0] for w in wheels], np.arange(DRIVE_NS // WHEELS_NS))
    scan_ns = np.array([scan.stamp_ns for scan in scans])
    wheels_ns = np.array([reading.stamp_ns for reading in wheels])
    index = np.rint(np.array(reach) - 5.0).astype(int)
    beside = scan_ns - wheels_ns[SCAN_NS // WHEELS_NS * index]
    assert np.abs(beside).max() <= 30_000_000
    for stamps, due_ns in ((scan_ns, SCAN_NS * np.diff(index)), (wheels_ns, WHEELS_NS)):
        steps = np.diff(stamps) - due_ns
        assert np.abs(steps[np.abs(steps) < gap_ns / 2] if gap_ns else steps).max() <= 60_000_000
        assert (np.diff(stamps) > 0).all()


@pytest.mark.slow_after(5)
@pytest.mark.parametrize("which", ["/points", "/odom", "stamps", "all"])
@pytest.mark.parametrize("step_s", STEPS_S)
def test_any_step_of_any_clock_keeps_the_order_of_the_file(
    which: str, step_s: float, tmp_path: Path, opened: Opened
):
    source = opened(write_recording("mcap", tmp_path, stepped_drive(which, {5_050_000_000: step_s})))
    # Nothing shows that the time did not pass when all clocks are set forward.
    check_order(source, gap_ns=round(step_s * 1e9) if which == "all" and step_s > 0 else 0)


@pytest.mark.slow_after(4)
@pytest.mark.parametrize("kind", ["bag", "db3"])
@pytest.mark.parametrize("which", ["/points", "/odom", "stamps", "all"])
def test_a_clock_that_is_set_several_times(kind: str, which: str, tmp_path: Path, opened: Opened):
    steps = {3_010_000_000: -0.5, 5_030_000_000: -7.0, 7_000_000_000: -0.3}
    check_order(opened(write_recording(kind, tmp_path, stepped_drive(which, steps))))


def test_two_lidars_on_one_topic_with_other_delays_are_no_steps(tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        places = [("base_link", name, (0.0, 0.0, 1.0, 0.0)) for name in ("front", "rear")]
        write("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, author.transforms(START_NS, *places))
        for index in range(100):
            frame, delay_ns = ("front", 110_000_000) if index % 2 else ("rear", 350_000_000)
            stamp_ns = START_NS + index * 50_000_000
            write_at = stamp_ns + delay_ns
            events.append((write_at, author.cloud(stamp_ns, points_of(index), frame)))
        for log_ns, cloud in sorted(events, key=lambda event: event[0]):
            write("/points", "sensor_msgs/msg/PointCloud2", log_ns, cloud)

    events: list[tuple[int, Any]] = []
    source = opened(write_recording("mcap", tmp_path, fill))
    stamps = [record.stamp_ns for record in source.records() if isinstance(record, Scan)]
    assert stamps == [START_NS + k * 50_000_000 for k in range(100)]
    assert not source.losses


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("begun_s", [12.3, 946_684_800.0, START_NS * 1e-9 + 37.0, START_NS * 1e-9 - 3.0])
@pytest.mark.parametrize("other", ["/points", "/odom"])
def test_a_topic_by_another_clock_is_aligned_without_its_delay(
    begun_s: float, other: str, tmp_path: Path, opened: Opened
):
    """The scans are recorded when their sweep of 98 ms is complete, which is no delay."""
    begun_ns = round(begun_s * 1e9)

    def fill(author: Author, write: Write) -> None:
        events = []
        for index in range(100):
            stamp_ns = index * SCAN_NS
            table = points_of(index)
            table["time"] = np.linspace(0.0, 0.098, len(table))
            at_ns = stamp_ns + (begun_ns if other == "/points" else START_NS)
            events.append((stamp_ns + SCAN_DELAY_NS, "/points", author.cloud(at_ns, table)))
        for index in range(500):
            stamp_ns = index * WHEELS_NS
            at_ns = stamp_ns + (begun_ns if other == "/odom" else START_NS)
            events.append((stamp_ns + WHEELS_DELAY_NS, "/odom", author.odometry(at_ns, 0.0, 0.0)))
        for arrived_ns, topic, message in sorted(events, key=lambda event: event[0]):
            kind = "sensor_msgs/msg/PointCloud2" if topic == "/points" else "nav_msgs/msg/Odometry"
            write(topic, kind, START_NS + arrived_ns, message)

    source = opened(write_recording("mcap", tmp_path, fill))
    records = list(source.records())
    scan_ns = np.array([record.stamp_ns for record in records if isinstance(record, Scan)])
    wheels_ns = np.array([record.stamp_ns for record in records if isinstance(record, Odometry)])
    assert len(scan_ns) == 100
    # Left are the transport of 6 ms and of 2 ms.
    assert np.abs(scan_ns - wheels_ns[::5]).max() <= 5_000_000
    assert any("another clock" in warning and other in warning for warning in source.description.warnings)
