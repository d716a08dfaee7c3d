"""Parts of the robot in view of its LiDAR are found by scans from several places."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.io.readers.robot_body import body_words, reach_of_body
from pipeline.types.records import Float


def scans_of(places: Float, posts: Float, rng: np.random.Generator) -> list[Float]:
    """Points of a level ground, of trunks in a forest, and of posts on the robot, seen from some places."""
    trees = np.random.default_rng(1).uniform(-25.0, 25.0, (150, 2))
    found = []
    for place in places:
        ground = np.column_stack([rng.uniform(-15.0, 15.0, (8000, 2)), rng.normal(-1.1, 0.02, 8000)])
        stands = np.concatenate([trees - place, posts])
        stands = stands[np.hypot(*stands.T) > 0.8]
        bark = np.repeat(stands, 60, axis=0) + rng.normal(0.0, 0.02, (60 * len(stands), 2))
        found.append(np.concatenate([ground, np.column_stack([bark, rng.uniform(-1.0, 2.0, len(bark))])]))
    return found


def walked(n: int) -> Float:
    """Places along a bend, 2 m apart."""
    turn = 0.2 * np.arange(n)
    return np.column_stack([10.0 * np.sin(turn), 10.0 * (1.0 - np.cos(turn))]) - 5.0


@pytest.mark.parametrize("seed", range(4))
def test_posts_on_the_robot_are_found_and_a_limit_beyond_them_is_named(seed: int):
    posts = np.array([[-2.2, 0.9], [-1.0, 0.3]])
    scans = scans_of(walked(8), posts, np.random.default_rng(seed))
    assert 2.2 < reach_of_body(scans) < 3.2
    (said,) = body_words(scans)
    assert "--set acquisition.range_min=" in said


@pytest.mark.parametrize("seed", range(4))
def test_a_forest_alone_shows_no_robot(seed: int):
    rng = np.random.default_rng(seed)
    assert body_words(scans_of(walked(8), np.zeros((0, 2)), rng)) == ()


@pytest.mark.parametrize("n", [0, 1, 8])
def test_a_robot_that_stands_shows_nothing(n: int):
    posts = np.array([[-2.2, 0.9]])
    assert reach_of_body(scans_of(np.zeros((n, 2)), posts, np.random.default_rng(0))) == 0.0


@pytest.mark.parametrize("seed", range(2))
def test_dense_low_plants_all_around_are_no_robot(seed: int):
    rng = np.random.default_rng(seed)
    plants = [rng.uniform([-4.0, -4.0, -1.1], [4.0, 4.0, -0.4], (60_000, 3)) for _ in range(8)]
    scans = scans_of(walked(8), np.zeros((0, 2)), rng)
    assert body_words([np.concatenate(pair) for pair in zip(scans, plants, strict=True)]) == ()
