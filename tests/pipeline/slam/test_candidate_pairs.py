"""Candidate pairs: all that any particle may associate, with the covariances of the textbook."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.slam.candidate_pairs import candidate_pairs, relative_positions, rotated_rows
from pipeline.slam.particle_maps import MapColumns, own_block, shared_map, with_room
from tests.pipeline.strategies import seeds


def full(rows):
    return np.array([[rows[0], rows[1]], [rows[1], rows[2]]])


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@given(seeds, st.integers(1, 40))
def test_landmarks_in_the_body_frame_are_those_of_each_particle(seed, landmarks):
    rng = np.random.default_rng(seed)
    mean = rng.normal(0.0, 9.0, (landmarks, 2))
    ones = np.ones(landmarks, np.int32)
    columns = MapColumns(mean, np.ones((landmarks, 3)), ones, ones.astype(np.float32), np.arange(landmarks))
    maps = with_room(shared_map(4, columns), 0, 100)
    moved = rng.integers(0, landmarks)
    maps.mean[own_block(maps, 2, moved // 16), moved % 16] += [0.5, -0.2]
    pose = rng.normal(0.0, 1.0, (4, 3))
    relative, apart = relative_positions(maps, np.arange(landmarks), pose, 1)
    for p in range(4):
        own = mean.copy()
        if p == 2:
            own[moved] += [0.5, -0.2]
        np.testing.assert_allclose(relative[p], (own - pose[p, :2]) @ rotation(pose[p, 2]), atol=1e-9)
    np.testing.assert_allclose(apart, np.hypot(*(relative - relative[1]).T).max(axis=1), atol=1e-9)


@pytest.mark.parametrize("distance_max", [0.5, 4.0])
@given(seed=seeds)
def test_pairs_are_all_within_reach_of_any_particle(seed, distance_max):
    rng = np.random.default_rng(seed)
    relative = rng.uniform(-9.0, 9.0, (6, 30, 2))[:1] + rng.normal(0.0, 0.3, (6, 30, 2))
    apart = np.hypot(*(relative - relative[0]).T).max(axis=1)
    covariance = np.tile([0.02, 0.003, 0.03], (30, 1)) * rng.uniform(0.1, 5.0, (30, 1))
    centre, R = rng.uniform(-9.0, 9.0, (20, 2)), np.tile([0.004, 0.001, 0.002], (20, 1))
    A = rng.normal(size=(3, 3)) * [[0.3], [0.3], [0.05]]
    P = A @ A.T
    pairs = candidate_pairs(centre, R, relative[0], apart, covariance, np.ones(30, np.bool_), P, distance_max)
    detection = np.repeat(np.arange(20), np.diff(pairs.first))
    found = set(zip(detection.tolist(), pairs.row.tolist(), strict=True))
    near = np.hypot(*(relative[:, None] - centre[:, None]).transpose(3, 0, 1, 2)) <= distance_max
    assert found >= set(map(tuple, np.argwhere(near.any(axis=0)).tolist()))
    for d, k in zip(detection, range(len(pairs.row)), strict=True):
        own = full(R[d]) + full(covariance[pairs.row[k]])
        J = np.array([[1.0, 0.0, -centre[d, 1]], [0.0, 1.0, centre[d, 0]]])
        S = own + J @ P @ J.T
        np.testing.assert_allclose(full(pairs.spread[k]), own)
        np.testing.assert_allclose(full(pairs.gate[k]), np.linalg.inv(S), rtol=1e-6)
        assert pairs.log_det[k] == pytest.approx(np.linalg.slogdet(S)[1], abs=1e-9)


@given(seeds, st.floats(-7.0, 7.0))
def test_rotated_covariances_are_those_of_the_rotated_axes(seed, angle):
    rows = np.array([[0.4, 0.1, 0.2]]) * np.random.default_rng(seed).uniform(0.1, 3.0, (5, 1))
    for before, after in zip(rows, rotated_rows(rows, angle), strict=True):
        np.testing.assert_allclose(
            full(after), rotation(angle) @ full(before) @ rotation(angle).T, atol=1e-12
        )
