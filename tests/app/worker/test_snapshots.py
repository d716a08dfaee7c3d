"""What is remembered of a run stays small and true."""

from __future__ import annotations

from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.worker.remap import ParameterHistory, Snapshots
from pipeline.config import Parameters
from pipeline.io.block_file import BlockFile

SETS = [Parameters().replace({"clustering.eps": eps}) for eps in (0.1, 0.2, 0.3)]


def test_states_stay_few_and_evenly_spread_however_long_the_run() -> None:
    kept: Snapshots[int] = Snapshots(0)
    for scans in range(20_001):
        kept.offer(scans, scans)
    held = {0, *kept._files}
    assert len(held) <= 21
    gaps = {b - a for a, b in zip(sorted(held), sorted(held)[1:], strict=False)}
    assert len(gaps) == 1
    assert gaps.pop() <= 20_000 / 10


@given(st.lists(st.integers(1, 9_000), min_size=1, max_size=3))
def test_a_run_of_known_length_stores_only_the_states_that_stay(lengths: list[int]) -> None:
    thinned: Snapshots[int] = Snapshots(0)
    planned: Snapshots[int] = Snapshots(0)
    stored, done = 0, 0
    for length in sorted(lengths):
        planned.expect(length)
        for scans in range(done, length):
            stored += planned.is_due(scans)
            thinned.offer(scans, scans)
            planned.offer(scans, scans)
        done = length
        assert planned._files.keys() == thinned._files.keys()
    assert stored <= len(lengths) * 20


def test_states_that_the_disk_refuses_are_not_kept_and_harm_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BlockFile, "put_block", lambda *_: False)
    with closing(Snapshots(0)) as kept:
        for scans in range(2001):
            kept.offer(scans, scans)
        assert kept.newest(2000) == (0, 0)


def test_a_damaged_state_is_passed_over() -> None:
    with closing(Snapshots(0)) as kept:
        for scans in range(101):
            kept.offer(scans, scans)
        file, _ = kept._files[100]
        assert file._file is not None
        file._file.handle.seek(0)
        file._file.handle.write(b"damaged")
        assert kept.newest(100) == (50, 50)


def test_a_run_that_cannot_go_back_stores_no_state() -> None:
    kept: Snapshots[int] = Snapshots(0, 0)
    assert not any(kept.is_due(scans) for scans in range(1000))


def test_two_collections_share_a_state_and_either_may_drop_it() -> None:
    first, second, third = Snapshots(0), Snapshots(0), Snapshots(0)
    for scans in range(101):
        first.offer(scans, scans)
    second.share(100, first, lambda state: state + 1)
    second.share(150, first, lambda state: state + 1)  # not stored in the first
    third.share(100, second, lambda state: state + 2)
    first.close()
    assert (second.newest(200), third.newest(200)) == ((100, 101), (100, 102))
    second.close()
    assert (second.newest(200), third.newest(200)) == ((0, 0), (100, 102))


@given(st.integers(0, 500), st.integers(0, 500))
def test_the_newest_state_is_not_newer_than_asked_for(scans: int, forgotten: int) -> None:
    kept = Snapshots(0)
    for n in range(401):
        kept.offer(n, n)
    kept.forget_after(forgotten)
    held, state = kept.newest(scans)
    assert held == state <= min(scans, forgotten)
    assert held == min(scans, forgotten, 400) // 50 * 50


@given(st.lists(st.tuples(st.integers(0, 20), st.sampled_from(SETS)), max_size=8))
def test_history_is_what_was_set_last_from_each_scan_on(changes: list[tuple[int, Parameters]]) -> None:
    history = ParameterHistory(SETS[0])
    plain = [SETS[0]] * 30
    for index, parameters in changes:
        wanted = plain[:index] + [parameters] * (30 - index)
        assert history.set_from(index, parameters) == (wanted != plain)
        plain = wanted
        assert [history.at(k) for k in range(30)] == plain
