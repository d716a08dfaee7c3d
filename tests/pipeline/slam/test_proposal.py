"""Hash grid and candidate pairs: the same pairs as a search over all landmarks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.gaussian import Pose, expected_spread, pose_of
from pipeline.geometry.hash_grid import cells_for, clear, fill, holds_unseen, per_metre
from pipeline.slam.proposal import likely_pairs, room_for

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.sampled_from([0.05, 1.0, 4.0, 20.0]))
def test_cells_find_who_stands_near(seed: int, radius: float) -> None:
    random = np.random.default_rng(seed)
    mean = random.uniform(-60.0, 60.0, (80, 2))
    mean[40:] = mean[:40] + random.normal(0.0, radius, (40, 2))
    seen = random.uniform(size=80) < 0.5
    cells, scale = cells_for(80), per_metre(radius)
    fill(cells, mean, 80, scale)
    for x, y in mean[:20]:
        wanted = np.any(~seen & (np.hypot(mean[:, 0] - x, mean[:, 1] - y) <= radius))
        assert holds_unseen(cells, mean, seen, x, y, radius**2, scale) == wanted
    clear(cells, 80)
    assert np.all(cells.head == -1)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("distance_max", [0.5, 1.0, 4.0])
@given(seed=SEEDS)
def test_pairs_are_all_within_the_gate_and_sorted(seed: int, distance_max: float) -> None:
    random = np.random.default_rng(seed)
    mean = random.uniform(-12.0, 12.0, (60, 2))
    covariance = np.tile([0.02, 0.0, 0.03], (60, 1)) * random.uniform(0.1, 5.0, (60, 1))
    mu, spread = (
        np.array([*random.normal(0.0, 1.0, 2), random.uniform(-3.0, 3.0)]),
        np.diag([0.01, 0.02, 1e-4]),
    )
    pose = pose_of(mu, spread)
    c, s = np.cos(mu[2]), np.sin(mu[2])
    centre = (mean[:30] + random.normal(0.0, 0.3, (30, 2)) - mu[:2]) @ np.array([[c, -s], [s, c]])
    R = np.tile([0.004, 0.001, 0.002], (30, 1))
    cells, room = cells_for(60), room_for(30, 60)
    scale, gate2 = per_metre(distance_max), 9.0
    fill(cells, mean, 60, scale)
    found: dict[tuple[int, int], float] = {}
    for _ in range(2):  # the second time in the sequence of the first
        n = likely_pairs(pose, c, s, centre, R, mean, covariance, cells, scale, gate2, distance_max, room)
        found = {
            (int(d), int(j)): cost
            for d, j, cost in zip(room.detection[:n], room.landmark[:n], room.cost[:n], strict=True)
        }
        assert found == pytest.approx(_all_pairs(pose, centre, R, mean, covariance, gate2, distance_max))
        assert np.all(np.diff(room.cost[room.order[:n]]) >= 0.0)
        assert sorted(room.sequence) == list(range(30))
        assert np.all(room.landmark_of == -1)
    for d in range(30):
        costs = sorted(cost for (one, _), cost in found.items() if one == d)
        assert [room.best[d], room.second[d]] == [*costs, np.inf, np.inf][:2]


def _all_pairs(
    pose: Pose,
    centre: np.ndarray,
    R: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    gate2: float,
    distance_max: float,
) -> dict[tuple[int, int], float]:
    """By the equations, every detection with every landmark."""
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    pairs = {}
    for d, (x, y) in enumerate(centre):
        away = np.array([c * x - s * y, s * x + c * y])
        xx, xy, yy = expected_spread(pose, c, s, away[0], away[1], R, d)
        for j, at in enumerate(mean):
            S0, S1, S2 = np.array([xx, xy, yy]) + covariance[j]
            S = np.array([[S0, S1], [S1, S2]])
            off = at - away - [pose.x, pose.y]
            d2 = off @ np.linalg.solve(S, off)
            if off @ off <= distance_max**2 and d2 <= gate2:
                pairs[d, j] = d2 + np.log(np.linalg.det(S))
    return pairs
