"""Times of points: unit and clock follow from the span over a sweep and from scan to scan."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.io.readers.point_times import PointTimes, TimedScan, decide_point_times
from pipeline.io.readers.ros_records import cloud_columns
from pipeline.io.readers.scan_columns import scan_of
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, Author, Write, points_of, write_recording
from tests.pipeline.io.test_pointcloud2 import XYZ, encode

PERIOD_NS, POINTS, SCANS = 100_000_000, 400, 10
STAMPS = START_NS + PERIOD_NS * np.arange(SCANS)
#: Times of the points after the first one of a sweep [ns].
SWEEP = np.linspace(0.0, 0.98 * PERIOD_NS, POINTS)
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def decided(columns: list[NDArray[Any]], name: str = "time", **more: Any) -> PointTimes:
    scans = [TimedScan(int(s), {name: c}) for s, c in zip(STAMPS, columns, strict=True)]
    times, why = decide_point_times(scans, **more)
    assert times is not None, why
    return times


def after(times: PointTimes, column: NDArray[Any], scan: int = 0) -> NDArray[Any]:
    offset_ns = times.offsets(column, int(STAMPS[scan]))
    assert offset_ns is not None
    return offset_ns


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize(
    "begin_ns", [0.0, -0.98 * PERIOD_NS, -0.49 * PERIOD_NS], ids=["start", "end", "middle"]
)
@pytest.mark.parametrize("kind", ["f4", "f8", "i4", "u4", "i8"])
def test_times_after_the_stamp_are_read_in_any_unit(unit: str, begin_ns: float, kind: str):
    if kind[0] != "f" and (unit in ("s", "ms") or (begin_ns < 0 and kind[0] == "u")):
        pytest.skip("a number of this kind does not hold these times")
    column = ((begin_ns + SWEEP) / UNITS[unit]).astype(kind)
    times = decided([column] * SCANS)
    assert (times.unit_ns, times.origin) == (UNITS[unit], "stamp")
    np.testing.assert_allclose(after(times, column), begin_ns + SWEEP, atol=1_000)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("kind", ["f8", "u8", "i8"])
def test_times_since_1970_are_those_of_the_stamps(unit: str, kind: str):
    if kind != "f8" and unit in ("s", "ms"):
        pytest.skip("an integer does not hold these times")
    size = UNITS[unit]
    columns = [
        ((int(s) // size) + (int(s) % size + SWEEP) / size).astype(kind)
        if kind == "f8"
        else (np.int64(s) + SWEEP.astype(np.int64)).astype(np.int64) // size
        for s in STAMPS
    ]
    columns = [c.astype(kind) for c in columns]
    times = decided(columns, "timestamp")
    assert (times.unit_ns, times.origin) == (size, "clock")
    np.testing.assert_allclose(after(times, columns[3], 3), SWEEP, atol=2_000)


@pytest.mark.parametrize("begun_s", [0.0, 37.0, 946_684_800.0])
@pytest.mark.parametrize("delay_ns", [0, 105_000_000, 12_000_000])
def test_another_clock_gives_the_times_from_the_first_or_the_last_point(begun_s: float, delay_ns: int):
    columns = [begun_s + (PERIOD_NS * (k + 2) + SWEEP) * 1e-9 for k in range(SCANS)]
    times = decided(columns, delay_ns=delay_ns)
    # A scan that is recorded 12 ms after its stamp was stamped at its end.
    end_ns = SWEEP[-1] if delay_ns == 12_000_000 else 0.0
    assert times.origin == ("last" if end_ns else "first")
    np.testing.assert_allclose(after(times, columns[5], 5), SWEEP - end_ns, atol=200)


def test_a_counter_that_wraps_around_within_a_sweep():
    begun = np.uint32(2**32 - 30_000_000)  # ns
    columns = [begun + (PERIOD_NS * k + SWEEP).astype(np.uint32) for k in range(SCANS)]
    assert columns[0].max() > columns[0][-1]
    times = decided(columns, "t")
    assert (times.unit_ns, times.origin) == (1, "first")
    np.testing.assert_allclose(after(times, columns[0]), SWEEP, atol=2)


def test_points_in_any_order_keep_their_times():
    rng = np.random.default_rng(1)
    column = rng.permutation(SWEEP) * 1e-9
    np.testing.assert_allclose(after(decided([column] * SCANS), column), column * 1e9, atol=1)


def test_a_few_damaged_times_spoil_no_others():
    column = SWEEP * 1e-9
    column[[3, 50, 200]] = 7.5e8, np.nan, -4.0
    times = decided([column] * SCANS)
    offset_ns, sound = after(times, column), np.delete(np.arange(POINTS), [3, 50, 200])
    np.testing.assert_allclose(offset_ns[sound], SWEEP[sound], atol=1)
    assert (np.abs(offset_ns[[3, 50, 200]] - np.median(SWEEP)) < 1e6).all()


def test_half_a_sweep_and_a_topic_that_was_thinned_out_keep_the_unit():
    half = SWEEP[: POINTS // 2] * 1e-9
    assert decided([half] * SCANS).unit_ns == 10**9
    slow = [TimedScan(START_NS + k * 10**10, {"t": SWEEP.astype(np.uint32)}) for k in range(3)]
    times, _ = decide_point_times(slow)
    assert times is not None
    assert times.unit_ns == 1


@pytest.mark.parametrize("column", [np.zeros(POINTS), np.full(POINTS, np.nan), SWEEP * 3e-15])
def test_what_cannot_be_used_is_said_with_the_field(column: NDArray[Any]):
    times, why = decide_point_times([TimedScan(int(s), {"time": column}) for s in STAMPS])
    assert times is None
    assert "the field time" in why


@pytest.mark.parametrize("kind", ["u4", "i8", "f4", "f8"])
def test_the_limits_of_values_that_cannot_be_used_are_those_of_the_column(kind: str):
    column = np.append(np.linspace(2303, 9000, POINTS), np.linspace(300_000, 1_306_368, 40)).astype(kind)
    if kind[0] == "f":
        column = np.append(column, [np.nan, np.inf, 3e30]).astype(kind)
    times, why = decide_point_times([TimedScan(int(s), {"time": column}) for s in STAMPS])
    assert times is None
    assert "has values from 2303 to 1306368, in no unit" in why


def test_a_large_unsigned_value_that_all_points_have_is_said_as_it_is():
    column = np.full(POINTS, 4_000_000_000, np.uint32)
    _, why = decide_point_times([TimedScan(int(s), {"time": column}) for s in STAMPS])
    assert "is 4000000000 in all points" in why


def test_a_field_that_can_be_used_is_taken_before_one_that_cannot():
    scans = [TimedScan(int(s), {"t": np.zeros(POINTS), "timeOffset": SWEEP * 1e-9}) for s in STAMPS]
    times, _ = decide_point_times(scans)
    assert times is not None
    assert times.field == "timeOffset"


def test_beams_without_a_return_do_not_count():
    table = np.zeros(POINTS, np.dtype([*XYZ.descr, ("timestamp", "<f8")]))
    seen = np.arange(POINTS) % 3 == 0  # two of three beams are zeros in every field
    for axis in "xyz":
        table[axis][seen] = 3.0
    table["timestamp"][seen] = (START_NS + SWEEP[seen]) * 1e-9
    times = PointTimes("timestamp", 10**9, "clock", PERIOD_NS)
    offset_ns = scan_of(START_NS, cloud_columns(encode(table)), times).offset_ns
    assert offset_ns is not None
    np.testing.assert_allclose(offset_ns, SWEEP[seen], atol=500)


@pytest.mark.slow_after(7)
@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("name", ["timestamp", "time_stamp", "timeOffset", "ts", "offset_time"])
def test_a_recording_says_by_which_clock_its_points_are(kind: str, name: str, tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for index in range(SCANS):
            stamp_ns = START_NS + index * PERIOD_NS
            table = points_of(index)
            dtype = np.dtype([*XYZ.descr, (name, "<f8")])
            timed = np.zeros(len(table), dtype)
            for axis in "xyz":
                timed[axis] = table[axis]
            timed[name] = 1234.5 + 0.1 * index + np.linspace(0.0, 0.098, len(table))
            write(
                "/points",
                "sensor_msgs/msg/PointCloud2",
                stamp_ns + 105_000_000,
                author.cloud(stamp_ns, timed),
            )

    source = opened(write_recording(kind, tmp_path, fill))
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert len(scans) == SCANS
    for scan in scans:
        assert scan.offset_ns is not None
        assert scan.offset_ns.min() == 0
        assert abs(int(scan.offset_ns.max()) - 98_000_000) < 1_000
    said = [text for text in source.description.warnings if "times of points" in text]
    assert len(said) == 1
    assert name in said[0]
    assert "another clock" in said[0]


def test_times_that_are_all_zero_are_said_once(tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for index in range(SCANS):
            stamp_ns = START_NS + index * PERIOD_NS
            table = points_of(index)
            table["time"] = 0.0
            write("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, table))

    source = opened(write_recording("mcap", tmp_path, fill))
    assert all(record.offset_ns is None for record in source.records() if isinstance(record, Scan))
    said = [text for text in source.description.warnings if "times of points" in text]
    assert len(said) == 1
    assert "the field time is 0 " in said[0]
