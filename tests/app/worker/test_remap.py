"""A run that is mapped again is as if its parameters had been in force from its first scan on."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import fields, is_dataclass, replace
from functools import cache

import numpy as np
import pytest

from app.worker.course import READ_QUANTITIES
from app.worker.process import new_session
from app.worker.protocol import MapChanges, Open
from app.worker.run import Run
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.front_end import SegmentedScan
from pipeline.mapper import Mapper
from pipeline.remapping.tree_rerun import TreeRerun
from pipeline.tree_log import TreesDifferError
from pipeline.types.records import Frame, Step, Trees

URI = "sim:paper?duration=2.4&odometry=poor"
LAST = 23
BASE = Parameters()
FEWER = BASE.replace({"detection.e_max": 12.0, "slam.particles": 60})  # judged anew
# Changes the trees but not the map of SLAM.
LATER = BASE.replace({"tracking.proximity_radius": 0.3, "classification.tree_share": 0.3})
JUDGED = BASE.replace({"detection.e_max": 20.0})  # from the first scan on that it touches
WIDER = BASE.replace({"clustering.eps": 0.25})  # looked at anew


def content_of(record: object) -> object:
    """Everything that a record holds, bit by bit, but for the numbers of trees, which stay those of the first
    map.
    """
    if isinstance(record, Trees):
        record = replace(record, number=np.zeros_like(record.number))
    if is_dataclass(record):
        return tuple(content_of(getattr(record, f.name)) for f in fields(record))
    if isinstance(record, np.ndarray):
        return (record.dtype.str, record.shape, record.tobytes())
    return repr(record)


def settle(session: Session) -> None:
    """Work until nothing is sought any more."""
    while session.pace == "hurry":
        session.work()


@pytest.fixture
def session() -> Iterator[Session]:
    """A run that stands at its last scan but one."""
    with closing(new_session()) as opened:
        opened.open(Open(URI, "auto", 3))
        opened.set_parameters(BASE, 0)
        opened.advance(LAST)
        settle(opened)
        yield opened


@contextmanager
def mapped_from_start(parameters: Parameters, last: int) -> Iterator[Session]:
    """A run that was mapped with some parameters from the start."""
    with closing(new_session()) as opened:
        opened.open(Open(URI, "auto", 3))
        opened.set_parameters(parameters, 0)
        opened.advance(last + 1)
        settle(opened)
        yield opened


def mapped_with(parameters: Parameters, last: int) -> tuple[object, object]:
    """The scan and the path of such a run."""
    return _mapped_once(parameters.model_dump_json(), last)


@cache
def _mapped_once(parameters: str, last: int) -> tuple[object, object]:
    with mapped_from_start(Parameters.model_validate_json(parameters), last) as opened:
        return content_of(opened.shown.frame), content_of(opened.shown.path)


def remapped(session: Session) -> tuple[Frame, MapChanges]:
    """Map again until it is done."""
    while session.is_remapping:
        done = session.remap()
        if done is not None:
            return done
    raise AssertionError("it was given up")


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [FEWER, WIDER, LATER, JUDGED])
def test_the_map_is_that_of_these_parameters_from_the_start(session, parameters):
    current = session.status().scan_index
    session.set_parameters(parameters, 1, whole=True)
    assert session.is_remapping
    frame, changes = remapped(session)
    assert (content_of(frame), content_of(session.shown.path)) == mapped_with(parameters, current)
    assert changes.revision == 1
    assert changes.scans == current + 1
    assert session.status().remapped is None
    assert not any(thread.name.startswith("segment") for thread in threading.enumerate()), "none is left"


def test_the_observed_area_is_that_of_the_new_map(session):
    """The free ranges depend on the filters."""
    near = BASE.replace({"filters.x_max": 5.0})
    old = dict(session.run.take_views())
    for revision, wanted in enumerate([near, BASE, near], 1):
        session.set_parameters(wanted, revision, whole=True)
        remapped(session)
        views = session.run.take_views()
        with mapped_from_start(wanted, LAST - 1) as other:
            assert other.run is not None
            expected = other.run.take_views()
        assert [(stamp, free.tobytes()) for stamp, free in views] == [
            (stamp, free.tobytes()) for stamp, free in expected
        ]
        assert session.run.take_views() == []
        same = all(np.array_equal(old[stamp], free) for stamp, free in views)
        assert same == (wanted == BASE)


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [FEWER, WIDER])
def test_undo_and_redo_bring_the_maps_back_that_were_on_the_page(session, parameters):
    maps: dict[int, object] = {}
    marks: dict[int, dict[int, float]] = {}
    for revision, wanted in enumerate([parameters, BASE, parameters, LATER, parameters, BASE, FEWER]):
        session.set_parameters(wanted, revision, whole=True)
        frame, changes = remapped(session)
        assert changes.revision == revision
        now: tuple[object, ...] = (content_of(frame), content_of(session.shown.path))
        now += (content_of(session.run.confirmed_s),)
        assert marks.setdefault(id(wanted), dict(changes.confirmed)) == dict(changes.confirmed)
        assert maps.setdefault(id(wanted), now) == now
    for wanted in (parameters, BASE, LATER):
        with mapped_from_start(wanted, LAST - 1) as other:
            assert other.shown.frame is not None
            assert isinstance(other.run, Run)
            since = content_of(other.run.confirmed_s)
            confirmed = sorted(other.run._map.confirmed_s.values())
            assert sorted(marks[id(wanted)].values()) == confirmed, "those that went again too"
            assert maps[id(wanted)] == (content_of(other.shown.frame), content_of(other.shown.path), since)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("parameters", [FEWER, WIDER])
def test_undo_and_redo_of_the_last_change_map_only_the_current_scan_again(session, parameters, monkeypatch):
    mapped: list[int] = []
    process = Mapper.process

    def process_and_note(mapper: Mapper, step: Step, scan: SegmentedScan | None = None) -> Frame:
        mapped.append(step.index)
        return process(mapper, step, scan)

    session.set_parameters(parameters, 1, whole=True)
    remapped(session)
    monkeypatch.setattr(Mapper, "process", process_and_note)
    for revision, wanted in enumerate([BASE, parameters, BASE], 2):
        mapped.clear()
        session.set_parameters(wanted, revision, whole=True)
        frame, _ = remapped(session)
        assert set(mapped) == {frame.index}
        assert (content_of(frame), content_of(session.shown.path)) == mapped_with(wanted, frame.index)


def places(frame: Frame) -> dict[int, tuple[float, float]]:
    """Where the confirmed trees stand, by their numbers."""
    rows = np.flatnonzero(frame.trees.confirmed)
    return {int(frame.trees.number[row]): tuple(frame.trees.position[row].tolist()) for row in rows}


@pytest.mark.slow
def test_trees_that_stay_keep_their_numbers():
    few = BASE.replace({"classification.tree_share": 0.8})
    none = BASE.replace({"classification.tree_share": 1.0, "tracking.hits_to_confirm": 200})
    eps = BASE.replace({"clustering.eps": 0.25})
    with closing(new_session()) as session:
        session.open(Open("sim:stand?duration=4", "auto", 3))
        session.set_parameters(BASE, 0)
        session.advance(32)
        settle(session)
        assert session.shown.frame is not None
        first = known = now = places(session.shown.frame)
        assert len(known) > 20
        for revision, wanted in enumerate([FEWER, eps, none, few, LATER, JUDGED, BASE], 1):
            session.set_parameters(wanted, revision, whole=True)
            frame, _ = remapped(session)
            now = places(frame)
            kept = 0
            for number, place in now.items():
                nearest = min(known, key=lambda n: np.hypot(*np.subtract(known[n], place)))
                if np.hypot(*np.subtract(known[nearest], place)) < 0.4:
                    assert number == nearest, (revision, place)
                    kept += 1
                else:
                    assert number not in known
            assert kept >= 0.8 * len(now)
            known = {**known, **now}
        assert now == first, "after undo"
        session.advance(1)
        settle(session)
        assert session.shown.frame is not None
        assert places(session.shown.frame).keys() >= first.keys()
        session.seek(2.5)
        settle(session)
        earlier = places(session.shown.frame).keys()  # trees that ended since then are among them
        assert len(earlier & first.keys()) > 0.9 * len(earlier)


def test_once_the_run_goes_on_a_map_that_was_left_is_made_again(session):
    session.set_parameters(FEWER, 1, whole=True)
    remapped(session)
    session.set_parameters(BASE, 2, whole=True)
    session.advance(1)
    settle(session)
    session.set_parameters(BASE, 3, whole=True)
    frame, _ = remapped(session)
    assert (content_of(frame), content_of(session.shown.path)) == mapped_with(BASE, frame.index)


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [FEWER, WIDER, LATER])
def test_it_goes_on_and_back_as_if_it_had_been_so_from_the_start(session, parameters):
    session.set_parameters(parameters, 1, whole=True)
    remapped(session)
    for index in (6, 15):
        session.seek(0.1 * index)
        settle(session)
        assert (content_of(session.shown.frame), content_of(session.shown.path)) == mapped_with(
            parameters, index
        )


def test_the_standing_scan_comes_first_then_the_preview_then_the_map(session, monkeypatch):
    heard: list[tuple[int, int]] = []
    segmented: list[int] = []
    session.on_preview = lambda revision, trees: heard.append((revision, len(trees.number)))
    segment = Mapper.segment

    def segment_and_note(mapper: Mapper, step: Step) -> SegmentedScan:
        segmented.append(step.index)
        return segment(mapper, step)

    monkeypatch.setattr(Mapper, "segment", segment_and_note)
    for revision, change in enumerate([{"clustering.eps": 0.25}, {"detection.e_max": 12.0}], 1):
        frame = session.set_parameters(BASE.replace(change), revision, whole=True)
        assert frame is not None
        assert (segmented, heard) == ([frame.index], []), "nothing else is in the way of the answer"
        rerun = session.run._remapping.rerun
        while not heard:
            assert session.remap() is None
            assert rerun.done <= 1
        frame, _ = remapped(session)
        ((of_revision, trees),) = heard
        assert of_revision == revision
        assert abs(int(frame.trees.confirmed.sum()) - trees) <= 2
        heard.clear()
        segmented.clear()


@pytest.mark.parametrize("begun_before", [False, True])
def test_where_the_scan_is_sought_first_it_comes_once_the_scan_is_there(session, begun_before):
    heard: list[int] = []
    session.on_preview = lambda revision, _: heard.append(revision)
    if begun_before:
        session.set_parameters(WIDER, 1, whole=True)
        while not heard:
            session.remap()
        session.seek(2.0)
        settle(session)
        assert heard == [1]
    session.seek(1.5)
    session.set_parameters(FEWER, 2, whole=True)
    assert heard == [1] * begun_before
    settle(session)
    remapped(session)
    assert heard == [*[1] * begun_before, 2]


def test_a_newer_change_stops_an_older_one(session):
    session.set_parameters(WIDER, 1, whole=True)
    for _ in range(5):
        session.remap()
    session.set_parameters(FEWER, 2, whole=True)
    frame, _ = remapped(session)
    assert content_of(frame) == mapped_with(FEWER, frame.index)[0]


def test_what_a_held_slider_changes_is_told_against_the_map_before_it_was_taken(session):
    def changes_after(parameters: Parameters, revision: int, step: int) -> MapChanges:
        session.set_parameters(parameters, revision, whole=True, step=step)
        return remapped(session)[1]

    none = BASE.replace({"classification.tree_share": 1.0, "tracking.hits_to_confirm": 30})
    first = changes_after(FEWER, 1, 1)
    second = changes_after(none, 2, 1)
    third = changes_after(FEWER, 3, 1)
    assert first.ghost == second.ghost == third.ghost
    assert (first.before, first.after, first.changes) == (third.before, third.after, third.changes)
    assert second.after < second.before
    other = changes_after(BASE, 4, 2)
    assert other.before == third.after


def test_a_change_from_here_on_leaves_the_map_before_it(session):
    session.set_parameters(WIDER, 1, whole=True)
    for _ in range(5):
        session.remap()
    session.set_parameters(FEWER, 2)
    assert not session.is_remapping
    assert session.status().remapped is None


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("parameters", [FEWER, LATER])
@pytest.mark.parametrize("done", [3, 18])
def test_who_goes_back_meanwhile_gets_the_map_of_where_he_is(session, done, parameters):
    session.set_parameters(parameters, 1, whole=True)
    for _ in range(done):
        session.remap()
    session.seek(1.5)
    assert not session.is_remapping  # until it is there
    settle(session)
    frame, _ = remapped(session)
    assert frame.index == 15
    assert content_of(frame) == mapped_with(parameters, 15)[0]


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [FEWER, LATER])
def test_it_goes_on_while_the_run_plays(session, parameters):
    session.seek(1.0)
    settle(session)
    session.set_parameters(parameters, 1, whole=True)
    session.play()
    done = None
    while done is None:
        session.work()
        done = session.remap() or session.remap()
    frame, _ = done
    assert content_of(frame) == mapped_with(parameters, frame.index)[0]
    after = session.work()
    assert content_of(after) == mapped_with(parameters, frame.index + 1)[0]


def test_a_change_of_the_trees_maps_only_the_current_scan_again(session, monkeypatch):
    mapped: list[int] = []
    process = Mapper.process

    def process_and_note(mapper: Mapper, step: Step, scan: SegmentedScan | None = None) -> Frame:
        mapped.append(step.index)
        return process(mapper, step, scan)

    monkeypatch.setattr(Mapper, "process", process_and_note)
    for revision, wanted in enumerate([LATER, BASE.replace({"tracking.hits_to_confirm": 2})], 1):
        mapped.clear()
        session.set_parameters(wanted, revision, whole=True)
        frame, _ = remapped(session)
        assert set(mapped) == {frame.index}
        assert (content_of(frame), content_of(session.shown.path)) == mapped_with(wanted, frame.index)
    session.seek(0.7)  # from a stored scan, or mapped again
    settle(session)
    assert content_of(session.run.map_again()) == mapped_with(wanted, 7)[0]


def test_where_all_scans_are_stored_the_source_is_not_read(session, monkeypatch):
    def nothing() -> Iterator[Step]:
        raise AssertionError("the source is read")

    monkeypatch.setattr(session.run._cursor, "_read", nothing)
    session.set_parameters(WIDER, 1, whole=True)
    frame, _ = remapped(session)
    assert content_of(frame) == mapped_with(WIDER, frame.index)[0]


def results(session: Session, scans: int) -> list[object]:
    """What is stored of the first scans, without the times that it took."""
    run = session.run
    assert isinstance(run, Run)
    known = run._map
    assert known.frames is not None
    frames = [known.frames.read(index) for index in (3, 4, scans - 1, 0)]
    course = run.course(READ_QUANTITIES, LAST, stages=False)
    clusters, path = known.clusters, np.stack([run.path.x, run.path.y, run.path.yaw], axis=1)
    return [
        *((shown.frame, shown.path, shown.confirmed_s) if shown else None for shown in frames),
        course.values,
        course.time_s,
        known.counts.totals(scans - 1, [], {}),
        clusters.places(path[: len(clusters)], BASE),
        known.views(),
        known.history._rows.column(0),
        known.confirmed_s,
        sorted(known.snapshots._files),
    ]


def test_what_is_stored_after_a_change_of_the_trees_is_that_of_a_first_run(session):
    session.set_parameters(LATER, 1, whole=True)
    frame, _ = remapped(session)
    known = results(session, frame.index)
    with mapped_from_start(LATER, frame.index) as other:
        assert list(map(deep, known)) == list(map(deep, results(other, frame.index)))
    session.set_parameters(BASE, 2, whole=True)  # the map before goes on
    remapped(session)
    session.advance(1)
    settle(session)
    with mapped_from_start(BASE, frame.index + 1) as other:
        assert list(map(deep, results(session, frame.index))) == list(map(deep, results(other, frame.index)))


def deep(value: object) -> object:
    """Everything that a value holds, bit by bit."""
    if is_dataclass(value):
        return tuple(deep(getattr(value, f.name)) for f in fields(value))
    if isinstance(value, dict):
        return {key: deep(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return tuple(map(deep, value))
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    return repr(value)


def test_where_other_trees_close_another_loop_the_whole_run_is_mapped_again(session, monkeypatch):
    def differs(_rerun: TreeRerun) -> None:
        raise TreesDifferError

    monkeypatch.setattr(TreeRerun, "map_next", differs)
    session.set_parameters(LATER, 1, whole=True)
    frame, _ = remapped(session)
    assert (content_of(frame), content_of(session.shown.path)) == mapped_with(LATER, frame.index)


def test_what_is_no_part_of_the_map_begins_nothing(session):
    session.set_parameters(BASE.replace({"evaluation.match_distance": 0.3}), 1, whole=True)
    assert not session.is_remapping


def test_what_cannot_be_read_again_leaves_the_map_and_says_so(session, monkeypatch):
    run = session.run
    before = content_of(session.shown.frame)

    def nothing(_index: int) -> Iterator[object]:
        raise SourceError("the disk is gone")

    monkeypatch.setattr(run._cursor, "again", nothing)
    session.set_parameters(WIDER, 1)
    at_hand = content_of(session.shown.frame)
    session.set_parameters(WIDER, 2, whole=True)
    while session.is_remapping:
        assert session.remap() is None
    assert content_of(session.shown.frame) == at_hand != before
    assert any("was not mapped again" in w and "the disk is gone" in w for w in session.status().warnings)


def test_it_tells_which_trees_came_and_went_and_why():
    with closing(new_session()) as session:
        session.open(Open("sim:paper?duration=12", "auto", 3))
        session.set_parameters(BASE, 0)
        session.advance(120)
        settle(session)
        frame = session.shown.frame
        assert frame is not None
        known = int(np.count_nonzero(frame.trees.confirmed))
        assert known >= 2
        assert isinstance(session.run, Run)
        marked = dict(session.run._map.confirmed_s)
        # No column is ever a tree now; then all are back.
        session.set_parameters(BASE.replace({"classification.tree_share": 1.0}), 1, whole=True)
        _, none = remapped(session)
        session.set_parameters(BASE, 2, whole=True)
        again, back = remapped(session)
    assert (none.before, none.after) == (known, known - sum(c.kind == "vanished" for c in none.changes))
    gone = [change for change in none.changes if change.kind == "vanished"]
    assert gone
    assert all("votes for a tree" in change.why or "does not confirm" in change.why for change in gone)
    assert [(c.x, c.y) for c in back.changes if c.kind == "appeared"] == [(c.x, c.y) for c in gone]
    assert back.after == known
    assert content_of(again) == content_of(frame)
    assert dict(back.confirmed) == marked, "also of those that went again, where each was confirmed first"
    assert set(marked) >= set(frame.trees.number[frame.trees.confirmed].tolist())
    assert all(0.0 <= time_s <= 12.0 for _, time_s in back.confirmed)
    assert [time_s for _, time_s in back.confirmed] == sorted(marked.values())


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("begun_before", [False, True])
def test_a_change_on_the_way_to_another_scan_acts_on_the_whole_run_there(session, begun_before):
    if begun_before:
        session.set_parameters(WIDER, 1, whole=True)
        for _ in range(5):
            session.remap()
    session.seek(2.0)
    session.set_parameters(FEWER, 2, whole=True)
    assert not session.is_remapping
    settle(session)
    frame, changes = remapped(session)
    assert changes.revision == 2
    assert content_of(frame) == mapped_with(FEWER, frame.index)[0]
    session.play()
    assert content_of(session.work()) == mapped_with(FEWER, frame.index + 1)[0]


def test_a_fault_on_the_way_ends_it_and_is_told_once(session, monkeypatch):
    session.set_parameters(FEWER, 1, whole=True)
    for _ in range(3):
        session.remap()

    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(session.run._remapping.rerun.mapper, "process", broken)
    with pytest.raises(ZeroDivisionError):
        session.remap()
    assert not session.is_remapping
    session.set_parameters(WIDER, 2, whole=True)
    session.fail("the run stopped")
    assert not session.is_remapping


def test_without_room_for_the_scans_they_are_read_once_more_and_that_is_said(monkeypatch):
    monkeypatch.setattr("pipeline.io.block_file.SPARE_BYTES", 1 << 62)
    with closing(new_session()) as session:
        session.open(Open(URI, "auto", 3))
        session.set_parameters(BASE, 0)
        session.advance(8)
        settle(session)
        session.set_parameters(FEWER, 1, whole=True)
        assert any(
            "scan 0 and possibly later scans are not cached" in warning
            for warning in session.status().warnings
        )
        frame, _ = remapped(session)
        assert content_of(frame) == mapped_with(FEWER, frame.index)[0]
