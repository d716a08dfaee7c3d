"""Inventory of whole clouds in closed form: stems, ground, and refused clouds."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.clouds.inventory import map_plot
from pipeline.config import preset
from pipeline.errors import SourceError
from pipeline.types.records import Verdict
from tests.app.extensions.clouds.made import Made
from tests.pipeline.plots import PLACES, bush, ground, hill, plot, stem

FOREST = preset("forest")


def errors(found, truth):
    """Row of each true stem's nearest tree, and how far it is."""
    away = np.hypot(*(found[None, :, :] - truth[:, None, :2]).transpose(2, 0, 1))
    return away.argmin(axis=1), away.min(axis=1)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(("slope", "sigma"), [(0.0, 0.003), (0.35, 0.005), (0.6, 0.01)])
def test_stems_of_known_places_and_diameters_are_found(slope, sigma):
    m = map_plot(Made(plot(np.random.default_rng(1), slope=slope, sigma=sigma)), FOREST)
    row, away = errors(m.trees.position, PLACES)
    assert len(m.trees.number) == len(PLACES), "all stems and nothing else"
    assert away.max() < 0.03
    assert np.abs(m.trees.dbh[row] - 2.0 * PLACES[:, 2]).max() < 0.012
    assert np.abs(m.trees.dbh[row] - 2.0 * PLACES[:, 2]).max() < 4.0 * np.nanmax(m.trees.dbh_sigma)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("slope", [0.0, 0.35])
def test_stems_are_found_in_a_cloud_without_ground_returns(slope):
    """Only the feet of the stems show the ground; everywhere else, the lowest returns are crowns."""
    rng = np.random.default_rng(7)
    parts = [stem(x, y, r, rng, slope=slope, height=10.0, per_m2=3000) for x, y, r in PLACES]
    x, y = rng.uniform(0.0, 15.0, (2, 60_000))
    parts.append(np.column_stack([x, y, hill(x, y, slope) + rng.uniform(7.0, 10.0, len(x))]))
    m = map_plot(Made(np.concatenate(parts)), FOREST)
    thick = PLACES[PLACES[:, 2] > 0.09]  # a thin stem without branches may count as a pole
    row, away = errors(m.trees.position, thick)
    assert len(thick) <= len(m.trees.number) <= len(PLACES)
    assert away.max() < 0.03
    assert np.abs(m.trees.dbh[row] - 2.0 * thick[:, 2]).max() < 0.012
    to_stem = np.hypot(*(m.trees.position[:, None] - PLACES[:, :2]).transpose(2, 0, 1)).min(axis=1)
    assert to_stem.max() < 0.03


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("height", [3.0, 4.0, 5.0])
@pytest.mark.parametrize(
    ("slope", "waves"),
    [(0.0, None), (0.35, 0.0), (0.35, 0.25)],
    ids=["level cut", "cut above the ground", "cut above another model of the ground"],
)
def test_stems_in_a_cloud_that_is_cut_off_are_no_poles(slope, waves, height):
    """Nothing was observed above the cut. The other model of the ground deviates from the true one by up to
    0.25 m."""
    points = plot(np.random.default_rng(1), slope=slope)
    x, y, z = points.T
    end = 0.0 if waves is None else hill(x, y, slope) + waves * np.sin(0.7 * x + 1.0) * np.cos(0.5 * y)
    m = map_plot(Made(points[z < end + height]), FOREST)
    _, away = errors(m.trees.position, PLACES)
    assert len(m.trees.number) == len(PLACES)
    assert away.max() < 0.03


def test_a_pole_beside_trees_is_no_tree():
    rng = np.random.default_rng(2)
    pole = stem(10.5, 10.5, 0.05, rng, height=3.0, taper=0.0)
    m = map_plot(Made(np.concatenate([plot(rng), pole])), FOREST)
    assert len(m.trees.number) == len(PLACES)
    assert np.hypot(*(m.trees.position - 10.5).T).min() > 1.0


def test_lean_and_taper_are_told():
    rng = np.random.default_rng(2)
    points = np.concatenate(
        [ground(6.0, 0.05, rng), stem(3.0, 3.0, 0.15, rng, lean=(0.1, -0.05), taper=0.01, sigma=0.003)]
    )
    m = map_plot(Made(points), FOREST)
    (tree,) = m.stems[m.tree_candidate]
    assert (tree["lean_x"], tree["lean_y"]) == pytest.approx((0.1, -0.05), abs=0.01)
    assert tree["taper"] == pytest.approx(-0.01, abs=0.004)


def test_a_short_arc_carries_a_place_but_no_diameter():
    rng = np.random.default_rng(3)
    crown = np.array([3.0, 3.0, 5.5]) + rng.normal(0.0, 1.0, (3000, 3)) * [0.8, 0.8, 0.5]  # else it is a pole
    parts = [ground(6.0, 0.05, rng), stem(3.0, 3.0, 0.15, rng, arc=2.2, sigma=0.003), crown]
    m = map_plot(Made(np.concatenate(parts)), FOREST)
    assert len(m.trees.number) == 1
    assert np.hypot(*(m.trees.position[0] - 3.0)) < 0.03
    assert np.isnan(m.trees.dbh[0])


def test_bushes_stumps_and_hanging_branches_are_no_trees():
    rng = np.random.default_rng(4)
    hanging = stem(6.0, 2.0, 0.06, rng) + np.array([0.0, 0.0, 3.5])
    parts = [ground(8.0, 0.05, rng), bush(2.0, 2.0, rng), stem(5.0, 5.0, 0.2, rng, height=0.9), hanging]
    m = map_plot(Made(np.concatenate(parts)), FOREST)
    assert len(m.trees.number) == 0
    assert {Verdict.STUMP, Verdict.OTHER} & set(m.verdict.tolist())


def test_undergrowth_at_the_foot_does_not_hide_a_stem():
    rng = np.random.default_rng(5)
    parts = [ground(6.0, 0.05, rng), stem(3.0, 3.0, 0.12, rng), bush(3.2, 3.1, rng, size=0.6, points=600)]
    m = map_plot(Made(np.concatenate(parts)), FOREST)
    assert len(m.trees.number) == 1
    assert np.hypot(*(m.trees.position[0] - 3.0)) < 0.03


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_the_ground_is_found_below_noise_and_bushes(slope):
    m = map_plot(Made(plot(np.random.default_rng(6), slope=slope)), FOREST)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(1.0, 14.0, 40), np.linspace(1.0, 14.0, 40)))
    off = m.ground.at(x, y) - hill(x, y, slope)
    assert np.abs(np.median(off)) < 0.05
    assert np.percentile(np.abs(off), 95) < 0.15


@pytest.mark.slow
def test_the_parts_in_which_a_cloud_comes_change_nothing():
    points = plot(np.random.default_rng(7), per_m2=600)
    a, b = (map_plot(Made(points, part=part), FOREST) for part in (10_000, 1_000_000))
    assert np.array_equal(a.trees.position, b.trees.position)
    assert np.array_equal(a.trees.dbh, b.trees.dbh, equal_nan=True)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((10, 3)),
        np.random.default_rng(0).uniform(0.0, 5.0, (500, 3)) * (1.0, 1.0, 0.0),
        np.random.default_rng(0).uniform(0.0, 5.0, (5000, 3)) * (1.0, 0.0, 1.0),
        np.random.default_rng(0).uniform(0.0, 6.0, (40_000, 3)),
        np.array([[0.0, 0.0, 0.0]]),
    ],
    ids=["ten identical points", "all one plane", "a wall", "a cube full of points", "one point"],
)
def test_what_is_no_plot_gives_no_tree_and_no_exception(points):
    assert len(map_plot(Made(points), FOREST).trees.number) == 0


CANOPY = np.random.default_rng(1).uniform(0.0, 10.0, (60_000, 3)) * (1.0, 1.0, 0.2) + (0.0, 0.0, 8.0)
LOW = np.random.default_rng(2).uniform(0.0, 10.0, (60_000, 3)) * (1.0, 1.0, 0.01)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("points", "warns"),
    [
        (LOW, "no points higher"),
        (np.vstack([CANOPY, [[5.0, 5.0, 0.0]]]), ""),
        (CANOPY, ""),
    ],
    ids=["grass alone", "crowns over one return", "crowns without a ground"],
)
def test_a_plot_without_trees_or_ground_gives_warnings_and_no_tree(points, warns):
    m = map_plot(Made(points), FOREST)
    assert len(m.trees.number) == 0
    assert any(warns in warning for warning in m.warnings) or not warns


@pytest.mark.parametrize("cut", [2.85, 3.0, 3.1])
def test_a_stem_that_the_border_of_the_plot_cuts_has_no_diameter_from_less_than_half(cut):
    """A stem of 30 cm at (3, 3), of which the border leaves what lies left of x = cut."""
    rng = np.random.default_rng(5)
    points = np.concatenate(
        [ground(6.0, 0.05, rng), stem(3.0, 3.0, 0.15, rng, sigma=0.003), bush(1.0, 1.0, rng)]
    )
    m = map_plot(Made(points[points[:, 0] < cut]), FOREST)
    assert len(m.trees.number) <= 1, "none is invented"
    if len(m.trees.number):
        assert np.hypot(*(m.trees.position[0] - 3.0)) < 0.05
    told = m.trees.dbh[np.isfinite(m.trees.dbh)]
    assert np.all(np.abs(told - 0.3) < 0.02)
    assert len(told) == 0 or cut > 2.9


@pytest.mark.slow
def test_two_million_points_are_a_plot_like_any_other():
    points = np.resize(plot(np.random.default_rng(10), per_m2=600), (2_000_000, 3))
    points += np.random.default_rng(11).normal(0.0, 0.002, points.shape)
    m = map_plot(Made(points, part=1 << 19), FOREST)
    assert m.counts["read"] == 2_000_000
    _, away = errors(m.trees.position, PLACES)
    assert len(m.trees.number) == len(PLACES)
    assert away.max() < 0.03


def test_points_far_away_are_left_out_and_counted():
    points = plot(np.random.default_rng(8), per_m2=600)
    m = map_plot(Made(np.vstack([points, [[5000.0, 5000.0, 0.0]]])), FOREST)
    assert m.counts["apart from the plot"] == 1
    assert len(m.trees.number) == len(PLACES)


def test_an_empty_cloud_and_one_too_wide_are_refused():
    with pytest.raises(SourceError, match="no points"):
        map_plot(Made(np.zeros((0, 3))), FOREST)
    wide = np.random.default_rng(9).uniform(0.0, 2000.0, (200_000, 3)) * (1.0, 1.0, 0.001)
    line = np.column_stack([np.linspace(0.0, 9000.0, 200_000)] * 2 + [np.zeros(200_000)])
    with pytest.raises(SourceError, match="too large for one plot"):
        map_plot(Made(np.vstack([wide, line])), FOREST)
