"""The worker's loop and its mailbox, in process: no scan is lost, statuses are kept, newest picture wins."""

from __future__ import annotations

import io
import itertools
import os
import queue
import threading
import time
from dataclasses import replace
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from app.common.text import COMPILING
from app.worker.loop import WorkerLoop
from app.worker.outbox import MOST_POINTS, Outbox, RecentScans, picture_of
from app.worker.protocol import (
    Advance,
    Answer,
    AskCluster,
    AskTree,
    Begin,
    FromWorker,
    Open,
    Opened,
    Pause,
    Play,
    Report,
    Seek,
    SetParameters,
    SetSpeed,
    Shown,
    State,
    Status,
    ToWorker,
    Unmapped,
    from_worker,
)
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.geometry.columns import rows_in_common
from tests.app.explain.stories import cluster_story
from tests.app.fakes import FakeSource, frame, make_session, opened, path


def driven(source: FakeSource, *commands: ToWorker) -> list[FromWorker]:
    """All that a driver says to commands that follow one another at once, until it stands still."""
    waiting: queue.Queue[ToWorker | None] = queue.Queue()
    said: list[FromWorker] = []
    pending = list(commands)
    session = make_session(source)

    def put(message: FromWorker) -> None:
        said.append(message)
        if isinstance(message, Report) and session.pace == "idle" and waiting.empty():
            waiting.put(pending.pop(0) if pending else None)

    now = [0.0]

    def clock() -> float:
        now[0] += 0.001
        return now[0]

    thread = threading.Thread(target=WorkerLoop(session, waiting, put, clock).run, daemon=True)
    thread.start()
    thread.join(20)
    assert not thread.is_alive()
    return said


def shown(said: list[FromWorker]) -> list[int]:
    return [message.frame.index for message in said if isinstance(message, Shown)]


def last_status(said: list[FromWorker]) -> Any:
    return [message.status for message in said if isinstance(message, Report)][-1]


def test_playing_shows_every_scan_and_ends_finished() -> None:
    said = driven(FakeSource(30), Open("fake:"), SetSpeed(0.0), Play())
    assert sorted(set(shown(said))) == list(range(30))
    assert last_status(said).state == "finished"
    assert last_status(said).speed == 0.0
    assert any(isinstance(message, Opened) for message in said)


def begin(run: int, eps: float = 0.15, *, play: bool = True) -> Begin:
    return Begin(run, Parameters().replace({"clustering.eps": eps}).model_dump(), 4, play)


def test_nothing_is_said_to_play_before_the_first_scan_is_ready() -> None:
    said = driven(FakeSource(5), Open("fake:"), begin(1))
    states = [m.status.state for m in said if isinstance(m, Report) and m.status.source == "fake:"]
    assert states.index("playing") > states.index("starting")
    first_picture = next(k for k, m in enumerate(said) if isinstance(m, Shown))
    before = [m.status for m in said[:first_picture] if isinstance(m, Report) and m.status.revision == 4]
    assert before[0].state == "starting"
    assert before[0].detail == "Preparing the mapper"


def test_compilation_is_reported_with_its_progress_and_no_silence_follows() -> None:
    session, said = make_session(FakeSource(9)), list[FromWorker]()
    commands: queue.Queue[ToWorker | None] = queue.Queue()

    def put(message: FromWorker) -> None:
        said.append(message)
        if isinstance(message, Shown) and message.frame.index == 2:
            for _ in range(3):
                driver.compiling()
        if isinstance(message, Report) and message.status.state == "finished":
            commands.put(None)

    clock = itertools.count(
        step=0.6
    ).__next__  # the second of three calls comes within the second of the first
    driver = WorkerLoop(session, commands, put, clock, kernels=iter([(60, 240), (180, 240)]).__next__)
    for command in (Open("fake:"), SetSpeed(0.0), Play()):
        commands.put(command)
    driver.run()
    reports = [m.status for m in said if isinstance(m, Report)]
    waiting = [status for status in reports if status.state == "waiting"]
    assert [status.compiled for status in waiting] == [0.25, 0.75]
    assert [status.kernels_left for status in waiting] == [180, 60]
    for status in waiting:
        assert (status.detail, status.source) == (COMPILING.capitalize(), "fake:")
        assert time.time() - 60.0 < (status.compiling_since_s or 0.0) <= time.time()
    after = reports[reports.index(waiting[-1]) + 1]
    assert (after.compiling_since_s, after.compiled) == (None, None)
    assert (after.state, after.detail) == ("playing", "")


def test_a_compilation_while_a_source_is_opened_is_reported_of_that_source() -> None:
    session, said = make_session(FakeSource(3)), list[FromWorker]()
    commands: queue.Queue[ToWorker | None] = queue.Queue()
    open_source = session._open_source

    def compiles(uri: str, options: Any) -> Any:
        driver.compiling()
        return open_source(uri, options)

    session._open_source = compiles
    kernels = itertools.cycle([(60, 240)]).__next__
    driver = WorkerLoop(session, commands, said.append, itertools.count(step=0.6).__next__, kernels=kernels)
    for command in (Open("fake:one"), Open("fake:two"), None):
        commands.put(command)
    driver.run()
    waiting = [m.status for m in said if isinstance(m, Report) and m.status.kernels_left == 180]
    assert [(status.source, status.state) for status in waiting][-1] == ("fake:two", "starting")
    assert waiting[-1].detail == COMPILING.capitalize()


def test_points_and_the_time_line_are_there_before_the_kernels() -> None:
    session, said = make_session(FakeSource(9), compiling=lambda: iter([False] * 4)), list[FromWorker]()
    commands: queue.Queue[ToWorker | None] = queue.Queue()

    def put(message: FromWorker) -> None:
        said.append(message)
        if isinstance(message, Report) and message.status.state == "finished":
            commands.put(None)

    driver = WorkerLoop(session, commands, put, itertools.count(step=0.3).__next__)
    for command in (Open("fake:"), SetSpeed(0.0), Play()):
        commands.put(command)
    driver.run()
    points = [message for message in said if isinstance(message, Unmapped)]
    assert [(message.run, message.frame.index) for message in points] == [(1, 0), (1, 1), (1, 2)]
    assert all(len(message.frame.raw) for message in points)
    before = said[: next(k for k, message in enumerate(said) if isinstance(message, Shown))]
    assert all(message in before for message in points)
    reports = [message.status for message in before if isinstance(message, Report)]
    waiting = [status for status in reports if status.unmapped == 3 and status.state == "starting"]
    assert {(status.scans, status.end_s, status.scan_index) for status in waiting} == {(9, 0.8, -1)}
    assert shown(said)[0] == 0  # mapping begins with the first scan all the same


def test_an_answer_that_compiled_leaves_nothing_to_wait_for(monkeypatch: pytest.MonkeyPatch) -> None:
    session, said = make_session(FakeSource(3)), list[FromWorker]()
    waiting: queue.Queue[ToWorker | None] = queue.Queue()
    for message in (Open("fake:"), AskTree(1, 1, 1), None):
        waiting.put(message)
    driver = WorkerLoop(session, waiting, said.append)

    def compile_first(_run: object, _frame: object, number: int, _mapped: object) -> None:
        driver.compiling()
        raise StemmapError(f"tree {number} is not known")

    monkeypatch.setattr("app.worker.loop.tree_story", compile_first)
    driver.run()
    assert any(m.status.detail == COMPILING.capitalize() for m in said if isinstance(m, Report))
    assert last_status(said).detail == ""


def test_the_answer_to_an_opening_begins_that_run_only() -> None:
    said = driven(FakeSource(5), Open("first:"), Open("second:"), begin(1, 0.9), begin(2, 0.3), Pause())
    assert [message.run for message in said if isinstance(message, Opened)] == [1, 2]
    assert last_status(said).source == "second:"
    assert not [
        m for m in said if isinstance(m, Report) and m.status.source == "first:" and m.status.revision
    ]
    expected = driven(FakeSource(5), SetParameters(begin(1, 0.3).values, 4), Open("second:"), Play())
    assert pictures(said) == pictures(expected)


def test_a_late_answer_alone_plays_nothing() -> None:
    said = driven(FakeSource(5), Open("first:"), Open("second:"), begin(1))
    assert shown(said) == []
    assert last_status(said).state == "paused"


def test_a_pause_while_opening_is_kept_and_without_play_the_first_scan_is_shown() -> None:
    said = driven(FakeSource(5), Open("fake:"), Pause(), begin(1))
    assert (shown(said), last_status(said).state) == ([], "paused")
    assert last_status(said).revision == 4
    said = driven(FakeSource(5), Open("fake:"), begin(1, play=False))
    assert set(shown(said)) == {0}
    assert last_status(said).state == "paused"


def test_a_run_that_is_opened_again_by_play_is_a_run_of_its_own() -> None:
    said = driven(FakeSource(5, fails_at=2), Open("fake:"), SetSpeed(0.0), Play(), Play())
    runs = [message.run for message in said if isinstance(message, Opened)]
    assert runs == [1, 2]
    assert [m.run for m in said if isinstance(m, Shown)] == [1, 1, 2, 2]


def pictures(said: list[FromWorker]) -> dict[int, float]:
    return {m.frame.index: m.frame.estimate.T_map_base.x for m in said if isinstance(m, Shown)}


@pytest.mark.slow
def test_on_a_long_way_the_status_says_where_it_goes() -> None:
    said = driven(FakeSource(900), Open("fake:"), Seek(85.0))
    on_the_way = [m.status for m in said if isinstance(m, Report) and m.status.detail.startswith("Going")]
    assert on_the_way
    assert {(s.detail, s.going_far) for s in on_the_way} == {("Going to 1:25 …", True)}
    assert {status.going_to_s for status in on_the_way} == {85.0}
    assert (last_status(said).detail, last_status(said).going_to) == ("", "")
    said = driven(FakeSource(90), Open("fake:"), Advance(3))
    assert not [m for m in said if isinstance(m, Report) and m.status.detail.startswith("Going")]


def test_a_change_shows_the_standing_scan_again() -> None:
    other = Parameters().replace({"clustering.eps": 0.9})
    said = driven(FakeSource(9), Open("fake:"), Advance(2), SetParameters(other.model_dump(), 8))
    pictures = [message for message in said if isinstance(message, Shown)]
    assert [p.frame.index for p in pictures[-2:]] == [1, 1]
    assert pictures[-1].frame.estimate.T_map_base != pictures[-2].frame.estimate.T_map_base
    assert last_status(said).revision == 8


def test_of_a_slider_that_moves_only_the_last_value_is_mapped() -> None:
    commands: queue.Queue[ToWorker | None] = queue.Queue()
    session = make_session(FakeSource(9))
    said: list[FromWorker] = []
    session.open(Open("fake:", "auto", 0))
    session.advance(1)
    while session.pace == "hurry":
        session.work()
    for k in range(1, 40):
        values = Parameters().replace({"clustering.eps": 0.1 * k}).model_dump()
        commands.put(SetParameters(values, k))
    commands.put(None)
    WorkerLoop(session, commands, said.append).run()
    assert shown(said) == [0]
    assert last_status(said).revision == 39


@pytest.mark.parametrize(
    ("source", "uri", "words"),
    [
        (FakeSource(5), "missing:", "there is no such file (missing:)"),
        (FakeSource(5, fails_at=2), "fake:", "the file ends here (scan 2)"),
    ],
)
def test_a_failure_is_a_state_and_another_source_can_be_opened(
    source: FakeSource, uri: str, words: str
) -> None:
    said = driven(source, Open(uri), Advance(5), Open("fake:"), Advance(1))
    failed = [m.status for m in said if isinstance(m, Report) and m.status.state == "failed"]
    assert words in failed[-1].detail
    assert last_status(said).state == "paused"
    assert shown(said)[-1] == 0


def test_a_fault_is_logged_and_survived(capsys: pytest.CaptureFixture[str]) -> None:
    broken = Parameters().replace({"clustering.eps": 5.0})
    said = driven(
        FakeSource(5),
        Open("fake:"),
        SetParameters(broken.model_dump(), 1),
        Advance(1),
        SetParameters(Parameters().model_dump(), 2),
        Advance(3),
    )
    assert "ZeroDivisionError: a fault on purpose" in capsys.readouterr().err
    assert shown(said)[-1] == 2
    assert last_status(said).state == "paused"


def test_values_that_are_no_parameters_are_refused() -> None:
    said = driven(FakeSource(5), Open("fake:"), SetParameters({"clustering": {"eps": "wide"}}, 1))
    assert "clustering.eps" in last_status(said).detail


def received(stream: io.BytesIO) -> list[FromWorker]:
    stream.seek(0)
    messages = []
    while (message := from_worker().read(stream)) is not None:
        messages.append(message)
    return messages


def test_the_newest_picture_wins_and_other_messages_are_all_sent() -> None:
    incoming, outgoing = os.pipe()
    with os.fdopen(incoming, "rb") as reading, os.fdopen(outgoing, "wb") as writing:
        mailbox = Outbox(writing)
        xs: list[float] = []
        for k in range(300):
            xs.append(float(k))
            mailbox.put(Shown(1, 0.1 * k, frame(k, k), 0, path(xs)))
            if k % 10 == 0:
                mailbox.put(Answer(k))
        collected: list[FromWorker] = []
        known: list[float] = []
        while not collected or not isinstance(collected[-1], Shown) or collected[-1].frame.index < 299:
            message = from_worker().read(reading)
            assert message is not None
            collected.append(message)
            if isinstance(message, Shown):
                known[message.path_start :] = message.path.x.tolist()
                assert known == xs[: message.frame.index + 1]
        mailbox.close()
    assert [message.ticket for message in collected if isinstance(message, Answer)] == list(range(0, 300, 10))
    assert shown(collected) == sorted(set(shown(collected)))
    assert len(shown(collected)) < 300


def test_a_status_replaces_an_unsent_status_of_the_same_state_only() -> None:
    class SlowStream(io.BytesIO):
        """Its first write waits until all messages are in the mailbox."""

        def write(self, data: Any) -> int:
            begun.set()
            assert may_write.wait(20.0)
            return super().write(data)

    begun, may_write = threading.Event(), threading.Event()
    stream = SlowStream()
    mailbox = Outbox(stream)
    mailbox.put(Answer(1))
    assert begun.wait(20.0)
    mailbox.put(Report(Status(state="starting", source="missing:")))
    for k in range(3):
        mailbox.put(Report(Status(state="failed", source="missing:", revision=k)))
    may_write.set()
    mailbox.close(20.0)
    statuses = [message.status for message in received(stream) if isinstance(message, Report)]
    assert [(status.state, status.revision) for status in statuses] == [("starting", 0), ("failed", 2)]


@pytest.mark.parametrize("state", ["paused", "finished"])
def test_a_standing_status_follows_the_frame_of_its_scan(state: State) -> None:
    stream = io.BytesIO()
    mailbox = Outbox(stream)
    for k in range(3):  # within the shortest pause between two frames
        mailbox.put(Shown(1, 0.1 * k, frame(k, k), 0, path([0.0])))
        mailbox.put(Report(Status(state=state, scan_index=k)))
    mailbox.close(5.0)
    *_, before, last = received(stream)
    assert isinstance(before, Shown)
    assert isinstance(last, Report)
    assert before.frame.index == last.status.scan_index == 2


def test_no_picture_of_the_run_before_follows_an_opening() -> None:
    stream = io.BytesIO()
    mailbox = Outbox(stream)
    for k in range(5):
        mailbox.put(Shown(1, 0.0, frame(k, k), 0, path([1.0])))
    mailbox.put(opened())
    mailbox.put(Shown(2, 0.0, frame(9, 9), 0, path([5.0, 6.0])))
    mailbox.close(5.0)
    messages = received(stream)
    at = next(k for k, message in enumerate(messages) if isinstance(message, Opened))
    after = [message for message in messages[at:] if isinstance(message, Shown)]
    assert [(message.run, message.path_start) for message in after] == [(2, 0)]


def test_a_path_that_was_rewritten_is_sent_from_where_it_differs() -> None:
    old, new = path([0.0, 1.0, 2.0]), path([0.0, 1.5, 2.0, 3.0])
    assert rows_in_common(old, new) == 1
    assert rows_in_common(new, path([0.0])) == 1


def test_a_huge_scan_is_thinned_evenly_in_the_picture_and_only_there() -> None:
    n = 3 * MOST_POINTS + 7
    x = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(np.float32)
    labels = (np.arange(n) % 5).astype(np.int32)
    whole = replace(frame(0, 0), raw=x, filtered=x, labels=labels)
    stream = io.BytesIO()
    mailbox = Outbox(stream)
    mailbox.put(Shown(1, 0.0, whole, 0, path([0.0])))
    mailbox.close(20.0)
    (message,) = received(stream)
    assert isinstance(message, Shown)
    picture = message.frame
    assert len(picture.raw) == len(picture.filtered) == len(picture.labels) == MOST_POINTS
    assert set(np.diff(picture.raw[:, 0])) == {3.0, 4.0}
    np.testing.assert_array_equal(picture.filtered[:, 0].astype(np.int64) % 5, picture.labels)
    assert picture.counts["not drawn"] == 2 * (n - MOST_POINTS)
    assert len(whole.raw) == n
    assert picture_of(frame(0, 0)).counts == frame(0, 0).counts


@pytest.mark.slow
def test_a_picture_that_cannot_be_sent_is_told_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.worker.protocol.LARGEST_MESSAGE", 100_000)
    stream = io.BytesIO()
    mailbox = Outbox(stream)
    first, second = path([0.0, 1.0]), path([0.0, 1.0, 2.0])
    huge = replace(frame(1, 1), raw=np.zeros((50_000, 3), np.float32))
    mailbox.put(Report(make_session(FakeSource(1)).status()))
    mailbox.put(Shown(1, 0.0, huge, 0, first))
    for _ in range(2000):  # until its turn has come
        if b"could not be shown" in stream.getvalue():
            break
        threading.Event().wait(0.01)
    mailbox.put(Shown(1, 0.1, frame(2, 2), 0, second))
    mailbox.close(20.0)
    quiet, told, shown_next = received(stream)
    assert isinstance(quiet, Report)
    assert quiet.status.warnings == []
    assert isinstance(told, Report)
    assert "larger than 100000" in told.status.warnings[-1]
    assert isinstance(shown_next, Shown)
    assert (shown_next.path_start, shown_next.path.x.tolist()) == (0, second.x.tolist())


def test_rows_of_the_odometry_are_those_of_the_path() -> None:
    stream = io.BytesIO()
    mailbox = Outbox(stream)
    odometry_xy = np.arange(6.0).reshape(3, 2)
    for n in (2, 3):
        shown = Shown(1, 0.1 * n, frame(n, n), 0, path([float(k) for k in range(n)]))
        mailbox.put(msgspec.structs.replace(shown, odometry_xy=odometry_xy[:n]))
        for _ in range(2000):
            if mailbox._picture is None:
                break
            threading.Event().wait(0.01)
    mailbox.close(20.0)
    first, second = received(stream)
    assert isinstance(first, Shown)
    assert isinstance(second, Shown)
    np.testing.assert_array_equal(first.odometry_xy, odometry_xy[:2])
    assert second.path_start == 2
    np.testing.assert_array_equal(second.odometry_xy, odometry_xy[2:])


def test_a_reader_that_is_gone_does_not_stop_the_loop() -> None:
    incoming, outgoing = os.pipe()
    os.close(incoming)
    writing = os.fdopen(outgoing, "wb", buffering=0)
    mailbox = Outbox(writing)
    mailbox.put(Shown(1, 0.0, frame(0, 0), 0, path([0.0])))
    mailbox.close(5.0)
    assert not mailbox._thread.is_alive()
    writing.close()


def test_who_asks_is_answered_and_the_run_goes_on_as_it_did() -> None:
    waiting: queue.Queue[ToWorker | None] = queue.Queue()
    said: list[FromWorker] = []

    def put(message: FromWorker) -> None:
        said.append(message)
        if isinstance(message, Report) and message.status.state == "finished":
            waiting.put(None)

    begin = Begin(1, Parameters().model_dump(), 1, play=True)
    for message in (SetSpeed(0.0), Open("fake:"), begin, AskTree(1, 1, 9), AskCluster(2, 1, 0, 0)):
        waiting.put(message)
    waiting.put(AskCluster(3, 7, 0, 0))
    WorkerLoop(make_session(FakeSource(6)), waiting, put).run()
    assert sorted(set(shown(said))) == list(range(6))
    answers = {message.ticket: message for message in said if isinstance(message, Answer)}
    assert set(answers) == {1, 2, 3}
    assert "tree 9 is not known" in answers[1].missing
    assert "shown too long ago" in answers[2].missing  # nothing was sent to anybody
    assert "another run was opened" in answers[3].missing
    assert all(answer.tree is None and answer.cluster is None for answer in answers.values())


def test_what_was_sent_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    recent = RecentScans()
    mailbox = Outbox(io.BytesIO(), recent)
    mailbox.put(Shown(1, 0.0, frame(0, 0), 0, path([0.0])))
    mailbox.close(timeout_s=5.0)
    waiting: queue.Queue[ToWorker | None] = queue.Queue()
    said: list[FromWorker] = []
    for message in (Open("fake:"), AskCluster(1, 1, 0, 0), AskCluster(2, 1, 0, 7), None):
        waiting.put(message)
    monkeypatch.setattr("app.explain.build.ClusterStory", lambda **_: cluster_story())
    WorkerLoop(make_session(FakeSource(3)), waiting, said.append, recent=recent).run()
    answers = [message for message in said if isinstance(message, Answer)]
    assert answers[0].cluster == cluster_story()
    assert "no cluster 7" in answers[1].missing


def test_a_story_that_fails_is_logged_and_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_run: object, _frame: object, _number: int, _mapped: object) -> None:
        raise ZeroDivisionError("on purpose")

    session = make_session(FakeSource(3))
    monkeypatch.setattr("app.worker.loop.tree_story", fail)
    waiting: queue.Queue[ToWorker | None] = queue.Queue()
    said: list[FromWorker] = []
    for message in (Open("fake:"), AskTree(1, 1, 1), None):
        waiting.put(message)
    WorkerLoop(session, waiting, said.append).run()
    (answer,) = [message for message in said if isinstance(message, Answer)]
    assert "fault in stemmap" in answer.missing
    assert "on purpose" in capsys.readouterr().err
    assert last_status(said).state != "failed"


def test_no_more_scans_are_behind_than_the_run_has_left(monkeypatch):
    driver = WorkerLoop(make_session(FakeSource(8)), queue.Queue(), lambda _: None)
    monkeypatch.setattr(driver._replay, "behind", lambda _: 696)
    status = Status("playing", source="sim:stand", kind="simulation", scans=750, scan_index=545)
    assert driver._behind(status, 0.0) == 204
    assert driver._behind(replace(status, scans=None), 0.0) == 696  # nobody knows how many there are
    assert driver._behind(replace(status, live=True, scans_behind=3), 0.0) == 3


def test_a_message_with_a_value_that_cannot_be_sent_is_dropped_and_the_next_one_is_sent() -> None:
    stream = io.BytesIO()
    mailbox = Outbox(stream)
    mailbox.put(Answer(1, missing=cast(Any, object())))
    mailbox.put(Answer(2))
    mailbox.close(5.0)
    assert [message.ticket for message in received(stream) if isinstance(message, Answer)] == [2]
