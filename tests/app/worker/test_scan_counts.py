"""Counts of the scans of a map, also after the run went back."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np

from app.worker.course import ScanCounts
from pipeline.types.records import Frame, Verdict
from tests.app import fakes


def scan(index: int, *verdicts: Verdict, warnings: tuple[str, ...] = ()) -> Frame:
    """A scan with clusters of some verdicts."""
    frame = fakes.frame(index, index, warnings=warnings)
    return replace(frame, clusters=replace(frame.clusters, verdict=np.array(verdicts, np.int32)))


def test_totals_are_those_of_the_scans_up_to_the_asked_one() -> None:
    counts = ScanCounts()
    for index in range(4):
        counts.record(scan(index, Verdict.TREE, Verdict.POLE, warnings=("slow",) * (index == 2)))
    for index in (3, 0, 1, 3, 2):  # in any order
        found = counts.totals(index, ["no clock"], {"lost": 2, "late": 0})
        assert found.verdicts == {"pole": index + 1, "tree": index + 1}
        assert found.health == {"good": index + 1, "weak": 0, "lost": 0}
        assert found.losses == {"lost": 2}
        assert found.warnings == ["no clock", "slow"][: 2 if index >= 2 else 1]


def test_scans_count_once_until_they_are_forgotten() -> None:
    counts = ScanCounts()
    for index in range(4):
        counts.record(scan(index, Verdict.TREE, warnings=("slow",)))
    assert counts.totals(3, [], {}).warnings == ["slow (4 times)"]
    counts.record(scan(1, Verdict.BUSH))  # mapped again
    counts.record(scan(9, Verdict.WALL))  # beyond the next one
    assert counts.totals(3, [], {}).verdicts == {"tree": 4}
    counts.record(scan(3, Verdict.BUSH))  # the last one, mapped again
    assert counts.totals(3, [], {}).verdicts == {"bush": 1, "tree": 3}
    assert counts.totals(3, [], {}).warnings == ["slow (3 times)"]
    counts.forget_from(1)
    counts.record(scan(1, Verdict.BUSH, Verdict.BUSH))
    assert counts.totals(0, [], {}).verdicts == {"tree": 1}
    assert counts.totals(1, [], {}).verdicts == {"bush": 2, "tree": 1}
    assert counts.totals(1, [], {}).warnings == ["slow"]


def test_a_scan_takes_92_bytes() -> None:
    counts, scans = ScanCounts(), 300
    for index in range(scans):
        counts.record(scan(index, Verdict.TREE))
    each = 4 * (len(Verdict) + 3) + 8  # numbers by verdict and pose quality, sigma
    assert each == 92
    assert sum(column.nbytes for column in counts._rows._columns) <= 2 * each * scans  # the capacity doubles


def test_warnings_take_memory_for_each_scan_that_has_them() -> None:
    """Texts with numbers differ from scan to scan, such as those of jumps of the odometry."""
    counts, scans = ScanCounts(), 1000
    frames = [scan(index, warnings=(f"it jumped by {index} m",)) for index in range(scans)]
    tracemalloc.start()
    try:
        for frame in frames:
            counts.record(frame)
            counts.totals(frame.index, [], {})
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert counts.totals(1, [], {}).warnings == ["it jumped by 0 m", "it jumped by 1 m"]
    assert taken < 1000 * scans
    counts.forget_from(2)
    counts.record(scan(2, warnings=("it jumped by 0 m",)))
    assert counts.totals(2, [], {}).warnings == ["it jumped by 0 m (2 times)", "it jumped by 1 m"]
    assert counts.totals(0, [], {}).warnings == ["it jumped by 0 m"]
