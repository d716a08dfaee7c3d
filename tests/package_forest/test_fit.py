"""A fitted forest votes as it was trained, and the same examples give the same trees."""

from __future__ import annotations

import numpy as np

from app.extensions.learning.examples import UNKNOWN, Examples
from app.extensions.learning.fit_forest import SETTINGS
from pipeline.classification.features import COUNT, NAMES
from pipeline.classification.forest import (
    ALL_AROUND,
    forest_of,
    vote,
)
from tests.benchmarks.package_forest.fit import FittedForest, as_json, fit, fit_free_end
from tests.pipeline.classification.figures import ending


def shares(fitted: FittedForest, figures):
    """Votes of a fitted forest in the order of CLASSES, shape (N, classes)."""
    leaf = fitted.trees.apply(figures[:, : fitted.trees.n_features_in_].astype(np.float32))
    return np.mean([share[leaf[:, k]] for k, share in enumerate(fitted.share)], axis=0)


def test_what_was_grown_votes_the_same_as_json():
    rng = np.random.default_rng(1)
    figures = rng.uniform(0.0, 1.0, (300, COUNT))
    label = np.where(figures[:, 3] > 0.5, 0, 1 + (figures[:, 5] > 0.5))
    label[:20] = UNKNOWN
    examples = [
        Examples("a", False, kind == ALL_AROUND, np.zeros((300, 5)), figures, label) for kind in SETTINGS
    ]
    for kind in SETTINGS:
        grown = fit(examples, kind)
        forest = forest_of(as_json({kind: grown}, []), kind)
        ours, theirs = vote(figures.astype(np.float32).astype(np.float64), forest), shares(grown, figures)
        # Thresholds are rounded to four digits: a figure that lies within the rounding may turn.
        assert np.mean(np.abs(ours - theirs).max(axis=1) < 0.02) > 0.95
        sure = label != UNKNOWN
        assert np.mean((ours[sure, 0] >= 0.5) == (label[sure] == 0)) > 0.95


def test_the_same_examples_grow_the_same_trees():
    rng = np.random.default_rng(2)
    figures = rng.uniform(0.0, 1.0, (100, COUNT))
    examples = [
        Examples("a", False, True, np.zeros((100, 5)), figures, (figures[:, 0] > 0.5).astype(np.int64))
    ]
    assert as_json({"k": fit(examples, ALL_AROUND)}, []) == as_json({"k": fit(examples, ALL_AROUND)}, [])


def test_poles_that_end_in_free_air_are_told_by_what_was_pasted():
    rng = np.random.default_rng(2)
    figures = np.repeat(ending(3.0, 2.0), 200, axis=0)
    figures[:, NAMES.index("thick")] = rng.uniform(0.0, 0.2, 200)
    label = (figures[:, NAMES.index("thick")] < 0.1).astype(np.int64)
    pasted = Examples("a with poles 0", True, False, np.zeros((200, 5)), figures, label)
    grown = fit_free_end([pasted])
    assert grown is not None
    assert np.mean((shares(grown, figures)[:, 0] >= 0.5) == (label == 0)) > 0.95
    assert fit_free_end([]) is None
    low = Examples("a with poles 1", True, False, np.zeros((200, 5)), np.zeros((200, COUNT)), label)
    assert fit_free_end([low]) is None
