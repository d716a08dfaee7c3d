"""What a figure tells is the vote with it less the vote without it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification.features import COUNT, NAMES
from pipeline.classification.forest import CLASSES, feature_effects, forest_of, standard_forest, vote
from pipeline.types.records import Verdict

TREE, NO_TREE = [1.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0]


def one_tree():
    """A pole when it tilts; else a tree when it is crowned, and half of one when it is not."""
    inner = {
        "figure": "crown",
        "at_most": 0.5,
        "yes": {"share": [0.5, 0.5, 0, 0, 0, 0]},
        "no": {"share": TREE},
    }
    root = {"figure": "tilt", "at_most": 0.1, "yes": inner, "no": {"share": NO_TREE}}
    return forest_of({"classes": [v.label for v in CLASSES], "all around": [root]}, "all around")


def figures(tilt: float, crown: float):
    row = np.zeros(COUNT)
    row[NAMES.index("tilt")], row[NAMES.index("crown")] = tilt, crown
    return row


def test_the_effect_of_each_figure_by_hand():
    told = feature_effects(figures(tilt=0.0, crown=1.0), one_tree(), Verdict.TREE)
    assert told[NAMES.index("tilt")] == 1.0 - 0.5  # unknown tilt: half of the tree, half of the pole
    assert told[NAMES.index("crown")] == 1.0 - 0.75
    assert np.count_nonzero(told) == 2
    leaning = feature_effects(figures(tilt=0.5, crown=1.0), one_tree(), Verdict.TREE)
    assert leaning[NAMES.index("tilt")] == 0.0 - 0.5
    assert leaning[NAMES.index("crown")] == 0.0  # was not asked on the way


@given(st.integers(0, 2**32 - 1))
def test_no_figure_tells_more_than_the_vote_holds(seed: int):
    forest = standard_forest(all_around=True)
    row = np.random.default_rng(seed).uniform(-1.0, 6.0, COUNT)
    share = vote(row[None], forest)[0, 0]
    told = feature_effects(row, forest, Verdict.TREE)
    assert np.all(told <= share + 1e-9)
    assert np.all(told >= share - 1.0 - 1e-9)
