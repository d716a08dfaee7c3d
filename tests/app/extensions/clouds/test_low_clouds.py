"""Clouds of scanners that do not look up, sparse clouds, coppice, and the limits of a radius."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.clouds.inventory import SECTION, SLICE, map_plot
from app.extensions.clouds.inventory.cross_sections import upper_end
from app.extensions.clouds.terrain_raster import TerrainRaster
from pipeline.config import preset
from pipeline.types.records import Verdict
from tests.app.extensions.clouds.made import Made
from tests.pipeline.plots import PLACES, bush, ground, hill, plot, stem

FOREST = preset("forest")


def found(m, truth, within=0.05):
    """Number of true places with a tree, and number of trees at none of them."""
    away = np.hypot(*(m.trees.position[:, None, :] - truth[None, :, :2]).transpose(2, 0, 1))
    near = away < within
    return int(near.any(axis=0).sum()), int((~near.any(axis=1)).sum())


#: Thinner stems without branches may count as poles.
THICK = PLACES[PLACES[:, 2] >= 0.1]


def phone_cloud(rng, slope, sigma=0.012, per_m2=3000):
    """The stems of THICK up to 1.8 to 3 m, each to another height, and the ground within a metre of them."""
    floor = ground(15.0, 0.04, rng, slope)
    near = np.hypot(*(floor[:, None, :2] - THICK[None, :, :2]).transpose(2, 0, 1)).min(axis=1) < 1.0
    tops = np.linspace(1.8, 3.0, len(THICK))[np.argsort(THICK[:, 0] * 7.3 % 1.0)]
    stems = [
        stem(x, y, radius, rng, slope=slope, height=top, sigma=sigma, per_m2=per_m2)
        for (x, y, radius), top in zip(THICK, tops, strict=True)
    ]
    return np.concatenate([floor[near], *stems, bush(5.0, 5.0, rng, slope), bush(11.0, 6.0, rng, slope)])


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("slope", [0.0, 0.3, 0.57])
def test_stems_that_a_phone_sees_to_different_heights_are_no_poles(slope):
    m = map_plot(Made(phone_cloud(np.random.default_rng(1), slope)), FOREST)
    assert found(m, THICK) == (len(THICK), 0)
    assert np.abs(np.sort(m.trees.dbh) - np.sort(2.0 * THICK[:, 2])).max() < 0.015


@pytest.mark.slow
def test_stray_points_above_a_phone_cloud_are_no_view_of_crowns():
    rng = np.random.default_rng(2)
    stray = rng.uniform((0.0, 0.0, 4.0), (15.0, 15.0, 9.0), (40, 3))
    m = map_plot(Made(np.vstack([phone_cloud(rng, 0.0), stray])), FOREST)
    assert found(m, THICK) == (len(THICK), 0)


@pytest.mark.slow
def test_posts_below_crowns_stay_posts_though_they_are_more_than_the_trees():
    rng = np.random.default_rng(3)
    trees = [stem(x, y, 0.15, rng, height=9.0) for x, y in ((3.0, 3.0), (12.0, 3.0), (7.0, 12.0))]
    posts = [stem(x, 7.0, 0.05, rng, height=3.0, taper=0.0) for x in np.arange(1.0, 14.0, 2.0)]
    crowns = rng.uniform((0.0, 0.0, 7.0), (15.0, 15.0, 9.0), (60_000, 3))
    m = map_plot(Made(np.concatenate([ground(15.0, 0.05, rng), crowns, *trees, *posts])), FOREST)
    assert len(m.trees.number) == 3


def test_the_upper_end_is_where_three_points_are():
    raster = TerrainRaster(np.zeros(2), 0.5, np.zeros((2, 2)), np.ones((2, 2), bool), np.ones((2, 2), bool))
    z = np.array([1.0, 2.0, 3.0, 4.0, 9.0])
    points = np.column_stack([np.full((5, 2), 0.2), z, z]).astype(np.float32)
    assert upper_end(points, raster) == pytest.approx(np.full((2, 2), 3.0))
    assert np.isneginf(upper_end(points[:2], raster)).all()
    assert np.isneginf(upper_end(points[:0], raster)).all()


@pytest.mark.parametrize("top", [2.0, 3.0, 8.0])
def test_stems_of_a_sparse_and_noisy_cloud_are_found(top):
    """About ten points in each slice of 0.4 m, with an error of 2.5 cm, and as many on bushes."""
    rng = np.random.default_rng(4)
    places = PLACES[PLACES[:, 2] >= 0.14]
    stems = [
        stem(x, y, r, rng, height=top, sigma=0.025, per_m2=10.0 / (2 * np.pi * r * 0.4)) for x, y, r in places
    ]
    bushes = [bush(x, y, rng, points=80) for x, y in ((5.0, 5.0), (11.0, 6.0), (6.0, 11.0), (11.0, 11.0))]
    m = map_plot(Made(np.concatenate([ground(15.0, 0.15, rng), *stems, *bushes])), FOREST)
    assert found(m, places) == (len(places), 0)
    assert np.isfinite(m.trees.dbh).sum() >= len(places) - 1
    assert abs(np.nanmean(m.trees.dbh) - 2.0 * places[:, 2].mean()) < 0.02


@pytest.mark.slow
def test_the_leaning_stems_of_coppice_are_told_apart():
    """Four stems of 8 to 11 cm from one stool, 0.5 m from one another at breast height, on a slope."""
    rng = np.random.default_rng(5)
    places, parts = [], [ground(10.0, 0.05, rng, 0.55)]
    for cx, cy in ((3.0, 3.0), (7.0, 6.5)):
        for k, diameter in enumerate((0.085, 0.09, 0.10, 0.11)):
            out = np.array([np.cos(1.57 * k + cx), np.sin(1.57 * k + cx)])
            x, y = np.array([cx, cy]) + 0.36 * out
            parts.append(
                stem(x, y, 0.5 * diameter, rng, slope=0.55, lean=0.1 * out, sigma=0.004, per_m2=6000)
            )
            places.append((x, y, 0.5 * diameter))
    truth = np.array(places)
    m = map_plot(Made(np.concatenate(parts)), FOREST)
    hits, more = found(m, truth)
    assert hits >= 7
    assert more == 0
    assert abs(np.nanmean(m.trees.dbh) - 2.0 * truth[:, 2].mean()) < 0.01


def giant(rng, radius, height=2.6):
    """A stem with bark of 2 cm, a tree beside it, and the ground around both."""
    floor = ground(10.0, 0.05, rng)
    floor = floor[np.hypot(*(floor[:, :2] - 5.0).T) > radius]
    return [
        floor,
        stem(5.0, 5.0, radius, rng, height=height, sigma=0.01),
        stem(1.0, 1.0, 0.15, rng, height=height),
    ]


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("radius", [0.65, 0.8, 0.95, 1.2])
def test_a_giant_tree_is_measured(radius):
    m = map_plot(Made(np.concatenate(giant(np.random.default_rng(6), radius))), FOREST)
    assert found(m, np.array([(5.0, 5.0), (1.0, 1.0)])) == (2, 0)
    assert m.trees.dbh[1] == pytest.approx(2.0 * radius, abs=0.02)


def test_a_stem_beyond_the_limit_is_named_with_the_limit_and_its_parameter():
    parameters = FOREST.replace({"detection.cloud_radius_max": 0.6})
    m = map_plot(Made(np.concatenate(giant(np.random.default_rng(7), 0.95))), parameters)
    assert len(m.trees.number) == 1
    assert (m.verdict == Verdict.TOO_THICK).sum() == 1
    assert m.stems["radius"][m.verdict == Verdict.TOO_THICK] == pytest.approx(0.95, abs=0.01)
    (warning,) = m.warnings
    assert "1.2 m" in warning
    assert "detection.cloud_radius_max" in warning


@pytest.mark.parametrize(
    ("wide", "turn", "is_section"),
    [(0.14, 0.0, True), (0.45, 0.0, True), (0.3, 30.0, True), (0.3, 45.0, True), (10.0, 0.0, False)],
)
def test_a_section_through_a_plot_is_told(wide, turn, is_section):
    points = plot(np.random.default_rng(9))
    points = points[np.abs(points[:, 1] - PLACES[0, 1]) < 0.5 * wide]
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]])
    m = map_plot(Made(points), FOREST)
    assert any(text.startswith(SECTION) for text in m.warnings) == is_section


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("low", "high", "is_slice"), [(1.2, 1.4, True), (1.0, 1.6, True), (0.5, 2.5, False), (-1.0, 1.0, False)]
)
def test_a_slice_of_stems_without_ground_is_told(low, high, is_slice):
    points = plot(np.random.default_rng(9))
    above = points[:, 2] - hill(points[:, 0], points[:, 1])
    m = map_plot(Made(points[(above > low) & (above < high)]), FOREST)
    assert any(text.startswith(SLICE) for text in m.warnings) == is_slice


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(("radius", "height"), [(0.3, 0.9), (0.95, 0.9), (0.3, 1.2)])
def test_a_low_stump_is_a_stump(radius, height):
    rng = np.random.default_rng(8)
    turn, off = rng.uniform(0.0, 2.0 * np.pi, 4000), radius * np.sqrt(rng.uniform(0.0, 1.0, 4000))
    top = np.column_stack(
        [5.0 + off * np.cos(turn), 5.0 + off * np.sin(turn), hill(5.0, 5.0) + rng.normal(height, 0.01, 4000)]
    )
    parts = giant(rng, radius, height)[:2]
    m = map_plot(Made(np.concatenate([*parts, top, stem(1.0, 1.0, 0.15, rng)])), FOREST)
    assert found(m, np.array([(1.0, 1.0)])) == (1, 0)
    assert (m.verdict == Verdict.STUMP).sum() == 1
    assert Verdict.STUMP.label == "stump"
