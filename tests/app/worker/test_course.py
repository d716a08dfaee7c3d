"""The course of a run: every mapped scan, in bounded memory, also after the run went back."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.dashboard.payload import course_payload
from app.worker.course import QUANTITIES, ScanSeries, stage_times
from app.worker.protocol import Open
from app.worker.run import Run
from app.worker.session import Session
from pipeline.config import Parameters
from tests.app.fakes import FakeSource, make_session


@given(st.integers(1, 300), st.sampled_from([4, 8, 16]))
def test_kept_scans_are_evenly_spaced_and_have_their_values(scans: int, most: int) -> None:
    series = ScanSeries(most)
    for index in range(scans):
        series.record(index, {"a": 10.0 * index})
    kept = series.scans("a")
    assert most / 2 < len(kept) <= most or len(kept) == scans
    assert len(set(np.diff(kept).tolist())) <= 1
    assert kept[0] == 0
    assert kept[-1] > scans - 1 - (scans // most + 1) * 2
    np.testing.assert_array_equal(series.values("a", kept), 10.0 * kept)


def test_a_scan_that_is_mapped_again_replaces_its_known_values_and_forgotten_ones_are_unknown() -> None:
    series = ScanSeries()
    for index in range(6):
        series.record(index, {"a": float(index), "b": 1.0})
    series.record(2, {"a": -1.0})
    np.testing.assert_array_equal(series.values("a", np.arange(4)), [0, 1, -1, 3])
    np.testing.assert_array_equal(series.values("b", np.arange(4)), [1, 1, 1, 1])
    series.forget_from(3)
    assert series.scans("a").tolist() == [0, 1, 2]
    assert series.names == ["a", "b"]
    series.forget_from(0)
    assert series.names == []
    assert np.isnan(series.values("unknown", np.arange(2))).all()
    assert len(series.scans("unknown")) == 0


def opened(scans: int) -> Session:
    session = make_session(FakeSource(scans))
    session.open(Open("fake:", "auto", 7))
    return session


def settle(session: Session) -> None:
    while session.pace == "hurry":
        session.work()


def test_the_course_has_all_mapped_scans_also_after_a_step_back() -> None:
    session = opened(40)
    session.play()
    for _ in range(30):
        session.work()
    session.seek(1.0)
    settle(session)
    run = session.run
    assert run is not None
    found = run.course([*QUANTITIES], 100, stages=True)
    assert found.scans.tolist() == [*range(30)]
    np.testing.assert_allclose(found.time_s, 0.1 * np.arange(30))
    assert np.isfinite(found.values["mapping"]).sum() == 30
    assert np.isnan(found.values["driven"][11:]).all(), "the path ends at the shown scan"
    assert {"total"} <= set(found.stages)
    few = run.course(["x"], 7, stages=False)
    assert len(few.scans) == 7
    assert few.scans[[0, -1]].tolist() == [0, 29]
    assert few.stages == {}
    np.testing.assert_array_equal(few.values["x"], found.values["x"][few.scans])
    payload = course_payload(found)
    assert payload["scans"] == [*range(30)]
    assert payload["quantities"]["sigma"] == {"title": "sigma of the position", "unit": "cm"}
    assert payload["values"]["driven"][11:] == [None] * 19
    assert set(payload["quantities"]) <= set(QUANTITIES)


def test_other_parameters_from_a_scan_on_remove_the_course_from_there() -> None:
    session = opened(40)
    session.play()
    for _ in range(30):
        session.work()
    session.pause()
    session.seek(1.0)
    settle(session)
    session.set_parameters(Parameters().replace({"clustering.eps": 0.3}), 1)
    run = session.run
    assert run is not None
    assert run.course(["x"], 100, stages=False).scans.tolist() == [*range(11)], (
        "the shown scan is mapped again"
    )


def test_a_run_before_its_first_scan_has_an_empty_course() -> None:
    run = opened(3).run
    assert run is not None
    found = run.course([*QUANTITIES], 10, stages=True)
    assert len(found.scans) == 0
    assert all(len(values) == 0 for values in found.values.values())


def test_a_stage_that_did_not_run_took_no_time() -> None:
    session = opened(40)
    session.play()
    for _ in range(30):
        session.work()
    run = session.run
    assert isinstance(run, Run)
    for index in range(30):
        times = {"total": 2.0, **({"sometimes": 1.0} if index % 2 == 0 else {})}
        run._map.course.record(index, stage_times(times))
    found = run.course(["x", "mapping"], 100, stages=True)
    assert found.values["mapping"].tolist() == [2.0] * 30
    assert found.stages["sometimes"].tolist() == [1.0, 0.0] * 15
