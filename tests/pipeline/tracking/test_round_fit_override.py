"""Circle fits from most sides override votes for classes that are not round, and no other classes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification import column_votes
from pipeline.classification.column_classifier import no_columns
from pipeline.classification.features import NAMES
from pipeline.classification.forest import CLASSES
from pipeline.config import preset
from pipeline.tracking import Tracker
from pipeline.tracking.track_classification import ROUND_FITS as FITS
from pipeline.tracking.track_classification import ROUND_REACH as REACH
from pipeline.tracking.track_classification import ROUND_SIDES as SIDES
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Verdict

FOREST = preset("forest")
PLACE = np.array([3.0, -2.0])


def column(verdict=Verdict.BUSH, **votes: float):
    """One column at PLACE; votes by the names of their classes, the rest for bushes."""
    share = np.zeros(len(CLASSES))
    for name, part in votes.items():
        share[CLASSES.index(Verdict[name.upper()])] = part
    share[CLASSES.index(Verdict.BUSH)] += 1.0 - share.sum()
    none = no_columns()
    rows = {name: np.zeros((1, *getattr(none, name).shape[1:])) for name in none.__dataclass_fields__}
    one = replace(none, **rows)
    one.axis[0, :2] = PLACE
    one.figures[0, NAMES.index("voxels to 3 m")] = 100.0
    return replace(one, share=share[None], verdict=np.array([verdict], np.int32))


def track(*, sides=SIDES, fits=FITS, off=0.0):
    """One track beside PLACE, fitted so often and seen on so many sides."""
    table = TrackTable.empty(1)
    table.x[0, :2] = PLACE + np.array([off, 0.0])
    table.radii[0], table.sides[0], table.hits[0] = fits, (1 << sides) - 1, fits
    return table


def verdict(columns, tracks, share=0.4):
    tracker = Tracker(FOREST.tracking)
    tracker.tracks = tracks
    judged = tracker.classify(1, columns, FOREST.classification.model_copy(update={"tree_share": share}))
    return Verdict(int(judged.verdict[0]))


def test_a_trunk_among_shrubs_is_a_tree_when_it_is_round_from_most_sides():
    assert verdict(column(tree=0.3), track()) is Verdict.TREE  # 0.3 / (0.3 + 0.07)


@pytest.mark.parametrize(
    "poor", [track(sides=SIDES - 1), track(fits=FITS - 1), track(off=REACH + 0.01), TrackTable.empty()]
)
def test_without_enough_circle_fits_the_votes_decide(poor):
    assert verdict(column(tree=0.3), poor) is Verdict.BUSH


@pytest.mark.parametrize("kind", ["pole", "person"])
def test_votes_for_another_round_class_decide(kind):
    for tree in (0.2, 0.39):
        assert (
            verdict(column(Verdict[kind.upper()], tree=tree, **{kind: 0.4}), track()) is Verdict[kind.upper()]
        )


@pytest.mark.parametrize("rule", [Verdict.MOVING, Verdict.TOO_FEW_POINTS])
def test_a_class_by_a_rule_is_not_changed(rule):
    assert verdict(column(rule, tree=0.39), track()) is rule


def rays(columns, met, passed):
    """The columns after so many rays between 2.2 and 3.2 m ended at them or behind them."""
    seen = replace(columns, met=columns.met.copy(), passed=columns.passed.copy())
    seen.met[:, 12], seen.passed[:, 12] = met, passed
    return replace(seen, verdict=column_votes(seen).verdict(0.4))


@pytest.mark.parametrize(("met", "passed"), [(0, 10), (2, 8), (29, 71)])
def test_a_round_column_that_ends_below_a_crown_is_too_low(met, passed):
    """Somebody under a tree: votes between a tree and a bush, circles from all sides, and free air above."""
    assert verdict(rays(column(tree=0.3), met, passed), track()) is Verdict.TOO_LOW


@pytest.mark.parametrize(("met", "passed"), [(0, 9), (30, 70), (10, 0)])
def test_a_column_that_continues_or_has_few_rays_keeps_its_class(met, passed):
    assert verdict(rays(column(tree=0.3), met, passed), track()) is Verdict.TREE


@pytest.mark.parametrize(
    ("votes", "kind"),
    [({"tree": 0.03}, "bush"), ({"tree": 0.1, "person": 0.5}, "person"), ({"tree": 0.5}, "tree")],
)
def test_the_height_rule_does_not_apply_to_classes_by_votes(votes, kind):
    assert verdict(rays(column(**votes), 0, 50), track()) is Verdict[kind.upper()]


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.05, 1.0))
def test_trees_stay_trees_and_the_result_is_monotonic_in_their_votes(tree, more, needed):
    low, high = sorted((tree, more))
    assert verdict(column(Verdict.TREE, tree=low), track(), needed) is Verdict.TREE
    told = [verdict(column(tree=part), track(), needed) is Verdict.TREE for part in (low, high)]
    assert told[1] or not told[0]


def test_the_tracker_reports_the_tree_and_the_class_of_its_column():
    tracker = Tracker(FOREST.tracking)
    tracker.tracks = track()
    columns = tracker.classify(1, column(tree=0.3), FOREST.classification)
    assert columns.verdict.tolist() == [Verdict.TREE]
    assert tracker.trees().confirmed.tolist() == [True]
