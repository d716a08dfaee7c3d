"""Stands for training: the trees of the scenario with more other objects, or upright; skipped scans do not
change the others."""

from __future__ import annotations

from collections import Counter
from dataclasses import astuple

import numpy as np
import pytest

from pipeline.io.readers.simulated import SimulatedSource
from pipeline.simulation.primitives import CONE
from pipeline.simulation.run import open_run
from pipeline.simulation.scenarios import SCENARIOS, parse_uri
from pipeline.simulation.scene import SimulatedScene
from pipeline.types.records import Scan
from tests.benchmarks.package_forest.labelled_scenes import FURNISHED, STANDS, FurnishedStand


@pytest.mark.parametrize("name", FURNISHED)
def test_a_furnished_stand_keeps_its_trees_and_has_more_of_all_else(name):
    uri = f"sim:{name}?seed=3&odometry=exact"
    request = parse_uri(uri)
    plain, furnished = open_run(request).scene, open_run(FurnishedStand(*astuple(request))).scene
    trees = [np.array(scene.truth.kind) == "tree" for scene in (plain, furnished)]
    np.testing.assert_array_equal(plain.truth.x[trees[0]], furnished.truth.x[trees[1]])
    np.testing.assert_array_equal(plain.truth.dbh[trees[0]], furnished.truth.dbh[trees[1]])
    count = Counter(furnished.truth.kind)
    poles, standing, bushes, boxes, _ = FURNISHED[name]
    assert poles > SCENARIOS[name].poles
    assert [count[kind] for kind in ("pole", "person", "bush", "other")] == [poles, standing, bushes, boxes]


def tilt_of_stems(scene: SimulatedScene) -> float:
    """The mean angle of the stems from the vertical [rad]; of the solids of a tree, the stem is the first."""
    tilts, solids = [], scene.still
    for owner in np.array(scene.owners)[np.array(scene.truth.kind) == "tree"]:
        stem = np.flatnonzero((solids.owner == owner) & (solids.kind == CONE))[0]
        tilts.append(np.arccos(min(solids.shape[stem, 5], 1.0)))
    return float(np.mean(tilts))


@pytest.mark.parametrize("furnished", [False, True])
@pytest.mark.parametrize("name", FURNISHED)
def test_the_stems_of_an_upright_stand_are_as_upright_as_its_poles(name, furnished):
    request = parse_uri(f"sim:{name}?seed=3")
    leaning = open_run(STANDS[furnished, False](*astuple(request))).scene
    upright = open_run(STANDS[furnished, True](*astuple(request))).scene
    assert Counter(upright.truth.kind) == Counter(leaning.truth.kind)
    assert tilt_of_stems(leaning) > np.radians(1.0)
    assert tilt_of_stems(upright) == pytest.approx(0.0, abs=1e-9)


def test_scans_that_are_left_out_change_nothing_of_the_others():
    source = SimulatedSource("", open_run(parse_uri("sim:paper?duration=1")))
    every, some = list(source.records()), list(source.records(every=4))
    scans = [record for record in every if isinstance(record, Scan)]
    made = [record for record in some if isinstance(record, Scan)]
    assert [scan.stamp_ns for scan in made] == [scan.stamp_ns for scan in scans[::4]]
    for one, same in zip(made, scans[::4], strict=True):
        np.testing.assert_array_equal(one.points, same.points)
    assert len(every) - len(some) == len(scans) - len(made)
