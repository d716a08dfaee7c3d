"""Whole runs with people: a walking or standing person is not mapped as a tree."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Float
from tests.benchmarks.trunks import EXACT_POSES
from tests.pipeline.detection.people import run_with
from tests.pipeline.strategies import first_of

EVERY = 2  # scans are made, and as many gathered as in a whole run
LOOK = 5  # of these the map is looked at
BEHIND_S = 6.0  # who left a place so long ago has left it behind
MATCH, PERSON = 0.5, 0.7  # m
SEEDS = first_of(range(3))


def looks(seed, kinds):
    """Of a run with people, every so many scans: the time [s], the trees that are none, shape (N, 2), and
    where the people were until then, shape (scans, people, 2). At last which of the true trees near the way
    stand."""
    run = run_with(seed, kinds)
    source = SimulatedSource("sim:lane", run)
    about, truth = source.description, run.scene.truth
    parameters = preset("forest").replace(EXACT_POSES)
    mapper = Mapper(parameters, sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=0)
    tree = np.stack([truth.x, truth.y], axis=1)
    told, trail = [], []
    place = np.zeros((0, 2))
    for k, step in enumerate(steps(source.records(every=EVERY))):
        frame = mapper.process(step)
        t = 0.1 * EVERY * k
        trail.append([each.place(t)[0] for each in run.scene.persons])
        if k % LOOK == LOOK - 1:
            place = frame.trees.position[frame.trees.confirmed]
            told.append((t, place[away(place, tree) > MATCH], np.array(trail)))
    near = (np.abs(tree[:, 1]) < 8.0) & (tree[:, 0] > 0.0) & (tree[:, 0] < 30.0)
    return told, away(tree[near], place) < MATCH


def away(place: Float, other: Float) -> Float:
    """From each place to the nearest other one [m]."""
    if len(other) == 0:
        return np.full(len(place), np.inf)
    distance: Float = np.hypot(*(place[:, None] - other[None]).transpose(2, 0, 1)).min(axis=1)
    return distance


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_walking_people_leave_no_tree_behind(seed):
    told, found = looks(seed, ("along", "ahead", "across", "pausing", "pausing"))
    assert found.all(), "no tree is lost to who walks before it"
    left = []
    for t, false, trail in told:
        old = trail[: max(len(trail) - round(BEHIND_S / (0.1 * EVERY)), 0)].reshape(-1, 2)
        late = trail[len(trail) - round(BEHIND_S / (0.1 * EVERY)) :].reshape(-1, 2)
        behind = (away(false, old) < PERSON) & (away(false, late) > PERSON)
        left += [(round(t, 1), place.round(2).tolist()) for place in false[behind]]
    assert not left, left


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_people_who_stand_still_for_a_minute_are_no_trees(seed):
    told, found = looks(seed, ("still", "still", "still", "still", "still", "by a trunk"))
    assert found.all()
    taken = [
        (round(t, 1), place.round(2).tolist())
        for t, false, trail in told
        if t >= 60.0
        for place in false[away(false, trail[-1]) < PERSON]
    ]
    assert not taken, taken
