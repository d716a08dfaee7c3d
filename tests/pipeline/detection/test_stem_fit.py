"""Fit of a leaning cylinder to the visible arc of a trunk: exact without noise, with consistent covariances
with noise, and usable results for degenerate clusters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.config import preset
from pipeline.detection.cluster_shape import describe
from pipeline.detection.cylinder_fit import BEAM, angular_width, fit_one, fit_stems
from pipeline.types.records import Labels, Sensor
from tests.pipeline.strategies import SENSOR, arc, one_cluster

FOREST = preset("forest").shape
PAPER = preset("paper").shape
SHARP = replace(SENSOR, range_sigma=0.001)


def fit(points, sensor=SENSOR):
    """The described cluster that all points are."""
    return describe(points.astype(np.float32), one_cluster(points), sensor, FOREST)


@given(
    st.floats(0.05, 0.5),
    st.floats(1.0, 1.5),
    st.floats(2.0, 10.0),
    st.floats(-3.1, 3.1),
    st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06)),
)
def test_an_arc_without_noise_gives_its_circle(radius, half_angle, distance, bearing, lean):
    # A trunk hides what lies beyond, and beams are not as thin as the rays of this arc: far from thin trunks
    # and near to edges that tells.
    distance = min(distance, 0.15 * radius / BEAM)
    edge = np.arcsin(1.0 - BEAM * distance / radius)
    half_angle = min(half_angle, np.arccos(radius / distance) - 0.02, edge)
    told = fit(arc(radius, half_angle, distance=distance, bearing=bearing, lean=lean), SHARP)
    true = np.array([distance * np.cos(bearing), distance * np.sin(bearing)])
    assert np.hypot(*(told.centre[0] - true)) < 4e-3
    assert told.radius[0] == pytest.approx(radius, abs=4e-3)
    assert told.radial_std[0] < 1e-3
    assert told.arc[0] == pytest.approx(2 * half_angle, abs=0.1)


def cast(rng, *, radius, distance, sigma, rows=5):
    """What a LiDAR with beams every 0.2 degrees sees of a trunk, and the trunk's centre."""
    bearing = rng.uniform(-np.pi, np.pi)
    centre = distance * np.array([np.cos(bearing), np.sin(bearing)])
    half = np.arcsin(radius / distance)
    azimuth = bearing + np.arange(rng.uniform(0, SENSOR.azimuth_step) - half, half, SENSOR.azimuth_step)
    ray = np.tile(np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1), (rows, 1))
    foot = ray @ centre
    reach = foot - np.sqrt(np.maximum(foot**2 - distance**2 + radius**2, 0.0))
    flat = ray * (reach + rng.normal(0, sigma, len(reach)))[:, None]
    return np.column_stack([flat, np.repeat(np.linspace(0, 0.6, rows), len(azimuth))]), centre


@pytest.mark.parametrize("radius", [0.1, 0.15, 0.25])
@pytest.mark.parametrize("distance", [3.0, 5.0, 8.0])
def test_the_covariance_bounds_the_error_of_the_fit(radius, distance):
    """An exact covariance gives a mean NEES of 2 (two degrees of freedom). The model adds the roughness of
    bark and the width of the beam, which this trunk lacks; so the mean NEES of 150 fits is 0.44 to 1.17."""
    rng = np.random.default_rng(6)
    nees, bias, z_radius = [], [], []
    for _ in range(150):
        points, true = cast(rng, radius=radius, distance=distance, sigma=0.02)
        told = fit(points)
        error = told.centre[0] - true
        nees.append(error @ np.linalg.solve(told.covariance[0], error))
        bias.append(error @ true / distance)
        z_radius.append((told.radius[0] - radius) / told.radius_sigma[0])
    assert 0.4 < np.mean(nees) < 1.3, np.mean(nees)
    assert abs(np.mean(bias)) < (0.004 if distance < 4.0 else 0.008), np.mean(bias)
    assert abs(np.mean(z_radius)) < 0.35, np.mean(z_radius)
    assert 0.4 < np.std(z_radius) < 1.0, np.std(z_radius)


@pytest.mark.parametrize("distance", [2.0, 5.0, 10.0])
def test_centre_and_diameter_are_as_good_as_was_measured_beforehand(distance):
    rng = np.random.default_rng(2)
    sensor = replace(SENSOR, range_sigma=0.025)
    centre, diameter = [], []
    for _ in range(60):
        radius = rng.uniform(0.08, 0.25)
        points, true = cast(rng, radius=radius, distance=distance, sigma=0.025, rows=3)
        told = fit(points, sensor)
        centre.append(np.hypot(*(told.centre[0] - true)))
        diameter.append(2 * (told.radius[0] - radius))
    assert np.sqrt(np.mean(np.square(centre))) < 0.04
    assert np.sqrt(np.mean(np.square(diameter))) < 0.05


def test_the_centroid_lies_before_the_centre_and_the_circle_does_not():
    points = arc(0.2, np.pi / 2, distance=5.0)
    centroid = describe(points.astype(np.float32), one_cluster(points), SENSOR, PAPER)
    assert 5.0 - centroid.centre[0, 0] == pytest.approx(0.2 * 2 / np.pi, abs=4e-3)  # evenly, ends counted
    assert abs(5.0 - fit(points, SHARP).centre[0, 0]) < 5e-3


@pytest.mark.parametrize("radius", [0.1, 0.15, 0.25])
@pytest.mark.parametrize("distance", [3.0, 6.0])
def test_a_mixed_pixel_at_each_edge_does_not_wreck_the_fit(radius, distance):
    """At an edge a beam is split, and its range lies anywhere between the trunk and what is behind."""
    centre_error, radius_error = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        points, true = cast(rng, radius=radius, distance=distance, sigma=0.02)
        bearing, half = np.arctan2(true[1], true[0]), np.arcsin(radius / distance)
        edges = np.concatenate([np.full(5, bearing - half), np.full(5, bearing + half)])
        reach = distance * np.cos(half) + rng.uniform(0.02, 0.3, 10)
        mixed = np.stack([reach * np.cos(edges), reach * np.sin(edges), np.tile(np.unique(points[:, 2]), 2)])
        told = fit(np.concatenate([points, mixed.T]))
        centre_error.append(np.hypot(*(told.centre[0] - true)))
        radius_error.append(told.radius[0] - radius)
    assert np.mean(centre_error) < 0.03, np.mean(centre_error)
    assert abs(np.mean(radius_error)) < 0.025, np.mean(radius_error)


@pytest.mark.parametrize("radius", [0.08, 0.15])
@pytest.mark.parametrize("distance", [3.0, 5.0])
def test_a_branch_beside_the_trunk_does_not_make_it_wide(radius, distance):
    """A branch leaves the trunk sideways and towards the sensor; a wide circle would fit both."""
    radius_error = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points, true = cast(rng, radius=radius, distance=distance, sigma=0.02)
        ahead = true / distance
        left = np.array([-ahead[1], ahead[0]])
        out = rng.uniform(radius, radius + 0.2, len(points) // 5)
        branch = true + out[:, None] * (left - 0.2 * ahead) + rng.normal(0, 0.01, (len(out), 2))
        branch = np.column_stack([branch, rng.uniform(0.3, 0.4, len(out))])
        radius_error.append(fit(np.concatenate([points, branch])).radius[0] - radius)
    assert abs(np.median(radius_error)) < 0.04, np.median(radius_error)


@pytest.mark.parametrize("distance", [3.0, 5.0])
def test_half_a_trunk_is_less_certain_than_all_of_it(distance):
    """What hides one side hides the width too: sigma must grow with the error that comes of it."""
    z, sigma = [], []
    for seed in range(60):
        points, true = cast(np.random.default_rng(seed), radius=0.15, distance=distance, sigma=0.02)
        seen = true[0] * points[:, 1] - true[1] * points[:, 0] < 0.0
        told, whole = fit(points[seen]), fit(points)
        z.append((told.radius[0] - 0.15) / told.radius_sigma[0])
        sigma.append(told.radius_sigma[0] / whole.radius_sigma[0])
    assert np.median(sigma) > 2.0, np.median(sigma)
    assert abs(np.mean(z)) < 1.8, np.mean(z)
    assert np.std(z) < 1.8, np.std(z)


def test_neighbours_do_not_disturb_one_another():
    parts = [
        arc(0.1, 1.2, distance=3.0),
        arc(0.2, 1.2, distance=5.0, bearing=1.0),
        arc(0.3, 1.0, bearing=2.0),
    ]
    points = np.concatenate(parts).astype(np.float32)
    label = np.repeat(np.arange(3, dtype=np.int32), [len(part) for part in parts])
    rows = np.random.default_rng(0).permutation(len(points))
    together = describe(points[rows], Labels(label[rows], 3, np.zeros(3, np.bool_)), SENSOR, FOREST)
    for k, part in enumerate(parts):
        np.testing.assert_allclose(together.centre[k], fit(part).centre[0], atol=1e-4)


@given(st.floats(-3.1, 3.1))
def test_turning_the_scan_turns_the_answer(turn):
    points = arc(0.18, 1.1, distance=6.0)
    c, s = np.cos(turn), np.sin(turn)
    C = np.array([[c, -s], [s, c]])
    one, other = fit(points), fit(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    np.testing.assert_allclose(other.centre[0], C @ one.centre[0], atol=1e-4)
    np.testing.assert_allclose(other.covariance[0], C @ one.covariance[0] @ C.T, rtol=1e-2, atol=1e-7)
    assert other.radius[0] == pytest.approx(one.radius[0], abs=1e-4)


# --- what is no trunk ----------------------------------------------------------------------------


def assert_usable(told):
    """A centre and a covariance that SLAM can take."""
    assert np.all(np.isfinite(told.centre))
    assert np.all(np.isfinite(told.covariance))
    for P in told.covariance:
        assert np.all(np.linalg.eigvalsh(P) > 0)
        assert P[0, 1] == P[1, 0]
    assert np.all(np.isfinite(told.radial_std))
    assert np.all((told.arc >= 0) & (told.arc <= 2 * np.pi))
    assert np.all(told.eccentricity >= 1)
    fitted = np.isfinite(told.radius_sigma)
    assert np.all(told.radius[fitted] > 0)


RUBBISH = {
    "all equal": np.tile([3.0, 1.0, 0.5], (30, 1)),
    "all at the sensor": np.zeros((30, 3)),
    "a plank along the ray": np.stack([np.linspace(2, 5, 40), np.zeros(40), np.zeros(40)], axis=1),
    "a wall across the ray": np.stack([np.full(40, 5.0), np.linspace(-2, 2, 40), np.zeros(40)], axis=1),
    "a wire upwards": np.stack([np.full(40, 5.0), np.zeros(40), np.linspace(0, 2, 40)], axis=1),
    "all around the sensor": arc(2.0, 3.1, distance=0.0),
    "two far ends": np.repeat([[3.0, 0, 0], [60.0, 60, 3]], 5, axis=0),
    "a whole wood": np.random.default_rng(0).normal(size=(60_000, 3)) * 30,
    "far away": arc(0.1, 1.0, distance=240.0, n=5, rows=1),
}


@pytest.mark.parametrize("name", RUBBISH)
def test_rubbish_gives_a_usable_answer(name):
    points = RUBBISH[name]
    for shape in (FOREST, PAPER):
        for sensor in (SENSOR, Sensor(), Sensor(range_sigma=0.2)):
            assert_usable(describe(points.astype(np.float32), one_cluster(points), sensor, shape))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("distance", [0.6, 3.0, 40.0])
def test_a_few_beams_have_a_centre_and_no_circle(n, distance):
    points = arc(0.1, 0.8, distance=distance, rows=1, n=n)
    told = fit(points)
    assert_usable(told)
    assert np.isnan(told.radius_sigma[0])
    assert np.hypot(*told.centre[0]) > np.hypot(points[:, 0], points[:, 1]).mean()


def test_where_no_circle_was_fitted_there_is_no_radius():
    assert np.isnan(fit(arc(0.1, 0.8, rows=1, n=4)).radius[0])
    assert np.isfinite(fit(arc(0.1, 0.8, rows=1, n=5)).radius[0])


@given(arrays.arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-50, 50)))
def test_no_cluster_at_all_breaks_the_fit(points):
    told = fit(points)
    assert_usable(told)


def test_a_sensor_without_noise_does_not_break_the_fit():
    assert_usable(fit(arc(0.15, 1.0), Sensor(range_sigma=0.0)))


def test_fitting_leaves_the_points_alone():
    points = arc(0.15, 1.0)
    before = points.copy()
    fit_stems(points, np.array([0, len(points)]), 0.02, 0.0035, np.zeros(1))
    np.testing.assert_array_equal(points, before)


def test_the_centre_is_that_of_the_leaning_axis_at_the_height_asked_for():
    """The axis of a stem seen from 1.5 to 3 m is extrapolated to breast height, where it is less certain."""
    lean, radius, breast = np.array([0.03, 0.1]), 0.15, 1.3
    angle, height = np.meshgrid(np.radians(np.linspace(100.0, 260.0, 30)), np.linspace(1.5, 3.0, 16))
    axis = np.array([5.0, 0.0]) + lean * (height.ravel()[:, None] - breast)
    around = radius * np.stack([np.cos(angle.ravel()), np.sin(angle.ravel())], axis=1)
    points, bounds = np.column_stack([axis + around, height.ravel()]), np.array([0, angle.size])
    lift = np.array([breast - height.mean()])
    at_mean, at_breast = (fit_stems(points, bounds, 0.02, 0.0035, a)[0] for a in (np.zeros(1), lift))
    np.testing.assert_allclose(at_breast[:2], [5.0, 0.0], atol=0.01)
    np.testing.assert_allclose(at_breast[:2] - at_mean[:2], lift * at_mean[9:11], atol=1e-12)
    assert at_breast[2] > at_mean[2]
    assert at_breast[4] > at_mean[4]
    np.testing.assert_array_equal(at_breast[5:], at_mean[5:])


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.1, np.pi))
def test_the_angular_width_is_the_spread_about_the_mean_direction(seed, count, spread):
    """Also if returns are behind the sensor, seen along the mean direction."""
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi) + rng.uniform(-spread, spread, count)
    reach = rng.uniform(1.0, 2.0, count)
    ray = np.exp(1j * bearing)
    middle = np.angle(reach @ ray)
    turn = np.angle(ray * np.exp(-1j * middle))
    assume(abs(reach @ ray) > 1e-3)
    assume(np.abs(turn).max() < np.pi - 1e-6)
    found = angular_width(np.vstack([ray.real, ray.imag, reach, np.zeros(count)]), count)
    np.testing.assert_allclose(found, [middle + (turn.max() + turn.min()) / 2, np.ptp(turn)], atol=1e-6)


@pytest.mark.parametrize("radius", [0.05, 0.08, 0.2])
@pytest.mark.parametrize("away", [5.0, 8.0])
def test_a_coarse_sensor_makes_no_stem_much_thicker_than_it_is_seen(radius: float, away: float):
    """Returns of a LiDAR without rings, a degree apart, all over the visible side of a stem."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(20):
        count = max(round(2.0 * radius * 2.5 / (0.0183 * away) ** 2), 8)
        across = rng.uniform(-radius, radius, count)
        depth = away - np.sqrt(radius**2 - across**2) + rng.normal(0.0, 0.02, count)
        points = np.stack([depth, across * depth / away, rng.uniform(-0.5, 2.0, count)], axis=1)
        fit = fit_one(points, Sensor(azimuth_step=0.0183, ring_step=0.0183))
        assert fit is not None
        errors.append(2.0 * (fit.radius - radius))
    assert abs(float(np.median(errors))) < 0.05
