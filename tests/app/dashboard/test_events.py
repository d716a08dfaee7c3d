"""The marks on the timeline: each event once, where it happened first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.dashboard.events import Events
from pipeline.types.records import Clearance, Health, Zone
from tests.app.fakes import frame


def seen(index: int, trees: int, health: Health | None = None):
    shot = frame(index, index, n_trees=trees)
    all_of_them = replace(shot.trees, confirmed=np.ones(trees, np.bool_))
    estimate = replace(shot.estimate, health=health or shot.health)
    return replace(shot, trees=all_of_them, estimate=estimate)


def marks(events: Events, *, before: bool = False) -> list[tuple[float, str, str]]:
    told = events.as_plain()["events"]
    return [(e["t"], e["kind"], e["text"]) for e in told if e.get("before", False) == before]


def test_a_tree_is_marked_where_it_was_confirmed_first():
    events = Events()
    assert events.shown(seen(0, 1), 0.0)
    assert not events.shown(seen(1, 1), 0.1)
    assert events.shown(seen(2, 2), 0.2)
    assert not events.shown(seen(1, 2), 0.1)  # the run went back
    assert marks(events) == [(0.0, "tree", "Tree 1 mapped"), (0.2, "tree", "Tree 2 mapped")]


def test_health_is_marked_when_it_changes_and_a_warning_when_it_is_new():
    events = Events()
    weak = Health(state="weak", reason="the wheels slip")
    assert events.shown(seen(3, 0, weak), 0.3)
    assert not events.shown(seen(4, 0, weak), 0.4)
    assert events.shown(seen(5, 0), 0.5)
    assert events.warned(["jumped"], 0.6)
    assert not events.warned(["jumped"], 0.7)
    assert marks(events) == [
        (0.3, "health", "SLAM weak: the wheels slip"),
        (0.5, "health", "SLAM good"),
        (0.6, "warning", "jumped"),
    ]


def lasting(events: Events) -> list[tuple[float, str, float | None]]:
    return [(e["t"], e["kind"], e["for_s"]) for e in events.as_plain()["events"] if "for_s" in e]


def test_stops_silences_and_doubts_are_logged_with_their_durations():
    events = Events()
    weak, lost = Health(state="weak", reason="the wheels slip"), Health(state="lost", reason="no trees")
    stopped = replace(seen(2, 0), clearance=Clearance(Zone.STOP, ahead=0.8))
    assert events.shown(seen(0, 0, weak), 0.0)
    assert events.shown(seen(1, 0, lost), 0.4)
    assert events.shown(stopped, 1.0)
    assert not events.shown(stopped, 1.1)
    assert lasting(events) == [(0.0, "health", 0.4), (0.4, "health", 0.6), (1.0, "stop", None)]
    assert events.shown(replace(seen(4, 0), clearance=Clearance(Zone.SLOW, ahead=1.5)), 3.5)
    assert events.silent("Nothing heard for 2 s: the robot is gone", 3.5)
    assert not events.silent("Nothing heard for 3 s: the robot is gone", 3.5)
    assert lasting(events)[-1] == (3.5, "silence", None)
    assert events.shown(seen(5, 0), 15.5)
    assert lasting(events)[-3:] == [(1.0, "stop", 2.5), (3.5, "slow", 0.0), (3.5, "silence", 12.0)]
    assert (3.5, "slow", "Obstacle in the slow zone, 1.50 m ahead at its nearest") in marks(events)
    assert (15.5, "silence", "Data again") in marks(events)
    assert (1.0, "stop", "Obstacle in the stop zone, 0.80 m ahead at its nearest") in marks(events)
    assert events.silent("gone again", 15.5)


def test_stops_and_doubts_end_at_a_silence_and_begin_again_after_it():
    events, lost = Events(), Health(state="lost", reason="no trees")
    stopped = replace(seen(0, 0, lost), clearance=Clearance(Zone.STOP, ahead=0.8))
    events.shown(stopped, 1.0)
    events.silent("Nothing heard for 2 s: the robot is gone", 3.0)
    silent = [(1.0, "health", 2.0), (1.0, "stop", 2.0), (3.0, "silence", None)]
    assert lasting(events) == silent
    events.shown(stopped, 3.0)  # the last scan, mapped with other parameters
    assert not events.silent("Nothing heard for 9 s: the robot is gone", 3.0)
    assert lasting(events) == silent
    events.shown(replace(stopped, index=1), 60.0)
    events.shown(replace(seen(2, 0), clearance=Clearance(Zone.CLEAR)), 64.0)
    assert lasting(events) == [
        (1.0, "health", 2.0),
        (1.0, "stop", 2.0),
        (3.0, "silence", 57.0),
        (60.0, "health", 4.0),
        (60.0, "stop", 4.0),
    ]
    events.silent("gone", 65.0)
    events.shown(seen(3, 0), 70.0)
    assert len(lasting(events)) == 6


def test_an_obstacle_is_logged_with_its_least_distance():
    events = Events()
    ahead = [(Zone.SLOW, 2.5), (Zone.SLOW, 2.0), (Zone.STOP, 0.9), (Zone.STOP, 0.14), (Zone.STOP, 0.5)]
    for k, (zone, distance) in enumerate([*ahead, (Zone.SLOW, 1.2), (Zone.CLEAR, np.inf), (Zone.SLOW, 2.9)]):
        has_changed = events.shown(replace(seen(k, 0), clearance=Clearance(zone, ahead=distance)), 0.1 * k)
        assert has_changed == (k != 4), "the page follows"
    nearest = [(t, text) for t, _, text in marks(events) if text.startswith("Obstacle")]
    assert nearest == [
        (0.0, "Obstacle in the slow zone, 0.14 m ahead at its nearest"),
        (0.2, "Obstacle in the stop zone, 0.14 m ahead at its nearest"),
        (0.7, "Obstacle in the slow zone, 2.90 m ahead at its nearest"),
    ]
    events.shown(replace(seen(1, 0), clearance=Clearance(Zone.SLOW, ahead=2.0)), 0.1)  # a person went back
    assert [(t, text) for t, _, text in marks(events) if text.startswith("Obstacle")] == nearest


def test_a_gap_of_a_recording_is_a_silence_at_which_a_stop_ends():
    events, stopped = Events(), replace(seen(0, 0), clearance=Clearance(Zone.STOP, ahead=0.8))
    scans = np.array([0.0, 1.0, 77.0, 77.5, 80.0])
    stamps = (1e9 * scans).astype(np.int64)
    for until in (1, 2, 3, 4, 2, 3, 4):  # also after a person went back
        events.shown(replace(stopped, index=until), scans[until - 1], None, stamps[:until])
    silences = [(1.0, "silence", 76.0)]
    assert lasting(events) == [(0.0, "stop", 1.0), *silences, (77.0, "stop", None)]
    events.forget()
    events.shown(stopped, 0.0, None, stamps[:1])
    events.shown(replace(seen(4, 0), clearance=Clearance(Zone.CLEAR)), 80.0, None, stamps)  # a jump ahead
    assert lasting(events) == [(0.0, "stop", 1.0), *silences, (77.5, "silence", 2.5)]


def test_a_sensor_with_a_scan_in_five_seconds_is_not_silent_between_them():
    events, scans = Events(), np.array([0.0, 5.0, 10.0, 15.0, 60.0, 65.0])
    stamps = (1e9 * scans).astype(np.int64)
    for until in range(1, 7):
        events.shown(seen(until, 0), scans[until - 1], None, stamps[:until])
    assert lasting(events) == [(15.0, "silence", 45.0)]


class Clock:
    """Stands in for the module `time`."""

    def __init__(self, now: float) -> None:
        self.now = now

    def time(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of this computer at 1000 s."""
    made = Clock(1000.0)
    monkeypatch.setattr("app.dashboard.events.time", made)
    return made


def test_a_link_that_stalls_is_silent_by_the_clock_of_the_reader(clock: Clock):
    events = Events()
    events.shown(seen(0, 0), 5.0)
    events.silent("Nothing heard for 2 s: /scan is announced and silent", 5.0, 2.0)
    clock.now = 1020.0
    events.shown(seen(1, 0), 5.1)  # the link delivers what it held back
    silence, again = events.as_plain()["events"]
    assert (silence["t"], silence["noted_s"], silence["for_s"]) == (5.0, 998.0, 22.0)
    assert (again["t"], again["noted_s"], again["text"]) == (5.1, 1020.0, "Data again")


def test_a_pause_is_logged_with_the_silences_in_it_and_ends_a_stop(clock: Clock):
    events = Events()
    stopped = replace(seen(0, 0), clearance=Clearance(Zone.STOP, ahead=0.8))
    events.shown(stopped, 4.0)
    assert events.paused(True, 5.0)
    assert not events.paused(True, 5.0)
    for began, ended in ((1010.0, 1030.0), (1040.0, 1050.0)):
        clock.now = began
        assert events.silent("gone", 5.0, 1.0)
        clock.now = ended
        assert events.heard(5.0)
        assert not events.heard(5.0)
    clock.now = 1060.0
    assert events.paused(False, 5.0)
    events.shown(stopped, 65.0)
    assert lasting(events) == [
        (4.0, "stop", 1.0),
        (5.0, "pause", 60.0),
        (5.0, "silence", 21.0),
        (5.0, "silence", 11.0),
        (65.0, "stop", None),
    ]


def test_a_recording_is_logged_and_outlasts_a_silence(clock: Clock):
    events = Events()
    assert not events.recorded("", "", 0.0)
    assert events.recorded("recording a.mcap, 0 MB", "/a.mcap", 1.0)
    events.silent("Nothing heard for 2 s: the robot is gone", 3.0)
    assert not events.recorded("finishing a.mcap", "/a.mcap", 4.0)
    clock.now += 8.0  # it goes on while the run is paused
    assert events.recorded("recorded a.mcap, 3 MB", "/a.mcap", 6.0)
    assert lasting(events)[0] == (1.0, "recording", 8.0)
    told = [(1.0, "recording", "Recording: /a.mcap"), (6.0, "recording", "Recorded a.mcap, 3 MB: /a.mcap")]
    assert [mark for mark in marks(events) if mark[1] == "recording"] == told


def test_a_recording_that_cannot_begin_is_logged_once():
    events = Events()
    assert events.recorded("not recording: no space is left", "", 1.0)
    assert not events.recorded("not recording: no space is left", "", 1.5)
    assert marks(events) == [(1.0, "recording", "Not recording: no space is left")]


def test_from_the_slow_to_the_stop_zone_no_obstacle_goes():
    events = Events()
    for k, zone in enumerate([Zone.SLOW, Zone.STOP, Zone.UNKNOWN, None, Zone.STOP, Zone.SLOW, Zone.CLEAR]):
        ahead = None if zone is None else Clearance(zone, ahead=1.0)
        events.shown(replace(seen(k, 0), clearance=ahead), 0.1 * k)
    assert [(round(10 * at), text.partition(",")[0]) for at, _, text in marks(events)] == [
        (0, "Obstacle in the slow zone"),
        (1, "Obstacle in the stop zone"),
        (5, "No obstacle in the stop zone"),
        (6, "No obstacle in the slow zone"),
    ]


def test_a_log_of_a_live_run_outlasts_many_trees_and_a_rerun():
    events = Events()
    events.shown(seen(0, 0, Health(state="lost", reason="no trees")), 0.0)
    events.shown(seen(1, 900), 5.0)
    assert lasting(events) == [(0.0, "health", 5.0)]
    events.remapped([(1, 0.2)], 5.0, live=True)
    assert lasting(events) == [(0.0, "health", 5.0)]
    assert events.shown(seen(2, 0, Health(state="weak", reason="again")), 6.0)
    events.remapped([(1, 0.2)], 6.0)
    assert lasting(events) == []


def test_a_slider_that_moves_is_one_change_and_one_that_came_back_is_none():
    events = Events()
    events.shown(seen(0, 1), 0.0)
    events.shown(seen(9, 2), 0.9)
    events.changed({"a": 1, "b": 2}, {"a": 1.5, "b": 2}, 0.5)
    events.changed({"a": 1.5, "b": 2}, {"a": 2, "b": 2}, 0.5)
    assert marks(events) == [(0.0, "tree", "Tree 1 mapped"), (0.5, "change", "a: 1 → 2")]
    events.changed({"a": 2, "b": 2}, {"a": 1, "b": 2}, 0.5)
    assert [kind for _, kind, _ in marks(events)] == ["tree"]


def test_after_a_rerun_the_marks_of_the_part_that_is_still_to_come_stay_until_it_comes():
    events = Events()
    for index, trees in [(0, 1), (9, 2), (20, 3)]:
        events.shown(seen(index, trees), 0.1 * index)
    events.changed({"a": 1}, {"a": 2}, 0.5)  # the run had gone back
    later = [(0.9, "tree", "Tree 2 mapped"), (2.0, "tree", "Tree 3 mapped")]
    assert marks(events, before=True) == later
    events.remapped([(1, 0.2)], 0.5)
    now = [(0.2, "tree", "Tree 1 mapped"), (0.5, "change", "a: 1 → 2")]
    assert (marks(events), marks(events, before=True)) == (now, later)
    assert events.shown(seen(12, 2), 1.2)
    assert marks(events) == [*now, (1.2, "tree", "Tree 2 mapped")]
    assert marks(events, before=True) == later[1:]
    assert events.shown(seen(20, 2), 2.0)  # a mark that is none any more
    assert marks(events, before=True) == []


def test_what_was_passed_over_is_marked_where_it_was_and_not_where_it_was_shown():
    events = Events()
    events.shown(seen(30, 2), 3.0, np.array([0.4, np.nan]))
    assert marks(events) == [(0.4, "tree", "Tree 1 mapped"), (3.0, "tree", "Tree 2 mapped")]


def test_edits_at_one_time_are_one_mark_that_counts_them_and_stay_when_parameters_change():
    events = Events()
    events.annotated("Ann", 1, 0.5)
    assert marks(events) == [(0.5, "annotation", "Ann edited an annotation")]
    events.annotated("Bob", 2, 0.5)
    events.annotated("", 1, 0.9)
    events.changed({"a": 1}, {"a": 2}, 0.1)
    assert [(t, text) for t, kind, text in marks(events) if kind == "annotation"] == [
        (0.5, "Bob edited 3 annotations"),
        (0.9, "Somebody edited an annotation"),
    ]


def test_of_more_trees_than_marks_none_is_confirmed_again():
    events = Events()
    assert events.shown(seen(0, 600), 0.0)
    told = marks(events)
    assert not events.shown(seen(1, 600), 0.1)
    assert marks(events) == told
    assert {t for t, _, _ in told} == {0.0}


def test_a_growing_count_is_one_event_and_warnings_displace_no_lost_pose():
    events = Events()
    events.shown(seen(0, 0, Health(state="lost", reason="no tree is known")), 0.0)
    for k in range(1, 500):
        events.warned([f"scans lost on the network ({k})"], 0.1 * k)
    assert marks(events)[1:] == [(0.1, "warning", "scans lost on the network")]
    for k in range(500):
        events.warned([f"warning {k}"], 60.0 + k)
    assert marks(events)[0] == (0.0, "health", "SLAM lost: no tree is known")
    assert len(marks(events)) == 400


@given(st.lists(st.tuples(st.integers(0, 900), st.integers(0, 60)), max_size=40))
def test_they_are_bounded_and_in_order(scans: list[tuple[int, int]]):
    events = Events()
    for index, trees in scans:
        events.shown(seen(index, trees), 0.1 * index)
        events.warned([f"{index} {trees} {k}" for k in range(trees)], 0.1 * index)
    told = marks(events)
    assert len(told) <= 400
    assert [t for t, _, _ in told] == sorted(t for t, _, _ in told)
    events.forget()
    assert marks(events) == []
