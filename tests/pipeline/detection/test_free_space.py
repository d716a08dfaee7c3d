"""Free space of a scan: directions and distances in which a missing tree would have been visible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.detection.free_space import BEHIND, BINS, DENSE, FIELD, clear_range, seen_range
from pipeline.geometry.azimuth_bins import direction_bin
from tests.pipeline.strategies import seeds

AROUND = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
POSE = np.array([1.0, 2.0, 0.5])


def circle(radius, angles=AROUND):
    """Points around the sensor, float32, shape (N, 3)."""
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles], axis=1).astype(np.float32)


def free_at(bearing, reach, raw, filtered):
    """Whether a tree at a distance in a direction of the base would have been visible."""
    free = clear_range(raw, filtered, np.zeros(3))
    return bool(free[direction_bin(np.cos(bearing), np.sin(bearing), BINS)] > reach + BEHIND)


def test_open_ground_is_free():
    raw = circle(20.0)
    nothing = np.zeros((0, 3), np.float32)
    assert free_at(0.3, 10.0, raw, nothing)


@pytest.mark.parametrize("bearing", [0.0, 1.2, np.pi, -np.pi / 2, -3.1])
def test_behind_a_trunk_nothing_is_free_and_beside_it_all_is(bearing):
    raw = circle(20.0)
    trunk = circle(5.0, bearing + np.linspace(-0.03, 0.03, 12))
    assert free_at(bearing, 3.9, raw, trunk)
    assert not free_at(bearing, 4.5, raw, trunk), "what stands so near behind proves nothing"
    assert not free_at(bearing, 8.0, raw, trunk)
    assert free_at(bearing + 0.3, 8.0, raw, trunk)


def test_where_the_sensor_does_not_look_nothing_is_free():
    ahead = circle(20.0, np.linspace(-0.6, 0.6, 300))
    nothing = np.zeros((0, 3), np.float32)
    assert free_at(0.0, 5.0, ahead, nothing)
    assert not free_at(1.5, 5.0, ahead, nothing)
    assert not free_at(np.pi, 5.0, ahead, nothing)


def test_beyond_the_edge_of_the_field_of_view_nothing_is_free():
    half = np.radians(35.0)
    ahead = circle(20.0, np.linspace(-half, half, 300))
    nothing = np.zeros((0, 3), np.float32)
    for side in (-1.0, 1.0):
        assert free_at(side * (half - 0.03), 5.0, ahead, nothing)
        assert not free_at(side * (half + 0.05), 5.0, ahead, nothing), "no beam went there"


def test_sparse_returns_do_not_show_the_edges_of_the_field_of_view():
    half = np.radians(35.0)
    sparse = circle(20.0, np.linspace(-half, half, 15))
    assert free_at(half + 0.05, 5.0, sparse, np.zeros((0, 3), np.float32))


def test_a_gap_between_returns_is_inside_the_field_of_view():
    gap = np.radians(0.5 * FIELD)
    around = np.concatenate([np.linspace(-0.6, -0.5 * gap, 200), np.linspace(0.5 * gap, 0.6, 200)])
    assert free_at(0.0, 5.0, circle(20.0, around), np.zeros((0, 3), np.float32))


def test_an_empty_scan_frees_nothing():
    nothing = np.zeros((0, 3), np.float32)
    np.testing.assert_array_equal(clear_range(nothing, nothing, np.zeros(3)), np.zeros(BINS))


def test_distances_count_from_the_base_and_not_from_the_sensor():
    raw = circle(20.0)
    trunk = circle(5.0, np.linspace(-0.02, 0.02, 9))
    free = clear_range(raw, trunk, np.array([2.0, 0.0, 0.8]))
    assert np.min(free) == pytest.approx(7.0, abs=0.01)


@given(st.floats(-np.pi, np.pi), st.floats(0.01, 100.0), st.integers(1, 400))
def test_bins_of_direction_cover_the_circle_whatever_the_length(angle, length, bins):
    x, y = np.cos(angle), np.sin(angle)
    k = direction_bin(x * length, y * length, bins)
    assert 0 <= k < bins
    nudged = direction_bin(x, y, bins)
    assert (k - nudged) % bins in (0, 1, bins - 1)


@pytest.mark.parametrize("bins", [72, 360, 7])
def test_bins_ascend_with_the_angle_and_differ_by_at_most_twofold(bins):
    angles = np.linspace(-np.pi, np.pi, 200_000, endpoint=False)
    told = np.array([direction_bin(np.cos(a), np.sin(a), bins) for a in angles[::20]])
    assert np.all(np.diff(told) >= 0)
    assert set(told.tolist()) == set(range(bins))
    if bins == 72:
        widths = np.bincount(told)
        assert widths.max() <= 2.1 * widths.min()


def test_the_origin_has_a_direction_too():
    assert direction_bin(0.0, 0.0, 360) == direction_bin(1.0, 0.0, 360)
    assert direction_bin(-0.0, -0.0, 360) == 180


@given(seeds, st.floats(0.0, 40.0))
def test_the_free_distance_is_that_of_the_nearest_point_by_direction(seed, spread):
    random = np.random.default_rng(seed)
    raw = random.normal(0.0, spread, (300, 3)).astype(np.float32)
    raw[:60, :2] = np.round(raw[:60, :2])  # on the axes, on the diagonals, at the origin
    sensor = np.array([0.25, -0.5, 1.0]) * float(random.integers(0, 2))
    nearest, near, looked = np.full(BINS, np.inf), np.zeros(BINS, bool), np.zeros(BINS, bool)
    for x, y in raw[:, :2] + sensor[:2]:
        k = direction_bin(x, y, BINS)
        near[[(k + j) % BINS for j in range(-FIELD, FIELD + 1)]] = True
        looked[k] = True
        nearest[k] = min(nearest[k], np.hypot(x, y))
    bins = np.flatnonzero(looked)
    gap = int(np.argmax(np.diff(bins, append=bins[0] + BINS)))
    width = np.diff(bins, append=bins[0] + BINS)[gap]
    if len(bins) >= DENSE * (BINS - width + 1):
        near[np.arange(bins[gap] + 1, bins[gap] + width) % BINS] = False
    free = np.where(near, nearest, 0.0)
    wanted = np.minimum(free, np.minimum(np.roll(free, 1), np.roll(free, -1)))
    np.testing.assert_allclose(clear_range(raw, raw, sensor), wanted)


HEIGHT, BAND = 1.0, (0.3, 3.0)  # of the sensor above plane ground, and where stems are looked for [m]


def seen_of(points, offset=(0.0, 0.0, HEIGHT), band=BAND, free=None):
    """`seen_range` of returns above plane ground at z = -HEIGHT, without free range by default."""
    points = np.asarray(points, np.float32).reshape(-1, 3)
    free = np.zeros(BINS) if free is None else free
    return seen_range(points, points[:, 2] + np.float32(HEIGHT), np.array(offset), HEIGHT, band, free)


@pytest.mark.parametrize(
    ("end", "seen"),
    [
        ((8.0, 0.0, 0.2), 8.0),  # a stem
        ((10.0, 0.0, -1.0), 7.0),  # the ground: the ray is below 0.3 m from 7 m on
        ((10.0, 0.0, 4.0), 5.0),  # a crown, 5 m above the ground: the ray is above 3 m from 5 m on
    ],
)
def test_a_ray_shows_stems_as_far_as_it_is_in_the_band(end, seen):
    ahead = direction_bin(1.0, 0.0, BINS)
    for before_base in (0.0, 1.5):  # of the sensor, along the ray
        # Undergrowth of half a metre hides nothing above it.
        ranges = seen_of([end, (2.0, 0.0, -0.5)], offset=(before_base, 0.0, HEIGHT))
        assert ranges[ahead] == pytest.approx(seen + before_base, abs=1e-5)
        assert not np.delete(ranges, ahead).any()


@pytest.mark.parametrize("end", [(10.0, 0.0, 4.0), (10.0, 0.0, -1.0)])
def test_a_sensor_outside_of_the_band_sees_stems_only_along_rays_that_enter_it(end):
    above, below = seen_of([end], band=(0.3, 0.9)).max(), seen_of([end], band=(1.1, 3.0)).max()
    enters = (above, below) if end[2] < 0.0 else (below, above)
    assert enters[0] > 0.0
    assert enters[1] == 0.0


@given(seeds)
def test_the_seen_range_is_that_of_points_along_all_rays(seed):
    rng = np.random.default_rng(seed)
    ends = rng.uniform((-15.0, -15.0, -1.0), (15.0, 15.0, 5.0), (40, 3)).astype(np.float32)
    free = rng.choice([0.0, 4.0, np.inf], BINS)
    got = seen_of(ends, free=free)
    wanted = free.copy()
    part = np.linspace(0.0, 1.0, 2001)[:, None]
    for end in ends:
        ray = part * end.astype(np.float64)
        last = np.flatnonzero((ray[:, 2] + HEIGHT >= BAND[0]) & (ray[:, 2] + HEIGHT <= BAND[1]))[-1]
        k = direction_bin(
            float(end[0]), float(end[1]), BINS
        )  # of the whole ray, from the sensor above the base
        wanted[k] = max(wanted[k], np.hypot(*ray[last, :2]))
    np.testing.assert_allclose(got, wanted, atol=0.02)


@pytest.mark.parametrize(
    ("sensor_height", "band", "height"),
    [(0.25, (0.3, 3.0), 0.28), (0.25, (0.3, 3.0), 0.25), (1.8, (1.2, 1.4), 1.6), (0.0, (0.3, 3.0), 0.1)],
)
def test_a_ray_that_stays_outside_of_the_band_shows_nothing(sensor_height, band, height):
    point, none = np.array([[5.0, 0.0, height - sensor_height]], np.float32), np.zeros(BINS)
    assert not seen_range(point, np.array([height], np.float32), np.zeros(3), sensor_height, band, none).any()
