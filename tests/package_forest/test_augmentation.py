"""Pasting: things stand in labelled scans where ground was seen, hide what is behind, and are hidden."""

from __future__ import annotations

import shutil
from functools import partial

import numpy as np
import pytest

from app.extensions.learning.examples import POLE as POLE_CLASS
from app.extensions.learning.examples import TREE, Examples
from pipeline.classification.features import COUNT
from pipeline.config import preset
from pipeline.simulation.primitives import SolidsBuilder
from tests.benchmarks.package_forest import augmentation
from tests.benchmarks.package_forest.augmentation import (
    _seen_with,
    digest_of,
    is_of,
    name_of_copy,
    paste,
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


def test_what_is_farther_is_hidden():
    wall = wall_at(10.0)
    points, kind = seen(wall, plate_at(15.0, 0.5))
    assert (kind == 50).all()
    assert len(points) == len(wall)


@pytest.mark.slow
def test_copies_are_drawn_by_what_the_scans_hold_whatever_their_folder_is_called(park, tmp_path):
    other = tmp_path / "elsewhere" / park.name
    shutil.copytree(park, other)
    one, same = paste(park, 1), paste(other, 1)
    assert [points.tobytes() for points, _ in one.scans] == [points.tobytes() for points, _ in same.scans]
    label = other / "labels" / "000000.label"
    label.write_bytes(label.read_bytes()[:-4] + b"\x01\x00\x00\x00")
    assert digest_of(other) != digest_of(park)
    assert paste(other, 1).place.tolist() != one.place.tolist()


def test_kept_copies_serve_until_the_scans_their_labels_or_the_format_change(park, tmp_path, monkeypatch):
    made = []

    def make(folder, copy, _parameters, _reach):
        made.append(copy)
        none = np.zeros((0, 5)), np.zeros((0, COUNT)), np.zeros(0, np.int64)
        yield Examples(name_of_copy(str(folder), copy), True, False, *none)

    monkeypatch.setattr(augmentation, "pasted_examples", make)
    ask = partial(augmentation.copies, park, tmp_path, preset("forest"), 25.0, 2)
    assert [e.scene for e in ask()] == [name_of_copy(str(park), copy) for copy in (0, 1)]
    assert len(ask()) == len(made) == 2
    monkeypatch.setattr(augmentation, "FORMAT", augmentation.FORMAT + 1)
    assert len(ask()) == 2
    assert made == [0, 1, 0, 1]


def test_a_copy_is_of_its_scene_alone():
    assert is_of(name_of_copy("parks/00", 3), "parks/00/")
    assert not is_of(name_of_copy("parks/00", 3), "parks/0")
