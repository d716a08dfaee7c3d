"""Splitting of clusters: a trunk is separated from a shrub at its foot, and other clusters stay unchanged."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.detection.cluster_shape import describe, describe_stems
from pipeline.detection.cluster_splitting import (
    ALIKE,
    ALIKE_LEAST,
    APART,
    LEAN,
    Runs,
    _count_agreeing_slices,
)
from pipeline.detection.verdicts import classify_clusters
from pipeline.types.records import Clusters, Labels, Verdict
from tests.pipeline.strategies import SENSOR, one_cluster

FOREST = preset("forest").shape.model_copy(update={"split_slices": 4})
DETECTION = preset("forest").detection
RADIUS = (preset("forest").detection.radius_min, preset("forest").detection.radius_max)
SHARP = replace(SENSOR, range_sigma=0.01)
HEIGHTS = np.arange(-1.3, 0.4, 0.05)  # of rings at a trunk, below a sensor that stands 1.6 m high
STEP = SENSOR.azimuth_step
TRUNK = np.array([8.0, 0.0])
SHAPES = {
    "trunk alone": lambda rng: trunk(rng),
    "shrub alone": lambda rng: shrub(rng, beside=0.0, top=0.4),
    "wall": lambda rng: wall(rng),
}


def trunk(rng, *, radius=0.15, at=TRUNK):
    """The front of a trunk, ring by ring."""
    distance = np.hypot(*at)
    turn = np.arange(-np.arcsin(radius / distance) + 0.2 * STEP, np.arcsin(radius / distance), STEP)
    foot = distance * np.cos(turn)
    reach = foot - np.sqrt(np.maximum(foot**2 - distance**2 + radius**2, 0.0))
    return rays(rng, np.arctan2(at[1], at[0]) + turn, reach, HEIGHTS, 0.01)


def shrub(rng, *, beside, top):
    """Leaves at all depths to one side of the trunk, up to some height."""
    turn = np.arange((beside - 0.3) / 8.0, (beside + 0.3) / 8.0, STEP)
    return rays(rng, turn, np.full(len(turn), 7.9), HEIGHTS[top > HEIGHTS], 0.12)


def wall(rng):
    turn = np.arange(-0.08, 0.08, STEP)
    return rays(rng, turn, 7.9 / np.cos(turn), HEIGHTS, 0.01)


def rays(rng, turn, reach, heights, sigma):
    points = []
    for z in heights:
        r = reach + sigma * rng.standard_normal(len(reach))
        points.append(np.stack([r * np.cos(turn), r * np.sin(turn), np.full(len(r), z)], axis=1))
    return np.concatenate(points)


def parts_of(points, slices=4, radius=RADIUS):
    shape = FOREST.model_copy(update={"split_slices": slices})
    return describe_stems(points.astype(np.float32), one_cluster(points), SHARP, shape, radius)


@pytest.mark.parametrize("top", [-0.8, -0.4])
def test_a_shrub_at_its_foot_does_not_hide_a_trunk(top):
    rng = np.random.default_rng(1)
    stem, leaves = trunk(rng), shrub(rng, beside=0.25, top=top)
    points = np.concatenate([leaves, stem])
    (whole,) = classify_clusters(parts_of(points, slices=0)[1], DETECTION).verdict
    assert whole != Verdict.TREE
    labels, clusters = parts_of(points)
    assert labels.clusters == 2
    assert classify_clusters(clusters, DETECTION).verdict[0] == Verdict.TREE
    assert np.hypot(*(clusters.centre[0] - TRUNK)) < 0.02
    assert clusters.radius[0] == pytest.approx(0.15, abs=0.02)
    taken = labels.label == 0
    assert np.count_nonzero(taken[: len(leaves)]) < 0.1 * len(leaves)
    assert np.count_nonzero(taken[len(leaves) :]) > 0.3 * len(stem)


def test_the_bounds_of_the_radius_decide_what_is_a_trunk():
    rng = np.random.default_rng(1)
    points = np.concatenate([shrub(rng, beside=0.13, top=-0.6), trunk(rng, radius=0.03)])
    assert parts_of(points)[0].clusters == 1
    assert parts_of(points, radius=(0.02, 0.9))[0].clusters == 2


@pytest.mark.parametrize("what", SHAPES)
def test_nothing_is_taken_out_of(what):
    points = SHAPES[what](np.random.default_rng(2))
    labels, clusters = parts_of(points)
    assert labels.clusters == 1
    assert_same(clusters, parts_of(points, slices=0)[1])


def test_more_slices_must_agree_than_the_shrub_leaves():
    rng = np.random.default_rng(3)
    points = np.concatenate([trunk(rng), shrub(rng, beside=0.1, top=-0.1)])
    assert parts_of(points, slices=2)[0].clusters == 2
    assert parts_of(points, slices=8)[0].clusters == 1


def test_other_clusters_keep_their_numbers_and_figures():
    rng = np.random.default_rng(4)
    alone, joined = (
        trunk(rng, at=np.array([6.0, 5.0])),
        np.concatenate([trunk(rng), shrub(rng, beside=0.25, top=-0.6)]),
    )
    points = np.concatenate([alone, joined, alone + np.array([0.0, -9.0, 0.0])]).astype(np.float32)
    label = np.repeat([0, 1, 2], [len(alone), len(joined), len(alone)]).astype(np.int32)
    before = Labels(label, 3, np.zeros(3, np.bool_))
    labels, clusters = describe_stems(points, before, SHARP, FOREST, RADIUS)
    assert labels.clusters == 4
    assert (labels.label[label != 1] == label[label != 1]).all()
    assert set(labels.label[label == 1]) == {1, 3}
    # As if the parts had been clusters from the start.
    assert_same(clusters, describe(points, labels, SHARP, FOREST))


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.floats(0.001, 1.0))
def test_no_return_is_lost_whatever_the_points(seed, slices, spread):
    rng = np.random.default_rng(seed)
    points = (rng.normal(0.0, spread, (120, 3)) + np.array([3.0, 0.0, 0.0])).astype(np.float32)
    label = rng.integers(-1, 3, 120).astype(np.int32)
    before = Labels(label, 3, np.zeros(3, np.bool_))
    labels, clusters = describe_stems(
        points, before, SENSOR, FOREST.model_copy(update={"split_slices": slices}), RADIUS
    )
    assert ((labels.label >= 0) == (label >= 0)).all()
    assert (np.bincount(labels.label[label >= 0], minlength=labels.clusters) == clusters.size).all()
    assert len(clusters.size) == labels.clusters == len(labels.hidden)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_circles_of_one_trunk_may_be_farther_apart_the_higher_they_are_above_each_other(seed, per_slice):
    """In each slice, the most similar circle agrees if it is within the limits."""
    rng = np.random.default_rng(seed)
    count = 12
    level, height = np.arange(count) // per_slice, rng.uniform(-2.0, 2.0, count)
    x, y, radius = rng.uniform(-0.2, 0.2, count), rng.uniform(-0.2, 0.2, count), rng.uniform(0.1, 0.2, count)
    returns = rng.integers(3, 9, count)
    runs = Runs(level, x, y, radius, height, returns, np.ones(count, np.bool_), np.zeros(count, np.bool_))
    first = int(rng.integers(count))
    off, wider = np.hypot(x - x[first], y - y[first]), np.abs(radius - radius[first])
    within = (off < APART + LEAN * np.abs(height - height[first])) & (
        wider < ALIKE * radius[first] + ALIKE_LEAST
    )
    unlike = np.where(within, off + wider, np.inf)
    agrees = np.array([within[k] and unlike[k] == unlike[level == level[k]].min() for k in range(count)])
    assert _count_agreeing_slices(runs, count, first) == (agrees.sum(), returns[agrees].sum())
    np.testing.assert_array_equal(runs.agrees, agrees)


def assert_same(one, other):
    for column in fields(Clusters):
        np.testing.assert_array_equal(getattr(one, column.name), getattr(other, column.name), column.name)
