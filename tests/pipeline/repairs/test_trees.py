"""Repairs of trees: each changes its row only, merged rows are weighted means, and files are checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.repairs.record import (
    Kind,
    Repair,
    identity_of,
    parse_repairs,
    read_repairs,
    repairs_text,
    tied_numbers,
    unapplied,
)
from pipeline.repairs.trees import repaired_trees
from pipeline.types.records import Path, Trees
from tests.pipeline.strategies import trees

THREE = trees([[0.0, 0.0], [5.0, 0.0], [9.0, 1.0]])


def repaired(kind: Kind, *places: tuple[float, float], value: str = "", of: Trees = THREE) -> Trees:
    found, problem = repaired_trees(of, Repair(kind, places, value=value))
    assert problem == ""
    return found


def test_a_merged_tree_is_the_weighted_mean_of_both_and_keeps_the_first_number():
    of = replace(
        THREE,
        covariance=np.array([1.0, 4.0, 1.0])[:, None, None] * 1e-4 * np.eye(2),
        dbh=np.array([0.3, 0.32, np.nan]),
        dbh_sigma=np.array([0.01, 0.02, np.nan]),
        sides=np.array([0b0011, 0b0110, 0]),
        height=np.array([20.0, np.nan, 18.0]),
        height_sigma=np.array([0.5, np.nan, 0.4]),
        lean=np.array([0.1, 0.2, 0.0]),
        first_seen_ns=np.array([5, 3, 0]),
    )
    found = repaired("merge", (0.1, 0.0), (5.1, 0.0), of=of)
    np.testing.assert_array_equal(found.number, [1, 3])
    np.testing.assert_allclose(found.position[0], [1.0, 0.0])  # the inverse variances are 4 to 1
    assert found.dbh[0] == pytest.approx((4 * 0.3 + 0.32) / 5)
    assert found.dbh_sigma[0] == pytest.approx(0.01 / np.sqrt(1.25))
    assert found.observations[0] == 9, "it is not known which scans detected both"
    assert found.sides is not None
    assert found.sides[0] == 0b0111
    assert (found.first_seen_ns[0], found.last_seen_ns[0]) == (3, 10**9)
    assert found.height is not None
    assert found.height[0] == 20.0
    assert found.lean is not None
    assert found.lean[0] == pytest.approx(0.15)
    np.testing.assert_array_equal(found.position[1], THREE.position[2])


def test_a_merged_tree_has_no_more_scans_than_the_union_of_both():
    times = {"first_seen_ns": np.array([0, 6, 0]), "last_seen_ns": np.array([5, 9, 9])}
    apart = replace(THREE, observations=np.array([4, 3, 2]), **times)
    assert repaired("merge", (0.0, 0.0), (5.0, 0.0), of=apart).observations[0] == 7, "no scan has both"
    assert repaired("merge", (0.0, 0.0), (9.0, 1.0), of=apart).observations[0] == 4


def test_a_position_by_a_person_has_no_scans_so_that_its_sigma_counts_as_assumed():
    assert repaired("move", (0.0, 0.0), (0.4, 0.0)).observations.tolist() == [0, 9, 9]
    assert repaired("split", (0.0, 0.0), (0.4, 0.0)).observations.tolist() == [9, 9, 9, 0]


@pytest.mark.parametrize(("a", "b"), [((23.1, 1.3), (14.5, 1.1)), ((30.0, 0.2), (20.0, 3.0))])
def test_the_mean_of_contradicting_diameters_covers_both(a: tuple[float, float], b: tuple[float, float]):
    dbh, sigma = np.array([a, b, (np.nan, np.nan)]).T / 100.0
    found = repaired("merge", (0.0, 0.0), (5.0, 0.0), of=replace(THREE, dbh=dbh, dbh_sigma=sigma))
    away = np.abs(found.dbh[0] - dbh[:2])
    further = 0.5 * ((dbh[0] - dbh[1]) ** 2 - np.square(sigma[:2]).sum())
    assert found.dbh_sigma[0] == pytest.approx(np.sum(1.0 / (np.square(sigma[:2]) + further)) ** -0.5)
    assert np.all(away < 1.3 * found.dbh_sigma[0])
    # One that is consistent is not changed by the further variance: continuous at the limit.
    near = np.array([0.2, 0.2 + np.hypot(*sigma[:2]), np.nan])
    found = repaired("merge", (0.0, 0.0), (5.0, 0.0), of=replace(THREE, dbh=near, dbh_sigma=sigma))
    assert found.dbh_sigma[0] == pytest.approx(np.sum(sigma[:2] ** -2.0) ** -0.5)


def test_a_split_tree_is_two_without_diameters():
    found = repaired("split", (5.0, 0.1), (5.6, 0.0))
    np.testing.assert_array_equal(found.number, [1, 2, 3, 2001])
    np.testing.assert_array_equal(found.position[[1, 3]], [[5.0, 0.0], [5.6, 0.0]])
    np.testing.assert_array_equal(np.isnan(found.dbh), [False, True, False, True])


def test_the_second_stem_has_the_number_of_its_tree_with_a_counter():
    once = repaired("split", (5.0, 0.0), (5.6, 0.0))
    twice = repaired("split", (5.0, 0.0), (5.0, 0.6), of=once)
    assert twice.number.tolist() == [1, 2, 3, 2001, 2002]


def test_move_class_and_delete_change_one_row():
    np.testing.assert_array_equal(repaired("move", (5.0, 0.0), (6.0, 2.0)).position[1], [6.0, 2.0])
    pole = repaired("class", (5.0, 0.0), value="pole")
    np.testing.assert_array_equal(pole.confirmed, [True, False, True])
    np.testing.assert_array_equal(repaired("class", (5.0, 0.0), value="tree", of=pole).confirmed, True)
    np.testing.assert_array_equal(repaired("delete", (5.0, 0.0)).number, [1, 3])
    assert repaired("class", (5.0, 0.0), value="tree") is THREE, "it is a tree already"


def test_a_tree_is_not_merged_with_itself():
    found, problem = repaired_trees(THREE, Repair("merge", ((0.0, 0.0), (0.2, 0.0))))
    assert found is THREE
    assert problem == "both positions are of tree 1"


def test_a_file_of_repairs_is_read_as_it_was_written(tmp_path):
    repairs = (
        Repair("merge", ((0.125, -1.0), (2.0, 3.0))),
        Repair("class", ((1.0, 2.0),), value="person"),
        Repair("tie", ((0.0, 1.0), (1.0, 0.0)), (1_700_000_000_123_456_789, 1_700_000_001_000_000_001)),
        Repair("forbid", stamps_ns=(1, 2)),
    )
    assert parse_repairs(repairs_text(repairs), "file") == repairs
    assert parse_repairs(repairs_text(()), "file") == ()
    with pytest.raises(SourceError, match="cannot be read"):
        read_repairs(tmp_path / "none.json")


def test_equal_repairs_in_the_same_order_have_one_identity():
    a, b = Repair("delete", ((1.0, 2.0),)), Repair("delete", ((1.0, 3.0),))
    assert identity_of(parse_repairs(repairs_text((a, b)), "file")) == identity_of((a, b))
    assert len({identity_of(each) for each in ((a, b), (b, a), (a,), ())}) == 4


def test_a_tie_names_only_trees_that_were_seen_in_scans_of_the_map():
    path = Path(np.array([10, 20]), *(np.zeros(2) for _ in range(4)))
    ties = [Repair("tie", ((0.0, 0.0), (5.0, 0.0)), stamps) for stamps in ((10, 20), (9, 20), (10, 21))]
    assert [tied_numbers(THREE, path, tie) for tie in ties] == [(1, 2), (2,), (1,)]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        '{"repairs": [{"kind": "burn"}]}',
        '{"repairs": [{"kind": "delete", "places": [[1, NaN]]}]}',
        '{"repairs": [{"kind": "delete", "places": [[1, 2]], "stamps_ns": [1]}]}',
        '{"repairs": [{"kind": "tie", "places": [[1, 2], [1, 2]], "stamps_ns": [1]}]}',
        '{"repairs": [{"kind": "class", "places": [[1, 2]], "value": "stone"}]}',
        '{"repairs": [{"kind": "delete", "places": [[1, 2]], "who": "me"}]}',
        '{"repairs": [{"kind": "delete", "places": [[1, 1e9]]}]}',
        '{"repairs": [{"kind": "delete", "places": [[1, 1' + "0" * 400 + "]]}]}",
        '{"repairs": [{"kind": "forbid", "stamps_ns": [1, 1' + "0" * 30 + "]}]}",
        '{"repairs": [{"kind": "forbid", "stamps_ns": [-1, 1]}]}',
    ],
)
def test_what_is_no_file_of_repairs_is_refused(text):
    with pytest.raises(SourceError):
        parse_repairs(text, "file")


def test_what_does_not_apply_is_said_with_its_number():
    repairs = [Repair("delete", ((0.0, 0.0),)), Repair("move", ((1.0, 0.0), (2.0, 0.0)))]
    assert unapplied(repairs, ["", "no tree"]) == ["repair 2 (move) does not apply: no tree"]
