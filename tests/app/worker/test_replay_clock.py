"""A replay keeps the time of the data, never skips, and says how late it is."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.worker.loop import LONGEST_DELAY_S, ReplayClock

NS = 1_000_000_000


@given(st.floats(0.1, 16.0), st.lists(st.integers(1, 10**9), min_size=1, max_size=20))
def test_scans_are_due_in_the_time_of_the_data(speed: float, gaps_ns: list[int]) -> None:
    pacer, stamp, now = ReplayClock(), 7 * NS, 100.0
    pacer.speed = speed
    assert pacer.delay(stamp, now) == 0.0
    for gap in gaps_ns:
        stamp += gap
        wait = pacer.delay(stamp, now)
        now += wait
    assert now == pytest.approx(100.0 + sum(gaps_ns) / NS / speed)


def test_speed_0_waits_for_nothing() -> None:
    pacer = ReplayClock()
    pacer.speed = 0.0
    assert [pacer.delay(k * NS, 5.0) for k in range(3)] == [0.0] * 3
    pacer.mapped(0, 5.0)
    pacer.mapped(NS, 5.1)
    assert pacer.behind(50.0) == 0


def test_late_scans_are_counted() -> None:
    pacer = ReplayClock()
    for k in range(5):
        pacer.delay(k * NS // 10, 0.0)
        pacer.mapped(k * NS // 10, 0.3 * (k + 1))  # each takes three times its time
    # Shown is the scan of 0.4 s; by the clock it is 1.5 s: scans of 0.5 to 1.5 s wait.
    assert pacer.behind(1.5) == 11
    assert pacer.rate_hz == pytest.approx(4 / 1.2)


def test_a_pause_is_not_made_up_for() -> None:
    pacer = ReplayClock()
    pacer.delay(0, 0.0)
    pacer.release()
    assert pacer.delay(NS, 60.0) == 0.0
    assert pacer.delay(2 * NS, 60.0) == pytest.approx(1.0)


def test_scans_of_equal_time_do_not_divide_by_zero() -> None:
    pacer = ReplayClock()
    for _ in range(3):
        pacer.delay(NS, 1.0)
        pacer.mapped(NS, 1.0)
    assert (pacer.behind(9.0), pacer.rate_hz) == (0, 0.0)


@pytest.mark.parametrize("speed", [5e-324])
def test_a_tiny_speed_gives_delays_that_a_clock_can_wait_for(speed: float) -> None:
    clock = ReplayClock()
    clock.speed = speed
    assert clock.delay(0, 5.0) == 0.0
    assert 0.0 < clock.delay(10**18, 5.0) <= LONGEST_DELAY_S
    clock.mapped(10**17, 5.0)
    clock.mapped(10**18, 5.1)
    assert clock.behind(6.0) == 0
