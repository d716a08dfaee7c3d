"""Matching of constellations: the pose is found where it is determined, and no wrong pose otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from pipeline.config.stages import Relocalisation
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.loop_closure.stem_matching import (
    MapStems,
    aligned,
    alignment_covariance,
    find_constellation,
    find_displacement,
    pairs_within,
    worst_sigma,
)

P = Relocalisation()
seeds = st.integers(0, 2**32 - 1)
SIDE = 60.0


def forest(rng, stems=160):
    """A Poisson forest of 60 by 60 m."""
    return rng.uniform(0.0, SIDE, (stems, 2))


def view(rng, stems, *, radius=14.0, missing=0.1, false=0.1, noise=0.05):
    """What a robot somewhere among the stems has mapped in its own frame, and the true T_map_local."""
    centre = rng.uniform(radius, SIDE - radius, 2)
    seen = stems[np.hypot(*(stems - centre).T) < radius]
    seen = seen[rng.random(len(seen)) >= missing]
    wrong = centre + rng.uniform(-radius, radius, (round(false * len(seen)), 2)) * 0.7
    there = np.concatenate([seen, wrong])
    T = Pose2(float(centre[0]), float(centre[1]), float(rng.uniform(-np.pi, np.pi)))
    return T.inverse().apply(there + rng.normal(0.0, noise, there.shape)), T


def is_right(match, T, local):
    """Whether a pose puts the local stems where they are."""
    off = np.abs(match.pose.apply(local) - T.apply(local)).max()
    return off < 1.0 and abs(float(wrap_angle(match.pose.yaw - T.yaw))) < 0.05


@given(seeds, st.floats(0.0, 0.35), st.floats(0.0, 0.35))
def test_no_loop_is_false_in_a_forest(seed, missing, false):
    rng = np.random.default_rng(seed)
    stems = forest(rng)
    local, T = view(rng, stems, missing=missing, false=false)
    known = stems[rng.random(len(stems)) >= missing]
    match = find_constellation(MapStems.at(local), MapStems.at(known), P)
    assert match.pose is None or is_right(match, T, local)
    assert (match.pose is None) == (match.reason is not None)


def test_most_views_of_a_forest_are_found():
    found = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        stems = forest(rng)
        local, T = view(rng, stems)
        match = find_constellation(MapStems.at(local), MapStems.at(stems), P)
        found += match.pose is not None and is_right(match, T, local)
    assert found >= 28


@given(seeds)
def test_a_forest_that_is_not_in_the_map_is_not_found_there(seed):
    rng = np.random.default_rng(seed)
    local, _ = view(rng, forest(rng))
    match = find_constellation(MapStems.at(local), MapStems.at(forest(rng)), P)
    assert match.pose is None
    assert match.reason in ("could be chance", "no agreement", "too few stems", "ambiguous")


@pytest.mark.slow
@given(seeds, st.floats(1.5, 5.0), st.floats(1.0, 1.6), st.floats(0.0, 0.1), st.floats(0.0, 0.2))
def test_a_plantation_is_refused(seed, spacing, ratio, jitter, missing):
    rng = np.random.default_rng(seed)
    n = int(SIDE / spacing)
    rows = np.stack(np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing * ratio), -1).reshape(-1, 2)
    stems = rows + rng.normal(0.0, jitter, rows.shape)
    stems = stems[rng.random(len(stems)) >= missing]
    local, _ = view(rng, stems, radius=max(10.0, 3 * spacing), missing=missing)
    match = find_constellation(MapStems.at(local), MapStems.at(stems), P)
    assert match.pose is None
    assert match.second >= 0.6 * len(match.local)


def test_diameters_can_tell_the_rows_of_a_plantation_apart():
    rng = np.random.default_rng(5)
    rows = np.stack(np.meshgrid(np.arange(12) * 3.0, np.arange(12) * 3.0), -1).reshape(-1, 2)
    dbh = rng.uniform(0.1, 0.9, len(rows))
    sigma = np.full(len(rows), 0.01)
    there = np.flatnonzero(np.hypot(*(rows - [15.0, 18.0]).T) < 9.0)
    T = Pose2(15.0, 18.0, 0.4)
    local = MapStems(T.inverse().apply(rows[there]), np.full(len(there), 0.05), dbh[there], sigma[there])
    match = find_constellation(local, MapStems(rows, np.full(len(rows), 0.05), dbh, sigma), P)
    assert match.pose is not None
    assert is_right(match, T, local.position)
    blind = find_constellation(MapStems.at(local.position), MapStems.at(rows), P)
    assert blind.reason == "ambiguous"


@pytest.mark.slow
@given(seeds, st.floats(-3.1, 3.1), st.floats(-500, 500), st.floats(-500, 500))
def test_the_pose_turns_with_the_local_frame(seed, yaw, x, y):
    rng = np.random.default_rng(seed)
    stems = forest(rng)
    local, _ = view(rng, stems, missing=0.0, false=0.0)
    T = Pose2(x, y, yaw)
    one = find_constellation(MapStems.at(local), MapStems.at(stems), P)
    other = find_constellation(MapStems.at(T.apply(local)), MapStems.at(stems), P)
    if one.pose is None or other.pose is None:
        return
    np.testing.assert_array_equal(one.reference, other.reference)
    np.testing.assert_allclose((other.pose @ T).as_array(), one.pose.as_array(), atol=1e-6)


def test_the_covariance_is_honest():
    """NEES of 60 poses lies inside the 95 % band of chi-square."""
    sigma, nees = 0.04, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        stems = forest(rng)
        local, T = view(rng, stems, noise=sigma, false=0.0)
        exact = P.model_copy(update={"slack": 0.0})
        match = find_constellation(MapStems.at(local, sigma), MapStems.at(stems, 0.0), exact)
        if match.pose is None:
            continue
        off = match.pose.as_array() - T.as_array()
        off[2] = float(wrap_angle(off[2]))
        nees.append(off @ np.linalg.solve(match.covariance, off))
    k = 3 * len(nees)
    assert len(nees) >= 50
    assert chi2.ppf(0.005, k) < np.sum(nees) < chi2.ppf(0.995, k)


@pytest.mark.parametrize("stems", [0, 1, 2, 5])
def test_few_stems_are_refused(stems):
    local = np.random.default_rng(0).uniform(0, 10, (stems, 2))
    match = find_constellation(MapStems.at(local), MapStems.at(forest(np.random.default_rng(1))), P)
    assert match.pose is None
    assert match.reason == "too few stems"


@pytest.mark.parametrize(
    "place",
    [
        np.full((20, 2), np.nan),
        np.zeros((20, 2)),
        np.stack([np.arange(20) * 2.5, np.zeros(20)], 1),
        np.array([[1e300, -1e300], [1e200, 1.0], *np.eye(2)] * 5),
    ],
    ids=["no numbers", "all at one place", "one even row", "far beyond"],
)
def test_poor_stems_are_refused(place):
    for local, reference in ((place, place), (place, forest(np.random.default_rng(1)))):
        assert find_constellation(MapStems.at(local), MapStems.at(reference), P).pose is None


def test_the_same_stems_give_the_same_bytes():
    rng = np.random.default_rng(3)
    stems = forest(rng)
    local, _ = view(rng, stems)
    one, two = (find_constellation(MapStems.at(local), MapStems.at(stems), P) for _ in range(2))
    assert one.pose == two.pose
    assert one.covariance.tobytes() == two.covariance.tobytes()


# --- closed forms ---------------------------------------------------------------------------------


@given(seeds, st.integers(2, 30))
def test_the_alignment_is_that_of_scipy(seed, n):
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    local, weight = rng.normal(0, 5, (n, 2)), rng.uniform(0.5, 2.0, n)
    reference = Pose2(3.0, -2.0, 2.5).apply(local) + rng.normal(0, 0.3, (n, 2))
    pose = aligned(local, reference, weight)
    middle = [weight @ p / weight.sum() for p in (local, reference)]
    flat = [np.pad(p - m, ((0, 0), (0, 1))) for p, m in zip((local, reference), middle, strict=True)]
    # The third axis is held by a heavy pair along it.
    up = np.array([[0.0, 0.0, 1.0]])
    oracle, _ = Rotation.align_vectors(
        np.concatenate([flat[1], up]), np.concatenate([flat[0], up]), np.append(weight, 1e6)
    )
    yaw = oracle.as_euler("zyx")[0]
    assert abs(float(wrap_angle(pose[2] - yaw))) < 1e-4
    np.testing.assert_allclose(Pose2(*pose).apply(middle[0][None])[0], middle[1], atol=1e-9)


def test_the_covariance_of_stems_on_a_circle():
    """n stems on a circle of radius r about the origin: sigma^2 / n each way, sigma^2 / (n r^2) in yaw."""
    n, r, sigma = 16, 5.0, 0.1
    angle = 2 * np.pi * np.arange(n) / n
    ring = r * np.stack([np.cos(angle), np.sin(angle)], 1)
    told = alignment_covariance(Pose2(), ring, ring, np.full(n, sigma**2))
    wanted = np.diag([sigma**2 / n, sigma**2 / n, sigma**2 / (n * r * r)])
    np.testing.assert_allclose(told, wanted, atol=1e-12)


@given(seeds, st.integers(0, 60))
def test_the_pairs_are_those_of_a_tree(seed, n):
    from scipy.spatial import cKDTree

    stems = np.random.default_rng(seed).uniform(0, 30, (n, 2))
    pair, length = pairs_within(stems, 2.0, 9.0, 10_000) if n else (np.zeros((0, 2)), np.zeros(0))
    told = {tuple(sorted(p)) for p in pair.tolist()}
    wanted = cKDTree(stems).query_pairs(9.0) - cKDTree(stems).query_pairs(2.0) if n else set()
    assert told == wanted
    assert np.all(np.diff(length) >= 0)


@given(seeds)
def test_the_worst_sigma_is_the_larger_eigenvalue(seed):
    A = np.random.default_rng(seed).normal(size=(5, 2, 2))
    C = A @ A.transpose(0, 2, 1)
    wanted = np.sqrt(np.linalg.eigvalsh(C)[:, 1])
    np.testing.assert_allclose(worst_sigma(C[:, [0, 0, 1], [0, 1, 1]]), wanted, rtol=1e-9)


@given(x=st.floats(-0.8, 0.8), y=st.floats(-0.8, 0.8), yaw=st.floats(-0.02, 0.02), seed=st.integers(0, 50))
def test_a_small_displacement_is_found_by_few_stems(x: float, y: float, yaw: float, seed: int):
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(0.0, 21.0, 7.0), np.arange(0.0, 14.0, 7.0)), axis=-1).reshape(-1, 2)
    reference = grid + rng.uniform(-1.0, 1.0, grid.shape)
    drift = Pose2(x, y, yaw)
    local = drift.inverse().apply(reference[:5]) + rng.normal(0.0, 0.02, (5, 2))
    match = find_displacement(MapStems.at(local), MapStems.at(reference), Relocalisation(), 1.5)
    assert match.pose is not None
    assert np.hypot(*(match.pose.apply(local) - reference[:5]).T).max() < 0.15
    assert match.reference.tolist() == match.local.tolist() == [0, 1, 2, 3, 4]


def test_stems_elsewhere_are_no_displacement():
    rng = np.random.default_rng(4)
    local, reference = rng.uniform(0.0, 20.0, (8, 2)), rng.uniform(0.0, 20.0, (8, 2))
    match = find_displacement(MapStems.at(local), MapStems.at(reference), Relocalisation(), 1.0)
    assert match.pose is None
    few = find_displacement(MapStems.at(reference[:3]), MapStems.at(reference), Relocalisation(), 1.0)
    assert few.reason == "too few stems"
