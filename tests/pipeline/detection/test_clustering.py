"""Three engines of DBSCAN agree on cores and noise; border points go to their nearest core."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sklearn.cluster import DBSCAN

from pipeline.config import preset
from pipeline.detection.clustering import ENGINES, cluster, dbscan_grid, number_by_first_point, weigh
from pipeline.types.records import Sensor
from tests.pipeline.strategies import SENSOR, simulated_cloud

FOREST = preset("forest").clustering
EPS = 0.25

# Quarters of eps are exact in binary, so that neighbours at exactly eps are met often.
lattice = st.integers(-12, 12).map(lambda k: k * EPS / 2)
anywhere = st.floats(-2, 2, width=32)


def clouds(dimensions, elements):
    """Clouds with many equal points."""
    shape = st.tuples(st.integers(0, 50), st.just(dimensions))
    return arrays.arrays(np.float32, shape, elements=elements)


def brute_force(points, eps, min_points):
    """Cores, and the number of the component of each core, by all distances at once."""
    p = points.astype(np.float64)
    square = ((p[:, None] - p[None]) ** 2).sum(axis=2)
    near = square <= eps * eps
    core = near.sum(axis=1) >= min_points
    component = np.where(core, np.arange(len(p)), -1)
    for _ in range(len(p)):
        linked = near & core[:, None] & core[None]
        lowest = np.where(linked, component[None], len(p)).min(axis=1, initial=len(p))
        spread = np.where(core, np.minimum(component, lowest), -1)
        if np.array_equal(spread, component):
            break
        component = spread
    return core, component, square


def assert_is_dbscan(points, label, eps, min_points, *, nearest):
    """The label is a DBSCAN of the points; if `nearest`, borders went to their nearest core."""
    core, component, square = brute_force(points, eps, min_points)
    pairs = {(a, b) for a, b in zip(component[core], label[core], strict=True)}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs}), "same parts"
    assert np.all(label[core] >= 0)
    in_reach = (square <= eps * eps) & core[None]
    np.testing.assert_array_equal(label < 0, ~core & ~in_reach.any(axis=1))
    for i in np.flatnonzero(~core & (label >= 0)):
        mine = in_reach[i] & (label == label[i])
        assert mine.any()
        if nearest:
            assert square[i][mine].min() == square[i][in_reach[i]].min()


def assert_numbered_by_first_point(label):
    """0, 1, 2 ... in the order in which they first appear."""
    seen = [k for k in dict.fromkeys(label.tolist()) if k >= 0]
    assert seen == list(range(len(seen)))


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("elements", [lattice, anywhere], ids=["lattice", "anywhere"])
def test_the_grid_is_dbscan(dimensions, elements):
    @given(clouds(dimensions, elements), st.integers(1, 9))
    def law(points, min_points):
        label, core = dbscan_grid(points.astype(np.float64), EPS, min_points)
        assert label.dtype == np.int32
        np.testing.assert_array_equal(core, brute_force(points, EPS, min_points)[0])
        assert_is_dbscan(points, label, EPS, min_points, nearest=True)
        assert_numbered_by_first_point(label)

    law()


@pytest.mark.parametrize("engine", ["sklearn", "open3d"])
@pytest.mark.parametrize("elements", [lattice, anywhere], ids=["lattice", "anywhere"])
def test_every_engine_is_dbscan(engine, elements):
    @given(clouds(3, elements), st.integers(1, 9))
    def law(points, min_points):
        label = ENGINES[engine](points, EPS, min_points)
        assert label.dtype == np.int32
        assert_is_dbscan(points, label, EPS, min_points, nearest=False)
        assert_numbered_by_first_point(label)

    law()


def test_points_over_the_corner_of_two_cells_are_neighbours_up_to_the_last_bit_of_eps():
    side = (1.0 - 1e-9) / np.sqrt(2.0)
    points = np.array([[0.0, 0.0], [side * (1 - 1e-10)] * 2, [2 * side] * 2])
    assert np.linalg.norm(points[1] - points[2]) < 1.0
    label, _ = dbscan_grid(points, 1.0, 2)
    np.testing.assert_array_equal(label, 0)


@pytest.mark.parametrize("engine", ENGINES)
def test_few_and_equal_points(engine):
    for n, min_points, label in ((0, 1, []), (1, 1, [0]), (1, 2, [-1]), (7, 7, [0] * 7), (7, 8, [-1] * 7)):
        for dimensions in (2, 3):
            points = np.full((n, dimensions), 1.5, np.float32)
            np.testing.assert_array_equal(ENGINES[engine](points, EPS, min_points), label)


@pytest.mark.parametrize("engine", ENGINES)
def test_points_in_a_row_at_exactly_eps_are_one_cluster(engine):
    points = np.array([[k * EPS, 0.0] for k in range(8)], np.float32)
    np.testing.assert_array_equal(ENGINES[engine](points, EPS, 3), [0] * 8)
    np.testing.assert_array_equal(ENGINES[engine](points, EPS * (1 - 1e-6), 2), [-1] * 8)


def test_a_border_point_goes_to_its_nearest_core_whatever_the_order():
    left = [[-0.2, 0.0]] * 5
    right = [[0.22, 0.0]] * 5
    border = [[0.0, 0.0]]
    for rows in (left + right + border, border + right + left, right + border + left):
        points = np.array(rows, np.float32)
        label, core = dbscan_grid(points.astype(np.float64), 0.3, 6)
        at = {round(float(p[0]), 2): k for p, k in zip(points, label, strict=True)}
        assert at[-0.2] == at[0.0]
        assert np.array_equal(core, points[:, 0] < 0.1) or np.all(core)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_border_point_as_near_to_two_clusters_goes_to_the_lower_cell_whatever_the_order(axis):
    left, right = [[-0.25, 0.0]] * 3 + [[-0.5, 0.0]] * 6, [[0.25, 0.0]] * 3 + [[0.5, 0.0]] * 6
    border = [[0.0, 0.0]]
    for rows in (left + right + border, border + right + left, right + border + left):
        points = np.roll(np.array(rows), axis, axis=1)
        label, core = dbscan_grid(points, 0.25, 9)
        at = points[:, axis]
        np.testing.assert_array_equal(core, at != 0.0)
        np.testing.assert_array_equal(label == label[at == -0.5][0], at <= 0.0)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize(("eps", "min_points"), [(0.15, 8), (0.25, 20)])
@pytest.mark.parametrize("other", ["sklearn", "open3d"])
def test_engines_agree_on_a_scan(dimensions, eps, min_points, other):
    cloud = simulated_cloud()
    cloud = cloud[(cloud[:, 2] > -0.5) & (np.abs(cloud[:, :2]).max(axis=1) < 9)]
    points = np.ascontiguousarray(cloud[:, :dimensions])
    ours, core = dbscan_grid(points.astype(np.float64), eps, min_points)
    np.testing.assert_array_equal(
        np.flatnonzero(core), DBSCAN(eps=eps, min_samples=min_points).fit(points).core_sample_indices_
    )
    theirs = ENGINES[other](points, eps, min_points)
    np.testing.assert_array_equal(ours < 0, theirs < 0)
    assert ours.max() >= 1
    pairs = set(zip(ours[core].tolist(), theirs[core].tolist(), strict=True))
    assert len(pairs) == ours.max() + 1 == theirs.max() + 1


@given(arrays.arrays(np.int32, st.integers(0, 30), elements=st.integers(-1, 6)))
@example(np.array([], np.int32))
@example(np.array([-1, -1], np.int32))
def test_renumbering_keeps_the_parts(label):
    ordered = number_by_first_point(label)
    assert_numbered_by_first_point(ordered)
    np.testing.assert_array_equal(ordered < 0, label < 0)
    assert len(set(zip(label.tolist(), ordered.tolist(), strict=True))) == len(set(label.tolist()))


def test_seen_from_above_a_trunk_is_one_cluster_and_in_space_it_is_rings():
    rings = np.array([[4 + 0.01 * k, 0.02 * k, z] for z in (0.0, 0.5, 1.0) for k in range(10)], np.float32)
    flat = FOREST.model_copy(update={"dimensions": 2, "eps": 0.15, "min_points": 8})
    assert cluster(rings, SENSOR, flat).clusters == 1
    assert cluster(rings, SENSOR, flat.model_copy(update={"dimensions": 3})).clusters == 3


@pytest.mark.parametrize("method", ["dbscan", "range_jump"])
def test_an_empty_scan_has_no_clusters(method):
    labels = cluster(np.zeros((0, 3), np.float32), SENSOR, FOREST.model_copy(update={"method": method}))
    assert labels.clusters == 0
    assert len(labels.label) == len(labels.hidden) == 0


@pytest.mark.parametrize("engine", ENGINES)
def test_a_weight_is_a_repeated_point(engine):
    @given(clouds(2, lattice), st.integers(1, 9), st.data())
    def law(points, min_points, data):
        weight = data.draw(arrays.arrays(np.int32, len(points), elements=st.integers(1, 3)))
        first = np.cumsum(weight) - weight
        core, _, square = brute_force(np.repeat(points, weight, axis=0), EPS, min_points)
        label, at_core = ENGINES[engine](points, EPS, min_points, weight), core[first]
        np.testing.assert_array_equal(
            dbscan_grid(points.astype(np.float64), EPS, min_points, weight)[1], at_core
        )
        reached = (square[first] <= EPS * EPS) & core[None]
        np.testing.assert_array_equal(label < 0, ~reached.any(axis=1))
        repeated = ENGINES["sklearn"](np.repeat(points, weight, axis=0), EPS, min_points)[first]
        pairs = {(a, b) for a, b in zip(label[at_core], repeated[at_core], strict=True)}
        assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})

    law()


def test_a_return_weighs_as_much_as_a_far_stem_lacks():
    reach = np.array([1.0, 5.0, 10.0, 15.0, 20.0, 25.0])
    points = np.stack([reach * 0.6, reach * 0.8, np.full(6, 9.0)], axis=1).astype(np.float32)
    wanted = FOREST.model_copy(update={"stem_area": 0.1, "weight_max": 5})
    returns = 0.1 / (reach**2 * SENSOR.azimuth_step * SENSOR.ring_step)
    expected = np.clip(np.floor(FOREST.min_points / returns), 1, 5)
    np.testing.assert_array_equal(weigh(points, SENSOR, wanted), expected)
    assert weigh(points, SENSOR, FOREST).max() == FOREST.weight_max


def test_a_far_thin_stem_is_a_cluster_and_the_paper_weighs_nothing():
    far = np.array([[18.0, 0.05 * k, z] for k in range(3) for z in (0.5, 1.1)], np.float32)
    assert cluster(far, SENSOR, FOREST).clusters == 1
    assert cluster(far, SENSOR, FOREST.model_copy(update={"stem_area": 0.0})).clusters == 0
    assert preset("paper").clustering.stem_area == 0.0


def test_a_coarse_sensor_does_not_cut_a_stem_between_two_of_its_lines():
    """A Mid-360 crosses a stem of 0.5 m at 9 m by three lines, 0.18 m apart."""
    height, across = np.meshgrid(np.arange(-0.5, 1.6, 0.14), [-0.18, 0.0, 0.18])
    away = 9.0 - np.sqrt(0.25**2 - across**2)
    stem = np.stack([away, across, height], axis=-1).reshape(-1, 3).astype(np.float32)
    coarse = Sensor(azimuth_step=0.0183, ring_step=0.0183)
    parameters = preset("forest").clustering
    assert cluster(stem, coarse, parameters).clusters == 1
    assert cluster(stem, Sensor(), parameters).clusters == 3
    beside = np.concatenate([stem, stem + np.array([0.0, 1.0, 0.0], np.float32)])
    assert cluster(beside, coarse, parameters).clusters == 2
