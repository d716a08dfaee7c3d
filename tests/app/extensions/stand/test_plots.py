"""Plots and the observed area."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.stand.figures import PlotTrees
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plots import (
    SamplePlot,
    along,
    checked,
    circle,
    detection_function,
    figures_of,
    rectangle,
    seen_plot,
    within_reach,
)
from pipeline.detection.free_space import BINS
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.seen_area import CELL, MOST_VIEWS, SeenArea, SeenRecorder, ViewSelection
from pipeline.types.records import Path


def path_of(poses):
    """A path with one pose per second."""
    x, y, yaw = np.array(poses, np.float64).reshape(-1, 3).T
    return Path(np.arange(len(x)) * 10**9, x, y, yaw, np.zeros(len(x)))


def area_of(cells):
    """An area that was observed from 1 m, twice."""
    place = np.array(cells, np.int64).reshape(-1, 2)
    n = len(place)
    return SeenArea(CELL, place, np.ones(n), np.full(n, 2), np.ones(n, np.bool_))


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(0.1, 500))
def test_a_circle_has_the_area_of_its_radius(x, y, radius):
    assert circle("c", x, y, radius).shape.area == pytest.approx(math.pi * radius**2, rel=1e-5)


@given(st.floats(-100, 100), st.floats(0.1, 100), st.floats(0.1, 100), st.floats(-4, 4))
def test_a_rectangle_contains_what_is_within_its_sides(x, length, width, turn):
    plot = rectangle("r", x, 5.0, length, width, turn)
    assert plot.shape.area == pytest.approx(length * width)
    axis, across = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    centre = np.array([x, 5.0])
    points = [
        centre + f * (length / 2 * axis) + g * (width / 2 * across) for f in (-0.99, 1.01) for g in (0.99,)
    ]
    assert plot.contains(np.array(points)).tolist() == [True, False]


def test_circles_lie_along_the_path():
    plots = along(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]), 8.0, 3.0)
    centres = [plot.shape.centroid.coords[0] for plot in plots]
    np.testing.assert_allclose(centres, [[4.0, 0.0], [10.0, 2.0], [10.0, 10.0]], atol=1e-9)
    with pytest.raises(StemmapError, match="shorter distance"):
        along(np.array([[0.0, 0.0], [1.0, 0.0]]), 8.0, 3.0)
    with pytest.raises(StemmapError, match="another distance"):
        along(np.array([[0.0, 0.0], [1000.0, 0.0]]), 0.1, 3.0)
    with pytest.raises(StemmapError, match="no plots"):
        along(np.zeros((0, 2)), 8.0, 3.0)


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        (None, "not an area"),
        (shapely.Polygon([(0, 0), (1, 0), (2, 0)]), "not valid|area of 0"),
        (shapely.Polygon([(0, 0), (2, 2), (2, 0), (0, 2)]), "not valid"),
        (shapely.box(0, 0, 2000, 2000), "more than 100 ha"),
    ],
)
def test_what_is_no_area_is_refused(shape, text):
    with pytest.raises(StemmapError, match=text):
        checked(SamplePlot("p", shape))


@pytest.mark.parametrize("number", [math.nan])
def test_a_number_that_is_not_finite_is_named(number):
    for make, key in (
        (lambda: circle("p", number, 0.0, 5.0), "x"),
        (lambda: circle("p", 0.0, 0.0, number), "radius"),
        (lambda: rectangle("p", 0.0, number, 5.0, 5.0), "y"),
        (lambda: rectangle("p", 0.0, 0.0, 5.0, number), "width"),
        (lambda: rectangle("p", 0.0, 0.0, 5.0, 5.0, number), "turn"),
    ):
        with pytest.raises(StemmapError, match=f"plot p: its {key} is not a number"):
            make()


@pytest.mark.parametrize("every", [math.nan, 0.0])
def test_a_distance_along_the_path_is_above_0(every):
    with pytest.raises(StemmapError, match="apart along the path"):
        along(np.array([[0.0, 0.0], [10.0, 0.0]]), every, 3.0)


def test_a_scan_observes_up_to_its_free_range_and_not_behind_a_stem():
    free = np.full(BINS, 10.0)
    free[: BINS // 4] = 3.0  # a quarter of all directions is hidden
    recorder = SeenRecorder()
    recorder.add(0, np.stack([np.full(BINS, 6.0), free]))
    seen = recorder.area(path_of([[0, 0, 0]]))
    expected = math.pi * (0.75 * 10.5**2 + 0.25 * 3.5**2)
    assert len(seen.place) * CELL**2 == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(seen.nearest, np.hypot(*seen.centres.T))
    assert (seen.views == 1).all()
    np.testing.assert_array_equal(seen.clear, seen.nearest <= 6.0)


def test_the_observed_area_moves_with_the_final_path():
    recorder, view = SeenRecorder(), np.full((2, BINS), 4.0)
    recorder.add(0, view)
    recorder.add(2 * 10**9, view)
    recorder.add(9 * 10**9, view)  # later than the path, as after a seek back
    seen = recorder.area(path_of([[100, 50, 1], [0, 0, 0], [101, 50, 1]]))
    np.testing.assert_allclose(seen.centres.mean(axis=0), [100.5, 50.0], atol=0.3)
    assert seen.views.max() == 2
    near = seen.rows(np.array([[100.5, 50.0]]))[0]
    assert seen.nearest[near] < 1.0
    assert len(SeenRecorder().area(path_of([[0, 0, 0]])).place) == 0


def test_the_observed_area_does_not_depend_on_how_many_views_are_grouped_at_once(monkeypatch):
    rng = np.random.default_rng(3)
    recorder, poses = SeenRecorder(), rng.uniform(-20.0, 20.0, (12, 3))
    for k in range(len(poses)):
        recorder.add(k * 10**9, rng.uniform(1.0, 12.0, (2, BINS)))
    at_once = recorder.area(path_of(poses))
    monkeypatch.setattr("pipeline.seen_area.ROWS_MOST", 1000)
    in_parts = recorder.area(path_of(poses))
    np.testing.assert_array_equal(in_parts.place, at_once.place)
    np.testing.assert_array_equal(in_parts.nearest, at_once.nearest)
    np.testing.assert_array_equal(in_parts.views, at_once.views)
    np.testing.assert_array_equal(in_parts.clear, at_once.clear)
    assert 0 < np.count_nonzero(at_once.clear) < len(at_once.clear)
    assert at_once.views.max() > 2


def test_views_are_recorded_after_a_motion_and_a_few_times_at_one_place():
    views = ViewSelection()
    assert views.take(Pose2())
    assert not views.take(Pose2(0.3, 0.0, 0.1))
    assert views.take(Pose2(0.6, 0.0, 0.0))
    assert views.take(Pose2(0.6, 0.0, 0.3))
    laps = ViewSelection()
    lap = [Pose2(0.6 * k + 0.25, 0.1, 0.05) for k in range(20)]
    taken = [sum(map(laps.take, lap)) for _ in range(10)]
    assert taken == [20] * MOST_VIEWS + [0] * (10 - MOST_VIEWS)
    assert laps.take(Pose2(0.25, 0.1, 3.0)), "another direction is another view"


def test_areas_of_two_drives_join():
    a, b = area_of([[0, 0], [1, 0]]), area_of([[1, 0], [2, 0]])
    both = a.joined(b)
    assert both.place.tolist() == [[0, 0], [1, 0], [2, 0]]
    assert both.views.tolist() == [2, 4, 2]
    grid = area_of([[x, y] for x in range(40) for y in range(40)])
    turned = area_of([]).joined(grid, Pose2(3.0, 1.0, 0.5))
    assert len(turned.place) == pytest.approx(1600, rel=0.08)
    assert shapely.union_all([seen_plot("p", turned).shape]).geom_type == "Polygon"  # no holes between cells
    assert not seen_plot("p", turned).shape.interiors


def test_reach_and_views_limit_what_counts_as_observed():
    seen = SeenArea(
        CELL,
        np.array([[0, 0], [1, 0], [2, 0], [3, 0]]),
        np.array([1.0, 16, 1, np.nan]),
        np.array([2, 9, 1, 0]),
        np.ones(4, np.bool_),
    )
    assert within_reach(seen, Stand()).place[:, 0].tolist() == [0, 3]


def test_figures_refer_to_the_observed_part_of_a_plot():
    seen = area_of([[x, y] for x in range(20) for y in range(40)])  # x 0..10, y 0..20
    position = np.array([[x, y] for x in np.arange(0.6, 20, 1.0) for y in np.arange(0.6, 20, 1.0)])
    trees = PlotTrees(position, np.full(400, 0.2), np.zeros(400))
    plots = [rectangle("half", 10, 10, 20, 20), rectangle("in", 5, 10, 10, 10), circle("out", 50, 50, 5)]
    figures = figures_of(plots, trees, seen, Stand())
    half = figures["half"]
    assert (half.area, half.seen, half.trees) == pytest.approx((400, 200, 200))
    assert half.values["n_ha"].value == pytest.approx(1e4)
    assert half.values["n_ha_plain"].value == pytest.approx(1e4)
    assert half.values["n_ha"].se > 0.0
    assert figures["in"].seen == figures["in"].area == pytest.approx(100)
    assert figures["in"].values["n_ha"] == pytest.approx((1e4, 600.0))  # the counting error
    exact = figures_of(plots, trees, seen, Stand(count_error=0.0))["in"]
    assert math.isnan(exact.values["n_ha"].se)  # detection does not decrease, and may be below 1
    assert (figures["out"].seen, figures["out"].trees) == (0.0, 0)
    assert "no part of the plot was observed" in figures["out"].warnings[0]


def test_cells_of_unknown_distance_do_not_change_the_detection():
    driven = area_of([[x, y] for x in range(40) for y in range(40)])
    driven = replace(driven, nearest=0.2 + np.abs(driven.centres[:, 1] - 10.0))
    random = np.random.default_rng(1)
    places = random.uniform(0.0, 20.0, (400, 2))
    found = random.random(400) < np.exp(-0.5 * np.square((places[:, 1] - 10.0) / 4.0))
    alone = PlotTrees(places[found], np.full(found.sum(), 0.2), np.zeros(found.sum()))
    scanned = area_of([[x, y] for x in range(40, 60) for y in range(40)])
    scanned = replace(scanned, nearest=np.full(len(scanned.place), np.nan))
    position = np.concatenate([alone.position, random.uniform([20.0, 0.0], [30.0, 20.0], (100, 2))])
    trees = PlotTrees(position, np.full(len(position), 0.2), np.zeros(len(position)))
    both = driven.joined(scanned)
    assert detection_function(trees, both, Stand()) == detection_function(alone, driven, Stand())
    assert math.isfinite(detection_function(trees, both, Stand()).sigma)
    missed = places[~found]
    every = np.concatenate([alone.position, missed])
    added = np.arange(len(every)) >= len(alone.dbh)
    with_missed = PlotTrees(every, np.full(len(every), 0.2), np.zeros(len(every)), added=added)
    assert detection_function(with_missed, driven, Stand()) == detection_function(alone, driven, Stand())
    figures = figures_of([rectangle("all", 15, 10, 30, 20)], trees, both, Stand())
    assert figures["all"].values["n_ha"].value == pytest.approx(len(position) / 0.06)


@pytest.mark.parametrize("sigma", [3.0, 5.0])
def test_trees_that_are_missed_far_from_the_path_give_the_decrease(sigma: float):
    seen = area_of([[x, y] for x in range(120) for y in range(-30, 30)])
    seen = replace(seen, nearest=np.abs(seen.centres[:, 1]))
    found = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        places = random.uniform([0.0, -15.0], [60.0, 15.0], (200, 2))
        places = places[random.random(200) < np.exp(-0.5 * np.square(places[:, 1] / sigma))]
        trees = PlotTrees(places, np.full(len(places), 0.2), np.zeros(len(places)))
        found.append(detection_function(trees, seen, Stand()).sigma)
    assert np.median(found) == pytest.approx(sigma, rel=0.1)


def test_cells_that_stems_and_their_undergrowth_hide_are_observed():
    """Without them a stand lost the trees that stand in undergrowth, but hardly any area."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(20), np.arange(20)))
    hidden = ((x == 5) & (y == 5)) | ((x > 9) & (x < 12) & (y > 9) & (y < 12)) | ((x > 13) & (y > 13))
    place = np.stack([x, y], axis=1)[~hidden]
    n = len(place)
    near = np.where(place[:, 0] < 8, 3.0, 9.0)
    seen = SeenArea(0.5, place, near, np.full(n, 4), np.ones(n, np.bool_))
    kept = within_reach(seen, Stand())
    assert len(kept.place) == 400 - 35, "holes up to 1 m are closed, the corner is not but for its tip"
    row = kept.rows(np.array([[2.75, 2.75], [5.25, 5.25], [8.0, 8.0]]))
    assert row[2] < 0
    assert kept.nearest[row[:2]].tolist() == [3.0, 9.0]
    assert kept.views[row[:2]].tolist() == [4, 4]
    assert len(within_reach(seen, Stand(reach=5.0)).place) == 20 * 8


def test_a_cloud_covers_its_cells_and_gaps_up_to_a_metre():
    from pipeline.seen_area import covered_area

    side = np.arange(0.05, 10.0, 0.1)
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    assert len(covered_area(points).place) * 0.25 == 100.0
    shadow = np.hypot(*(points - 5.0).T) < 0.45
    gap = np.all(np.abs(points - [2.0, 7.0]) < 1.4, axis=1)  # 2.8 m wide
    area = covered_area(points[~shadow & ~gap])
    assert area.rows(np.array([[5.0, 5.0], [2.0, 7.0], [-0.1, 5.0]])).tolist()[1:] == [-1, -1]
    assert area.rows(np.array([[5.0, 5.0]]))[0] >= 0
    moved = covered_area(points + np.array([500_000.0, 5_300_000.0]))  # as far as UTM coordinates
    assert len(moved.place) == 400
    assert not len(covered_area(np.zeros((0, 2))).place)
