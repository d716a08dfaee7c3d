"""The laws of a session again, with the real mapper on a simulated run."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

from app.cli import main
from app.dashboard.shown_run import ShownRun
from app.sources.request import SourceRequest
from app.worker.process import new_session
from app.worker.protocol import Open, Shown
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.io.atomic_files import write_texts
from pipeline.io.result_files import seen_text
from pipeline.seen_area import SeenRecorder
from pipeline.types.records import Float, Frame, Path

URI = "sim:stand?duration=7"


@pytest.fixture
def session():
    session = new_session()
    session.open(Open(URI, "auto", 3))
    yield session
    session.close()


def stand_at(session: Session, index: int) -> Frame:
    session.advance(index - session.status().scan_index)
    while session.pace == "hurry":
        session.work()
    assert session.shown.frame is not None
    assert session.shown.frame.index == index
    return session.shown.frame


def assert_same(a: Frame, b: Frame) -> None:
    for name in ("raw", "filtered", "labels"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.estimate.T_map_base == b.estimate.T_map_base
    np.testing.assert_array_equal(a.estimate.particles, b.estimate.particles)
    np.testing.assert_array_equal(a.estimate.weights, b.estimate.weights)
    for name in ("number", "position", "covariance", "dbh", "observations"):
        np.testing.assert_array_equal(getattr(a.trees, name), getattr(b.trees, name))


def test_the_real_mapper_comes_back_to_the_same_bytes(session: Session) -> None:
    first = {index: stand_at(session, index) for index in (8, 55, 60)}
    path = session.shown.path
    for index in (8, 60, 55):
        assert_same(stand_at(session, index), first[index])
    stand_at(session, 60)
    assert path is not None
    assert session.shown.path is not None
    np.testing.assert_array_equal(session.shown.path.x, path.x)


@pytest.mark.slow
def test_the_observed_area_is_that_of_the_command(session: Session, tmp_path: FilePath) -> None:
    """Also after steps back and forth."""
    for index in (40, 10, 69):
        stand_at(session, index)
    assert session.run is not None
    assert session.shown.path is not None
    recorder = SeenRecorder()
    for stamp_ns, view in session.run.take_views():
        recorder.add(stamp_ns, view)
    stand_at(session, 20)
    assert session.run.take_views() == []
    stand_at(session, 69)
    assert main(["map", URI, "--seed", "3", "--out", str(tmp_path / "out")]) == 0
    assert seen_text(recorder.area(session.shown.path)) == (tmp_path / "out" / "seen.csv").read_text()


def test_a_rerun_gives_the_course_of_the_new_map(session: Session) -> None:
    stand_at(session, 12)
    run = session.run
    assert run is not None
    names = ["clusters", "trees", "mapping"]
    before = run.course(names, 100, stages=False)
    assert np.isfinite(before.values["mapping"]).all()
    odometry_xy = run.odometry_xy
    assert len(odometry_xy) == 13
    session.set_parameters(Parameters().replace({"clustering.eps": 0.6}), 1, whole=True)
    while session.is_remapping:
        session.remap()
    found = run.course(names, 100, stages=False)
    assert found.scans.tolist() == before.scans.tolist() == [*range(13)]
    assert (found.values["clusters"] != before.values["clusters"]).any()
    timed = np.flatnonzero(np.isfinite(found.values["mapping"]))
    assert timed.tolist() == [12], "times of other parameters are removed"
    np.testing.assert_array_equal(run.odometry_xy, odometry_xy)


def test_a_slider_on_the_standing_scan_and_back_leaves_no_trace(session: Session) -> None:
    before = stand_at(session, 12)
    other = session.set_parameters(Parameters().replace({"clustering.eps": 0.6}), 1)
    assert other is not None
    assert len(other.clusters.size) != len(before.clusters.size)
    again = session.set_parameters(Parameters(), 2)
    assert again is not None
    assert_same(again, before)
    following = stand_at(session, 13)
    stand_at(session, 2)
    assert_same(stand_at(session, 13), following)


def assert_equal(a: Any, b: Any, name: str = "") -> None:
    """Records are equal in all arrays and values."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for each in dataclasses.fields(a):
            assert_equal(getattr(a, each.name), getattr(b, each.name), f"{name}.{each.name}")
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=name)
        assert a.dtype == b.dtype, name
    else:
        assert a == b or (a != a and b != b), (name, a, b)


def mapped(session: Session, scans: int) -> list[tuple[Frame, Path, Float]]:
    """Play so many scans: the frame, the path and the confirmation times at each."""
    results = []
    session.play()
    for _ in range(scans):
        frame = session.work()
        assert frame is not None
        assert session.shown.path is not None
        assert session.shown.confirmed_s is not None
        results.append((frame, session.shown.path, session.shown.confirmed_s))
    session.pause()
    return results


def looked_at(session: Session, index: int) -> tuple[Frame, Path, Float]:
    """Seek a scan without mapping: what is shown of it at once."""
    shown = session.advance(index - session.status().scan_index)
    assert shown is not None
    assert shown is session.shown.frame
    assert session.shown.is_stored
    assert session.status().scan_index == index
    assert session.status().going_to == ""
    assert session.shown.path is not None
    assert session.shown.confirmed_s is not None
    return shown, session.shown.path, session.shown.confirmed_s


@pytest.mark.slow
def test_a_mapped_scan_is_shown_again_without_mapping(session: Session) -> None:
    results = mapped(session, 65)
    for index in (63, 62, 0, 31, 33, 50, 64 - 1):
        shown = looked_at(session, index)
        for old, new, name in zip(results[index], shown, ("frame", "path", "confirmed"), strict=True):
            assert_equal(old, new, f"{name} {index}")
    # The mapper arrives at the scan that is shown, and the run goes on from there.
    before = looked_at(session, 61)
    while session.pace == "hurry":
        session.work()
    assert not session.shown.is_stored
    for old, new in zip(before[:2], (session.shown.frame, session.shown.path), strict=True):
        assert_equal(old, new)
    session.play()
    following = session.work()
    assert_equal(following, results[62][0])


@pytest.mark.slow
def test_after_a_change_of_the_whole_run_its_scans_are_shown_with_the_new_map(session: Session) -> None:
    mapped(session, 60)
    other = Parameters().replace({"clustering.eps": 0.4})
    session.set_parameters(other, 1, whole=True)
    while session.remap() is None:
        pass
    shown = looked_at(session, 30)[0]
    while session.pace == "hurry":
        session.work()
    assert session.shown.frame is not None
    assert_equal(shown.clusters, session.shown.frame.clusters)
    assert_equal(shown.estimate, session.shown.frame.estimate)
    np.testing.assert_array_equal(shown.filtered, session.shown.frame.filtered)
    np.testing.assert_array_equal(
        shown.trees.number[shown.trees.confirmed],
        session.shown.frame.trees.number[session.shown.frame.trees.confirmed],
    )


def test_with_other_parameters_in_force_nothing_of_before_is_shown(session: Session) -> None:
    mapped(session, 30)
    session.set_parameters(Parameters().replace({"clustering.eps": 0.4}), 1)
    assert session.advance(-10) is None  # its scan is mapped with these parameters on arrival
    assert not session.shown.is_stored


@pytest.mark.slow
def test_the_page_and_the_command_line_give_the_same_files(session: Session, tmp_path: FilePath) -> None:
    out, there = tmp_path / "out", tmp_path / "page"
    assert main(["map", URI, "--out", str(out), "--seed", "3"]) == 0
    seen = SeenRecorder()
    session.advance(10_000)
    while session.pace == "hurry":
        session.work()
        assert session.run is not None
        for stamp_ns, view in session.run.take_views():
            seen.add(stamp_ns, view)
    assert session.run is not None
    last = session.run.current
    for index in (20, last):  # the counts are those of the shown scan, also after the run went back
        stand_at(session, index)
        assert session.shown.counts is not None
        assert sum(session.shown.counts.health.values()) == index + 1
    frame, truth = session.shown.frame, session.run.source.truth()
    assert frame is not None
    assert truth is not None
    assert session.shown.path is not None
    record = json.loads((out / "run.json").read_text())
    shown = Shown(1, session.shown.time_s, frame, 0, session.shown.path, None, session.shown.counts)
    request = SourceRequest(URI, seed=3)
    start_ns = frame.stamp_ns - round(session.shown.time_s * 1e9)
    run = ShownRun(
        request, record["source"]["sha256"], session.status(), shown, session.shown.path, start_ns, "forest",
        Parameters(), truth.trees, seen, (), None,
    )  # fmt: skip
    write_texts(there, run.texts())
    for name in ("trees.csv", "path.csv", "seen.csv", "terrain.csv"):
        assert (there / name).read_text() == (out / name).read_text(), name
    written = json.loads((there / "run.json").read_text())
    for key in ("seed", "parameters", "trees", "evaluation", "verdicts", "losses", "warnings"):
        assert written[key] == record[key], key
