"""Times are medians over the last scans, also where a stage fails."""

from __future__ import annotations

import itertools

import pytest

from app.common.timers import Stopwatch


def test_medians_of_the_last_scans() -> None:
    ticks = itertools.accumulate([0.0, 0.001, 0.0, 0.002, 0.0, 0.009, 0.0, 0.004])
    stopwatch = Stopwatch(scans=3, clock=lambda: next(ticks))
    for _ in range(4):
        with stopwatch("slam"):
            pass
    assert stopwatch.stage_ms == {"slam": pytest.approx(4.0)}  # of 2, 9 and 4
    assert stopwatch.scan_ms == 0.0


def test_a_failing_stage_is_measured_and_fails() -> None:
    ticks = itertools.count()
    stopwatch = Stopwatch(clock=lambda: next(ticks))
    with pytest.raises(KeyError), stopwatch.whole_scan(), stopwatch("slam"):
        raise KeyError
    assert stopwatch.stage_ms == {"slam": 1000.0}
    assert stopwatch.scan_ms == 3000.0


def test_what_waits_for_a_kernel_to_be_compiled_is_not_measured() -> None:
    ticks = itertools.count()
    stopwatch = Stopwatch(clock=lambda: next(ticks))
    with stopwatch.whole_scan():
        with stopwatch("ground"):
            stopwatch.disturb()
        with stopwatch("slam"):
            pass
    assert stopwatch.stage_ms == {"slam": 1000.0}
    assert stopwatch.scan_ms == 0.0
