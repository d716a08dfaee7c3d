"""Stand figures against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.stand.figures import MISSED, PlotTrees, combined, compared_with_gaps, stand_figures
from app.extensions.stand.parameters import Stand

EXACT_COUNT = Stand(count_error=0.0)
INDEPENDENT = Stand(dbh_shared_sigma=0.0, count_error=0.0)


def trees_of(dbh, sigma=0.0, position=None):
    """Trees in a row, 2 m apart, unless positions are given."""
    dbh = np.array(dbh, np.float64)
    if position is None:
        position = np.stack([2.0 * np.arange(len(dbh)), np.zeros(len(dbh))], axis=1)
    return PlotTrees(np.reshape(position, (-1, 2)), dbh, np.full(len(dbh), sigma))


def figures(
    trees, *, area=1000.0, seen=None, outside=None, detection=(1.0, 0.0), perimeter=120.0, limits=None
):
    """Figures of a plot that was observed completely, unless something else is given."""
    return stand_figures(
        trees,
        trees_of([]) if outside is None else outside,
        area=area,
        seen=area if seen is None else seen,
        perimeter=perimeter,
        detection=detection,
        parameters=limits or EXACT_COUNT,
    )


def test_a_complete_plot_with_exact_diameters_has_the_textbook_figures_without_error():
    f = figures(trees_of([0.10, 0.20, 0.30, 0.40] * 5))
    v = f.values
    assert v["n_ha"] == (200.0, 0.0)
    basal = math.pi / 4 * (0.01 + 0.04 + 0.09 + 0.16) * 5
    assert v["g_ha"].value == pytest.approx(10.0 * basal)
    dg = 100.0 * math.sqrt(0.30 / 4)
    assert v["dg_cm"].value == pytest.approx(dg)
    assert v["mean_dbh_cm"].value == pytest.approx(25.0)
    # 100 per hectare are 10 trees here: five of 40 cm and five of 30 cm
    assert v["dominant_dbh_cm"].value == pytest.approx(100.0 * math.sqrt((0.16 + 0.09) / 2))
    assert v["sdi"].value == pytest.approx(200.0 * (dg / 25.4) ** 1.605)
    assert [v[name].se for name in ("g_ha", "dg_cm", "mean_dbh_cm", "dominant_dbh_cm", "sdi")] == [0.0] * 5
    assert f.warnings == ()


def test_stems_of_25_4_cm_have_their_number_as_density_index():
    assert figures(trees_of([0.254] * 30)).values["sdi"].value == pytest.approx(300.0)


def test_errors_of_diameters_reach_the_figures_as_by_propagation():
    d, sigma = np.array([0.15, 0.25, 0.35] * 4), 0.01
    v = figures(trees_of(d, sigma), limits=INDEPENDENT).values
    assert v["g_ha"].se == pytest.approx(10.0 * math.sqrt(np.square(math.pi / 2 * d * sigma).sum()), rel=1e-4)
    assert v["mean_dbh_cm"].se == pytest.approx(1.0 / math.sqrt(12), rel=1e-3)
    dg = math.sqrt(np.square(d).mean())
    assert v["dg_cm"].se == pytest.approx(100 * math.sqrt(np.square(d * sigma).sum()) / (12 * dg), rel=1e-3)
    assert v["n_ha"].se == pytest.approx(0.0, abs=1e-5)


def test_an_error_that_all_diameters_share_does_not_shrink_with_their_number():
    """Diameters drawn with their own and a shared error: the errors agree with the spread of the figures."""
    random = np.random.default_rng(4)
    true, shared, own = random.uniform(0.15, 0.45, 60), 0.006, 0.012
    names = ("g_ha", "v_ha", "dg_cm", "mean_dbh_cm", "sdi")
    found, told = [], []
    for _ in range(400):
        d = true + random.normal(0.0, shared) + random.normal(0.0, own, 60)
        volume = {
            "volume": 10.0 * np.square(d),
            "volume_sigma": 20.0 * d * math.hypot(own, shared),
            "volume_shared": 20.0 * d * shared,
        }
        trees = replace(trees_of(d, math.hypot(own, shared)), **volume)
        v = figures(trees, limits=Stand(count_error=0.0, dbh_shared_sigma=shared)).values
        found.append([v[name].value for name in names])
        told.append([v[name].se for name in names])
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(np.square(told), axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=0.12)
    many = figures(trees_of([0.3] * 400, 0.01), limits=Stand(count_error=0.0, dbh_shared_sigma=0.006)).values[
        "mean_dbh_cm"
    ]
    assert many.se == pytest.approx(math.sqrt(0.6**2 + (1.0 - 0.6**2) / 400))


def test_a_shared_error_moves_all_trees_across_the_minimum_diameter_together():
    random = np.random.default_rng(5)
    true, shared, own = random.uniform(0.05, 0.15, 300), 0.006, 0.008
    found, told = [], []
    for _ in range(400):
        d = true + random.normal(0.0, shared) + random.normal(0.0, own, 300)
        limits = Stand(count_error=0.0, dbh_shared_sigma=shared, dbh_min=0.1)
        n = figures(trees_of(d, math.hypot(own, shared)), limits=limits).values["n_ha"]
        found.append(n.value)
        told.append(n.se)
    assert np.std(found) == pytest.approx(np.sqrt(np.mean(np.square(told))), rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("shared", [0.0, 0.005])
def test_the_number_of_a_class_is_wrong_by_about_its_standard_error(shared):
    """Diameters of drawn stands are measured with errors. The true number of a class differs from the counted
    one by more than the stated error, because the stated one does not contain the mean shift of a tree near a
    limit; for evenly distributed diameters this is a factor of sqrt(sqrt(2)) = 1.19 at a single limit."""
    random = np.random.default_rng(6)
    wrong, told = [], []
    limits = Stand(count_error=0.0, dbh_min=0.08, dbh_shared_sigma=shared)
    for _ in range(150):
        true = random.uniform(0.02, 0.62, 150)
        sigma = np.hypot(random.uniform(0.013, 0.027, 150), shared)
        d = true + random.normal(0.0, shared) + random.normal(0.0, np.sqrt(sigma**2 - shared**2))
        trees = PlotTrees(trees_of(d).position, d, sigma)
        for each in figures(trees, area=1e4, limits=limits).classes:
            if 8.0 <= each.low < 56.0:
                inside = (100.0 * true >= each.low) & (100.0 * true < each.high)
                wrong.append(each.n_ha.value - np.count_nonzero(inside))
                told.append(each.n_ha.se)
    ratio = math.sqrt(np.mean(np.square(wrong)) / np.mean(np.square(told)))
    assert 1.0 < ratio < 1.35


def test_the_error_of_a_class_is_not_known_where_that_of_all_stems_is_not():
    d = np.linspace(0.18, 0.38, 40)
    assumed = figures(trees_of(d, 0.02), detection=(1.0, math.nan), limits=INDEPENDENT)
    assert math.isnan(assumed.values["n_ha"].se)
    assert all(math.isnan(c.n_ha.se) for c in assumed.classes)
    assert all(c.g_ha.se > 0.0 for c in assumed.classes if c.trees)
    corrected = figures(trees_of(d, 0.02), detection=(0.8, 0.05), limits=INDEPENDENT)
    assert all(math.isnan(c.n_ha.se) for c in corrected.classes)
    complete = figures(trees_of(d, 0.02))
    assert all(c.n_ha.se > 0.0 for c in complete.classes if c.trees)
    partly = figures(trees_of(d, 0.02), area=2000.0, seen=1000.0, detection=(0.8, 0.05))
    errors = [c.n_ha.se for c in partly.classes if c.trees]
    assert np.all(errors > 10.0 * np.sqrt([0.5 * c.trees for c in partly.classes if c.trees]))
    empty = figures(trees_of([0.2, 0.5], 0.001), area=2000.0, seen=1000.0).classes[6]
    assert (empty.trees, empty.n_ha.value) == (0, 0.0)
    assert math.isnan(empty.n_ha.se + empty.g_ha.se)
    complete = figures(trees_of([0.2, 0.5], 0.001), detection=(1.0, math.nan)).classes[6]
    assert math.isnan(complete.n_ha.se + complete.g_ha.se)
    gaps = compared_with_gaps(partly, trees_of([0.3] * 200), 1500.0, Stand())
    assert all(math.isnan(c.n_ha.se + c.g_ha.se) for c in gaps.classes)


def test_trees_below_the_minimum_diameter_may_belong_to_the_first_class():
    d = [0.3] * 10
    alone, beside = (figures(trees_of([*d, *thin], 0.01)).classes for thin in ([0.1], [0.1, 0.069]))
    assert beside[0].trees == alone[0].trees
    assert beside[0].n_ha.se > alone[0].n_ha.se + 1.0


def test_equal_diameters_do_not_inflate_the_error_of_the_dominant_one():
    dominant = figures(trees_of([0.2] * 40, 0.01), limits=INDEPENDENT).values["dominant_dbh_cm"]
    assert dominant == pytest.approx((20.0, 1.0 / math.sqrt(10)))


@pytest.mark.slow
def test_the_unseen_part_of_a_plot_has_a_sampling_error_like_that_of_drawn_stands():
    """Stands drawn at random, a quarter of the plot seen: the errors agree with the spread of the figures."""
    random = np.random.default_rng(1)
    errors, told = [], []
    for _ in range(400):
        d = random.uniform(0.1, 0.5, random.poisson(80))
        seen = random.random(len(d)) < 0.25
        v = figures(trees_of(d[seen]), seen=250.0, outside=trees_of(d[~seen])).values
        truth = 10.0 * math.pi / 4 * float(np.square(d).sum())
        assert v["n_ha_plain"].value == pytest.approx(10.0 * len(d))
        errors.append((v["n_ha"].value - 10.0 * len(d), v["g_ha"].value - truth))
        told.append((v["n_ha"].se, v["g_ha"].se))
    assert np.isnan(told).any(axis=1).sum() <= 4  # 1 of 740 is taken for a plot of unlike parts
    ratio = np.std(errors, axis=0) / np.sqrt(np.nanmean(np.square(told), axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=0.12)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 * np.std(errors, axis=0) / 20)


def test_more_trees_than_the_observed_part_lets_expect_make_the_errors_unknown():
    """11 trees in the observed 420 m^2 and 47 in the rest of 992 m^2 cannot be one stand."""
    outside = trees_of([0.3] * 47)
    f = figures(trees_of([0.3] * 11), area=992.0, seen=420.0, outside=outside)
    assert f.values["n_ha"].value == pytest.approx(1e4 * 11 / 420)
    for name in ("n_ha", "g_ha", "n_ha_corrected", "g_ha_corrected"):
        assert math.isnan(f.values[name].se)
    assert any("has 58 trees" in text and "leads to 26" in text for text in f.warnings)
    alike = figures(trees_of([0.3] * 24), area=992.0, seen=420.0, outside=trees_of([0.3] * 34))
    assert alike.values["n_ha"].se > 0.0
    assert not any("not like" in text for text in alike.warnings)


def test_a_whole_observed_area_whose_gaps_have_more_trees_has_no_known_errors():
    """11 trees on 388 m^2 and 48 in gaps of 512 m^2 are not one stand; as many as expected are."""
    whole = figures(trees_of([0.3] * 11), area=388.0, detection=(0.9, 0.02))
    compared = compared_with_gaps(whole, trees_of([0.3] * 48), 900.0, Stand())
    for name in ("n_ha", "g_ha", "n_ha_corrected", "g_ha_corrected"):
        assert math.isnan(compared.values[name].se)
        assert compared.values[name].value == whole.values[name].value
    assert any(
        "48 trees of the map stand in gaps" in text and "15 are expected" in text
        for text in compared.warnings
    )
    assert compared_with_gaps(whole, trees_of([0.3] * 15), 900.0, Stand()) is whole
    assert compared_with_gaps(whole, trees_of([0.01] * 48), 900.0, Stand()) is whole, "thinner than counted"


def test_drawn_stands_are_not_doubted_for_their_gaps():
    random, doubted = np.random.default_rng(3), 0
    for _ in range(400):
        seen = random.random(random.poisson(60)) < 0.6
        whole = figures(trees_of([0.3] * int(seen.sum())), area=600.0)
        gaps = trees_of([0.3] * int((~seen).sum()))
        doubted += compared_with_gaps(whole, gaps, 1000.0, Stand()) is not whole
    assert doubted <= 20  # 10 are expected, with a standard deviation of 3


def test_trees_that_people_add_in_the_part_out_of_sight_change_no_figure():
    outside = replace(trees_of([0.3] * 18), added=np.arange(18) >= 2)
    f = figures(trees_of([0.3] * 50), seen=900.0, outside=outside)
    of_map = figures(trees_of([0.3] * 50), seen=900.0, outside=trees_of([0.3] * 2))
    np.testing.assert_equal(dict(f.values), dict(of_map.values))
    assert f.values["n_ha"].se > 0.0
    assert f.warnings == ()


@pytest.mark.slow
def test_trees_that_are_not_detected_are_added_with_their_error():
    random = np.random.default_rng(2)
    errors, told = [], []
    for _ in range(400):
        found = trees_of([0.2] * random.binomial(100, 0.7))
        n = figures(found, detection=(0.7, 0.0)).values["n_ha_corrected"]
        errors.append(n.value - 1000.0)
        told.append(n.se)
    assert abs(np.mean(errors)) < 3 * np.std(errors) / 20
    assert np.std(errors) == pytest.approx(math.sqrt(np.mean(np.square(told))), rel=0.12)
    sure, unsure = (figures(trees_of([0.2] * 70), detection=(0.7, e)) for e in (0.0, 0.07))
    assert unsure.values["n_ha_corrected"].se > sure.values["n_ha_corrected"].se
    assert unsure.values["n_ha"] == sure.values["n_ha"]


def added_to(trees, dbh):
    """Trees of a map with those that a person added, in their order."""
    every = trees_of([*trees.dbh, *dbh])
    added = np.arange(len(every.dbh)) >= len(trees.dbh)
    return replace(every, dbh_sigma=np.concatenate([trees.dbh_sigma, np.zeros(len(dbh))]), added=added)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_a_tree_that_a_person_adds_is_one_of_those_that_the_map_lacks(share):
    """Stands drawn, of which 70 % are found and a share of the others is added: the corrected stems and basal
    area have no bias, and their errors agree with the spread."""
    random = np.random.default_rng(8)
    errors, told = [], []
    for _ in range(400):
        d = random.uniform(0.15, 0.45, 100)
        found, met = random.random(100) < 0.7, random.random(100) < share
        v = figures(added_to(trees_of(d[found]), d[~found & met]), detection=(0.7, 0.0)).values
        truth = 10.0 * math.pi / 4 * float(np.square(d).sum())
        errors.append((v["n_ha_corrected"].value - 1000.0, v["g_ha_corrected"].value - truth))
        told.append((v["n_ha_corrected"].se, v["g_ha_corrected"].se))
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 * np.std(errors, axis=0) / 20)
    ratio = np.std(errors, axis=0) / np.sqrt(np.mean(np.square(told), axis=0))
    assert ratio[0] == pytest.approx(1.0, abs=0.12)
    assert ratio[1] < 1.12  # what a person adds is known, so the error is at most that which is told


@given(
    st.lists(st.floats(0.08, 1.0) | st.just(math.nan), max_size=30),
    st.lists(st.floats(0.08, 1.0) | st.just(math.nan), max_size=30),
    st.floats(0.01, 1.0),
    st.floats(0.05, 1.0),
)
def test_an_added_tree_counts_once_and_without_correction(dbh, more, share, p):
    common: dict[str, Any] = {"seen": 1000.0 * share, "detection": (p, 0.1 * p)}
    before, after = (
        figures(trees, **common).values for trees in (trees_of(dbh), added_to(trees_of(dbh), more))
    )
    each = 1e4 / common["seen"]
    assert after["n_ha"].value == pytest.approx(each * (len(dbh) + len(more)))
    corrected = max(len(dbh) / p, len(dbh) + len(more))
    assert after["n_ha_corrected"].value == pytest.approx(each * corrected)
    for name in ("n_ha", "n_ha_corrected"):
        assert after[name].value >= before[name].value - 1e-6
        assert not after[name].se < 0.0
    for name in ("n_ha", "g_ha"):
        assert not after[f"{name}_corrected"].value < after[name].value * (1.0 - 1e-9)


def test_diameters_by_tape_share_no_error():
    mapped = trees_of([0.3] * 40, 0.005)
    taped = replace(mapped, by_tape=np.ones(40, np.bool_))
    limits = Stand(count_error=0.0, dbh_shared_sigma=0.005)
    for name in ("mean_dbh_cm", "dg_cm", "g_ha", "sdi"):
        before, after = (figures(trees, limits=limits).values[name] for trees in (mapped, taped))
        assert after.value == before.value
        assert after.se == pytest.approx(before.se / math.sqrt(40))
    near = [figures(replace(trees, dbh=np.full(40, 0.07)), limits=limits) for trees in (mapped, taped)]
    assert near[1].values["n_ha"].se < 0.5 * near[0].values["n_ha"].se


def test_an_error_that_a_plot_does_not_know_is_not_known_of_the_mean():
    """Half of the trees have no diameter: which half is not known, so the mean has the same bias."""
    known = figures(trees_of([0.1, 0.3] * 20))
    unknown = figures(trees_of([0.1, math.nan] * 20))
    assert math.isnan(unknown.values["g_ha"].se)
    assert math.isnan(combined({"a": known, "b": unknown})["g_ha"].se)
    assert math.isfinite(combined({"a": known, "b": unknown})["n_ha"].se)
    assert math.isfinite(combined({"a": known, "b": known})["g_ha"].se)


def test_a_plot_in_full_view_has_the_counting_error_in_each_figure_of_stems():
    wrong, exact = (
        figures(trees_of([0.1, 0.3] * 20), detection=(1.0, math.nan), limits=limits)
        for limits in (Stand(count_error=0.06), EXACT_COUNT)
    )
    for name in ("n_ha", "g_ha", "n_ha_corrected", "g_ha_corrected", "sdi"):
        assert wrong.values[name].se == pytest.approx(0.06 * wrong.values[name].value), name
    for name in ("dg_cm", "mean_dbh_cm", "dominant_dbh_cm", "nearest_neighbour_m", "clark_evans"):
        np.testing.assert_equal(wrong.values[name], exact.values[name])
    assert [c.n_ha.se for c in wrong.classes if c.trees] == pytest.approx([MISSED * 200.0] * 2)
    with_view = figures(trees_of([0.2] * 40), seen=900.0, limits=Stand(count_error=0.06)).values["n_ha"]
    without = figures(trees_of([0.2] * 40), seen=900.0).values["n_ha"]
    assert with_view.se == pytest.approx(math.hypot(without.se, 0.06 * with_view.value))


def test_trees_that_people_confirmed_measured_or_added_are_not_false():
    trees, limits = trees_of([0.2] * 40), Stand(count_error=0.06)
    half = np.arange(40) < 20
    for stated in ("confirmed", "by_tape", "added"):
        f = figures(replace(trees, **{stated: half}), limits=limits)
        assert f.values["n_ha"].se == pytest.approx(10.0 * (20 * 0.06 + 20 * 0.01)), stated
    every = figures(replace(trees, confirmed=np.ones(40, np.bool_)), limits=limits)
    assert every.values["n_ha"].se == pytest.approx(10.0 * 40 * 0.01)


@pytest.mark.slow
def test_the_counting_error_of_all_plots_does_not_decrease_with_their_number():
    """Maps drawn with a share of false trees that all of their plots have."""
    random = np.random.default_rng(3)
    errors, told = [], []
    for _ in range(200):
        false = 1.0 + random.normal(0.0, 0.06)
        counts = np.round(false * 200.0 * random.normal(1.0, 0.1, 9)).astype(int)
        plots = {str(k): figures(trees_of([0.2] * n), limits=Stand()) for k, n in enumerate(counts)}
        mean = combined(plots)["n_ha"]
        errors.append(mean.value - 2000.0)
        told.append(mean.se)
    assert np.std(errors) == pytest.approx(math.sqrt(np.mean(np.square(told))), rel=0.12)


def test_thin_trees_do_not_count_and_those_without_a_diameter_have_the_mean():
    f = figures(trees_of([0.05, 0.2, 0.2, math.nan] * 3))
    assert (f.trees, f.without_dbh) == (9, 3)
    assert f.values["g_ha"].value == pytest.approx(10.0 * 9 * math.pi / 4 * 0.04)
    assert f.values["n_ha"].value == pytest.approx(90.0)
    assert any("3 of 9 trees have no diameter" in text for text in f.warnings)
    assert figures(trees_of([0.05]), limits=Stand(dbh_min=0.04)).trees == 1


def test_a_tree_near_the_minimum_diameter_makes_the_number_uncertain():
    at_limit = figures(trees_of([0.07] + [0.3] * 11, 0.01)).values["n_ha"]
    assert at_limit.se == pytest.approx(10.0 * 0.5, rel=1e-6)


def test_classes_cover_all_trees_once():
    f = figures(trees_of([0.07, 0.08, 0.12, 0.1199, 0.20, 0.31]))
    assert [c[:2] for c in f.classes[:2]] == [(7.0, 8.0), (8.0, 12.0)]
    assert [c.trees for c in f.classes] == [1, 2, 1, 0, 1, 0, 1]
    assert sum(c.n_ha.value for c in f.classes) == pytest.approx(f.values["n_ha"].value)
    assert sum(c.g_ha.value for c in f.classes) == pytest.approx(f.values["g_ha"].value)


def test_clark_evans_tells_a_grid_from_random_and_clustered_stems():
    random = np.random.default_rng(3)
    side = 100.0

    def index(position):
        trees = trees_of([0.2] * len(position), position=position)
        return figures(trees, area=side**2, perimeter=4 * side).values["clark_evans"]

    grid = np.stack(np.meshgrid(np.arange(5, 100, 10.0), np.arange(5, 100, 10.0)), axis=-1).reshape(-1, 2)
    drawn = [index(random.uniform(0, side, (100, 2))) for _ in range(200)]
    centres = random.uniform(0, side, (10, 2))
    clustered = np.clip(np.repeat(centres, 10, axis=0) + random.normal(0, 2, (100, 2)), 0, side)
    values = np.array([i.value for i in drawn])
    assert values.mean() == pytest.approx(1.0, abs=0.02)
    assert values.std() == pytest.approx(drawn[0].se, rel=0.15)
    assert index(grid).value > 1.8
    assert index(clustered).value < 0.6
    f = figures(trees_of([0.2] * 100, position=grid), area=side**2, perimeter=4 * side)
    assert f.values["nearest_neighbour_m"] == pytest.approx((10.0, 0.0))


@pytest.mark.parametrize(
    ("trees", "seen", "text"),
    [
        ([], 1000.0, "no trees"),
        ([0.2] * 9, 1000.0, "only 9 trees"),
        ([], 0.0, "observed"),
        ([0.2], 100.0, "10 %"),
    ],
)
def test_what_the_figures_cannot_rest_on_is_a_warning(trees, seen, text):
    f = figures(trees_of(trees), seen=seen)
    assert any(text in warning for warning in f.warnings)
    assert not any(math.isinf(x) for value in f.values.values() for x in value)


def test_a_plot_without_area_is_refused():
    with pytest.raises(ValueError, match="no area"):
        figures(trees_of([0.2]), area=0.0)


@given(
    st.lists(st.floats(0.05, 1.0) | st.just(math.nan), max_size=30),
    st.floats(0.01, 1.0),
    st.floats(0.05, 1.0),
    st.floats(0.0, 0.05),
)
def test_figures_are_finite_or_unknown_and_errors_are_not_negative(dbh, share, p, sigma):
    f = figures(trees_of(dbh, sigma), seen=1000.0 * share, detection=(p, 0.1 * p))
    for value, se in f.values.values():
        assert not math.isinf(value)
        assert not se < 0.0
    assert sum(c.trees for c in f.classes) + f.without_dbh == f.trees or not f.classes


def test_plots_together_have_their_weighted_mean_and_the_error_between_them():
    plots = {
        name: figures(trees_of([0.2] * n), area=area)
        for name, n, area in (("a", 20, 1000.0), ("b", 30, 1000.0), ("c", 25, 1000.0))
    }
    n = combined(plots)["n_ha"]
    assert n.value == pytest.approx(250.0)
    assert n.se == pytest.approx(50.0 / math.sqrt(3))
    unequal = combined({"a": plots["a"], "b": figures(trees_of([0.2] * 90), area=3000.0)})["n_ha"]
    assert unequal.value == pytest.approx(1e4 * 110 / 4000)
    assert math.isnan(combined({"a": plots["a"]})["n_ha"].se)


def test_the_error_of_the_mean_of_plots_that_are_alike_is_that_of_the_plots():
    plots = {name: figures(trees_of([0.2] * 20, 0.02), limits=INDEPENDENT) for name in "ab"}
    own, mean = plots["a"].values["g_ha"], combined(plots)["g_ha"]
    assert mean.value == pytest.approx(own.value)
    assert mean.se == pytest.approx(own.se / math.sqrt(2))


def test_trees_without_a_volume_have_the_mean_one_by_basal_area():
    trees = trees_of([0.2] * 12)
    volume = np.array([0.5] * 9 + [np.nan] * 3)
    with_volume = replace(trees, volume=volume, volume_sigma=np.where(np.isfinite(volume), 0.03, np.nan))
    f = figures(with_volume, area=1000.0)
    assert f.with_volume == 9
    assert f.values["v_ha"] == (pytest.approx(60.0), pytest.approx(10.0 * 0.03 * 3.0 * 12 / 9))
    assert f.values["v_ha_corrected"].value == pytest.approx(60.0)
    assert any("volume of 9 of 12 trees" in text for text in f.warnings)
    half = figures(with_volume, area=1000.0, seen=500.0, detection=(0.5, 0.0))
    assert half.values["v_ha"].value == pytest.approx(120.0)
    assert half.values["v_ha_corrected"].value == pytest.approx(240.0)
    empty = figures(with_volume.where(np.zeros(12, np.bool_)), area=1000.0)
    assert empty.values["v_ha"] == (0.0, 0.0)
    assert combined({"a": f, "b": empty})["v_ha"].value == pytest.approx(30.0)
    assert figures(trees).with_volume is None
    assert math.isnan(figures(trees).values["v_ha"].value)


@pytest.mark.slow
def test_the_error_of_volumes_is_that_of_stands_of_which_some_heights_are_seen():
    random = np.random.default_rng(6)
    errors, told = [], []
    for _ in range(400):
        d = random.uniform(0.15, 0.45, 30)
        true = 9.0 * np.square(d) * random.normal(1.0, 0.2, 30)
        sigma = np.full(30, 0.02)
        volume = np.where(random.random(30) < 0.5, true + random.normal(0.0, sigma), np.nan)
        v = figures(replace(trees_of(d), volume=volume, volume_sigma=sigma)).values["v_ha"]
        errors.append(v.value - 10.0 * true.sum())
        told.append(v.se)
    assert abs(np.mean(errors)) < 3 * np.std(errors) / 20
    assert np.std(errors) == pytest.approx(math.sqrt(np.mean(np.square(told))), rel=0.12)


def with_heights(trees, height, sigma):
    return replace(trees, height=np.array(height), height_sigma=np.where(np.isfinite(height), sigma, np.nan))


def test_mean_heights_are_those_of_the_textbook():
    d, height = [0.1, 0.2, 0.3] * 4, [10.0, 20.0, 25.0] * 4
    f = figures(with_heights(trees_of(d), height, 0.5), limits=INDEPENDENT)
    assert f.values["mean_height_m"] == pytest.approx((55.0 / 3, 0.5 / math.sqrt(12)))
    lorey = (0.01 * 10.0 + 0.04 * 20.0 + 0.09 * 25.0) / 0.14
    weight = np.array([0.01, 0.04, 0.09] * 4) / 0.56
    assert f.values["lorey_height_m"] == pytest.approx((lorey, 0.5 * math.sqrt(np.square(weight).sum())))
    assert (f.with_height, f.warnings) == (12, ())
    unknown = figures(trees_of(d))
    assert all(math.isnan(unknown.values[name].value) for name in ("mean_height_m", "lorey_height_m"))
    assert unknown.warnings == ()
    assert combined({"a": f, "b": unknown})["mean_height_m"].value == pytest.approx(55.0 / 3)


@pytest.mark.slow
def test_heights_of_a_part_of_the_trees_are_a_sample_of_all():
    """Stands of which 42 of 50 heights are known, with errors of heights and diameters."""
    random = np.random.default_rng(8)
    names, errors, told = ("mean_height_m", "lorey_height_m"), [], []
    for _ in range(200):
        d = random.lognormal(math.log(0.3), 0.3, 50)
        height = 30.0 * (1.0 - np.exp(-5.0 * d)) + random.normal(0.0, 2.0, 50)
        seen = np.where(random.permutation(50) < 42, height + random.normal(0.0, 0.8, 50), np.nan)
        measured = with_heights(trees_of(d + random.normal(0.0, 0.02, 50), 0.02), seen, 0.8)
        v = figures(measured, limits=INDEPENDENT).values
        whole = figures(with_heights(trees_of(d), height, 0.0), limits=INDEPENDENT).values
        errors.append([v[name].value - whole[name].value for name in names])
        told.append([v[name].se for name in names])
    ratio = np.std(errors, axis=0) / np.sqrt(np.square(told).mean(axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_few_heights_are_a_warning_with_their_number_and_have_no_error():
    for missing, is_known in ((10, True), (11, False)):
        height = np.where(np.arange(50) < missing, np.nan, 20.0)
        f = figures(with_heights(trees_of([0.3] * 50), height, 0.5))
        (text,) = f.warnings
        assert f"mean heights are those of {50 - missing} of 50 trees" in text
        assert ("errors are not known" in text) != is_known
        assert f.values["lorey_height_m"].value == pytest.approx(20.0)
        assert math.isfinite(f.values["lorey_height_m"].se) == is_known


def test_lorey_needs_heights_and_diameters_of_the_same_trees():
    """Of the trees, 14 % have no height and 14 % others no diameter: 28 % lack a measurement for it."""
    dbh = np.where(np.arange(50) < 7, np.nan, 0.3)
    height = np.where((np.arange(50) >= 7) & (np.arange(50) < 14), np.nan, 20.0)
    values = figures(with_heights(trees_of(dbh), height, 0.5)).values
    assert math.isfinite(values["mean_height_m"].se)
    assert math.isnan(values["lorey_height_m"].se)


def test_plain_figures_of_several_plots_refer_to_their_whole_area():
    inside = PlotTrees(np.array([[1.0, 1.0], [4.0, 4.0]]), np.full(2, 0.2), np.full(2, 0.01))
    nothing = inside.where(np.zeros(2, np.bool_))
    common: dict[str, Any] = {"perimeter": 40.0, "detection": (1.0, 0.0), "parameters": Stand()}
    plots = {
        "seen": stand_figures(inside, nothing, area=100.0, seen=100.0, **common),
        "partly": stand_figures(nothing, inside, area=300.0, seen=100.0, **common),
    }
    assert combined(plots)["n_ha_plain"].value == pytest.approx(1e4 * 4 / 400.0)
    assert combined(plots)["n_ha"].value == pytest.approx(1e4 * 2 / 200.0)


def test_a_plot_that_was_not_observed_is_no_area_without_trees():
    trees = trees_of([0.2] * 20)
    alone, hidden = figures(trees), figures(trees.where(np.zeros(20, np.bool_)), seen=0.0)
    assert all(math.isnan(value) for value, _ in hidden.values.values())
    means = combined({"alone": alone, "hidden": hidden})
    for name, (value, _) in alone.values.items():
        assert means[name].value == pytest.approx(value, nan_ok=True), name


def test_an_error_of_0_is_not_known_while_detection_is_assumed():
    trees = trees_of([0.2] * 20)
    f = figures(trees, detection=(1.0, math.nan))
    assert f.values["n_ha"].value == f.values["n_ha_corrected"].value == 200.0
    assert math.isnan(f.values["n_ha"].se)
    assert math.isnan(f.values["n_ha_corrected"].se)
    assert all(math.isnan(c.n_ha.se) for c in f.classes)
    half = figures(trees, seen=500.0, detection=(1.0, math.nan))
    assert half.values["n_ha"] == figures(trees, seen=500.0).values["n_ha"]
    unsure = figures(trees_of([0.2] * 20, [0.01] * 20), detection=(1.0, math.nan))
    assert unsure.values["g_ha"].se > 0.0


@pytest.mark.slow
def test_trees_without_a_diameter_are_drawn_from_the_others():
    """Stands of which 8 of 50 trees are not measured: errors of the basal area and of mean diameters."""
    random = np.random.default_rng(8)
    names, errors, told = ("g_ha", "dg_cm", "mean_dbh_cm"), [], []
    for _ in range(400):
        d = random.lognormal(math.log(0.3), 0.3, 50)
        known = np.where(random.permutation(50) < 42, d, np.nan)
        v, whole = (figures(trees_of(each), limits=INDEPENDENT).values for each in (known, d))
        errors.append([v[name].value - whole[name].value for name in names])
        told.append([v[name].se for name in names])
    ratio = np.std(errors, axis=0) / np.sqrt(np.square(told).mean(axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=0.12)


def test_errors_are_not_known_where_many_trees_have_no_diameter():
    d = np.full(50, 0.3)
    for missing, is_known in ((10, True), (11, False)):
        f = figures(trees_of(np.where(np.arange(50) < missing, np.nan, d), 0.01))
        assert np.isfinite([f.values[name].se for name in ("g_ha", "dg_cm", "sdi")]).all() == is_known
        assert any("more than a fifth" in text for text in f.warnings) != is_known
        assert f.values["g_ha"].value == pytest.approx(50 * 10.0 * math.pi / 4 * 0.09)


@pytest.mark.slow
def test_the_thickest_trees_are_those_of_all_of_which_some_are_measured():
    random, errors = np.random.default_rng(9), []
    for _ in range(200):
        d = random.lognormal(math.log(0.3), 0.3, 80)
        known = np.where(random.random(80) < 0.5, d, np.nan)
        of_part, of_all = (
            figures(trees_of(each), area=1000.0).values["dominant_dbh_cm"].value for each in (known, d)
        )
        errors.append(of_part - of_all)
    assert np.mean(errors) == pytest.approx(0.0, abs=1.0)  # 10 of 80 trees, so 5 of 40
