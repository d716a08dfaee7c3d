"""What is remembered of a run stays small and true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.worker import remap
from app.worker.remap import ParameterHistory, Snapshots, nbytes
from pipeline.config import Parameters
from pipeline.geometry.poses import Pose3
from pipeline.mapper import Mapper
from pipeline.slam import SlamState
from pipeline.types.records import Sensor

SETS = [Parameters().replace({"clustering.eps": eps}) for eps in (0.1, 0.2, 0.3)]


def test_states_stay_few_and_evenly_spread_however_long_the_run() -> None:
    kept: Snapshots[int] = Snapshots(0)
    for scans in range(20_001):
        kept.offer(scans, scans)
    held = {kept.newest(scans)[0] for scans in range(20_001)}
    assert len(held) <= 40
    gaps = {b - a for a, b in zip(sorted(held), sorted(held)[1:], strict=False)}
    assert len(gaps) == 1
    assert gaps.pop() <= 20_000 / 15


def test_large_states_are_fewer_and_the_first_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    megabyte = 1 << 20
    # It grows: 1 MB every 50 scans.
    monkeypatch.setattr(remap, "nbytes", lambda scans: scans * megabyte // 50)
    kept: Snapshots[int] = Snapshots(0)
    held: set[int] = set()
    for scans in range(10_001):
        kept.offer(scans, scans)
        held = {kept.newest(n)[0] for n in range(0, scans + 1, 50)}
        assert sum(n // 50 for n in held) <= 256
        assert 0 in held
    assert len(held) > 1


def test_a_state_beyond_all_bounds_is_not_kept_and_harms_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remap, "nbytes", lambda scans: scans << 40)
    kept: Snapshots[int] = Snapshots(0)
    for scans in range(2001):
        kept.offer(scans, scans)
    assert kept.newest(2000) == (0, 0)


@dataclass
class Inner:
    a: object
    b: float = 0.5


def test_the_bytes_of_a_state_are_those_of_all_its_arrays() -> None:
    assert nbytes(Inner(Inner(np.zeros((3, 2))), b=2.0)) == 48
    assert nbytes(Inner((np.zeros(2), None))) == 16
    assert nbytes(7) == 0
    state = Mapper(Parameters(), sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0).snapshot()
    slam = state.slam
    assert isinstance(slam, SlamState)
    assert nbytes(state) >= slam.pose.nbytes + slam.maps.block.nbytes + slam.maps.mean.nbytes


@given(st.integers(0, 500), st.integers(0, 500))
def test_the_newest_state_is_not_newer_than_asked_for(scans: int, forgotten: int) -> None:
    kept: Snapshots[int] = Snapshots(0)
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
