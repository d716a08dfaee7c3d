"""Scores: optimal matching, counts that sum to their totals, distances between trees, and errors of paths."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.batch.summary import evaluation_lines, truth_in_doubt
from pipeline.config import preset
from pipeline.evaluation import (
    PathError,
    evaluate,
    fit_rigid,
    match,
    pair_distances,
    pair_errors,
    path_error,
)
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Path, TruthPath
from tests.pipeline.strategies import poses2, seeds, trees, truth_trees

FOREST = preset("forest").evaluation
KINDS = ("tree", "pole", "person", "bush", "other")


# --- matching -------------------------------------------------------------------------------------


def _best(found, truth, reach):
    """Number of pairs and sum of distances of the best matching, by trying all."""
    d = np.hypot(*(found[:, None] - truth[None]).transpose(2, 0, 1))
    best = (0, 0.0)
    slots = [*range(len(truth)), *[-1] * len(found)]
    for choice in set(itertools.permutations(slots, len(found))):
        pairs = [(i, j) for i, j in enumerate(choice) if j >= 0 and d[i, j] <= reach]
        best = max(best, (len(pairs), -sum(d[i, j] for i, j in pairs)))
    return best


@given(seeds, st.integers(0, 4), st.integers(0, 4))
def test_the_matching_is_the_best_of_all(seed, n, m):
    rng = np.random.default_rng(seed)
    found, truth = rng.uniform(0, 2, (n, 2)), rng.uniform(0, 2, (m, 2))
    told = match(found, truth, 0.8)
    used = told[told >= 0]
    assert len(set(used.tolist())) == len(used)
    d = np.hypot(*(found[told >= 0] - truth[used]).T)
    assert np.all(d <= 0.8)
    pairs, cost = _best(found, truth, 0.8)
    assert len(used) == pairs
    assert d.sum() == pytest.approx(-cost, abs=1e-9)


def test_two_trees_between_two_truths_are_both_matched():
    """Each takes its nearest would match one of them only."""
    assert match(np.array([[0.0, 0], [0.9, 0]]), np.array([[0.5, 0], [1.4, 0]]), 0.5).tolist() == [0, 1]


# --- scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("right", "elsewhere", "missed", "doubtful"),
    [
        (1, 12, 15, True),
        (0, 12, 16, True),
        (4, 12, 12, False),  # a quarter
        (3, 0, 13, False),  # a map that has begun, and is right so far
        (12, 40, 0, False),  # a map with much that is wrong
        (0, 3, 16, False),  # too few to tell
    ],
)
def test_a_truth_that_few_trees_match_is_doubted(right, elsewhere, missed, doubtful):
    found = np.column_stack([5.0 * np.arange(right + elsewhere), np.zeros(right + elsewhere)])
    truth = np.column_stack([5.0 * np.arange(right + missed), np.zeros(right + missed)])
    truth[right:] += (0.0, 2.5)
    score = evaluate(trees(found), truth_trees(truth, ("tree",) * len(truth)), FOREST)
    assert (score.TA.count, score.FR.count, score.spurious) == (right, missed, elsewhere)
    assert score.is_doubtful is doubtful
    told = truth_in_doubt(score)
    assert bool(told) is doubtful
    if doubtful:
        assert told.startswith(f"only 1 of {right + missed} true trees is near" if right else "none of 16")
        assert f"warning: {told}" in evaluation_lines(score)


def test_missed_and_false_trees_are_named():
    found = np.array([[0.0, 0], [10, 0], [20, 0], [70, 0]])
    truth = truth_trees(np.array([[0.1, 0], [10, 0], [22, 4.26], [60, 0]]), ("tree", "pole", "tree", "tree"))
    score = evaluate(trees(found), truth, FOREST, np.array([[15.0, 0.0]]))
    number = trees(found).number.tolist()
    assert score.missed == ((22.0, 4.26),)
    assert score.false == (number[1], number[2])
    lines = evaluation_lines(score)
    assert "missed at x, y [m]: 22.0, 4.3" in lines
    assert f"false trees of the map: {number[1]}; {number[2]}" in lines
    many = evaluation_lines(replace(score, missed=((0.0, 0.0),) * 14))
    assert "missed at x, y [m]: " + "0.0, 0.0; " * 12 + "and 2 more" in many


def test_what_is_beyond_the_reach_is_counted():
    found, kinds = np.array([[0.0, 0.0]]), ("tree", "tree", "pole", "hidden")
    truth = truth_trees(np.array([[0.0, 0], [30, 0], [40, 0], [50, 0]]), kinds)
    score = evaluate(trees(found), truth, FOREST, np.zeros((1, 2)))
    assert (score.TA.of, score.beyond) == (1, 2)
    assert "not counted: 2 objects of the ground truth are farther from the path (evaluation.reach)" in (
        evaluation_lines(score)
    )
    assert evaluate(trees(found), truth, FOREST).beyond == 0


def test_trees_at_all_parts_of_a_long_path_count():
    path = np.column_stack([np.linspace(0.0, 4000.0, 40_000), np.zeros(40_000)])
    position = np.array([[0.0, 1.0], [1638.4, 5.0], [4000.0, 2.0], [2000.0, 500.0]])
    score = evaluate(trees(position), truth_trees(position, ("tree",) * 4), FOREST, path)
    assert (score.TA.of, score.beyond) == (3, 1)


@pytest.mark.parametrize(
    ("factor", "told"),
    [(3.0, ""), (0.3, ""), (13.0, "10 times"), (0.001, "1/1000 of")],
)
@pytest.mark.parametrize("n", [3, 4])
def test_diameters_of_another_unit_are_doubted(factor, told, n):
    place = np.column_stack([5.0 * np.arange(n), np.zeros(n)])
    truth = truth_trees(place, ("tree",) * n)
    truth = replace(truth, dbh=trees(place).dbh * factor * np.linspace(0.9, 1.1, n))
    score = evaluate(trees(place), truth, FOREST)
    assert score.dbh_ratio == pytest.approx(factor, rel=0.1)
    doubt = truth_in_doubt(score)
    assert (
        doubt.startswith(f"the diameters of the ground truth are about {told}")
        if told and n > 3
        else not doubt
    )


@given(seeds, st.integers(0, 12), st.integers(0, 12), st.booleans())
def test_counts_sum_to_their_wholes(seed, n, m, with_path):
    rng = np.random.default_rng(seed)
    kinds = tuple(rng.choice(KINDS, m))
    found, truth = trees(rng.uniform(0, 12, (n, 2))), truth_trees(rng.uniform(0, 12, (m, 2)), kinds)
    path = rng.uniform(0, 6, (5, 2)) if with_path else None
    p = FOREST.model_copy(update={"match_distance": 1.5, "reach": 5.0})
    e = evaluate(found, truth, p, path)
    assert e.TA.of == e.FR.of == e.TA.count + e.FR.count
    assert e.TR.of == e.FA.of == e.TR.count + e.FA.count
    assert e.TA.of + e.TR.of <= m
    if path is None:
        assert e.TA.of == kinds.count("tree")
        assert e.TA.count + e.FA.count + e.spurious == n
    assert e.TA.count + e.FA.count + e.spurious <= n
    accepted = e.TA.count + e.FA.count + e.spurious
    assert e.correctness == (pytest.approx(e.TA.count / accepted) if accepted else None)
    assert e.completeness == e.TA.rate
    for rate in (e.TA.rate, e.TR.rate, e.correctness, e.f1):
        assert rate is None or 0.0 <= rate <= 1.0


def test_a_map_by_hand():
    truth = truth_trees(
        [[0, 0], [5, 0], [9, 0], [0, 5], [5, 5], [30, 0]], ["tree", "tree", "tree", "pole", "bush", "tree"]
    )
    found = trees([[0.3, 0.0], [5.0, 0.4], [0.0, 5.1], [2.0, 2.0]], dbh=0.34)
    e = evaluate(found, truth, FOREST, np.array([[4.0, 2.0]]))
    assert (e.TA.count, e.TA.of) == (2, 3), "the tree at 30 m is not asked for"
    assert (e.FR.count, e.FA.count, e.TR.count, e.TR.of) == (1, 1, 1, 2)
    assert e.spurious == 1
    assert e.completeness == pytest.approx(2 / 3)
    assert e.correctness == pytest.approx(2 / 4)
    assert e.f1 == pytest.approx(2 * (2 / 3) * 0.5 / (2 / 3 + 0.5))
    assert e.position_rmse == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 2))
    assert e.position_bias == pytest.approx(np.hypot(0.15, 0.2))
    assert e.dbh_rmse == pytest.approx(0.04)
    assert e.dbh_bias == pytest.approx(0.04)
    assert e.dbh_count == 2
    d = np.hypot(4.7, 0.4)
    assert e.mean_pair_error_percent == pytest.approx(100 * (5 - d) / 5)


def test_the_truth_decides_whether_a_pair_at_the_edge_of_the_reach_counts():
    near, far = FOREST.reach - 0.1, FOREST.reach + 0.1
    at_origin = np.zeros((1, 2))
    beyond = evaluate(trees([[near, 0.0]]), truth_trees([[far, 0.0]]), FOREST, at_origin)
    assert (beyond.TA.count, beyond.TA.of, beyond.spurious, beyond.correctness) == (0, 0, 0, None)
    within = evaluate(trees([[far, 0.0]]), truth_trees([[near, 0.0]]), FOREST, at_origin)
    assert (within.TA.count, within.TA.of, within.spurious, within.correctness) == (1, 1, 0, 1.0)


def test_unconfirmed_trees_do_not_count():
    e = evaluate(trees([[0, 0]], confirmed=False), truth_trees([[0, 0]]), FOREST)
    assert (e.TA.count, e.FR.count, e.spurious) == (0, 1, 0)


@pytest.mark.parametrize("found", [[], [[0, 0], [3, 3]]])
@pytest.mark.parametrize("truth", [[], [[0, 0]]])
@pytest.mark.parametrize("path", [None, np.zeros((0, 2)), np.zeros((1, 2))])
def test_empty_sides_have_no_rates_and_no_errors(found, truth, path):
    e = evaluate(trees(found), truth_trees(truth), FOREST, path)
    if not truth:
        assert e.completeness is None
        assert e.position_rmse is None
    assert e.TR.rate is None


def test_unknown_diameters_are_left_out():
    found = trees([[0, 0], [5, 0]])
    found.dbh[0] = np.nan
    truth = truth_trees([[0, 0], [5, 0]])
    truth.dbh[1] = np.nan
    e = evaluate(found, truth, FOREST)
    assert e.dbh_count == 0
    assert e.dbh_rmse is None


# --- pairs ----------------------------------------------------------------------------------------


@given(seeds, st.integers(0, 8), poses2)
def test_moving_and_turning_a_map_changes_no_distance(seed, n, motion):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-10, 10, (n, 2))
    found = truth + rng.normal(0, 0.1, (n, 2))
    one, other = pair_errors(found, truth), pair_errors(motion.apply(found), truth)
    np.testing.assert_allclose(one.percent, other.percent, atol=1e-6)
    np.testing.assert_allclose(one.percent, one.percent.T)
    np.testing.assert_allclose(np.diag(one.percent), 0.0)
    assert np.isnan(one.mean) == (n < 2)


@given(st.floats(0.5, 2.0))
def test_a_map_that_is_too_large_errs_by_its_scale(scale):
    truth = np.random.default_rng(0).uniform(-10, 10, (6, 2))
    told = pair_errors(scale * truth, truth)
    assert told.mean == pytest.approx(100 * abs(scale - 1), abs=1e-9)
    assert told.largest == pytest.approx(told.mean, abs=1e-9)


def test_two_near_trees_are_a_pair():
    truth = np.array([[0.0, 0.0], [0.5, 0.0]])
    assert pair_errors(1.1 * truth, truth).percent.max() == pytest.approx(10.0)


def test_distances_by_hand():
    told = pair_distances(np.array([[0.0, 0], [3, 4], [3, 0]]))
    np.testing.assert_allclose(told, [[0, 5, 3], [5, 0, 4], [3, 4, 0]])


# --- the path -------------------------------------------------------------------------------------

T = 1_700_000_000_000_000_000 + np.arange(50, dtype=np.int64) * 100_000_000
X, Y = np.linspace(0, 10, 50), np.sin(np.linspace(0, 6, 50))


def path_of(x, y, stamp=T):
    """A path through x, y."""
    return Path(stamp, x, y, np.zeros_like(x), np.zeros_like(x))


def error_of(*words: Any, **rest: Any) -> PathError:
    """The error of a path that has one."""
    told = path_error(*words, **rest)
    assert told is not None
    return told


def truth_of(x, y, stamp=T, same_frame=True):
    """A true path through x, y."""
    return TruthPath(stamp, x, y, np.full(len(x), np.nan), same_frame)


@given(poses2)
def test_a_path_in_another_frame_is_aligned_to_nothing(motion):
    moved = motion.apply(np.stack([X, Y], axis=1))
    told = error_of(path_of(X, Y), truth_of(moved[:, 0], moved[:, 1], same_frame=False))
    assert told.aligned
    assert told.rms < 1e-6
    inside = error_of(path_of(X, Y), truth_of(moved[:, 0], moved[:, 1]))
    wanted = np.hypot(*(moved - np.stack([X, Y], axis=1)).T)
    assert inside.rms == pytest.approx(np.sqrt((wanted**2).mean()), abs=1e-9)
    assert inside.largest == pytest.approx(wanted.max(), abs=1e-9)
    assert inside.median == pytest.approx(np.median(wanted), abs=1e-9)
    assert not inside.aligned


@given(seeds, poses2)
def test_the_fit_is_the_motion_that_was_made_and_no_nudge_betters_it(seed, motion):
    rng = np.random.default_rng(seed)
    a = rng.normal(0, 5, (12, 2))
    b = motion.apply(a) + rng.normal(0, 0.1, (12, 2))
    told = fit_rigid(a, b)
    cost = lambda T: np.square(T.apply(a) - b).sum()  # noqa: E731
    for nudge in (Pose2(1e-3), Pose2(0, 1e-3), Pose2(0, 0, 1e-3), Pose2(-1e-3), Pose2(0, -1e-3, -1e-3)):
        assert cost(told) <= cost(told @ nudge) + 1e-12


def test_a_mirrored_path_is_not_turned_into_a_match():
    told = error_of(path_of(X, Y), truth_of(X, -Y, same_frame=False))
    assert told.rms > 0.3


def test_the_path_is_interpolated_to_the_times_of_the_truth():
    between = T[:-1] + 50_000_000
    told = error_of(path_of(X, 2 * X), truth_of(X[:-1] + 10 / 98, 2 * X[:-1] + 20 / 98, between))
    assert told.rms < 1e-7
    assert told.compared == 49


def test_times_outside_the_path_are_not_compared():
    told = error_of(path_of(X[10:20], Y[10:20], T[10:20]), truth_of(X, Y))
    assert told.compared == 10


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_too_few_common_times_give_no_error(rows):
    assert path_error(path_of(X, Y), truth_of(X[:rows], Y[:rows], T[:rows])) is None
    assert path_error(path_of(X[:rows], Y[:rows], T[:rows]), truth_of(X, Y)) is None
