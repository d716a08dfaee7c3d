"""The preview has the trees of the map that the rerun gives."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

import pipeline.remapping.preview as preview_of
from pipeline.geometry.columns import rows_of
from pipeline.remapping.preview import (
    MOST_PLACES,
    SAMPLE_BYTES,
    SAMPLE_SCANS,
    ClusterTable,
    grouped,
    preview_trees,
    sample_scans,
)
from pipeline.remapping.rerun import Rerun, ScanCaches
from pipeline.types.records import Verdict
from pipeline.types.units import SECOND_NS
from tests.pipeline.remapping.mapped import BASE, frames, mapper, run


def share_within(place: np.ndarray, other: np.ndarray, distance: float) -> float:
    """Share of some places that are near to another one."""
    apart = np.hypot(*(place[:, None] - other[None]).transpose(2, 0, 1))
    return float((apart.min(axis=1, initial=np.inf) < distance).mean())


@pytest.mark.parametrize(
    "change", [{}, {"classification.tree_share": 0.6}, {"detection.e_max": 5.0}, {"slam.particles": 40}]
)
def test_it_is_near_to_the_map_that_comes(change, known):
    cache, before = known
    parameters = BASE.replace(change)
    preview = preview_trees(before, parameters)
    assert preview is not None
    frame = frames(Rerun(mapper(parameters), cache), len(cache))[-1]
    exact = frame.trees.position[frame.trees.confirmed]
    assert len(exact) > 3
    assert share_within(exact, preview.position, 0.3) > 0.8
    assert share_within(preview.position, exact, 0.3) > 0.8


def test_a_column_without_enough_votes_is_not_a_tree(known):
    columns = known[1].columns
    trees = columns.axis[columns.verdict == Verdict.TREE, :2]
    assert len(trees)
    preview = preview_trees(known[1], BASE.replace({"classification.tree_share": 1.0}))
    assert preview is not None
    assert share_within(trees, preview.position, 0.1) < 0.5


def test_hits_are_the_clusters_that_are_trees(known):
    parameters = BASE.replace({"tracking.hits_to_confirm": 1, "tracking.proximity_radius": 0.3})
    before = replace(known[1], columns=None)
    preview = preview_trees(before, parameters)
    assert preview is not None
    found = np.count_nonzero(before.clusters.verdicts(BASE.detection) == Verdict.TREE)
    assert int(preview.observations.sum()) == found


def test_a_long_run_keeps_the_clusters_of_some_scans(known, monkeypatch):
    parameters = BASE.replace({"tracking.hits_to_confirm": 1, "tracking.proximity_radius": 0.3})
    before = replace(known[1], columns=None)
    whole = preview_trees(before, parameters)
    assert whole is not None
    monkeypatch.setattr(preview_of, "MOST_ROWS", before.clusters.start[-1] // 3)
    m, few = mapper(BASE), ClusterTable()
    for step in run()[0]:
        scan = m.segment(step)
        few.put(step.index, scan.clusters, scan.sensor_offset)
        assert few.start[-1] <= preview_of.MOST_ROWS
    assert few.spacing == 4
    kept = np.arange(0, len(run()[0]), 4)
    verdicts = before.clusters.of(kept.tolist()).verdicts(BASE.detection)
    assert few.verdicts(BASE.detection).tolist() == verdicts.tolist()
    given = preview_trees(replace(before, clusters=few), parameters)
    assert given is not None
    assert share_within(given.position, whole.position, 0.3) > 0.9
    often = whole.position[whole.observations > 20]
    assert share_within(often, given.position, 0.3) > 0.9
    assert given.observations.sum() == pytest.approx(whole.observations.sum(), rel=0.2)


def test_a_stored_scan_also_counts_for_the_time_up_to_the_next_one(known, monkeypatch):
    before, scans = replace(known[1], columns=None), 12
    path = rows_of(before.path, slice(0, scans))
    seen_s = (path.stamp_ns[-1] - path.stamp_ns[0]) / SECOND_NS
    parameters = BASE.replace({"tracking.confirm_time": seen_s})
    whole = preview_trees(replace(before, path=path), parameters)
    monkeypatch.setattr(preview_of, "MOST_SCANS", 3)
    m, few = mapper(BASE), ClusterTable()
    for step in run()[0][:scans]:
        scan = m.segment(step)
        few.put(step.index, scan.clusters, scan.sensor_offset)
    assert few.spacing == 4
    given = preview_trees(replace(before, clusters=few, path=path), parameters)
    assert whole is not None
    assert given is not None
    assert len(whole.position) > 3
    assert share_within(whole.position, given.position, 0.3) > 0.9


@pytest.mark.parametrize("lost", [True, False])
def test_clusters_of_a_lost_robot_are_left_out(lost, known):
    m, path = mapper(BASE), known[1].path
    clusters = ClusterTable()
    for step in run()[0]:
        scan = m.segment(step)
        clusters.put(step.index, scan.clusters, scan.sensor_offset, lost=lost and 20 <= step.index < 40)
    away = path.x.copy()
    away[20:40] = 500.0
    preview = preview_trees(replace(known[1], clusters=clusters, path=replace(path, x=away)), BASE)
    assert preview is not None
    assert (preview.position[:, 0] < 300.0).any()
    assert (preview.position[:, 0] > 300.0).any() != lost


@pytest.mark.parametrize(
    ("seed", "reach", "most"), [(0, 0.05, MOST_PLACES), (1, 0.45, MOST_PLACES), (2, 9.0, 50), (3, 0.45, 5)]
)
def test_clusters_join_the_nearest_of_all_places(seed, reach, most):
    rng = np.random.default_rng(seed)
    centre, tree = rng.normal(0.0, 3.0, (300, 2)), rng.random(300) < 0.8
    place: list[np.ndarray] = []
    hits: list[int] = []
    seen: list[list[int]] = []  # scans of each group
    for k, x in zip(np.flatnonzero(tree), centre[tree], strict=True):
        scan = int(k >= 100)
        apart = np.array([np.hypot(*(p - x)) for p in place])
        if len(place) and apart.min() < reach:
            at = int(apart.argmin())
            hits[at] += 1
            place[at] = place[at] + (x - place[at]) / hits[at]
            seen[at].append(scan)
        elif len(place) < most:
            place.append(x)
            hits.append(1)
            seen.append([scan])
    found, times, first, last = grouped(centre, tree, np.array([0, 100, 300]), np.zeros((2, 5)), reach, most)
    assert times.tolist() == hits
    assert [first.tolist(), last.tolist()] == [[min(scans) for scans in seen], [max(scans) for scans in seen]]
    assert found == pytest.approx(np.array(place), abs=1e-9)


@pytest.mark.parametrize("change", [{"clustering.eps": 0.2}, {"classification.interval": 0.2}])
def test_without_a_needed_sample_there_is_no_preview(change, known):
    assert preview_trees(known[1], BASE.replace(change)) is None


SEGMENTATIONS = [
    {"clustering.eps": 0.3},
    {"filters.voxel_size": 0.03},
    {"filters.x_max": 8.0, "filters.x_min": -8.0, "tracking.hits_to_confirm": 4},
]


def sampled(parameters):
    """A sample of the run as segmented with these parameters."""
    steps, segment = run()[0], mapper(parameters).segmenter()
    return {n: segment(steps[n]) for n in sample_scans(len(steps), steps[0].scan.points.nbytes)}


@pytest.mark.parametrize("method", ["columns", "none"])
@pytest.mark.parametrize("change", SEGMENTATIONS)
def test_a_sample_shows_the_effect_of_other_clusters(change, method, known):
    before = known[1] if method == "columns" else replace(known[1], columns=None)
    parameters = BASE.replace(change)
    preview = preview_trees(before, parameters, sampled(parameters))
    assert preview is not None
    if method == "columns":
        with closing(ScanCaches()) as caches:
            rerun = Rerun(mapper(parameters), caches.of(parameters), lambda n: iter(run()[0][n:]))
            frame = frames(rerun, len(run()[0]))[-1]
        exact = frame.trees.position[frame.trees.confirmed]
    else:
        exact = by_hits(parameters, before)
    assert len(exact) > 1
    assert share_within(exact, preview.position, 0.3) > 0.7
    # The votes for a column with fewer points are not known before the rerun.
    known_votes = method == "none" or "filters.x_max" not in change
    assert share_within(preview.position, exact, 0.3) > (0.7 if known_votes else 0.4)


def by_hits(parameters, before):
    """Places where the clusters of all scans, segmented again, are trees often enough."""
    segment, table = mapper(parameters).segmenter(), ClusterTable()
    for step in run()[0]:
        scan = segment(step)
        table.put(step.index, scan.clusters, scan.sensor_offset)
    preview = preview_trees(replace(before, parameters=parameters, clusters=table), parameters)
    assert preview is not None
    return preview.position


def test_a_sample_with_the_same_segmentation_changes_nothing(known):
    other = replace(known[1], parameters=BASE.replace({"clustering.eps": 0.3}))
    wanted, given = preview_trees(known[1], BASE), preview_trees(other, BASE, sampled(BASE))
    assert wanted is not None
    assert given is not None
    assert given.position.tobytes() == wanted.position.tobytes()
    assert given.observations.tolist() == wanted.observations.tolist()


def test_a_sample_without_clusters_leaves_the_trees_of_columns(known):
    parameters = BASE.replace({"clustering.min_points": 500})
    wanted, preview = preview_trees(known[1], BASE), preview_trees(known[1], parameters, sampled(parameters))
    assert wanted is not None
    assert preview is not None
    assert 0 < len(preview.position) <= len(wanted.position)
    bare = preview_trees(replace(known[1], columns=None), parameters, sampled(parameters))
    assert bare is not None
    apart = np.hypot(*(wanted.position[:, None] - bare.position[None]).transpose(2, 0, 1))
    assert (apart.min(axis=1, initial=np.inf) < 0.3).mean() < 0.5


def test_a_sample_is_spread_over_the_run_and_bounded():
    few, many, large = sample_scans(20, 1000), sample_scans(1000, 1000), sample_scans(100, SAMPLE_BYTES // 3)
    assert list(few) == list(range(20))
    assert SAMPLE_SCANS // 2 <= len(many) <= SAMPLE_SCANS
    assert (many[0], many.step) == (0, 32)
    assert 1 <= len(large) <= 3
    assert list(sample_scans(5, 2 * SAMPLE_BYTES)) == [0]
