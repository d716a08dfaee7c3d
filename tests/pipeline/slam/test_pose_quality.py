"""Pose quality: consistent statistics, and the state that follows from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.slam import FastSlam
from pipeline.slam.particle_ancestry import FOUNDED, Genealogy
from pipeline.slam.pose_quality import (
    FOUND_LOST,
    INNOVATION,
    INNOVATION_WEAK,
    ODOMETRY_WEAK,
    RECOGNISED,
    SHIFT,
    SIGMA_GOOD,
    STATISTICS,
    STRANGE_LOST,
    TREE_MOTION_MAX,
    TREE_MOTION_SCANS,
    OdometryDoubt,
    RunningStatistics,
    ScanStatistics,
    is_lost,
    mean_statistics,
    named_statistics,
    pose_health,
    update_statistics,
)
from pipeline.slam.rigid_shift_test import MANY
from pipeline.types.records import SIGMA_XY_MAX
from tests.pipeline.strategies import ALL_FREE, NOTHING_SEEN, detections, seeds

FOREST = preset("forest").slam.model_copy(update={"update_distance": 0.0})
WORLD = np.stack(np.meshgrid(np.arange(-12.0, 13.0, 4.0), [-3.0, 3.0]), axis=-1).reshape(-1, 2)


def seen(pose, sigma=0.02, rng=None, reach=9.0):
    """Detections of the world's trees from a pose."""
    centre = pose.inverse().apply(WORLD)
    centre = centre[np.hypot(*centre.T) < reach]
    return detections(centre + (rng.normal(0, sigma, centre.shape) if rng else 0.0), sigma=sigma)


def driven(slam, scans, rng, start=0, at=0.0, step=0.05):
    """The health of each scan of a straight drive with honest errors."""
    told = []
    for k in range(start, start + scans):
        at += step if k else 0.0
        told.append(slam.process(k, Pose2(step if k else 0.0), seen(Pose2(at), rng=rng), NOTHING_SEEN).health)
    return told, at


def test_an_honest_drive_is_good_with_figures_near_what_they_should_be():
    told, _ = driven(FastSlam(FOREST, 0), 60, np.random.default_rng(0))
    assert {h.state for h in told} == {"good"}
    assert all(h.reason == "" for h in told)
    assert 0.4 < np.nanmean([h.innovation for h in told]) < 1.6
    assert told[-1].recognised == pytest.approx(told[-1].detections, abs=0.5)
    assert told[-1].sigma_xy < 0.05
    assert 1 <= told[-1].ancestors <= 100
    assert told[-1].n_eff >= 1.0


def test_errors_that_were_told_too_small_show_in_the_innovation():
    rng = np.random.default_rng(0)
    slam, word = FastSlam(FOREST, 0), []
    for k in range(60):
        found = seen(Pose2(), sigma=0.02)
        noisy = detections(found.centre + rng.normal(0, 0.06, found.centre.shape), sigma=0.02)
        word.append(slam.process(k, Pose2(), noisy, NOTHING_SEEN).health)
    assert np.nanmean([h.innovation for h in word[20:]]) > 1.5


def test_wheels_that_slip_show_in_the_odometry():
    rng = np.random.default_rng(0)
    slam = FastSlam(FOREST, 0)
    honest, at = driven(slam, 30, rng)
    slipped = slam.process(30, Pose2(0.07), seen(Pose2(at), rng=rng), NOTHING_SEEN).health
    assert slipped.odometry > 2.0 * np.median([h.odometry for h in honest[5:]])
    assert slipped.state == "weak"
    assert "contradict the odometry" in slipped.doubt
    assert slipped.warnings("") == (slipped.doubt,)
    assert slipped.warnings(slipped.doubt) == honest[-1].warnings("") == ()
    assert (
        pose_health(
            RunningStatistics(odometry=1.01 * ODOMETRY_WEAK), ScanStatistics(), 50.0, 9, np.zeros((3, 3))
        ).state
        == "weak"
    )


def test_a_kidnapped_robot_is_lost():
    """The known trees are in free view and are not there."""
    rng = np.random.default_rng(0)
    slam = FastSlam(FOREST, 0)
    driven(slam, 30, rng)
    words = []
    for k in range(30, 60):
        elsewhere = detections([[2.0, 1.2], [5.0, -1.1], [-4.0, 1.4]], sigma=0.02)
        words.append(slam.process(k, Pose2(), elsewhere, ALL_FREE).health)
    assert "lost" in {h.state for h in words}
    assert next(h for h in words if h.state == "lost").reason


def test_driving_where_nothing_is_known_is_weak():
    rng = np.random.default_rng(0)
    slam = FastSlam(FOREST, 0)
    driven(slam, 30, rng)
    empty = [slam.process(k, Pose2(0.5), detections([]), NOTHING_SEEN).health for k in range(30, 42)]
    told = empty[-1]
    assert told.state == "weak"
    assert "only odometry" in told.reason
    assert np.isnan(told.innovation)


@pytest.mark.parametrize(
    ("recent", "sigma", "doubt", "state"),
    [
        (RunningStatistics(), 0.1, "", "good"),
        (RunningStatistics(), 1.01 * SIGMA_GOOD, "", "weak"),
        (RunningStatistics(), 1.01 * SIGMA_XY_MAX, "", "lost"),
        (RunningStatistics(), float("nan"), "", "lost"),
        (RunningStatistics(), 0.1, "no odometry", "weak"),
        (RunningStatistics(innovation=1.01 * INNOVATION_WEAK), 0.1, "", "weak"),
        (RunningStatistics(found=0.5 * FOUND_LOST, mapped=True), 0.1, "", "lost"),
        (RunningStatistics(found=0.5 * FOUND_LOST, mapped=False), 0.1, "", "good"),
        (RunningStatistics(ambiguous=0.9), 0.1, "", "weak"),
    ],
)
def test_the_word_and_its_reason(recent, sigma, doubt, state):
    health = pose_health(recent, ScanStatistics(), 50.0, 20, np.diag([sigma**2, sigma**2, 0.01**2]), doubt)
    assert health.state == state
    assert bool(health.reason) == (state != "good")


@given(seeds)
def test_the_statistics_of_particles_are_averaged_by_weight(seed):
    rng = np.random.default_rng(seed)
    statistics = rng.uniform(1.0, 2.0, (8, STATISTICS))
    third_only = np.eye(8)[3]
    scan = named_statistics(*mean_statistics(statistics, third_only, np.eye(3)), 5)
    assert scan.recognised == pytest.approx(statistics[3, RECOGNISED])
    assert scan.innovation == pytest.approx(statistics[3, INNOVATION] / (2 * statistics[3, RECOGNISED]))
    assert scan.odometry == pytest.approx(np.linalg.norm(statistics[3, SHIFT]), rel=1e-3)


def test_a_scan_that_says_nothing_leaves_the_means():
    recent = RunningStatistics(innovation=2.0, found=0.4, ambiguous=0.3, mapped=True)
    after = update_statistics(recent, ScanStatistics(), 1.0)
    assert (after.innovation, after.found, after.ambiguous) == (2.0, 0.4, 0.3)
    assert after.alone == 1.0


@pytest.mark.parametrize(("trees", "state"), [(MANY - 1, "weak"), (MANY, "good")])
def test_trees_that_contradict_an_odometry_for_long_must_be_many(trees, state):
    """Fewer may be people."""
    recent, scan = RunningStatistics(mapped=True), ScanStatistics(detections=trees, recognised=float(trees))
    for _ in range(2 * TREE_MOTION_SCANS):
        recent = update_statistics(recent, scan, 0.0, OdometryDoubt(contradicted=True))
    assert pose_health(recent, scan, 50.0, 20, np.zeros((3, 3)), "stuck").state == state


def test_trees_that_led_for_long_make_a_doubted_odometry_good():
    recent, states = RunningStatistics(mapped=True), []
    for _ in range(TREE_MOTION_SCANS + 5):
        recent = update_statistics(
            recent, ScanStatistics(detections=6, recognised=5.0), 0.0, OdometryDoubt(True)
        )
        states.append(pose_health(recent, ScanStatistics(), 50.0, 20, np.zeros((3, 3)), "no odometry").state)
    assert states == ["weak"] * (TREE_MOTION_SCANS - 1) + ["good"] * 6
    few = update_statistics(recent, ScanStatistics(detections=2, recognised=2.0), 0.0, OdometryDoubt(True))
    assert few.led == 0
    for k in range(2 * TREE_MOTION_SCANS):
        recent = update_statistics(
            recent, ScanStatistics(detections=6, recognised=5.0), 0.1, OdometryDoubt(k % 2 == 1)
        )
        word = pose_health(
            recent, ScanStatistics(), 50.0, 20, np.zeros((3, 3)), "no odometry" if k % 2 else ""
        ).state
        assert word == "good", "a doubt that comes and goes does not begin anew"
    for _ in range(TREE_MOTION_MAX):
        recent = update_statistics(recent, ScanStatistics(detections=6, recognised=5.0), 0.1)
    assert recent.led == 0, "another doubt is another one"


CHANCE = ScanStatistics(detections=12, recognised=1.0, found=20.0, missed=200.0)


@pytest.mark.parametrize(
    ("familiar", "alone", "doubted", "missed", "lost"),
    [
        (0.9, 0.0, False, 200.0, True),
        (0.9, 0.0, False, 0.0, False),  # what was known is hidden: the view has changed, and not the place
        (0.9, 0.0, False, 30.0, False),  # or a tree fell
        (0.9, 20.0, False, 200.0, False),
        (0.9, 20.0, True, 200.0, True),
        (0.3, 0.0, False, 200.0, False),
    ],
)
def test_a_known_place_whose_trees_are_all_missed_at_once_is_another_one(
    familiar, alone, doubted, missed, lost
):
    """Some trees are recognised there by chance."""
    recent, states = RunningStatistics(mapped=True, familiar=familiar, alone=alone), []
    for _ in range(STRANGE_LOST):
        recent = update_statistics(recent, replace(CHANCE, missed=missed), 0.2, OdometryDoubt(doubted))
        states.append(pose_health(recent, CHANCE, 50.0, 20, np.zeros((3, 3))).state)
    assert (recent.strange == STRANGE_LOST) == lost
    assert (states == ["weak"] * (STRANGE_LOST - 1) + ["lost"]) == lost
    assert is_lost(recent) == lost
    assert update_statistics(recent, replace(CHANCE, found=200.0), 0.2).strange == 0


def test_the_trees_of_another_place_do_not_soon_make_it_the_known_one():
    assert preset("forest").slam.hits_to_weigh < STRANGE_LOST
    recent = RunningStatistics(mapped=True, familiar=0.9)
    for hits in (0, 0, 0, 3, 4):
        scan = ScanStatistics(
            detections=12, recognised=12.0 if hits else 0.0, found=12.0 * hits, missed=200.0
        )
        recent = update_statistics(recent, scan, 0.2)
    assert is_lost(recent)


def test_distinct_ancestors_are_those_of_the_generations():
    rng = np.random.default_rng(0)
    genealogy, came_from = Genealogy(), []
    for k in range(3 * FOUNDED + 7):
        ancestors = np.sort(rng.integers(0, 40, 40)) if k % 3 == 0 else None
        came_from.append(np.arange(40) if ancestors is None else ancestors)
        genealogy = genealogy.with_scan(np.zeros((40, 3)), ancestors, 0)
    rows = np.arange(40)
    for ancestors in reversed(came_from[2 * FOUNDED :]):
        rows = ancestors[rows]
    assert genealogy.distinct_ancestors == len(set(rows.tolist()))
    assert Genealogy().distinct_ancestors == 0
