"""Decision rule: verdicts by rays at breast height that do not depend on the votes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.classification import column_votes, no_columns
from pipeline.classification.column_classifier import BREAST_HEIGHT, RAYS
from pipeline.classification.features import NAMES
from pipeline.classification.forest import CLASSES
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.types.records import Verdict


def verdict(
    stopped: int,
    passed: int,
    height: float = 1.5,
    present: float = 0.0,
    absent: float = 0.0,
    lately: float = 0.0,
) -> Verdict:
    """The verdict of a column with all votes for a tree, by the rays that it stopped and let pass, and by the
    scans in which it was present and absent, and absent lately without a break."""
    met, through = np.zeros((1, SLICES), np.int32), np.zeros((1, SLICES), np.int32)
    met[0, int(height / SLICE)], through[0, int(height / SLICE)] = stopped, passed
    none = no_columns()
    rows = {name: np.zeros((1, *getattr(none, name).shape[1:])) for name in none.__dataclass_fields__}
    one = replace(none, **rows)
    one.figures[0, NAMES.index("voxels to 3 m")] = 100.0
    one.share[0, CLASSES.index(Verdict.TREE)] = 1.0
    one.present[0], one.absent[0], one.absent_lately[0] = present, absent, lately
    return Verdict(int(column_votes(replace(one, met=met, passed=through)).verdict(0.4)[0]))


def test_a_motorcycle_is_no_tree_because_rays_pass_above_it_at_breast_height():
    assert verdict(0, 40) is Verdict.TOO_LOW
    assert verdict(10, 30) is Verdict.TOO_LOW


@pytest.mark.parametrize(("stopped", "passed"), [(40, 0), (12, 28), (0, RAYS - 1), (0, 0)])
def test_what_stops_rays_or_was_hardly_seen_is_left_to_the_votes(stopped: int, passed: int):
    assert verdict(stopped, passed) is Verdict.TREE


def test_rays_below_and_above_breast_height_do_not_matter():
    assert verdict(0, 40, BREAST_HEIGHT.start * SLICE - 0.1) is Verdict.TREE
    assert verdict(0, 40, BREAST_HEIGHT.stop * SLICE + 0.1) is Verdict.TREE


@pytest.mark.parametrize(
    ("present", "absent", "gone"),
    [(0, 5, True), (0, 4, False), (5, 6, True), (6, 6, False), (9, 6, False), (4, 20, True)],
)
def test_a_column_that_is_absent_in_most_scans_is_gone(present: int, absent: int, gone: bool):
    found = verdict(40, 0, present=present, absent=absent)
    assert found is (Verdict.MOVING if gone else Verdict.TREE)


@pytest.mark.parametrize(("lately", "gone"), [(11, False), (12, True)])
def test_who_stood_long_is_gone_after_some_scans_without_them(lately: int, gone: bool):
    found = verdict(40, 0, present=100, absent=20, lately=lately)
    assert found is (Verdict.MOVING if gone else Verdict.TREE)
