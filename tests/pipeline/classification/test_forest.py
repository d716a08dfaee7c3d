"""Random forest: files are validated, a forest votes as it was trained, and effects of features are exact."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification.features import COUNT, NAMES
from pipeline.classification.forest import (
    ALL_AROUND,
    CLASSES,
    FILE,
    FREE_END,
    MOVED,
    ONE_WAY,
    feature_effects,
    forest_of,
    is_seen_all_around,
    read_forest,
    standard_forest,
    vote,
)
from pipeline.errors import StemmapError
from pipeline.types.records import Verdict
from tests.pipeline.classification.figures import ending

LEAF = {"share": [1.0, 0, 0, 0, 0, 0]}
OTHER = {"share": [0, 0, 0, 0, 0, 1.0]}


def written(tmp_path, **changes: object):
    node = {"figure": "tilt", "at_most": 0.1, "yes": LEAF, "no": OTHER}
    data = {"classes": [kind.label for kind in CLASSES], ALL_AROUND: [node], ONE_WAY: [LEAF], **changes}
    file = tmp_path / "forest.json"
    file.write_text(json.dumps(data))
    return file


@given(turn=st.floats(0.0, 6.3), length=st.floats(0.0, 50.0))
def test_a_sensor_that_looks_one_way_has_seen_all_around_once_it_has_moved(
    turn: float, length: float
) -> None:
    path = np.linspace(0.0, length, 9)[:, None] * np.array([np.cos(turn), np.sin(turn)])
    assert is_seen_all_around(16, path[:1])
    assert not is_seen_all_around(0, path[:1])
    assert not is_seen_all_around(0, np.zeros((0, 2)))
    if length <= MOVED or length > 1.5 * MOVED:  # between them it depends on the direction
        assert is_seen_all_around(0, path) == (length > MOVED)
    assert not is_seen_all_around(0, path) or is_seen_all_around(0, np.vstack([path, path[:1]]))


def test_a_figure_decides_at_its_threshold(tmp_path):
    forest = read_forest(written(tmp_path), ALL_AROUND)
    figures = np.zeros((3, COUNT))
    figures[:, NAMES.index("tilt")] = 0.05, 0.1, 0.11
    assert vote(figures, forest)[:, 0].tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize(
    "changes",
    [
        {"classes": ["tree"]},
        {ALL_AROUND: []},
        {ALL_AROUND: [{"share": [7.0, 0, 0, 0, 0, 0]}]},
        {ALL_AROUND: [{"figure": "colour", "at_most": 1.0, "yes": LEAF, "no": LEAF}]},
        {ALL_AROUND: [{"figure": "tilt", "at_most": 1.0, "yes": LEAF}]},
        {ALL_AROUND: [{"figure": "tilt", "at_most": 10**400, "yes": LEAF, "no": LEAF}]},
    ],
)
def test_a_damaged_file_is_refused_with_a_remedy(tmp_path, changes):
    with pytest.raises(StemmapError, match="decision trees cannot be read"):
        read_forest(written(tmp_path, **changes), ALL_AROUND)


def test_a_file_that_is_missing_too_large_or_no_json_is_refused(tmp_path):
    file = tmp_path / "f.json"
    with pytest.raises(StemmapError):
        read_forest(file, ONE_WAY)
    file.write_text("{")
    with pytest.raises(StemmapError):
        read_forest(file, ONE_WAY)
    file.write_bytes(b" " * 4_000_001)
    with pytest.raises(StemmapError, match="too large"):
        read_forest(file, ONE_WAY)


def test_the_forest_of_the_package_votes_in_shares():
    figures = np.random.default_rng(0).uniform(-1.0, 5.0, (50, COUNT))
    for all_around in (True, False):
        votes = vote(figures, standard_forest(all_around))
        assert votes.sum(axis=1) == pytest.approx(1.0, abs=0.02)
        assert (votes >= 0.0).all()
    assert FILE.stat().st_size < 1_300_000


def test_what_ends_in_free_air_is_asked_whether_it_is_a_pole(tmp_path):
    pole = {"share": [0.3, 0.7, 0, 0, 0, 0]}
    forest = read_forest(written(tmp_path, **{FREE_END: [pole]}), ONE_WAY)
    assert vote(ending(3.0, 1.0), forest)[0].tolist() == [0.0, 1.0, 0, 0, 0, 0]
    # What is low, or may go on above what was seen, keeps its votes.
    assert vote(ending(1.8, 3.0), forest)[0].tolist() == LEAF["share"]
    assert vote(ending(5.0, 0.8), forest)[0].tolist() == LEAF["share"]
    assert vote(np.zeros((0, COUNT)), forest).shape == (0, len(CLASSES))


def test_a_tree_that_ends_in_free_air_stays_one(tmp_path):
    tree = {"share": [0.5, 0.5, 0, 0, 0, 0]}
    forest = read_forest(written(tmp_path, **{FREE_END: [tree]}), ONE_WAY)
    assert vote(ending(3.0, 1.0), forest)[0].tolist() == LEAF["share"]


def test_sensors_that_see_all_around_and_older_files_ask_nobody(tmp_path):
    pole = {"share": [0.0, 1.0, 0, 0, 0, 0]}
    assert read_forest(written(tmp_path, **{FREE_END: [pole]}), ALL_AROUND).free_end is None
    assert read_forest(written(tmp_path), ONE_WAY).free_end is None
    with pytest.raises(StemmapError, match="decision trees cannot be read"):
        read_forest(written(tmp_path, **{FREE_END: []}), ONE_WAY)


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
