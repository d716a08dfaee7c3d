"""Walking people, whose clusters look like trees to a robot with stuck wheels: they do not move the pose. A
robot with a correct pose is not reported as lost when its view changes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.detection.free_space import BINS
from pipeline.geometry.directions import bin_direction
from pipeline.geometry.poses import Pose2
from pipeline.slam import FastSlam
from pipeline.slam.slip_detection import UNSURE
from tests.pipeline.strategies import ALL_FREE, NOTHING_SEEN, detections, first_of

FOREST = preset("forest").slam.model_copy(update={"update_distance": 0.0})
WALK, RATE = 1.4, 10  # m/s, Hz
SIGMA = (0.03, 0.06)  # m
SCANS = 40
STRIDE = 0.1  # m, of a robot that drives
SEEDS = first_of(range(5))


def walked(seed, people, trees, *, sigma, stride=0.0, speed=WALK, free=NOTHING_SEEN):
    """Estimates and true poses of a robot with honest wheels that people pass, all at one speed."""
    rng = np.random.default_rng([7, seed])
    direction = rng.uniform(-np.pi, np.pi)
    velocity = speed / RATE * np.array([np.cos(direction), np.sin(direction)])
    standing, walking = rng.uniform(-8.0, 8.0, (trees, 2)), rng.uniform(-6.0, 6.0, (people, 2))
    slam, pose, told = FastSlam(FOREST, seed), Pose2(), []
    for k in range(SCANS):
        step = Pose2(stride if k else 0.0)
        pose = pose @ step
        world = np.concatenate([standing, walking + velocity * (k - SCANS / 2)])
        centre = pose.inverse().apply(world)
        centre = centre + rng.normal(0.0, sigma, centre.shape)
        told.append((slam.process(k, step, detections(centre, sigma=sigma), free), pose))
    return told


def worst(told):
    """The largest error of the position [m]."""
    return max(np.hypot(e.T_map_base.x - true.x, e.T_map_base.y - true.y) for e, true in told)


@pytest.mark.parametrize("stride", [0.0, STRIDE])
@pytest.mark.parametrize("trees", [0, 1, 2])
@pytest.mark.parametrize("people", [4, 5])
@pytest.mark.parametrize("seed", SEEDS)
def test_people_who_walk_together_do_not_move_the_pose(seed, people, trees, stride):
    for sigma in SIGMA:
        for free in (NOTHING_SEEN, ALL_FREE):
            told = walked(seed, people, trees, sigma=sigma, stride=stride, free=free)
            assert worst(told) <= 0.1
            assert not any("trees move" in estimate.health.doubt for estimate, _ in told)


def left_by(seed, people, trees, *, speed, stride=0.0, dropouts=0.0):
    """Estimates and true poses of a robot with honest wheels that knows people who stood for long, since they
    walk off; trees are missed in a share of the scans."""
    rng = np.random.default_rng([9, seed])
    direction = rng.uniform(-np.pi, np.pi)
    velocity = speed / RATE * np.array([np.cos(direction), np.sin(direction)])
    world = np.zeros((0, 2))
    while len(world) < trees + people:
        place = rng.uniform(-8.0, 8.0, 2)
        if np.hypot(*place) > 0.8 and np.hypot(*(world - place).T).min(initial=9.0) > 1.3:
            world = np.concatenate([world, [place]])
    slam, pose, told = FastSlam(FOREST, seed), Pose2(), []
    for k in range(2 * SCANS):
        step = Pose2(stride if k else 0.0)
        pose = pose @ step
        now = world.copy()
        now[trees:] += velocity * max(0, k - SCANS)
        seen = rng.random(len(now)) >= np.where(np.arange(len(now)) < trees, dropouts, 0.0)
        centre = pose.inverse().apply(now[seen])
        centre = centre + rng.normal(0.0, SIGMA[0], centre.shape)
        told.append((slam.process(k, step, detections(centre, sigma=SIGMA[0]), NOTHING_SEEN), pose))
    return told[SCANS:]


@pytest.mark.parametrize("speed", [1.0, WALK])
@pytest.mark.parametrize(("trees", "dropouts"), [(0, 0.0), (2, 0.6), (3, 0.3), (3, 0.6)])
@pytest.mark.parametrize("seed", SEEDS)
def test_known_people_who_walk_off_do_not_move_the_pose(seed, trees, dropouts, speed):
    for stride in (0.0, STRIDE):
        assert worst(left_by(seed, 5, trees, speed=speed, stride=stride, dropouts=dropouts)) <= 0.1


def test_the_pose_is_uncertain_when_known_people_walk_off():
    told = [left_by(seed, 5, 0, speed=1.0) for seed in range(6)]
    assert any(e.health.doubt == UNSURE and e.health.state == "weak" for one in told for e, _ in one)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_pose_is_not_reported_as_good_when_many_people_walk_off(seed):
    told = left_by(seed, 8, 0, speed=WALK)
    assert all(e.health.state != "good" for e, _ in told if e.health.doubt)
    assert worst(told) <= 0.1 or told[-1][0].health.state == "weak"


@pytest.mark.parametrize("trees", [1, 2, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_one_tree_outvotes_slow_people(seed, trees):
    assert worst(walked(seed, 5, trees, sigma=0.03, speed=0.7)) <= 0.1


def looked(first, then, *, free, scans=40):
    """The health of a robot that stands still and sees some of its trees for long, and others then."""
    rng, slam, states = np.random.default_rng(0), FastSlam(FOREST, 0), []
    for k in range(scans + 30):
        trees = first if k < scans else then
        centre = trees + rng.normal(0.0, 0.02, trees.shape)
        states.append(slam.process(k, Pose2(), detections(centre, sigma=0.03), free).health.state)
    return states


def stand(seed):
    """Trees to the left and to the right of a robot at the origin that looks along x."""
    rng, trees = np.random.default_rng([8, seed]), np.zeros((0, 2))
    while len(trees) < 30:
        place = rng.uniform(-9.0, 9.0, 2)
        if abs(place[1]) > 2.0 and np.hypot(*(trees - place).T).min(initial=9.0) > 1.5:
            trees = np.concatenate([trees, [place]])
    return trees[trees[:, 1] > 0.0], trees[trees[:, 1] < 0.0]


def free_to_the_right():
    """To the left something hides what there is."""
    return np.array([20.0 if bin_direction(k, BINS)[1] < -0.2 else 0.0 for k in range(BINS)])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("free", [NOTHING_SEEN, free_to_the_right()])
def test_a_robot_whose_view_changes_is_not_lost(seed, free):
    assert set(looked(*stand(seed), free=free)) == {"good"}


@pytest.mark.parametrize("seed", SEEDS)
def test_a_robot_is_not_lost_where_a_curve_shows_other_trees_and_a_known_one_fell(seed):
    left, right = stand(seed)
    fell = np.concatenate([left, [[1.0, -1.5]]])
    assert "lost" not in looked(fell, right, free=free_to_the_right())


@pytest.mark.parametrize("seed", SEEDS)
def test_a_robot_that_misses_all_trees_in_free_view_is_lost(seed):
    states = looked(*stand(seed), free=ALL_FREE)
    assert set(states[:40]) == {"good"}
    assert "lost" in states[40:46]


@pytest.mark.parametrize("seed", first_of(range(3)))
@pytest.mark.parametrize(("few", "many"), [(3, 14), (5, 14), (3, 6), (8, 10)])
def test_a_robot_that_is_carried_from_few_trees_to_many_is_lost(few, many, seed):
    """The many become known within three scans, and soon outweigh the few."""
    left, right = stand(seed)
    states = looked(left[:few], np.concatenate([right, 1.3 * right + 0.4])[:many], free=ALL_FREE)
    assert set(states[:40]) == {"good"}
    assert "lost" in states[40:46]
