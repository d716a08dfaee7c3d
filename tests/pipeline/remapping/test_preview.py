"""The rough answer: the trees of the map that comes, from what was kept alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.worker.parallel import looked_at_once
from pipeline.io.checkpoints import encode
from pipeline.remapping import Rerun, Sample, rough_trees
from pipeline.remapping.clusters import ClusterTable
from pipeline.remapping.preview import MOST_PLACES, _gathered
from pipeline.remapping.sample import MOST_SCANS
from pipeline.types.records import Verdict
from tests.pipeline.remapping.mapped import BASE, mapper, run, ungathered, with_odd


def share_within(place: np.ndarray, other: np.ndarray, distance: float) -> float:
    """Of some places, those near to another one."""
    apart = np.hypot(*(place[:, None] - other[None]).transpose(2, 0, 1))
    return float((apart.min(axis=1, initial=np.inf) < distance).mean())


@pytest.mark.parametrize(
    "change", [{}, {"classification.tree_share": 0.6}, {"detection.e_max": 5.0}, {"slam.particles": 40}]
)
def test_it_is_near_to_the_map_that_comes(change, known):
    kept, basis = known
    parameters = BASE.replace(change)
    rough = rough_trees(basis, kept.clusters, parameters)
    assert rough is not None
    *_, frame = Rerun(mapper(parameters), kept).frames(len(kept))
    exact = frame.trees.position[frame.trees.confirmed]
    assert len(exact) > 3
    assert share_within(exact, rough.position, 0.3) > 0.8
    assert share_within(rough.position, exact, 0.3) > 0.8


def test_without_votes_enough_nothing_that_was_gathered_is_a_tree(known):
    kept, basis = known
    columns = basis.notes.newest_columns()
    assert columns is not None
    assert (columns.verdict(0.4) == Verdict.TREE).any()
    rough = rough_trees(basis, kept.clusters, BASE.replace({"classification.tree_share": 1.0}))
    assert rough is not None
    trees = columns.place[columns.verdict(0.4) == Verdict.TREE]
    assert share_within(trees, rough.position, 0.1) < 0.5


def test_hits_are_the_clusters_that_are_trees(known):
    kept, basis = known
    parameters = BASE.replace({"tracking.hits_to_confirm": 1, "tracking.distance_max": 0.4})
    bare = ungathered(basis)
    rough = rough_trees(bare, kept.clusters, parameters)
    assert rough is not None
    assert basis.notes.is_usual.all()
    found = sum(len(stretch.recorded.centre) for stretch in basis.notes.stretches)
    assert int(rough.observations.sum()) == found


@pytest.mark.parametrize("lost", [True, False])
def test_what_was_seen_by_a_lost_robot_is_nowhere(lost, known):
    kept, basis = known
    odd, path = np.zeros(len(basis.notes), np.bool_), basis.path.copy()
    odd[20:40], path[20:40] = lost, (500.0, 0.0, 0.0)
    rough = rough_trees(replace(with_odd(basis, odd), path=path), kept.clusters, BASE)
    assert rough is not None
    assert (rough.position[:, 0] < 300.0).any()
    assert (rough.position[:, 0] > 300.0).any() != lost


@pytest.mark.parametrize(
    ("seed", "reach", "most"), [(0, 0.05, MOST_PLACES), (1, 0.45, MOST_PLACES), (2, 9.0, 50), (3, 0.45, 5)]
)
def test_clusters_join_the_nearest_of_all_places(seed, reach, most):
    rng = np.random.default_rng(seed)
    centre, tree = rng.normal(0.0, 3.0, (300, 2)), rng.random(300) < 0.8
    place: list[np.ndarray] = []
    hits: list[int] = []
    for x in centre[tree]:
        apart = np.array([np.hypot(*(p - x)) for p in place])
        if len(place) and apart.min() < reach:
            at = int(apart.argmin())
            hits[at] += 1
            place[at] = place[at] + (x - place[at]) / hits[at]
        elif len(place) < most:
            place.append(x)
            hits.append(1)
    found, times = _gathered(centre, tree, np.array([0, 100, 300]), np.zeros((2, 5)), reach, most)
    assert times.tolist() == hits
    assert found == pytest.approx(np.array(place), abs=1e-9)


@pytest.mark.parametrize("change", [{"clustering.eps": 0.2}, {"classification.every": 2}])
def test_nothing_is_told_of_clusters_that_nobody_knows(change, known):
    kept, basis = known
    assert rough_trees(basis, kept.clusters, BASE.replace(change)) is None


LOOKS = [
    {"clustering.eps": 0.3},
    {"filters.voxel_size": 0.03},
    {"clustering.min_points": 40},
    {"filters.x_max": 8.0, "filters.x_min": -8.0, "tracking.hits_to_confirm": 4},
]


def sampled(parameters):
    """What some scans of the run show with these parameters."""
    sample = Sample()
    for step in run()[0]:
        sample.offer(step)
    return sample.looked(mapper(parameters).segmenter(), len(run()[0]))


@pytest.mark.parametrize("method", ["columns", "none"])
@pytest.mark.parametrize("change", LOOKS)
def test_scans_that_are_looked_at_again_tell_of_other_clusters(change, method, known):
    kept, basis = known
    if method == "none":  # hits alone make a tree
        basis = ungathered(basis)
    parameters = BASE.replace(change)
    rough = rough_trees(basis, kept.clusters, parameters, sampled(parameters))
    assert rough is not None
    if method == "columns":
        *_, frame = Rerun(mapper(parameters), kept, lambda: iter(run()[0])).frames(len(kept))
        exact = frame.trees.position[frame.trees.confirmed]
    else:
        exact = by_hits(parameters, basis)
    assert len(exact) > 1
    assert share_within(exact, rough.position, 0.3) > 0.7
    # How the votes on less of a trunk would turn out, nobody knows.
    known_votes = method == "none" or "filters.x_max" not in change
    assert share_within(rough.position, exact, 0.3) > (0.7 if known_votes else 0.4)


def by_hits(parameters, basis):
    """Where the clusters of all scans, looked at again, show trees often enough."""
    look = mapper(parameters).segmenter()
    every = {step.index: look(step) for step in run()[0]}
    table = ClusterTable()
    for index, looked in every.items():
        table.put(index, looked.clusters)
    as_now = replace(basis, parameters=parameters)
    rough = rough_trees(as_now, table, parameters)
    assert rough is not None
    return rough.position


def test_a_sample_of_the_same_looks_changes_nothing(known):
    kept, basis = known
    other = replace(basis, parameters=BASE.replace({"clustering.eps": 0.3}))
    wanted = rough_trees(basis, kept.clusters, BASE)
    given = rough_trees(other, kept.clusters, BASE, sampled(BASE))
    assert wanted is not None
    assert given is not None
    assert given.position.tobytes() == wanted.position.tobytes()
    assert given.observations.tolist() == wanted.observations.tolist()


def test_scans_that_show_nothing_leave_what_was_gathered_alone(known):
    kept, basis = known
    parameters = BASE.replace({"clustering.min_points": 500})
    rough = rough_trees(basis, kept.clusters, parameters, sampled(parameters))
    wanted = rough_trees(basis, kept.clusters, BASE)
    assert rough is not None
    assert wanted is not None
    assert 0 < len(rough.position) <= len(wanted.position)
    bare = ungathered(basis)
    rough = rough_trees(bare, kept.clusters, parameters, sampled(parameters))
    assert rough is not None
    seen = np.hypot(*(wanted.position[:, None] - rough.position[None]).transpose(2, 0, 1)) < 0.3
    assert seen.any(axis=1).mean() < 0.5


def test_scans_that_are_looked_at_on_two_cores_show_the_same():
    sample, parameters = Sample(), BASE.replace({"clustering.eps": 0.3})
    for step in run()[0][:20]:
        sample.offer(step)
    one = sample.looked(mapper(parameters).segmenter(), 20)
    two = sample.looked(mapper(parameters).segmenter(), 20, looked_at_once)
    assert list(one) == list(two) == list(range(20))
    assert encode(tuple(two.values())) == encode(tuple(one.values()))


def test_a_sample_is_spread_over_the_run_and_bounded():
    step, sample = run()[0][0], Sample()
    looked, asked = mapper(BASE).segment(step), []

    def look(step):
        asked.append(step.index)
        return looked

    for index in range(1000):
        sample.offer(replace(step, index=index))
    held = list(sample.looked(look, 900))
    assert held == asked
    assert MOST_SCANS // 2 <= len(sample) <= MOST_SCANS
    assert len(set(np.diff(held))) == 1
    assert held[0] == 0
    assert held[-1] < 900
    large = replace(step, scan=replace(step.scan, points=np.zeros((500_000, 3), np.float32)))
    sample = Sample()
    for index in range(100):
        sample.offer(replace(large, index=index))
    assert len(sample) <= 3
