"""Times of points by the order in which a spinning sensor fired them; the oracle is the simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io.readers import open_source
from pipeline.io.readers.firing_order import FIRING_ORDER, turn_shares
from pipeline.io.readers.point_times import TimedScan, decide_point_times
from pipeline.io.readers.scan_columns import has_times, timed_scan
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.types.records import Float, Float32, Int, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.test_scan_folders import save

TURN_NS = 100_000_000


def sweep(lidar: str) -> Scan:
    source = open_source(f"sim:stand?duration=1&lidar={lidar}")
    assert isinstance(source, SimulatedSource)
    return source.run.sweep(0).scan


def fired(lidar: str) -> tuple[Float32, Int]:
    """Points in the order of firing, and their times [ns]."""
    scan = sweep(lidar)
    assert scan.offset_ns is not None
    order = np.argsort(scan.offset_ns, kind="stable")
    return scan.points[order], scan.offset_ns[order].astype(np.int64)


@pytest.fixture(scope="module")
def vlp16() -> tuple[Float32, Int]:
    return fired("vlp16")


def times_of(points: Float32) -> Float:
    shares = turn_shares(points)
    assert shares is not None
    return shares * TURN_NS


@pytest.mark.parametrize("lidar", ["vlp16", "xt32", "helios", "os1-64"])
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["its direction", "the other direction"])
def test_the_order_of_firing_tells_the_times(lidar: str, side: float):
    points, true_ns = fired(lidar)
    found = times_of(points * np.array([1.0, side, 1.0], np.float32))
    assert np.abs(found - (true_ns - true_ns[0])).max() < 1.5e6  # of 100 ms


@given(begin=st.floats(0.05, 0.6), width=st.floats(0.0, 0.3))
def test_a_sector_without_returns_moves_no_times(vlp16: tuple[Float32, Int], begin: float, width: float):
    points, true_ns = vlp16
    share = true_ns / TURN_NS
    kept = (share < begin) | (share > begin + width)
    assert np.abs(times_of(points[kept]) - (true_ns[kept] - true_ns[0])).max() < 2e6


def test_other_orders_tell_nothing(vlp16: tuple[Float32, Int]):
    points, _ = vlp16
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    rows = np.arange(len(points))
    by_ring = np.lexsort((rows, np.round(np.degrees(elevation))))
    for order in (by_ring, np.random.default_rng(0).permutation(rows), rows[: len(rows) // 3], rows[:100]):
        assert turn_shares(points[order]) is None
    assert turn_shares(sweep("solid").points) is None
    assert turn_shares(np.zeros((5000, 3), np.float32)) is None


def test_a_topic_that_may_be_thinned_out_has_no_times(vlp16: tuple[Float32, Int]):
    columns = dict(zip("xyz", vlp16[0].T, strict=True))
    for period_ns, known in ((50_000_000, True), (TURN_NS, True), (200_000_000, False), (500_000_000, False)):
        times, why = decide_point_times([timed_scan(k * period_ns, columns) for k in range(5)])
        assert why == ""
        assert (times is not None) is known
        if times is not None:
            assert (times.field, times.unit_ns) == (FIRING_ORDER, period_ns)
            assert "order of the points" in times.words


def test_a_field_of_times_is_preferred(vlp16: tuple[Float32, Int], monkeypatch: pytest.MonkeyPatch):
    points, true_ns = vlp16
    columns = {**dict(zip("xyz", points.T, strict=True)), "t": true_ns.astype(np.uint32)}
    monkeypatch.setattr("pipeline.io.readers.point_times.turn_shares", None)  # not even looked at
    times, _ = decide_point_times([timed_scan(k * TURN_NS, columns) for k in range(5)])
    assert times is not None
    assert times.field == "t"


@pytest.mark.parametrize(("period_ms", "known"), [(50, True), (100, False)])
def test_turns_that_may_have_been_left_out_have_no_times_and_it_is_said(period_ms: int, known: bool):
    # A VLP-16 that turns 20 times a second fires every 55.3 us, 0.4 degrees apart; a topic of it at 10 Hz has
    # every second turn, and its sweeps last half a period.
    shot, laser = np.divmod(np.arange(16 * 900), 16)
    turn, rise = np.radians(0.4 * shot), np.radians(2.0 * laser - 15.0)
    points = 8.0 * np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)
    columns = {**dict(zip("xyz", points.astype(np.float32).T, strict=True)), "ring": laser.astype(np.uint16)}
    times, why = decide_point_times([timed_scan(k * period_ms * 1_000_000, columns) for k in range(5)])
    assert (times is not None) is known
    assert ("111 us apart" in why and "left out" in why) is not known


def test_clouds_of_other_odometry_may_be_de_skewed_and_have_no_times(vlp16: tuple[Float32, Int]):
    points, _ = vlp16
    columns = {**dict(zip("xyz", points.T, strict=True)), "curvature": np.zeros(len(points), np.float32)}
    timed = [timed_scan(k * TURN_NS, columns) for k in range(5)]
    assert [scan.points for scan in timed] == [None] * 5
    assert decide_point_times(timed) == (None, "")
    assert decide_point_times([TimedScan(k * TURN_NS, {}) for k in range(5)]) == (None, "")


def test_scans_of_a_folder_have_times_and_it_is_said(
    vlp16: tuple[Float32, Int], tmp_path: Path, opened: Opened
):
    points, true_ns = vlp16
    for k in range(4):
        save(tmp_path / f"{k:04d}.pcd", points)
    save(tmp_path / "0004.pcd", points[::-1][np.random.default_rng(0).permutation(len(points))])
    source = opened(tmp_path)
    assert any("order of the points" in text for text in source.description.warnings)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert [has_times(scan) for scan in scans] == [True] * 4 + [False]
    # A scan in another order is at the middle of its sweep, as the others are on average.
    assert scans[4].offset_ns is not None
    assert np.unique(scans[4].offset_ns).tolist() == [pytest.approx(TURN_NS / 2, rel=0.02)]
    assert scans[0].offset_ns is not None
    assert np.abs(scans[0].offset_ns - (true_ns - true_ns[0])).max() < 1.5e6
