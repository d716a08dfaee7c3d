"""Learning from annotations: examples are of what was judged, nothing is judged by trees that saw it, and a
forest is the one that its name tells or is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.cli import main
from app.dashboard.parameters import ParameterState
from app.extensions.learning import LEAST_OTHERS, LEAST_TREES
from app.extensions.learning.examples import (
    CLASS_OF_KIND,
    SEEN,
    TREE,
    ExampleCollector,
    Examples,
    object_numbers,
)
from app.extensions.learning.fit_forest import PRIOR, SETTINGS, all_expanded, expanded
from app.extensions.learning.learning import (
    SAME_PLACE,
    Rates,
    fold_of,
    groups_of,
    seen_by,
    validate,
    what_lacks,
)
from app.store.forests import FOLDER, PACKAGE, Forests, name_of
from app.store.records import Author, Content
from app.store.store import Store
from pipeline.classification import no_columns
from pipeline.classification.features import COUNT, NAMES
from pipeline.classification.forest import ALL_AROUND, CLASSES, FILE, FREE_END, ONE_WAY, forest_of, vote
from pipeline.config import Parameters, assign, preset
from pipeline.errors import ParameterError, StemmapError
from pipeline.types.records import Columns
from tests.benchmarks.package_forest.fit import FITS

POLE = CLASS_OF_KIND["pole"]
LEAF = {"share": [0.9, 0.1, 0, 0, 0, 0]}
ANN = Author("a" * 32, "Ann")


def columns(*rows: tuple[float, float, float]) -> Columns:
    """Columns at x, y that so many scans saw; their first figure is x."""
    n, none = len(rows), no_columns()
    table = np.array(rows).reshape(n, 3)
    figures = np.zeros((n, COUNT))
    figures[:, 0] = table[:, 0]
    axis = np.column_stack([table[:, :2], np.zeros((n, 3))])
    zero = np.zeros(n)
    return Columns(
        np.zeros((n, 2), np.int64), axis, zero, table[:, 2], zero, zero, none.met, none.passed, figures,
        np.zeros((n, 6)), np.zeros(n, np.int32),
    )  # fmt: skip


def examples(places, trees, scene="a", figures=None):
    """One example of each place."""
    n = len(places)
    axis = np.column_stack([np.array(places, np.float64).reshape(n, 2), np.zeros((n, 3))])
    label = np.where(np.array(trees, bool), TREE, POLE)
    return Examples(scene, False, True, axis, np.zeros((n, COUNT)) if figures is None else figures, label)


def data(**changes: object):
    """JSON of a forest with one leaf."""
    return {"classes": [c.label for c in CLASSES], ALL_AROUND: [LEAF], ONE_WAY: [LEAF], **changes}


# --- what was judged ------------------------------------------------------------------------------


def test_what_was_judged_is_taken_after_some_scans_and_as_it_was_last():
    judged = ExampleCollector([Content(1.0, 0.0), Content(5.0, 0.0, "pole"), Content(9.0, 9.0)])
    for seen in range(1, SEEN[1] + 1):
        x = 1.0 + 0.001 * seen
        judged.add(columns((x, 0.0, seen), (5.1, 0.0, 1.0), (1.3, 0.0, 99.0), (7.0, 0.0, 99.0)))
    found = judged.examples("a", all_around=True)
    # The tree after SEEN[0] and SEEN[1] scans and at the end; the pole at the end; nothing of the third.
    firsts = [1.0 + 0.001 * SEEN[0], 1.0 + 0.001 * SEEN[1], 1.0 + 0.001 * SEEN[1], 5.1]
    assert found.figures[:, 0].tolist() == pytest.approx(firsts)
    assert found.label.tolist() == [TREE, TREE, TREE, POLE]
    assert object_numbers([found]).tolist() == [0, 0, 0, 1]


def test_two_annotations_never_share_a_column():
    judged = ExampleCollector([Content(0.0, 0.0), Content(0.3, 0.0, "pole")])
    judged.add(columns((0.05, 0.0, 9.0)))
    assert judged.examples("a", all_around=True).label.tolist()[-1:] == [TREE]
    assert POLE not in judged.examples("a", all_around=True).label


# --- what is learned ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SETTINGS)
def test_a_leaf_says_what_it_said_and_what_is_new_by_their_weights(kind):
    n, share = 4, np.array(LEAF["share"])
    label = np.full(n, POLE)
    (leaf,) = expanded([LEAF], SETTINGS[kind], np.zeros((n, COUNT)), label, np.arange(n), seed=0)
    said = n * SETTINGS[kind].upright * np.eye(len(CLASSES))[POLE]
    assert leaf["share"] == pytest.approx((PRIOR * share + said) / (PRIOR + said.sum()), abs=0.006)


def test_a_thing_counts_once_however_many_examples_it_gave():
    figures, label = np.zeros((6, COUNT)), np.array([POLE] * 5 + [TREE])
    once = expanded([LEAF], SETTINGS[ALL_AROUND], figures[4:], label[4:], np.array([0, 1]), seed=0)
    assert (
        expanded([LEAF], SETTINGS[ALL_AROUND], figures, label, np.array([0, 0, 0, 0, 0, 1]), seed=0) == once
    )


def test_what_nothing_new_is_known_of_stays_and_what_contradicts_is_told_apart():
    tilt = NAMES.index("tilt")
    tree = {"figure": "tilt", "at_most": 5.0, "yes": LEAF, "no": LEAF}
    rng = np.random.default_rng(0)
    figures = np.zeros((40, COUNT))
    figures[:, tilt] = rng.uniform(0.0, 5.0, 40)
    label = np.where(figures[:, tilt] > 2.5, POLE, TREE)
    trees = expanded([tree] * 60, SETTINGS[ALL_AROUND], figures, label, np.arange(40), seed=0)
    assert all(each["no"] == LEAF for each in trees)
    forest = forest_of(data(**{ALL_AROUND: trees}), ALL_AROUND)
    votes = vote(figures, forest)[:, 0]
    assert votes[label == TREE].min() > votes[label == POLE].max()
    assert trees == expanded([tree] * 60, SETTINGS[ALL_AROUND], figures, label, np.arange(40), seed=0)


def ending_in_free_air(n: int):
    figures = np.zeros((n, COUNT))
    figures[:, NAMES.index("highest return")] = 3.0
    figures[:, NAMES.index("free above the highest return")] = 2.0
    figures[:, NAMES.index("voxels to 3 m")] = 100.0
    return figures


@pytest.mark.parametrize(("kind", "said"), [(TREE, POLE), (POLE, TREE)])
def test_enough_annotations_turn_what_ends_in_free_air(kind, said):
    """A few do not; and where nobody annotated, all is as it was."""
    one = {"share": (0.9 * np.eye(len(CLASSES))[said] + 0.1 * np.eye(len(CLASSES))[kind]).tolist()}
    base = data(**{ONE_WAY: [{"share": [0.8, 0.2, 0, 0, 0, 0]}], FREE_END: [one]})

    def tree(n: int) -> float:
        grown = all_expanded(base, ONE_WAY, ending_in_free_air(n), np.full(n, kind), np.arange(n), seed=0)
        return float(vote(ending_in_free_air(1), forest_of({**base, **grown}, ONE_WAY))[0, TREE])

    assert tree(1) == pytest.approx(tree(0), abs=0.4)
    assert (tree(1) > 0.5) == (tree(0) > 0.5) == (said == TREE)
    assert (tree(12) > 0.5) == (kind == TREE)
    assert all_expanded(base, ONE_WAY, np.zeros((9, COUNT)), np.full(9, kind), np.arange(9), seed=0)[
        FREE_END
    ] == [one]


def test_sensors_that_see_all_around_and_older_forests_have_nothing_more_to_expand():
    base = data(**{FREE_END: [LEAF]})
    some = ending_in_free_air(2), np.array([TREE, POLE]), np.arange(2)
    assert set(all_expanded(base, ALL_AROUND, *some, seed=0)) == {ALL_AROUND}
    assert set(all_expanded(data(), ONE_WAY, *some, seed=0)) == {ONE_WAY}


def test_what_is_validated_asks_the_expanded_trees_too():
    """Each place left out is judged with what others tell of things that end in free air."""
    places = [(5.0 * k, 0.0) for k in range(30)]
    seen = replace(examples(places, [True] * 30, figures=ending_in_free_air(30)), all_around=False)
    base = data(
        **{ONE_WAY: [{"share": [0.9, 0.1, 0, 0, 0, 0]}], FREE_END: [{"share": [0.1, 0.9, 0, 0, 0, 0]}]}
    )
    told = validate([seen], base, ONE_WAY, forest_of(base, ONE_WAY), 0.4, seed=0)
    assert (told.old.TA.count, told.new.TA.count, told.new.TA.of) == (0, 30, 30)


# --- what it is worth -----------------------------------------------------------------------------


@given(
    st.lists(
        st.lists(st.tuples(st.floats(0, 20), st.floats(0, 20)), min_size=1, max_size=12),
        min_size=2,
        max_size=5,
    )
)
def test_no_place_and_no_run_is_in_two_folds(runs):
    rng = np.random.default_rng(0)
    some = [examples(places, rng.random(len(places)) < 0.5, str(k)) for k, places in enumerate(runs)]
    by, group = groups_of(some)
    place = np.concatenate([e.axis for e in some])[:, :2]
    if len(np.unique(group)) < 2:
        return
    tree = np.concatenate([e.label for e in some]) == TREE
    if min(tree.sum(), (~tree).sum()) < 5:
        return  # less is never learned from
    fold = fold_of(group, tree, object_numbers(some), seed=0)
    for fold_a, a in zip(fold, place, strict=True):
        near = np.hypot(*(place - a).T) < SAME_PLACE - 1e-9
        assert (fold[near] == fold_a).all()
    if by == "run":
        for e, before in zip(some, np.cumsum([0, *(len(e.label) for e in some)]), strict=False):
            assert len(np.unique(fold[before : before + len(e.label)])) == 1


def test_three_runs_apart_are_left_out_as_wholes_and_two_that_share_a_place_are_one():
    apart = [examples([(100.0 * k, 0.0), (100.0 * k + 9.0, 0.0)], [True, False], str(k)) for k in range(3)]
    by, group = groups_of(apart)
    assert (by, len(np.unique(group))) == ("run", 3)
    assert all(a == b for a, b in list(pairwise(group.tolist()))[::2])
    again = [*apart[:2], examples([(0.2, 0.0), (500.0, 0.0)], [True, False], "again")]
    by, group = groups_of(again)
    assert (by, len(np.unique(group))) == ("place", 5)


def test_rates_count_what_they_say():
    rates = Rates.of(np.array([True, True, False, True, False]), np.array([True, True, True, False, False]))
    told = [(r.count, r.of) for r in (rates.TA, rates.FR, rates.TR, rates.FA)]
    assert told == [(2, 3), (1, 3), (1, 2), (1, 2)]


def test_too_few_examples_are_told_with_what_is_needed():
    places = [(3.0 * k, 0.0) for k in range(LEAST_TREES + LEAST_OTHERS)]
    tree = np.arange(len(places)) < LEAST_TREES
    assert what_lacks([examples(places, tree)]) == ""
    assert "there are 10 trees and 4 other objects" in what_lacks([examples(places[:-1], tree[:-1])])
    assert "there are 0 trees and 0 other objects" in what_lacks([])
    assert "within a metre" in what_lacks([examples([(0.0, 0.01 * k) for k in range(15)], tree)])


# --- the file -------------------------------------------------------------------------------------


def test_a_kept_forest_is_found_by_its_name_and_says_where_it_comes_from(tmp_path):
    learned = data(learned={"date": "today", "runs": [{"source": "abc"}]})
    name = Forests(tmp_path).keep(learned)
    assert name == name_of(data()), "the date is no part of what decides"
    again = Forests(tmp_path)
    assert vote(np.zeros((1, COUNT)), again(name, True))[0].tolist() == LEAF["share"]
    assert seen_by(again.read(name)) == ("abc",)


def test_the_provenance_of_a_learned_forest_is_that_of_its_file(tmp_path):
    learned = {
        "date": "today",
        "runs": [{"source": "abc"}, {"source": "def"}],
        "things": {"TA": 12, "pole": 5},
    }
    forests = Forests(tmp_path)
    name = forests.keep(data(learned=learned))
    expected = {"name": name, "date": "today", "things": {"TA": 12, "pole": 5}, "runs": 2}
    assert forests.provenance(name) == expected
    assert forests.provenance(name) == expected, "also when it is cached"
    assert forests.provenance(PACKAGE) is None
    assert forests.provenance("0123456789abcdef") is None
    forests.keep(data())
    assert Forests(tmp_path).provenance(name) is None, "a file without provenance"


@pytest.mark.parametrize(
    "text",
    ["{", "[" * 99_999, " " * 4_000_001, json.dumps(data(**{ALL_AROUND: [{"share": [1, 0, 0, 0, 0, 0]}]}))],
    ids=["torn", "deep", "large", "other trees"],
)
def test_a_damaged_forest_is_refused_and_the_one_in_force_stays(tmp_path, text):
    name = Forests(tmp_path).keep(data())
    (tmp_path / FOLDER / f"{name}.json").write_text(text)
    state = ParameterState()
    state.check = Forests(tmp_path).check
    with pytest.raises(StemmapError, match=r"(random forest is damaged|decision trees cannot be read)"):
        state.change({"classification.forest": name})
    assert (state.parameters, state.revision) == (preset("forest"), 0)


def test_an_unknown_forest_and_a_name_that_is_a_path_are_refused(tmp_path):
    with pytest.raises(StemmapError, match="not in the data folder"):
        Forests(tmp_path)("0123456789abcdef", True)
    with pytest.raises(StemmapError, match="not in the data folder"):
        Forests(tmp_path)("../../etc/passwd", True)
    for name in ("../../etc/passwd", "0123456789ABCDEF", "", "package\n"):
        with pytest.raises(ParameterError, match=r"classification\.forest"):
            assign(Parameters(), [f"classification.forest={name}"]).replace({"classification.forest": name})


# --- the command ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_that_was_annotated_is_learned_from(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path))
    base = tmp_path / "base.json"
    base.write_text(json.dumps(data()))
    monkeypatch.setattr(
        "app.extensions.learning.learning.FILE", base
    )  # forty large trees take longer to learn
    assert main(["train"]) == 1
    assert "there are no annotations" in capsys.readouterr().err
    uri = "sim:stand?duration=2&trees=40"
    digest, truth = true_things(uri)
    store = Store(tmp_path)
    run = store.open_run(digest, uri, uri)
    store.add(run, ANN, [c for c in truth if c.kind == "tree"][:3])
    assert main(["train"]) == 1
    assert "10 trees and 5 other objects are needed" in capsys.readouterr().err
    assert main(["train", "sim:slope"]) == 2
    assert "there is no annotated run 'sim:slope'" in capsys.readouterr().err
    for row in store.annotations(run):
        store.change(run, ANN, row.id, row.version, None)
    store.add(run, ANN, truth)
    store.close()
    assert main(["train", uri]) == 0
    table = capsys.readouterr().out
    assert "no place in two of them" in table
    assert [line.split()[0] for line in table.splitlines()[2:5]] == ["TA", "old", "new"]
    (kept,) = (tmp_path / FOLDER).glob("*.json")
    learned = json.loads(kept.read_text())["learned"]
    assert sum(learned["things"].values()) >= LEAST_TREES + LEAST_OTHERS
    assert learned["runs"] == [{"name": uri, "source": digest}]
    # Nothing uses it before somebody says so.
    assert preset("forest").classification.forest == "package"
    assert Forests(tmp_path)(kept.stem, True) is not None
    # The same again, now from kept examples.
    assert main(["train", "--out", str(tmp_path / "again.json")]) == 0
    again, first = (json.loads(f.read_text()) for f in (tmp_path / "again.json", kept))
    assert {**again["learned"], "date": ""} == {**first["learned"], "date": ""}
    assert name_of(again) == kept.stem


def true_things(uri: str) -> tuple[str, list[Content]]:
    """The digest of a simulated run, and what it knows of itself."""
    from pipeline.io.readers import open_source

    source = open_source(uri)
    truth = source.truth()
    assert truth is not None
    assert truth.trees is not None
    rows = zip(truth.trees.x.tolist(), truth.trees.y.tolist(), truth.trees.kind, strict=True)
    return source.description.digest, [Content(*row) for row in rows]


def test_the_package_forest_is_one_that_can_be_kept(tmp_path):
    package = json.loads(FILE.read_text())
    forests = Forests(tmp_path)
    assert len(forests(forests.keep(package), False).trees.root) == FITS[ONE_WAY].trees
