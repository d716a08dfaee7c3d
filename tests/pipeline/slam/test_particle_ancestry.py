"""Ancestry of the particles: paths of their ancestors, immutable and bounded."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.poses import Pose2
from pipeline.slam.particle_ancestry import BLOCK, RECENT_POSES, EstimatedPath, Genealogy
from tests.pipeline.strategies import seeds


def grown(rng, particles, scans):
    """A genealogy and, beside it, the whole past of every particle, kept without sharing."""
    genealogy, pasts = Genealogy(), np.zeros((particles, 0, 3))
    for _ in range(scans):
        pose = rng.normal(size=(particles, 3))
        ancestors = rng.integers(0, particles, particles) if rng.random() < 0.3 else None
        pasts = np.concatenate([pasts, pose[:, None]], axis=1)
        pasts = pasts if ancestors is None else pasts[ancestors]
        genealogy = genealogy.with_scan(pose, ancestors, 0)
    return genealogy, pasts


@given(seeds, st.integers(1, 9), st.integers(1, 40))
def test_a_path_is_the_past_of_its_particle(seed, particles, scans):
    genealogy, pasts = grown(np.random.default_rng(seed), particles, scans)
    for leaf in range(particles):
        np.testing.assert_allclose(genealogy.path(leaf), pasts[leaf], atol=1e-6)


@given(seeds, st.integers(1, 9))
def test_particles_drawn_anew_keep_their_past(seed, particles):
    rng = np.random.default_rng(seed)
    genealogy, pasts = grown(rng, particles, 12)
    rows = rng.integers(0, particles, 15)
    drawn = genealogy.redrawn(rows)
    for leaf, row in enumerate(rows):
        np.testing.assert_allclose(drawn.path(leaf), pasts[row], atol=1e-6)
    np.testing.assert_allclose(genealogy.path(0), pasts[0], atol=1e-6)


def test_a_long_past_is_settled_and_stays():
    particles = RECENT_POSES // BLOCK
    genealogy = Genealogy()
    for k in range(2 * BLOCK + 10):
        genealogy = genealogy.with_scan(np.full((particles, 3), float(k)), None, 0)
    assert len(genealogy.settled) == 1
    assert len(genealogy.recent) < 2 * BLOCK
    assert len(genealogy) == 2 * BLOCK + 10
    np.testing.assert_array_equal(genealogy.path(3)[:, 0], np.arange(2 * BLOCK + 10))


def test_a_settled_past_takes_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.slam.particle_ancestry.RECENT_POSES", BLOCK)
    pose, path, past, known = np.zeros((1, 3)), EstimatedPath(), Genealogy(), list[int]()
    tracemalloc.start()
    try:
        for _ in range(40):
            past = past.with_scans([(pose, None, 0)] * BLOCK)
            for _ in range(BLOCK):
                path = path.with_pose(pose[0])
            known.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert len(past.settled) == 39
    assert known[-1] - known[-2] < 4096  # of 25 kB


def test_nothing_has_no_path():
    assert Genealogy().path(0).shape == (0, 3)
    assert Genealogy().redrawn(np.zeros(4, np.int64)).path(0).shape == (0, 3)


@given(seeds)
def test_the_mean_motion_is_that_of_the_surviving_particles(seed):
    rng = np.random.default_rng(seed)
    particles = 6
    genealogy, paths = grown(rng, particles, 8)
    weights = rng.dirichlet(np.ones(particles))
    scans = np.array([2, 5, 7])
    wanted = np.zeros((3, 2))
    for path, weight in zip(paths, weights, strict=True):
        last = Pose2(*path[-1]).inverse()
        wanted += weight * np.array([(last @ Pose2(*path[k])).as_array()[:2] for k in scans])
    mean = genealogy.mean_motion_from(scans, weights)
    np.testing.assert_allclose(mean[:, :2], wanted, atol=1e-5)
    np.testing.assert_allclose(mean[2], 0.0, atol=1e-6)


def test_the_mean_motion_reaches_back_before_the_scans_with_ancestors():
    path = np.column_stack([0.1 * np.arange(BLOCK + 40), np.zeros(BLOCK + 40), np.zeros(BLOCK + 40)])
    mean = Genealogy.of_path(path, 3).mean_motion_from(np.array([BLOCK - 10, BLOCK + 30]), np.full(3, 1 / 3))
    np.testing.assert_allclose(mean[:, 0], [-4.9, -0.9], atol=1e-4)


@pytest.mark.parametrize("scans", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 7])
def test_an_estimated_path_contains_each_pose_once_and_in_order(scans: int) -> None:
    poses = np.random.default_rng(scans).normal(size=(scans, 3))
    path = EstimatedPath()
    for pose in poses:
        path = path.with_pose(pose)
    at_once = EstimatedPath.of(poses)
    assert len(path) == len(at_once) == scans
    np.testing.assert_array_equal(path.poses(), poses)
    np.testing.assert_array_equal(at_once.poses(), poses)
    assert [b.shape for b in path.blocks] == [b.shape for b in at_once.blocks]


def test_a_longer_path_leaves_the_shorter_one_unchanged() -> None:
    poses = np.random.default_rng(1).normal(size=(BLOCK, 3))
    short = EstimatedPath.of(poses[:-1])
    whole = short.with_pose(poses[-1])
    np.testing.assert_array_equal(short.poses(), poses[:-1])
    np.testing.assert_array_equal(whole.poses(), poses)
