"""What a search is for, as closed forms; over what it goes; and what stands in its file."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.dashboard.parameters import read_file
from app.extensions.search.plan import (
    SENSIBLE,
    Goal,
    Plan,
    PlannedRun,
    SearchAxis,
    Trial,
    axes_of,
    check,
    pool,
    values_of,
)
from app.extensions.search.result import Result, best_parameters, toml_of, warning_of
from app.sources.request import SourceRequest
from pipeline.config import field_specs, preset
from pipeline.errors import ParameterError
from tests.app.extensions.search.jobs import counted
from tests.app.extensions.search.provenance import provenance_in

FOREST = preset("forest")
# Eight of ten trees and one of two poles; two of four trees and three where nothing stands.
ONE = counted(8, 2, 1, 1, 0, 0.1, 1.0)
OTHER = counted(2, 2, 0, 0, 3, 0.2, 5.0)
NOTHING = counted(0, 4, 0, 2, 0, None, None)

counts = st.integers(0, 50)
scores = st.builds(
    lambda ta, fr, fa, tr, spurious, rmse, pair: counted(
        ta, fr, fa, tr, spurious, rmse if ta else None, pair if ta > 1 else None
    ),
    counts, counts, counts, counts, counts, st.floats(0, 0.5), st.floats(0, 100),
)  # fmt: skip


def test_several_runs_are_pooled_tree_by_tree():
    pooled = pool([ONE, OTHER])
    assert pooled.ta == 10 / 14
    assert pooled.f1 == pytest.approx(2 * 10 / (2 * 10 + 4 + 1 + 3))
    assert pooled.false_share == 4 / 14
    assert pooled.position_rmse_m == pytest.approx(math.sqrt((8 * 0.01 + 2 * 0.04) / 10))
    assert pooled.mean_pair_error_percent == pytest.approx((28 * 1.0 + 1 * 5.0) / 29)


def test_an_empty_map_has_no_errors_and_the_worst_f1():
    pooled = pool([NOTHING])
    assert (pooled.f1, pooled.ta, pooled.false_share) == (0.0, 0.0, 0.0)
    assert pooled.position_rmse_m is None
    assert pooled.mean_pair_error_percent is None


@given(scores)
def test_f1_of_one_run_is_the_harmonic_mean(score):
    pooled = pool([score])
    if score.TA.count:
        correct = score.TA.count / (score.TA.count + score.FA.count + score.spurious)
        assert pooled.f1 == pytest.approx(2 * pooled.ta * correct / (pooled.ta + correct))
        assert pooled.false_share == pytest.approx(1 - correct)


@given(st.lists(scores, min_size=1, max_size=4), st.lists(scores, min_size=1, max_size=4))
@pytest.mark.parametrize("name", ["ta", "position", "pairs"])
def test_a_set_beyond_the_bound_loses_against_each_within(name, some, others):
    goal, start = Goal(name, 0.1), pool([ONE])
    losses = [goal.loss(pool(each), start) for each in (some, others)]
    within = [goal.is_kept(loss) for loss in losses]
    if within[0] and not within[1]:
        assert losses[0] < losses[1]
    for loss, kept, each in zip(losses, within, (some, others), strict=True):
        pooled = pool(each)
        if name == "ta":
            assert kept == (pooled.false_share <= 0.1)
        elif kept:
            assert pooled.f1 >= start.f1 - 1e-9
            assert loss in (pooled.position_rmse_m, pooled.mean_pair_error_percent)


def test_the_start_itself_is_within_the_bound_of_errors():
    start = pool([ONE, OTHER])
    assert Goal("position").loss(start, start) == start.position_rmse_m
    assert Goal("pairs").loss(start, start) == start.mean_pair_error_percent
    assert Goal("f1").loss(start, start) == 1 - start.f1
    assert Goal("position").shown(0.0123) == "RMSE 1.23 cm"


# --- the space ------------------------------------------------------------------------------------


def test_the_sensible_parameters_can_be_tried_and_hold_what_the_forest_has():
    axes = axes_of(SENSIBLE)
    check(axes, FOREST)
    flat = FOREST.flat()
    assert all(axis.holds(flat[axis.name]) for axis in axes)


def test_bounds_come_from_the_declaration_and_can_be_narrowed():
    whole, narrow, words, switch, whole_number = axes_of(
        [
            "detection.e_min",
            "detection.arc_min=10..20.5",
            "shape.centre",
            "acquisition.deskew",
            "slam.particles=5..9",
        ]
    )
    assert (whole.low, whole.high) == (1.0, 1000.0)
    assert (narrow.low, narrow.high) == (10.0, 20.5)
    assert words.choices == ("centroid", "circle")
    assert switch.choices == (False, True)
    assert (whole_number.kind, whole_number.low) == ("int", 5.0)
    assert [axes_of([axis.words])[0] for axis in (whole, narrow, words, switch, whole_number)] == [
        whole, narrow, words, switch, whole_number
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("detection.emin=1..5", "there is no parameter"),
        ("detection.e_min=5..1", "must be less"),
        ("detection.e_min=0..5", "is not within 1 to 1000"),
        ("detection.e_min=1", "two numbers"),
        ("tracking.hits_to_confirm=1.5..4", "should be a whole number"),
        ("shape.centre=circle", "at least two values"),
        ("evaluation.reach=1..50", "how a map is scored"),
        ("obstacles.width=1..2", "does not change the map"),
    ],
)
def test_bounds_that_cannot_be_are_told(text, words):
    with pytest.raises(ParameterError, match=words):
        axes_of([text])


def test_a_parameter_is_named_once():
    with pytest.raises(ParameterError, match="given twice"):
        axes_of(["detection.e_min", "detection.e_min=1..2"])


def test_bounds_that_leave_no_set_are_told_by_their_contradiction():
    axes = axes_of(["detection.e_min=100..200", "detection.e_max=10..50"])
    with pytest.raises(ParameterError, match=r"detection.e_min = 100.*must be less"):
        check(axes, FOREST)
    check(axes_of(["detection.e_min=1..100", "detection.e_max=10..50"]), FOREST)


@given(st.data())
def test_what_is_tried_lies_within_the_bounds(data):
    for spec in (each for each in field_specs() if each.kind == "float"):
        axis = SearchAxis(spec.name, "float", spec.minimum or 0.0, spec.maximum or 1.0)
        suggested = data.draw(st.floats(axis.low, axis.high))
        value = axis.value_of(suggested)
        assert axis.holds(value)
        assert value == pytest.approx(suggested, rel=1e-3)


# --- the file -------------------------------------------------------------------------------------

AXES = axes_of(["detection.e_max=10..200", "shape.centre"])
PLAN = Plan(
    runs=(
        PlannedRun(SourceRequest("a run")),
        PlannedRun(SourceRequest('another"\n[detection]'), truth_name="trees.csv", held_out=True),
    ),
    axes=AXES,
    start=FOREST.model_dump(),
)
START = Trial(-1, {"detection.e_max": 60.0, "shape.centre": "circle"}, 0.3, (ONE,), (OTHER,))
BEST = Trial(7, {"detection.e_max": 41.5, "shape.centre": "centroid"}, 0.2, (ONE,), (NOTHING,))
# The name of the second is no line of the file's own, nor are its ends of line for Python alone.
SOURCES = (("a run", "aa" * 32, False), ('another"\n[detection]\u2028\x85', "bb" * 32, True))


def result(best=BEST, *, better=True):
    return Result(START, best, better, 20, 2, {"detection.e_max": 0.9, "shape.centre": 0.1}, SOURCES)


def test_a_file_is_a_set_that_says_where_it_comes_from():
    text = toml_of(PLAN, result(), "2026-01-31")
    assert read_file(text, "best.toml") == ("forest", FOREST.replace(BEST.values))
    told = provenance_in(text)
    assert told["tuned"]["date"] == "2026-01-31"
    assert told["tuned"]["trials"] == 20
    assert told["tuned"]["over"] == ["detection.e_max=10..200", "shape.centre=centroid,circle"]
    first, second = told["run"]
    assert (first["uri"], first["sha256"], first["held_out"]) == SOURCES[0]
    assert (second["uri"], second["truth"], second["held_out"]) == (
        SOURCES[1][0],
        "trees.csv",
        True,
    )
    assert first["best"]["f1"] == pytest.approx(2 * 8 / 19, abs=1e-6)
    assert "position_rmse_m" not in second["best"]
    assert toml_of(PLAN, result(), "2026-01-31") == text


def test_a_search_that_found_nothing_better_gives_the_start():
    none = result(START, better=False)
    assert best_parameters(PLAN, none) == FOREST
    assert provenance_in(toml_of(PLAN, none, "2026-01-31"))["tuned"]["better_than_start"] is False
    assert warning_of(none) == ""


def test_worse_on_the_held_out_runs_is_warned_of():
    assert "F1 fell from" in warning_of(result())


def test_values_have_few_digits():
    assert values_of(AXES, {"detection.e_max": 41.500049, "shape.centre": "circle"}) == {
        "detection.e_max": 41.5, "shape.centre": "circle"
    }  # fmt: skip
