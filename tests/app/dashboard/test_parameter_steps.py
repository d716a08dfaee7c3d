"""Undo and redo of parameters are inverse, whatever is done between; a gesture is one step."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.dashboard.parameters import ParameterState, file_of, read_file
from pipeline.config import Parameters, preset
from pipeline.errors import ParameterError, StemmapError

CHANGES = st.one_of(
    st.tuples(st.just("clustering.eps"), st.sampled_from([0.1, 0.2, 0.3])),
    st.tuples(st.just("slam.particles"), st.sampled_from([50, 60])),
    st.tuples(st.just("preset"), st.sampled_from(["paper", "forest", "stems"])),
    st.tuples(st.just("reset"), st.just("")),
)


class Clock:
    """A clock that is set by hand."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def do(state: ParameterState, name: str, value: object) -> None:
    if name == "preset":
        state.use_preset(str(value))
    elif name == "reset":
        state.reset([])
    else:
        state.change({name: value})  # type: ignore[dict-item]


@given(st.lists(CHANGES, max_size=12))
def test_undo_leads_back_through_all_that_held_and_redo_forth(changes: list[tuple[str, object]]):
    clock = Clock()
    state = ParameterState(clock=clock)
    held: list[tuple[str, Parameters]] = [(state.preset, state.parameters)]
    for name, value in changes:
        clock.now += 60.0
        do(state, name, value)
        if (state.preset, state.parameters) != held[-1]:
            held.append((state.preset, state.parameters))
    for before in reversed(held[:-1]):
        state.undo()
        assert (state.preset, state.parameters) == before
    with pytest.raises(StemmapError, match="no change"):
        state.undo()
    for after in held[1:]:
        state.redo()
        assert (state.preset, state.parameters) == after
    with pytest.raises(StemmapError, match="no change"):
        state.redo()


def test_values_of_a_slider_that_moves_are_one_step():
    clock = Clock()
    state = ParameterState(clock=clock)
    for value in (0.2, 0.3, 0.4):
        clock.now += 0.1
        state.change({"clustering.eps": value})
    clock.now += 0.1
    state.change({"slam.particles": 50})
    clock.now += 60.0
    state.change({"slam.particles": 60})
    assert state.as_plain()["undo"] == 3
    state.undo()
    assert state.parameters.slam.particles == 50
    state.undo()
    assert (state.parameters.slam.particles, state.parameters.clustering.eps) == (100, 0.4)
    state.undo()
    assert state.parameters == preset("forest")
    assert state.as_plain()["redo"] == 3


def test_what_a_held_slider_sends_is_one_step_however_long_it_is_held():
    clock = Clock()
    state = ParameterState(clock=clock)
    for value in (0.2, 0.3, 0.4):
        clock.now += 60.0
        state.change({"clustering.eps": value}, "first")
    state.change({"clustering.eps": 0.5}, "second")  # taken again at once
    state.change({"clustering.eps": 0.6})
    assert (state.as_plain()["undo"], state.step) == (3, 3)
    state.undo()
    state.undo()
    assert state.parameters.clustering.eps == 0.4
    state.undo()
    assert state.parameters == preset("forest")


def test_what_was_undone_is_gone_after_another_change():
    state = ParameterState()
    state.change({"clustering.eps": 0.2})
    state.undo()
    state.change({"slam.particles": 50})
    assert (state.as_plain()["undo"], state.as_plain()["redo"]) == (1, 0)


def test_steps_of_another_run_are_not_done_again_in_this_one():
    state = ParameterState()
    assert state.suit("forest", "a")
    state.change({"clustering.eps": 0.2})
    state.undo()
    assert not state.suit("forest", "a")  # the same run again
    assert state.as_plain()["redo"] == 1
    assert state.suit("forest", "b")
    assert (state.as_plain()["undo"], state.as_plain()["redo"]) == (0, 0)
    state.change({"clustering.eps": 0.2})
    state.change({"slam.particles": 50})
    state.undo()
    state.suit("forest", "c")  # the radius is still in force, and can be taken back
    assert (state.as_plain()["undo"], state.as_plain()["redo"]) == (1, 0)
    state.undo()
    assert state.parameters == preset("forest")


def test_a_refused_change_is_no_step():
    state = ParameterState()
    with pytest.raises(ParameterError):
        state.change({"clustering.eps": -1.0})
    assert (state.as_plain()["undo"], state.step) == (0, 0)


@given(st.sampled_from(["forest", "paper", "laser2d"]), st.integers(1, 500), st.floats(0.01, 5.0))
def test_a_file_brings_back_what_was_written(name: str, points: int, eps: float):
    values = preset(name).replace({"clustering.min_points": points, "clustering.eps": eps})
    assert read_file(file_of(name, values), "a file") == (name, values)


def test_a_file_without_preset_is_laid_over_the_present_one():
    name, values = read_file("[clustering]\neps = 1\n", "mine.toml", otherwise="paper")
    assert (name, values) == ("paper", preset("paper").replace({"clustering.eps": 1.0}))
    assert read_file("# preset: of another program\n", "mine.toml") == ("forest", preset("forest"))
    with pytest.raises(ParameterError, match=r"mine\.toml"):
        read_file("[clustering]\neps = 'wide'\n", "mine.toml")
