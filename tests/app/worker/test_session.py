"""The laws of a session: a scan's picture depends on the source, the seed and the parameters that each
scan was mapped with, and on nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.worker.protocol import Open, State, Status
from app.worker.run import reflectance_of
from app.worker.session import Session, with_robot
from pipeline.config import Parameters
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Pose3
from pipeline.preprocessing import acquire, acquired_rows
from pipeline.repairs.record import Repair
from pipeline.repairs.repaired import MapOfRun, RepairedMap, Repairer
from pipeline.types.records import Frame, Scan, Step
from tests.app.fakes import FakeMapper, FakeSource, make_session, scan

SCANS = 130  # more than two kept states


def parameters(eps: float) -> Parameters:
    return Parameters().replace({"clustering.eps": eps})


def settle(session: Session) -> Frame | None:
    """Work until nothing is sought any more."""
    while session.pace == "hurry":
        session.work()
    return session.shown.frame


def opened(scans: int = SCANS, **source: object) -> Session:
    session = make_session(FakeSource(scans, **source))  # type: ignore[arg-type]
    session.open(Open("fake:", "auto", 7))
    return session


def played(eps_of: dict[int, float], last: int) -> float:
    """The checksum after a plain run to a scan, with eps set from scans on."""
    from pipeline.odometry.synchroniser import steps

    mapper, eps, chain = FakeMapper(Parameters(), 7), 0.15, 0.0
    for step in steps(FakeSource(SCANS).records()):
        eps = eps_of.get(step.index, eps)
        mapper.parameters = parameters(eps)
        chain = mapper.process(step).estimate.T_map_base.x
        if step.index == last:
            break
    return chain


def checksum(session: Session) -> float:
    assert session.shown.frame is not None
    return session.shown.frame.estimate.T_map_base.x


@pytest.mark.parametrize("index", [0, 1, 49, 50, 51, 100, 129])
def test_seeking_gives_what_playing_gives(index: int) -> None:
    session = opened()
    session.seek(12.9)  # to the last scan, so that every index lies behind
    settle(session)
    session.seek(index * 0.1)
    settle(session)
    assert session.status().scan_index == index
    assert checksum(session) == played({}, index)
    assert session.shown.path is not None
    assert len(session.shown.path.x) == index + 1


def test_seeking_forward_again_uses_what_is_known_and_gives_the_same() -> None:
    session = opened()
    session.seek(12.0)
    settle(session)
    session.seek(0.2)
    settle(session)
    session.advance(117)
    steps_taken = 0
    while session.pace == "hurry":
        session.work()
        steps_taken += 1
    assert steps_taken <= 51
    assert checksum(session) == played({}, 119)


def test_a_change_on_the_standing_scan_counts_it_once() -> None:
    session = opened()
    session.advance(31)
    settle(session)
    for eps in (0.3, 0.7, 0.4):
        shown = session.set_parameters(parameters(eps), 1)
        assert shown is session.shown.frame
        assert checksum(session) == played({30: eps}, 30)
    session.advance(1)
    settle(session)
    assert checksum(session) == played({30: 0.4}, 31)


def test_a_change_while_playing_acts_from_the_next_scan() -> None:
    session = opened()
    session.play()
    for _ in range(20):
        session.work()
    assert session.set_parameters(parameters(0.5), 3) is None
    session.work()
    assert checksum(session) == played({20: 0.5}, 20)
    assert session.status().revision == 3


def test_going_back_keeps_the_map_as_it_was_and_the_parameters_as_they_are() -> None:
    session = opened()
    session.advance(101)
    settle(session)
    session.set_parameters(parameters(0.5), 1)
    session.seek(6.0)
    settle(session)
    assert checksum(session) == played({60: 0.5}, 60)
    session.advance(60)
    settle(session)
    assert checksum(session) == played({60: 0.5}, 120)


@dataclass
class Model:
    """What a session must show, by the plain definition."""

    eps_of: dict[int, float] = field(default_factory=dict)
    eps: float = 0.15
    current: int = -1

    def stand(self, index: int) -> None:
        index = min(max(index, 0), SCANS - 1)
        if index <= self.current and index != self.current:
            self._from(index)
        self.current = index

    def change(self, eps: float) -> None:
        self.eps = eps
        self._from(max(self.current, 0))

    def _from(self, index: int) -> None:
        self.eps_of = {k: v for k, v in self.eps_of.items() if k < index}
        self.eps_of[index] = self.eps


commands = st.lists(
    st.one_of(
        st.tuples(st.just("seek"), st.integers(0, SCANS + 5)),
        st.tuples(st.just("advance"), st.integers(-60, 60)),
        st.tuples(st.just("play"), st.integers(0, 30)),
        st.tuples(st.just("change"), st.sampled_from([0.15, 0.3, 0.5])),
    ),
    max_size=8,
)


@pytest.mark.slow
@given(commands)
def test_whatever_is_done_the_picture_is_that_of_a_plain_run(done: list[tuple[str, float]]) -> None:
    session, model = opened(), Model()
    for name, value in done:
        if name == "seek":
            session.seek(value * 0.1)
            model.stand(int(value))
        elif name == "advance":
            session.advance(int(value))
            model.stand(model.current + int(value))
        elif name == "play":
            if session.status().state == "finished":
                model.current = SCANS  # playing begins anew: it goes back to the first scan
                model.stand(0)
            session.play()
            settle(session)
            for _ in range(int(value)):
                session.work()
                if session.status().state == "playing":
                    assert session.shown.frame is not None
            session.pause()
            model.current = session.status().scan_index
        else:
            session.set_parameters(parameters(value), 1)
            model.change(value)
        settle(session)
        assert session.status().scan_index == model.current
        if model.current >= 0:
            assert checksum(session) == played(model.eps_of, model.current)


impatient = st.lists(
    st.tuples(
        st.one_of(
            st.tuples(st.just("seek"), st.integers(0, SCANS - 2)),
            st.tuples(st.just("advance"), st.integers(-60, 40)),
            st.tuples(st.sampled_from(["play", "pause"]), st.just(0)),
        ),
        st.integers(0, 70),
    ),
    max_size=8,
)


@pytest.mark.slow
@given(impatient)
def test_however_commands_overtake_one_another_a_scan_is_mapped_the_same(
    done: list[tuple[tuple[str, int], int]],
) -> None:
    session = opened()
    for (name, value), scans in done:
        if name == "seek":
            session.seek(value * 0.1)
        elif name == "advance":
            session.advance(value)
        elif name == "play":
            session.play()
        else:
            session.pause()
        for _ in range(scans):
            session.work()
    settle(session)
    if session.status().scan_index >= 0:
        assert checksum(session) == played({}, session.status().scan_index)


@pytest.mark.slow
@given(start=st.integers(0, 128), target=st.integers(0, 128), after=st.integers(0, 140), known=st.booleans())
def test_a_change_on_the_way_acts_from_the_sought_scan_on(
    start: int, target: int, after: int, known: bool
) -> None:
    session = opened()
    if known:
        session.advance(SCANS)
        settle(session)
    session.advance(start - session.status().scan_index)
    settle(session)
    session.seek(target * 0.1)
    for _ in range(after):
        if session.pace == "hurry":
            session.work()
    session.set_parameters(parameters(0.5), 1)
    settle(session)
    assert session.status().scan_index == target
    assert checksum(session) == played({target: 0.5}, target)


def test_targets_that_are_overtaken_cost_nothing() -> None:
    source = FakeSource(SCANS)
    session = make_session(source)
    session.open(Open("fake:", "auto", 7))
    session.advance(120)
    settle(session)
    for index in range(100, 0, -1):
        session.seek(index * 0.1)
    settle(session)
    assert source.reads == 1  # the steps are stored
    assert checksum(session) == played({}, 1)


def test_a_run_ends_keeps_its_picture_and_begins_anew() -> None:
    session = opened(5)
    session.play()
    while session.pace != "idle":
        session.work()
    assert session.status().state == "finished"
    assert session.status().scan_index == 4
    session.play()
    settle(session)
    assert session.status().state == "playing"
    assert session.status().scan_index == 0
    assert checksum(session) == played({}, 0)


def test_pausing_while_seeking_stands_at_the_sought_scan() -> None:
    session = opened()
    session.play()
    session.seek(8.0)
    session.work()
    session.pause()
    settle(session)
    assert (session.status().state, session.status().scan_index) == ("paused", 80)


def test_seeking_while_playing_goes_on_playing() -> None:
    session = opened()
    session.play()
    session.seek(8.0)
    settle(session)
    assert session.status().state == "playing"
    session.work()
    assert session.status().scan_index == 81


@pytest.mark.parametrize("time_s", [float("nan"), 1e300])
def test_odd_times_do_no_harm(time_s: float) -> None:
    session = opened(4)
    session.seek(time_s)
    settle(session)
    assert session.status().scan_index in (-1, 0, 3)


def test_seeking_to_the_time_that_is_shown_stays_there() -> None:
    session = opened()
    session.advance(78)
    settle(session)
    session.seek(session.status().time_s)
    settle(session)
    assert session.status().scan_index == 77


def test_a_failing_source_says_so_and_what_came_before_can_be_seen() -> None:
    session = opened(fails_at=70)
    session.play()
    for _ in range(70):
        session.work()
    with pytest.raises(SourceError, match="ends here"):
        session.work()
    session.fail("the file ends here (scan 70)")
    assert session.status().state == "failed"
    assert session.status().scan_index == 69
    assert session.pace == "idle"
    session.seek(2.0)
    settle(session)
    assert checksum(session) == played({}, 20)
    session.advance(60)
    with pytest.raises(SourceError, match="ends here"):
        settle(session)


def test_counts_of_the_last_scan_are_known_while_it_waits_for_other_parameters() -> None:
    """After a failure the scan is not mapped again, but it can still be shown."""
    session = opened(fails_at=7)
    session.play()
    for _ in range(7):
        session.work()
    session.fail("the file ends here (scan 7)")
    assert session.set_parameters(parameters(0.6), 1) is None
    session.seek(0.6)
    shown = settle(session)
    assert shown is not None
    assert shown.index == 6
    assert session.shown.counts is not None
    assert sum(session.shown.counts.health.values()) == 7


def test_a_seek_after_a_fault_starts_from_a_sound_state() -> None:
    session = opened()
    session.advance(10)
    settle(session)
    with pytest.raises(ZeroDivisionError):
        session.set_parameters(parameters(5.0), 1)
    session.fail("a fault")
    session.set_parameters(parameters(0.15), 2)
    session.advance(1)
    settle(session)
    assert checksum(session) == played({}, 10)


def test_the_status_says_where_a_seek_goes_until_it_is_there() -> None:
    session = opened()
    session.seek(6.55)
    assert session.status().going_to == "0:06"
    assert session.status().going_to_s == pytest.approx(6.55)
    session.work()
    assert (session.status().state, session.status().going_to) == ("paused", "0:06")
    settle(session)
    assert session.status().going_to == ""
    session.advance(-55)  # to a scan that was mapped
    assert (session.status().going_to, session.status().scan_index) == ("", 10)
    session.advance(100)
    assert (session.status().going_to, session.status().going_to_s) == ("scan 110", None)
    settle(session)
    assert (session.status().going_to, session.status().going_to_s) == ("", None)


def test_what_the_odometry_means_is_a_warning_or_a_failure() -> None:
    source = FakeSource(5)
    session = make_session(source)
    session.open(Open("fake:", "static", 0))
    assert ["static" in warning for warning in session.status().warnings] == [True]
    source.description = replace(source.description, has_odometry=False, scans=1)
    session.open(Open("fake:", "auto", 0))
    assert ["no odometry" in warning for warning in session.status().warnings] == [True]
    with pytest.raises(SourceError, match="no odometry"):
        session.open(Open("fake:", "wheels", 0))
    assert source.closed


def test_opening_another_source_closes_the_first() -> None:
    source = FakeSource(5)
    session = make_session(source)
    session.open(Open("fake:", "auto", 0))
    with pytest.raises(SourceError):
        session.open(Open("missing:", "auto", 0))
    assert source.closed
    session.fail("there is no such file (missing:)")
    assert session.status().source == "missing:"
    session.open(Open("fake:", "auto", 0))
    assert session.status().state == "paused"
    assert session.shown.frame is None


def test_a_source_that_gives_other_scans_the_second_time_goes_back_where_its_steps_are_stored() -> None:
    session = opened(drifts=True)
    session.advance(80)
    settle(session)
    first = checksum(session)
    session.advance(20)
    settle(session)
    session.advance(-20)
    settle(session)
    assert checksum(session) == first


@pytest.fixture
def no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """No step and no frame can be stored."""
    monkeypatch.setattr("pipeline.io.block_file.SPARE_BYTES", 1 << 62)
    monkeypatch.setattr("pipeline.io.block_file.BLOCKS_BETWEEN_CHECKS", 1)


@pytest.mark.usefixtures("no_room")
def test_a_source_that_gives_other_scans_the_second_time_cannot_go_back_without_them() -> None:
    session = opened(drifts=True)
    session.advance(100)
    settle(session)
    session.advance(-20)
    with pytest.raises(SourceError, match="same scans again"):
        session.work()


@pytest.mark.usefixtures("no_room")
def test_without_stored_steps_the_source_is_read_again_from_its_start() -> None:
    source = FakeSource(SCANS)
    session = make_session(source)
    session.open(Open("fake:", "auto", 0))
    session.advance(110)
    settle(session)
    session.advance(-1)
    settle(session)
    assert source.reads == 2


def test_preparing_leaves_no_trace() -> None:
    session = opened()
    session.prepare()
    assert session.status().mapping_ms == 0.0
    session.advance(3)
    settle(session)
    assert checksum(session) == played({}, 2)


def test_preparing_maps_with_the_parameters_of_the_first_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[float] = []
    process = FakeMapper.process

    def remember(self: FakeMapper, step: Step) -> Frame:
        used.append(self.parameters.clustering.eps)
        return process(self, step)

    monkeypatch.setattr(FakeMapper, "process", remember)
    session = opened()
    session.set_parameters(parameters(0.7), 1)
    session.prepare()
    assert used == [0.7]


def test_a_source_without_a_scan_cannot_be_prepared() -> None:
    with pytest.raises(SourceError, match="no scan in it"):
        opened(0).prepare()


def test_status_tells_the_figures_of_the_run() -> None:
    session = opened()
    session.advance(3)
    settle(session)
    status = session.status()
    assert (status.kind, status.scans) == ("fake run", SCANS)
    assert status.end_s == pytest.approx(12.9)
    assert status.time_s == pytest.approx(0.2)
    assert status.health == "no trees yet"
    assert "chain" in status.stage_ms
    assert session.next_ns() == scan(3).stamp_ns


def test_reflectances_are_those_of_the_acquired_points() -> None:
    acquisition = Parameters().acquisition
    points = np.random.default_rng(3).uniform(-40.0, 40.0, (500, 3)).astype(np.float32)
    points[:2] = [[acquisition.range_min, 0.0, 0.0], [acquisition.range_max, 0.0, 0.0]]  # both are within
    bright = np.arange(500, dtype=np.float32)
    step = Step(0, Scan(1, points, bright), None)
    raw, _ = acquire(step, Pose3.identity(), acquisition)
    np.testing.assert_array_equal(points[acquired_rows(step, acquisition)], raw)
    assert 2 < len(raw) < 500
    found = reflectance_of(raw, step, acquisition)
    assert found is not None
    assert (found[0], len(found)) == (0, len(raw))
    assert found[-1] >= 254
    assert (np.diff(found.astype(int)) >= 0).all()
    assert reflectance_of(raw[:0], step, acquisition) is None
    assert reflectance_of(raw, Step(0, Scan(1, points), None), acquisition) is None


def test_status_counts_the_scans_that_are_left_out() -> None:
    source = FakeSource(SCANS)
    session = make_session(source)
    session.open(Open("fake:"))
    assert session.status().scans_left_out == 0
    source.losses = {"scans lost on the network": 3, "scans without points": 2, "poses without a frame": 7}
    assert session.status().scans_left_out == 5


@pytest.mark.parametrize(
    ("before", "waiting", "state", "is_silent"),
    [("playing", 0, "waiting", True), ("playing", 3, "playing", False), ("paused", 3, "paused", True)],
)
def test_a_robot_whose_scans_wait_is_not_called_silent_unless_it_is_paused(
    before: State, waiting: int, state: str, is_silent: bool
) -> None:
    robot = SimpleNamespace(
        waiting_for=lambda: "Nothing heard for 3 s",
        scans_waiting=waiting,
        silence_s=3.0,
        map_age_s=7.0,
        robot="a",
        robots=["a"],
        recording="",
        recorded_file="",
        losses={"scans lost on the network": 3, "scans skipped because mapping was behind": 162},
    )
    status = with_robot(Status(state=before, source="zenoh:", scan_index=5), cast(Any, robot))
    assert (status.state, status.detail) == (state, "Nothing heard for 3 s" if is_silent else "")
    assert (status.health == "no data for 3 s") == is_silent
    assert (status.silence_s, status.map_age_s, status.scans_lost) == (3.0, 7.0, 3)


def test_a_source_without_a_mapper_is_closed() -> None:
    def refuses(*_: object) -> Any:
        raise StemmapError("the forest 'oak' does not exist")

    source = FakeSource(3)
    with pytest.raises(StemmapError, match="oak"):
        Session(lambda *_: source, refuses, Parameters()).open(Open("fake:"))
    assert source.closed


TIE = Repair("tie", ((1.0, 0.0), (1.0, 0.0)), (0, 1))


@pytest.mark.parametrize("error", [ValueError, np.linalg.LinAlgError])
def test_a_fault_in_a_repair_is_its_problem_and_the_map_is_shown_without_it(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    session = opened()
    session.advance(3)
    settle(session)
    before = session.shown.frame

    def failing(*_: Any, **__: Any) -> RepairedMap:
        raise error("singular")

    monkeypatch.setattr(Repairer, "repaired", failing)
    assert session.shown.set_repairs((TIE,)) is before
    assert session.shown.repaired is not None
    assert "singular" in session.shown.repaired.problems[0]
    assert session.status().scan_index == 2


def noted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Repairer, bool]]:
    """Return a list to which each repair appends its `Repairer` and whether it was hurried."""
    calls: list[tuple[Repairer, bool]] = []
    repaired = Repairer.repaired

    def noting(self: Repairer, run: MapOfRun, repairs: Any, *, hurried: bool = False) -> RepairedMap:
        calls.append((self, hurried))
        return repaired(self, run, repairs, hurried=hurried)

    monkeypatch.setattr(Repairer, "repaired", noting)
    return calls


def test_a_pause_repairs_the_loops_of_the_shown_scan_by_their_own_solution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session, calls = opened(), noted(monkeypatch)
    session.play()
    session.work()
    session.shown.set_repairs((TIE,))
    before = calls[-1]
    assert session.pause() is session.shown.frame
    assert (before[1], calls[-1][1]) == (True, False)
    assert session.pause() is None, "it is shown already"


def test_the_last_scan_of_a_played_run_has_its_own_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    session, calls = opened(3), noted(monkeypatch)
    session.shown.set_repairs((TIE,))
    session.play()
    while session.pace != "idle":
        session.work()
        assert session.shown.frame is not None
    assert not calls[-1][1]


def test_other_parameters_repair_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    session, calls = opened(), noted(monkeypatch)
    session.advance(3)
    settle(session)
    session.shown.set_repairs((TIE,))
    session.set_parameters(parameters(0.5), 1)
    assert session.shown.frame is not None
    assert calls[0][0] is not calls[-1][0]


def test_a_tie_acts_while_a_stored_scan_is_shown() -> None:
    session = opened()
    session.seek(12.0)
    settle(session)
    session.seek(1.0)
    before = session.shown.is_stored
    session.shown.set_repairs((TIE,))
    assert (before, session.shown.is_stored) == (True, False)
