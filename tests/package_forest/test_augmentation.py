"""Pasting: things stand in labelled scans where ground was seen, hide what is behind, and are hidden."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.learning.examples import POLE as POLE_CLASS
from app.extensions.learning.examples import TREE
from pipeline.config import preset
from pipeline.simulation.primitives import SolidsBuilder
from tests.benchmarks.package_forest.augmentation import (
    _seen_with,
    is_of,
    pasted_examples,
)
from tests.benchmarks.package_forest.labelled_scenes import LABELS
from tests.benchmarks.package_forest.street_scenes import simulate_street

POLE = LABELS["pole"]


@pytest.fixture(scope="module")
def park(tmp_path_factory):
    """A simulated park seen one way, as a folder of labelled scans; ground is what real labels call so."""
    folder = tmp_path_factory.mktemp("park")
    (folder / "velodyne").mkdir()
    (folder / "labels").mkdir()
    street = simulate_street(204, one_way=True)
    first = 0
    for k, step in enumerate(street.steps):
        points = step.scan.points
        label = np.array([LABELS[kind] for kind in street.kind[first : first + len(points)]], "<u4")
        first += len(points)
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(
            folder / "velodyne" / f"{k:06d}.bin"
        )
        label.tofile(folder / "labels" / f"{k:06d}.label")
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * len(street.steps))
    return folder


@pytest.mark.slow
def test_copies_hold_trees_and_poles_and_are_the_same_each_time(park):
    made = [list(pasted_examples(park, copy, preset("forest"), 25.0)) for copy in (0, 1, 2, 0)]
    label = np.concatenate([e.label for copy in made for e in copy])
    assert (label == TREE).any()
    assert (label == POLE_CLASS).any()
    assert all(is_of(e.scene, str(park)) for copy in made for e in copy)
    for one, again in zip(made[0], made[3], strict=True):
        assert one.figures.tobytes() == again.figures.tobytes()
        assert one.label.tobytes() == again.label.tobytes()


def wall_at(x: float, step: float = 0.005):
    """Returns of a wall across the view, seen from the origin."""
    side = np.arange(-0.1, 0.1, step)
    y, z = (each.ravel() for each in np.meshgrid(side, side))
    return (x * np.column_stack([np.ones(len(y)), y, z])).astype(np.float32)


def plate_at(x: float, half: float):
    builder = SolidsBuilder()
    builder.box(0, [x, 0.0, 0.0], [0.05, half, half])
    return builder.build()


def seen(points, solids):
    rng = np.random.default_rng(0)
    return _seen_with(points, np.full(len(points), 50), solids, np.array([POLE]), rng)


def test_what_is_nearer_hides_all_that_is_behind_it_and_nothing_beside():
    wall = wall_at(10.0)
    points, kind = seen(wall, plate_at(5.0, 0.25))
    left = points[kind == 50] / 10.0
    # The near face of the plate, at 4.95 m, is 0.0505 as wide as it is away.
    beside = np.abs(wall[:, 1:] / 10.0).max(axis=1) > 0.0506
    assert len(left) == np.count_nonzero(beside)
    assert np.abs(left[:, 1:]).max(axis=1).min() > 0.0505
    assert np.count_nonzero(kind == POLE) > 150
    assert np.abs(points[kind == POLE][:, 0] - 4.95).max() < 0.15
