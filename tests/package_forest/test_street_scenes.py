"""Street scenes for training: the same seed gives the same scene, and labels match the objects."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.learning.examples import TREE, UNKNOWN
from pipeline.config import preset
from tests.benchmarks.package_forest.labelled_scenes import street_examples
from tests.benchmarks.package_forest.street_scenes import simulate_street


@pytest.fixture(scope="module", params=[False, True], ids=["all around", "one way"])
def street(request):
    return request.param, simulate_street(204, one_way=request.param)


def test_the_same_seed_gives_the_same_street(street):
    one_way, first = street
    again = simulate_street(204, one_way=one_way)
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.kind, again.kind)
    assert len(simulate_street(205, one_way=one_way).points) != len(first.points)


def test_every_return_has_a_label(street):
    _, scene = street
    assert sum(len(step.scan.points) for step in scene.steps) == len(scene.points) == len(scene.kind)
    assert {"ground", "foliage"} <= set(scene.kind.tolist())
    assert scene.returns.sum() == np.count_nonzero(scene.kind == "trunk")


def test_trunks_stand_where_their_returns_are():
    scene = simulate_street(204, one_way=False)
    sure = scene.trunk[scene.returns >= 30]
    returns = scene.points[scene.kind == "trunk"][:, :2]
    assert len(sure)
    for place in sure:
        assert np.count_nonzero(np.hypot(*(returns - place).T) < 1.5) >= 30


def test_examples_of_a_street_know_trees_and_other_things():
    examples = list(street_examples(204, False, preset("forest"), 25.0))
    label = examples[-1].label
    assert np.count_nonzero(label == TREE) > 0
    assert np.count_nonzero((label != TREE) & (label != UNKNOWN)) > 0
    assert np.hypot(*examples[-1].axis[:, :2].T).max() < 25.0
