"""Pasting: poles stand among labelled scans where the ground was seen, hide what is behind and are hidden."""

from __future__ import annotations

import numpy as np
import pytest

from app.training.furniture import POLE
from app.training.growing import POLE as POLE_CLASS
from app.training.growing import TREE
from app.training.pasting import _merged, is_of, name_of_copy, pasted_examples
from app.training.streets import simulate_street
from pipeline.parameters import preset


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
        label = street.label[first : first + len(points)].astype("<u4")
        first += len(points)
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(
            folder / "velodyne" / f"{k:06d}.bin"
        )
        label.tofile(folder / "labels" / f"{k:06d}.label")
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * len(street.steps))
    return folder


def test_copies_hold_trees_and_poles_and_are_the_same_each_time(park):
    made = [list(pasted_examples(park, copy, preset("forest"), 25.0)) for copy in (0, 1, 2, 0)]
    label = np.concatenate([e.label for copy in made for e in copy])
    assert (label == TREE).any()
    assert (label == POLE_CLASS).any()
    assert all(is_of(e.scene, str(park)) for copy in made for e in copy)
    for one, again in zip(made[0], made[3], strict=True):
        assert one.figures.tobytes() == again.figures.tobytes()
        assert one.label.tobytes() == again.label.tobytes()


def test_what_is_nearer_hides_what_is_farther():
    wall = np.array([[10.0, y, 0.0] for y in np.arange(-1.0, 1.0, 0.02)], np.float32)
    label = np.full(len(wall), 50)
    behind, before = wall[:10] * np.float32(1.5), wall[:10] * np.float32(0.5)
    points, kind = _merged(wall, label, behind, np.full(10, POLE))
    assert (kind == 50).all()
    assert len(points) == len(wall)
    points, kind = _merged(wall, label, before, np.full(10, POLE))
    assert np.count_nonzero(kind == POLE) == 10
    assert len(points) < len(wall) + 10


def test_a_copy_is_of_its_scene_alone():
    assert is_of(name_of_copy("parks/00", 3), "parks/00/")
    assert not is_of(name_of_copy("parks/00", 3), "parks/0")
