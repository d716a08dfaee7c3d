"""Reviews by a person in the files of a run."""

from __future__ import annotations

import json
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.batch.export import read_for_export, trees_geojson
from app.batch.run_edits import SAME_THING, measured_by_people, reach_at, reviewed_run, reviews_of
from app.batch.run_folder import read_run, read_terrain
from app.store.records import FRAME, SKIPPED, Author, Content
from app.store.store import Store
from pipeline.errors import SourceError
from tests.app.batch.finished_runs import grid_run, reject_on_page
from tests.app.cli.test_commands import stemmap

PLACES = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]])


@pytest.mark.parametrize(
    ("contents", "reviews"),
    [
        ([Content(2.0, 0.2, "pole")], {2: "rejected"}),
        ([Content(0.0, SAME_THING + 0.01)], {}),
        ([Content(0.0, 0.0, SKIPPED), Content(2.0, 0.0, "of others")], {1: "skipped"}),
        ([Content(0.0, 0.2, "pole"), Content(0.0, 0.0, SKIPPED)], {1: "rejected"}),
        ([Content(4.0, 0.1, "bush"), Content(4.0, 0.3), Content(0.0, 0.0)], {1: "confirmed", 3: "rejected"}),
        ([Content(4.0, 0.3), Content(4.0, 0.1, "bush")], {3: "rejected"}),
    ],
)
def test_the_nearest_annotation_decides(contents, reviews):
    assert reviews_of([1, 2, 3], PLACES, contents) == reviews
    assert reviews_of([], np.zeros((0, 2)), contents) == {}


@given(
    st.floats(0.01, 1.2),
    st.floats(0.0, 0.4),
    st.sampled_from(["bush", "pole", SKIPPED]),
    st.floats(-np.pi, np.pi),
)
def test_a_rejection_never_passes_to_a_tree_that_was_a_neighbour(
    gap: float, off: float, kind: str, angle: float
):
    own = np.array([5.0, -3.0])
    beside = own + gap * np.array([np.cos(angle), np.sin(angle)])
    place = own - off * np.array([np.cos(angle), np.sin(angle)])  # on the far side of the neighbour
    both = np.array([own, beside, [90.0, 0.0]])
    x, y = place.tolist()
    answer = Content(x, y, kind, reach=reach_at(both, (x, y)))
    assert list(reviews_of([1, 2, 3], both, [answer])) == [1]
    assert reviews_of([2, 3], both[1:], [answer]) == {}  # the own tree is gone
    # An isolated tree that moves is the same one.
    assert reach_at(both[:1], (x, y)) is None
    assert reach_at(np.zeros((0, 2)), (0.0, 0.0)) is None


def test_a_confirmation_holds_for_the_copy_that_a_later_map_has():
    copies = np.array([[0.0, 0.0], [0.3, 0.0]])
    answer = Content(0.0, 0.0, "tree", 0.3, reach=reach_at(copies, (0.0, 0.0)))
    later = np.array([[0.15, 0.0]])
    assert reviews_of([1], later, [answer]) == {1: "confirmed"}
    assert not len(measured_by_people([1], later, [answer]).added)


def test_the_nearest_tape_counts_and_what_belongs_to_no_tree_is_added():
    far = Content(0.0, SAME_THING + 0.01, "tree", 0.4)
    contents = [
        Content(0.0, 0.1, "tree", 0.22),
        Content(2.0, 0.0, "pole", 0.5),
        Content(9.0, 9.0, "pole"),
        far,
    ]
    people = measured_by_people([1, 2, 3], PLACES, contents)
    assert people.tape == {1: 0.22}
    for each in (people, measured_by_people([], np.zeros((0, 2)), [far])):
        assert (each.added.tolist(), each.added_dbh.tolist()) == ([[0.0, SAME_THING + 0.01]], [0.4])
    nothing = measured_by_people([1, 2, 3], PLACES, [])
    assert (nothing.tape, nothing.added.shape) == ({}, (0, 2))


@pytest.mark.parametrize(
    ("contents", "tape", "added"),
    [
        ([Content(2.0, 0.0, "pole"), Content(2.3, 0.0, "tree", 0.31)], {}, [0.31]),
        ([Content(2.4, 0.0, "tree", 0.3), Content(2.0, 0.0, "tree", 0.2)], {2: 0.2}, [0.3]),
        ([Content(2.0, 0.0, SKIPPED), Content(2.4, 0.0, "tree", 0.3)], {2: 0.3}, []),
        ([Content(2.0, 0.0, "tree", 0.2), Content(2.3, 0.0, "pole", 0.1)], {2: 0.2}, []),
    ],
)
def test_a_tree_has_one_annotation_and_the_others_are_added_trees(contents, tape, added):
    people = measured_by_people([1, 2, 3], PLACES, contents)
    assert (people.tape, people.added_dbh.tolist(), len(people.added)) == (tape, added, len(added))


def test_what_people_measured_is_exported_beside_the_map(tmp_path):
    folder = grid_run(tmp_path / "run")
    x, y = read_run(folder).trees.position[4].tolist()
    contents = [Content(x, y, "tree", 0.234), Content(2.0, 2.0, "tree", 0.31), Content(4.0, 2.0)]
    with reviewed_run(folder, contents) as reviewed:
        run = read_for_export(reviewed)
        features = json.loads(trees_geojson(run))["features"]
        with reviewed_run(reviewed, []) as again:
            assert len(read_for_export(again).added) == 0
    assert np.flatnonzero(np.isfinite(run.columns["dbh_tape_cm"])).tolist() == [4]
    assert (run.columns["dbh_tape_cm"][4], run.columns["dbh_cm"][4]) == (23.4, 20.0)
    assert run.columns["dbh_counted_cm"][3:5].tolist() == [20.0, 23.4]
    assert run.columns["g_m2"][3:5] == pytest.approx(np.pi / 4 * np.square([0.2, 0.234]), abs=5e-5)
    assert run.columns["dbh_source"][3:5].tolist() == ["map", "tape"]
    np.testing.assert_allclose(run.added, [[2.0, 2.0], [4.0, 2.0]])
    np.testing.assert_array_equal(run.added_dbh, [31.0, np.nan])
    assert [feature["properties"]["dbh_tape_cm"] for feature in features[3:5]] == [None, 23.4]
    counted = [
        (of["dbh_counted_cm"], of["dbh_source"]) for of in (features[k]["properties"] for k in (3, 4, -2, -1))
    ]
    assert counted == [(20.0, "map"), (23.4, "tape"), (31.0, "tape"), (None, None)]
    assert [feature["properties"]["review"] for feature in features[-3:]] == ["open", "added", "added"]
    assert features[-2]["geometry"]["coordinates"] == [2.0, 2.0]


def test_a_rejected_tree_stays_in_the_table_and_counts_nowhere(tmp_path):
    folder = grid_run(tmp_path / "run")
    run = read_run(folder)
    (ax, ay), (bx, by) = run.trees.position[:2].tolist()
    with reviewed_run(folder, [Content(ax, ay, "other"), Content(bx, by)]) as reviewed:
        left = read_run(reviewed)
        text = (reviewed / "trees.csv").read_text()
    assert len(left.trees.number) == len(run.trees.number) - 1
    assert left.rejected.number.tolist() == [run.trees.number[0]]
    assert run.trees.number[0] not in left.trees.number
    assert [n for n, review in left.reviews.items() if review == "confirmed"] == [run.trees.number[1]]
    assert text.count(",rejected") == 1
    assert len(text.splitlines()) == len(run.trees.number) + 1
    with reviewed_run(folder, []) as same:
        assert same == folder


def test_reviews_without_their_annotations_are_open_again(tmp_path):
    folder = grid_run(tmp_path / "run")
    file = folder / "trees.csv"
    for review in ("rejected", "confirmed"):
        text = file.read_text()
        file.write_text(text.replace(",open", f",{review}", 1))
        with reviewed_run(folder, []) as reviewed:
            assert (reviewed / "trees.csv").read_text() == text
        file.write_text(text)


def test_an_error_names_the_folder_of_the_run(tmp_path):
    folder = grid_run(tmp_path / "run")
    (folder / "terrain.csv").write_text("x_m\n")
    with pytest.raises(SourceError) as caught, reviewed_run(folder, [Content(0.0, 0.0)]) as reviewed:
        read_terrain(reviewed)
    assert str(folder / "terrain.csv") in str(caught.value)


def test_an_unknown_review_is_refused(tmp_path):
    folder = grid_run(tmp_path / "run")
    file = folder / "trees.csv"
    file.write_text(file.read_text().replace(",open", ",maybe", 1))
    with pytest.raises(SourceError, match="a row is damaged"):
        read_run(folder)


def test_an_export_has_the_reviews_of_the_page(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "kept"))
    folder = grid_run(tmp_path / "run")
    reject_on_page(folder, tmp_path / "kept")
    exported = tmp_path / "trees.geojson"
    result = stemmap(capsys, "export", folder, "--to", exported)
    assert (result.code, result.err) == (0, "review: 1 tree rejected on the page left out\n")
    features = json.loads(exported.read_text())["features"]
    assert {each["properties"]["review"] for each in features} == {"open"}
    assert len(features) == 99


@pytest.mark.parametrize(
    ("kind", "exported_trees"),
    [("", 99), (FRAME, 99), ("pole", 100)],  # all are undone
)
def test_reviews_in_the_files_count_until_a_tree_is_reviewed_here(
    tmp_path, capsys, monkeypatch, kind, exported_trees
):
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "kept"))
    folder = grid_run(tmp_path / "run")
    file = folder / "trees.csv"
    file.write_text(file.read_text().replace(",open", ",rejected", 1))
    run = read_run(folder)
    with closing(Store(tmp_path / "kept")) as store:
        number = store.open_run(run.record["source"]["sha256"], run.uri, "grid")
        if kind:
            author = Author("a" * 16, "Ann")
            store.add(number, author, [Content(1.0, 1.0, kind)])
            store.undo(number, author)
    exported = tmp_path / "trees.geojson"
    stemmap(capsys, "export", folder, "--to", exported)
    assert len(json.loads(exported.read_text())["features"]) == exported_trees
