"""Assignment of a tree column to the track at its axis, by distance and number of hits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.tracking import Tracker
from pipeline.tracking.track_classification import REACH, SHARED_SURROUNDINGS, _best_first
from pipeline.tracking.track_table import TrackTable
from pipeline.tracking.tracker import COLUMN_SIGMA
from pipeline.types.records import RING_FAR, Columns, Verdict
from pipeline.types.units import SECOND_NS
from tests.pipeline.strategies import detections, track
from tests.pipeline.tracking.test_round_fit_override import PLACE, column

FOREST = preset("forest")
ENOUGH = FOREST.tracking.hits_to_confirm


def told(*tracks: tuple[float, int]):
    """The verdicts of tracks (distance from the column [m], hits) after its column was judged a tree."""
    tracker = Tracker(FOREST.tracking)
    table = TrackTable.empty(len(tracks))
    for k, (away, hits) in enumerate(tracks):
        table.x[k, :2] = PLACE + away * np.array([np.cos(2.0 * k), np.sin(2.0 * k)])
        table.number[k], table.hits[k] = k + 1, hits
    tracker.tracks, tracker.next_number = table, len(tracks) + 1
    tracker.classify(1, column(Verdict.TREE, tree=0.8), FOREST.classification)
    return [Verdict(int(v)) if v >= 0 else None for v in tracker.tracks.verdict]


@pytest.mark.parametrize(
    ("own", "beside"),
    [
        ((0.0, 5), (0.43, 290)),
        ((0.07, 240), (0.43, 290)),
        ((0.15, 240), (0.43, 290)),
        ((0.05, 100), (0.4, 3000)),
        ((0.15, 240), (0.4, 3000)),
        ((0.28, 98), (0.22, 26)),  # undergrowth beside a stem, sim:wild with seed 102
    ],
)
def test_branches_near_a_stem_do_not_get_its_column(own, beside):
    assert told(beside, own) == [Verdict.OTHER, Verdict.TREE]
    assert told(own, beside) == [Verdict.TREE, Verdict.OTHER]


def test_of_two_parts_of_a_trunk_the_one_with_more_hits_gets_the_column():
    assert told((0.05, 2), (0.12, 200)) == [Verdict.OTHER, Verdict.TREE]
    assert told((0.1, 200), (0.1, 2)) == [Verdict.TREE, Verdict.OTHER]


def test_a_single_track_within_reach_gets_the_column():
    assert told((REACH - 0.01, 1)) == [Verdict.TREE]
    assert told((REACH + 0.01, 1))[1:] == [Verdict.TREE], "the column begins a track of its own"


@pytest.mark.parametrize("away", [REACH + 0.01, RING_FAR - 0.01])
@pytest.mark.parametrize("own", [[], [(0.0, 0)]], ids=["no track", "a track without detections"])
def test_a_column_without_detections_belongs_to_the_detected_stem_in_its_surroundings(away, own):
    assert told((away, ENOUGH), *own) == [Verdict.TREE, *[Verdict.OTHER] * len(own)]


def test_the_stem_in_the_surroundings_is_the_one_with_most_detections():
    assert told((0.5, ENOUGH), (0.8, 50)) == [None, Verdict.TREE]


@pytest.mark.parametrize("stem", [(RING_FAR + 0.01, 50), (0.6, ENOUGH - 1)], ids=["too far", "too few"])
def test_a_column_without_a_detected_stem_in_its_surroundings_begins_a_track(stem):
    assert told(stem)[1:] == [Verdict.TREE]


@pytest.mark.parametrize("seed", range(4))
def test_a_track_of_a_column_has_the_covariance_of_the_axis_and_of_the_pose(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 3)) * [[0.3], [0.2], [0.05]]
    pose, of_pose = Pose2(*rng.uniform(-2.0, 2.0, 3)), A @ A.T
    tracker = Tracker(FOREST.tracking)
    track(tracker, 0, pose, of_pose, detections([]))
    tracker.classify(1, column(Verdict.TREE, tree=0.8), FOREST.classification)
    x, y = PLACE - [pose.x, pose.y]
    J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
    shared = J @ of_pose @ J.T
    np.testing.assert_allclose(tracker.tracks.x[:, :2], [PLACE])
    np.testing.assert_allclose(tracker.tracks.shared, [shared], atol=1e-12)
    np.testing.assert_allclose(
        tracker.tracks.P[:, :2, :2], [np.diag([COLUMN_SIGMA**2] * 2) + shared], atol=1e-12
    )


@pytest.mark.parametrize(
    "kind", [Verdict.POLE, Verdict.PERSON, Verdict.MOVING, Verdict.TOO_LOW, Verdict.BUSH, Verdict.OTHER]
)
def test_what_has_a_column_that_is_no_tree_is_not_the_stem_of_a_column_beside_it(kind):
    assert beside(kind) == [kind, Verdict.TREE]


@pytest.mark.parametrize(
    ("hits", "away", "trees"),
    [
        ((20, 0), SHARED_SURROUNDINGS - 0.01, [True, False]),
        ((20, 1), SHARED_SURROUNDINGS - 0.01, [True, True]),
        ((20, 0), SHARED_SURROUNDINGS + 0.01, [True, True]),
        ((20, ENOUGH), 0.6, [True, True]),
        ((0, ENOUGH), SHARED_SURROUNDINGS - 0.01, [False, True]),
        ((0, 0), SHARED_SURROUNDINGS - 0.01, [True, False]),
        ((0, 0), SHARED_SURROUNDINGS + 0.01, [True, True]),
    ],
)
def test_a_second_tree_in_the_surroundings_of_a_tree_has_detections(hits, away, trees):
    tracker = Tracker(FOREST.tracking)
    table = TrackTable.empty(2)
    table.x[:, :2] = PLACE + np.array([[0.0, 0.0], [away, 0.0]])
    table.number[:], table.hits[:] = (1, 2), hits
    tracker.tracks, tracker.next_number = table, 3
    one, other = column(Verdict.TREE, tree=0.9), column(Verdict.TREE, tree=0.8)
    other.axis[0, :2] = table.x[1, :2]
    tracker.classify(1, together(one, other), FOREST.classification)
    assert [verdict == Verdict.TREE for verdict in tracker.tracks.verdict.tolist()] == trees


def test_of_two_trees_without_detections_the_one_that_was_a_tree_remains():
    tracker = Tracker(FOREST.tracking)
    table = TrackTable.empty(2)
    table.x[:, :2] = PLACE + np.array([[0.0, 0.0], [1.0, 0.0]])
    table.number[:] = 1, 2
    tracker.tracks, tracker.next_number = table, 3
    for share in (0.8, 0.95, 0.8):  # of the votes for the second one; the first has 0.9
        one, other = column(Verdict.TREE, tree=0.9), column(Verdict.TREE, tree=share)
        other.axis[0, :2] = PLACE + np.array([1.0, 0.0])
        tracker.classify(1, together(one, other), FOREST.classification)
        assert tracker.tracks.verdict.tolist() == [Verdict.TREE, Verdict.OTHER]


def together(one: Columns, other: Columns) -> Columns:
    """Columns of two tables."""
    columns = {
        name: np.concatenate([getattr(one, name), getattr(other, name)]) for name in one.__dataclass_fields__
    }
    return replace(one, **columns)


def beside(kind: Verdict):
    """Verdicts of the tracks after classification: a detected track with its own column of a class, and a
    tree column without detections 0.6 m beside it."""
    tracker = Tracker(FOREST.tracking)
    table = TrackTable.empty(1)
    table.x[0, :2] = PLACE + np.array([0.6, 0.0])
    table.number[0], table.hits[0] = 1, 20
    tracker.tracks, tracker.next_number = table, 2
    tree, other = column(Verdict.TREE, tree=0.8), column(kind)
    other.axis[0, :2] = table.x[0, :2]
    tracker.classify(1, together(tree, other), FOREST.classification)
    return [Verdict(int(v)) for v in tracker.tracks.verdict]


@given(st.lists(st.tuples(st.floats(0.0, 0.44), st.integers(0, 600)), min_size=1, max_size=6))
def test_a_track_that_is_nearer_and_has_more_hits_is_preferred(tracks):
    verdicts = told(*tracks)
    (chosen,) = [k for k, verdict in enumerate(verdicts) if verdict is Verdict.TREE]
    away, hits = tracks[chosen]
    assert not [t for t in tracks if t[0] < away - 1e-6 and t[1] > hits]
    assert away <= 1e-6 or not [t for t in tracks if t[0] < away - 1e-6 and t[1] == hits]


def between(verdict: Verdict, away: float, hits: int = 3):
    """The verdict of a track that came since its column was judged, and whether it is a tree of the map."""
    tracker = Tracker(FOREST.tracking)
    table = TrackTable.empty(1)
    table.number[0], table.hits[0], table.stamp_ns[0] = 1, hits, 2 * SECOND_NS
    table.x[0, :2] = PLACE + np.array([away, 0.0])
    tracker.tracks, tracker.next_number = table, 2
    tracker.classify_new(column(verdict))
    return int(tracker.tracks.verdict[0]), bool(tracker.trees().confirmed[0])


@pytest.mark.parametrize("verdict", [Verdict.BUSH, Verdict.PERSON, Verdict.POLE, Verdict.OTHER])
def test_hits_do_not_confirm_a_track_at_a_column_of_another_class(verdict):
    assert between(verdict, REACH - 0.01) == (int(verdict), False)
    assert between(verdict, REACH + 0.01) == (-1, True), "of a place where nothing is known hits tell"


def test_a_new_track_next_to_a_tree_is_not_confirmed_before_classification():
    assert between(Verdict.TREE, 0.3) == (int(Verdict.OTHER), False)


def test_of_columns_of_one_tree_the_one_with_most_votes_remains():
    axis = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 5.0, 0.0], [5.0, 0.0, 0.0]])
    votes = np.zeros((4, 6))
    votes[:, 0] = 0.6, 0.9, 0.5, 0.8
    verdict = np.array([Verdict.TREE, Verdict.TREE, Verdict.TREE, Verdict.POLE], np.int32)
    assert _best_first(axis, votes, verdict).tolist() == [1, 2]
