"""SLAM with odometry that is missing, stuck or jumping: reported, compensated, and with few false trees."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.odometry.synchroniser import steps
from pipeline.slam import FastSlam, Motion
from pipeline.slam.motion import SLACK_MAX, accumulated, correct_by_pose
from pipeline.types.records import Odometry, PoseMeasurement
from tests.pipeline.strategies import ALL_FREE, NOTHING_SEEN, detections, scan

FOREST = preset("forest").slam.model_copy(update={"update_distance": 0.0})
STRIDE, KNOWN, AFTER = 0.1, 60, 51
MS = 1_000_000


def stand(seed=3, trees=90):
    """Trees no nearer to one another than 1.5 m along the way."""
    rng = np.random.default_rng(seed)
    places: list[np.ndarray] = []
    while len(places) < trees:
        place = rng.uniform([-10.0, -12.0], [25.0, 12.0])
        if abs(place[1]) > 1.0 and all(np.hypot(*(place - p)) > 1.5 for p in places):
            places.append(place)
    return np.array(places)


WORLD = stand()


def seen(pose, rng, reach=10.0):
    """What a scan shows of the stand."""
    centre = pose.inverse().apply(WORLD)
    centre = centre[np.hypot(*centre.T) < reach]
    return detections(centre + rng.normal(0.0, 0.02, centre.shape), sigma=0.03)


def wheels(scans, change=None):
    """True poses and what the odometry says; `change` is applied to its pose from scan KNOWN on."""
    truth = [Pose2(STRIDE * k) for k in range(scans)]
    return truth, [p if change is None or k < KNOWN else change(p) for k, p in enumerate(truth)]


def driven(told, truth, missing=()):
    """Frames of a drive through the joiner of scans and odometry; scans in ms of 100."""
    records: list[Any] = []
    for k, pose in enumerate(told):
        if pose is not None and k not in missing:
            records.append(
                Odometry(k * 100 * MS, Pose3.from_euler(np.array([pose.x, pose.y, 0.0]), 0, 0, pose.yaw))
            )
        records.append(scan(k * 100 * MS))
    slam, rng, before, rows = FastSlam(FOREST, 0), np.random.default_rng(0), None, []
    losses = Counter[str]()
    for step in steps(records, losses=losses):
        at = round(step.scan.stamp_ns / (100 * MS))
        now = step.T_odom_base or before or Pose2()
        motion = Pose2() if before is None else before.inverse() @ now
        before = now
        estimate = slam.process(
            step.index, Motion(motion, step.slack, step.doubt, step.measured), seen(truth[at], rng), ALL_FREE
        )
        error = np.hypot(estimate.T_map_base.x - truth[at].x, estimate.T_map_base.y - truth[at].y)
        rows.append((at, estimate.health, error, step.warnings))
    return slam, rows, losses


def false_trees(slam):
    """Well known landmarks where no tree stands."""
    known = slam.state.map_of(slam.state.best)
    place = known.mean[known.hits >= FOREST.hits_to_weigh]
    return sum(np.hypot(*(WORLD - p).T).min() > 0.3 for p in place)


def good_again(rows):
    """Whether the last scan is good and near the truth, or it is said that the robot is lost."""
    _, health, error, _ = rows[-1]
    return (health.state == "good" and error < 0.2) or health.state == "lost"


@pytest.mark.parametrize("jump", [0.5, 5.0, 50.0])
def test_a_jump_of_the_odometry_leaves_the_map_as_it_was(jump):
    truth, told = wheels(KNOWN + AFTER, lambda p: Pose2(p.x + jump, p.y, p.yaw))
    slam, rows, _ = driven(told, truth)
    at_jump = rows[KNOWN][1]
    assert at_jump.state == "weak"
    assert "odometry" in at_jump.reason
    assert good_again(rows)
    assert false_trees(slam) <= 1


def test_a_flip_of_the_heading_leaves_the_map_as_it_was():
    truth, told = wheels(KNOWN + AFTER, lambda p: Pose2(-p.x, p.y, np.pi))
    slam, rows, _ = driven(told, truth)
    assert rows[KNOWN][1].state == "weak"
    assert any("jumped" in text for text in rows[KNOWN][3])
    assert good_again(rows)
    assert false_trees(slam) <= 1


def test_the_motion_of_stuck_wheels_is_determined_by_trees():
    truth, told = wheels(KNOWN + AFTER)
    told = [p if k < KNOWN else told[KNOWN - 1] for k, p in enumerate(told)]
    slam, rows, _ = driven(told, truth)
    assert rows[KNOWN][1].state == "weak"
    assert all("it is stuck" in health.doubt for _, health, _, _ in rows[KNOWN:])
    assert rows[-1][1].state == "good", "the trees lead"
    assert max(error for _, _, error, _ in rows[KNOWN:]) < 0.1
    assert false_trees(slam) == 0


def test_missing_odometry_is_weak_until_trees_determined_the_motion_for_long():
    truth, told = wheels(KNOWN + AFTER)
    slam, rows, _ = driven(told, truth, missing=range(KNOWN, KNOWN + AFTER))
    begun = next(k for k, (_, health, _, _) in enumerate(rows) if "no odometry" in health.doubt)
    assert KNOWN <= begun <= KNOWN + 3
    assert {health.state for _, health, _, _ in rows[begun : begun + 10]} == {"weak"}
    assert "no odometry" in rows[begun + 10][1].reason
    assert "no odometry" in rows[-1][1].doubt
    assert good_again(rows)
    assert max(error for _, _, error, _ in rows[KNOWN:]) < 0.1
    assert false_trees(slam) == 0


@pytest.mark.parametrize(("seen_trees", "last"), [(0, "lost"), (2, "weak")])
def test_missing_odometry_stays_weak_without_trees(seen_trees, last):
    slam, states = FastSlam(FOREST, 0), []
    for k in range(60):
        motion = Motion(Pose2(), (0.05, 0.02), "there is no odometry") if k >= 10 else Pose2()
        found = [[4.0, 1.0], [4.0, -1.0]][:seen_trees]
        states.append(slam.process(k, motion, detections(found), NOTHING_SEEN).health.state)
    assert set(states[10:]) == {"weak", last}
    assert states[-1] == last, "five seconds at 0.5 m/s are farther than the next tree"


@pytest.mark.parametrize("scans", [1, 4, 40])
def test_the_sigma_of_an_unknown_velocity_grows_with_the_time_and_not_with_its_root(scans):
    speed, time = 0.5, 4.0
    motion, covariance, slack = np.zeros(3), np.zeros((3, 3)), np.zeros(2)
    for _ in range(scans):
        part = (speed * time / scans, 0.1 * time / scans)
        step = Motion(Pose2(), part, "there is no odometry", period=time / scans)
        moved = accumulated(motion, covariance, slack, step, 0.0, FOREST)
        assert moved is not None
        motion, covariance, slack, _ = moved
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [2.0, 2.0, 0.4])


def test_the_sigma_of_an_unknown_motion_is_bounded():
    moved = accumulated(
        np.zeros(3), np.zeros((3, 3)), np.zeros(2), Motion(Pose2(), (30.0, 12.0)), 0.0, FOREST
    )
    assert moved is not None
    np.testing.assert_allclose(np.sqrt(np.diag(moved[1])), [SLACK_MAX[0], *SLACK_MAX])


@pytest.mark.parametrize("shown", [True, False])
def test_trees_end_the_growth_of_the_sigma_without_odometry(shown):
    slam = FastSlam(FOREST, 0)
    for k in range(30):
        motion = Motion(Pose2(), (0.05, 0.02), "there is no odometry") if k >= 10 else Pose2()
        found = detections([[4.0, 1.0], [4.0, -1.0], [-2.0, 3.0]] if shown or k < 10 else [])
        slam.process(k, motion, found, NOTHING_SEEN)
    assert slam.state.slack[0] == pytest.approx(0.0 if shown else 1.0)


@pytest.mark.parametrize("hz", [10, 20])
def test_a_doubtful_odometry_uses_as_many_views_and_as_much_slack_at_each_rate(hz):
    records = [scan(round(k * 1000 / hz) * MS) for k in range(4 * hz)]
    slam = FastSlam(FOREST, 0)
    for step in steps(records):
        motion = Motion(Pose2(), step.slack, step.doubt, is_view=step.is_view, period=step.period_ns * 1e-9)
        slam.process(step.index, motion, detections(np.zeros((0, 2))), NOTHING_SEEN)
    assert slam.state.views == 40
    assert slam.state.slack[0] == pytest.approx(0.5 * (4.0 - 1.0 / hz))


def test_a_gap_of_sixty_seconds_without_anything_is_bridged():
    """The robot was pushed two metres while all was off, and its odometry starts where it ended."""
    scans = KNOWN + AFTER
    truth = [Pose2(STRIDE * k + (2.0 if k >= KNOWN else 0.0)) for k in range(scans)]
    slam, rng, told = FastSlam(FOREST, 0), np.random.default_rng(0), []
    for k in range(scans):
        gap = k == KNOWN
        motion = Motion(
            Pose2(0.0 if k in (0, KNOWN) else STRIDE),
            (3.0, 0.5) if gap else (0.0, 0.0),
            "there is no odometry" if gap else "",
        )
        estimate = slam.process(k, motion, seen(truth[k], rng), ALL_FREE)
        told.append((k, estimate.health, abs(estimate.T_map_base.x - truth[k].x), ()))
    assert told[KNOWN][1].state == "weak"
    assert good_again(told)
    assert false_trees(slam) <= 1


@pytest.mark.parametrize("bad", ["NaN", "back in time", "twice"])
def test_invalid_readings_are_skipped_and_counted(bad):
    truth, told = wheels(KNOWN)
    records: list[Any] = []
    for k, pose in enumerate(told):
        records.append(Odometry(k * 100 * MS, Pose3.from_euler(np.array([pose.x, 0.0, 0.0]), 0, 0, 0)))
        if k == 30:
            at = {"NaN": 3050, "back in time": 1000, "twice": 3000}[bad] * MS
            x = np.nan if bad == "NaN" else 9.0
            records.append(Odometry(at, Pose3(np.eye(3), np.array([x, 0.0, 0.0]))))
        records.append(scan(k * 100 * MS))
    losses = Counter[str]()
    joined = list(steps(records, losses=losses))
    assert sum(losses.values()) == 1
    assert any("left out" in text for step in joined for text in step.warnings)
    np.testing.assert_allclose(
        [s.T_odom_base.x for s in joined if s.T_odom_base], [p.x for p in truth], atol=1e-9
    )


# --- poses by another source ----------------------------------------------------------------------


def measured(x, y, yaw=0.0, sigma=(0.05, 0.05, 0.02), stamp_ns=0):
    """A pose of another source."""
    return PoseMeasurement(stamp_ns, Pose2(x, y, yaw), np.diag(np.square(sigma)))


def test_a_measured_pose_gives_the_kalman_update():
    from filterpy.kalman import update

    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    P, R, mu, z = A @ A.T + np.eye(3), B @ B.T + np.eye(3), rng.normal(size=3), rng.normal(size=3)
    wanted_mu, wanted_P = update(mu.copy(), P.copy(), z, R=R, H=np.eye(3))
    told_mu, told_P = mu.copy(), P.copy()
    likelihood = correct_by_pose(told_mu, told_P, z, R)
    np.testing.assert_allclose(told_mu, wanted_mu, atol=1e-12)
    np.testing.assert_allclose(told_P, wanted_P, atol=1e-12)
    S = P + R
    y = z - mu
    assert likelihood == pytest.approx(-0.5 * (y @ np.linalg.solve(S, y)) - 0.5 * np.log(np.linalg.det(S)))


@pytest.mark.parametrize("method", ["fastslam1", "fastslam2"])
def test_a_measured_pose_bounds_the_drift(method):
    """Where no tree stands the odometry drifts; another source says where the robot is."""
    errors = {}
    for helped in (False, True):
        slam = FastSlam(FOREST.model_copy(update={"method": method, "noise_distance": 0.2}), 0)
        told = []
        for k in range(80):
            pose = measured(0.5 * k, 0.0) if helped and k % 5 == 0 and k else None
            motion = Motion(Pose2(0.5, 0.02) if k else Pose2(), measured=pose)
            told.append(slam.process(k, motion, detections([]), NOTHING_SEEN))
        errors[helped] = (abs(told[-1].T_map_base.y), float(np.sqrt(told[-1].covariance[1, 1])))
    assert errors[False][0] > 1.0
    assert errors[True][0] < 0.3
    assert errors[True][1] < errors[False][1]


@pytest.mark.parametrize(
    "covariance",
    [
        np.diag([1.0, 1.0, -1.0]),
        np.full((3, 3), np.nan),
        np.zeros((3, 3)),
        np.eye(2),
        np.eye(3) + np.eye(3, k=1),
    ],
    ids=["negative", "NaN", "zero", "2 x 2", "not symmetric"],
)
def test_a_measured_pose_with_an_invalid_covariance_is_skipped_and_counted(covariance):
    losses = Counter[str]()
    bad = PoseMeasurement(0, Pose2(), covariance)
    (step,) = steps([bad, scan(0)], losses=losses)
    assert step.measured is None
    assert sum(losses.values()) == 1
    assert any("positive definite" in text for text in step.warnings)


def test_a_measured_pose_is_used_between_two_views():
    slam = FastSlam(FOREST, 0)
    slam.process(0, Pose2(), detections([]), NOTHING_SEEN)
    motion = Motion(Pose2(0.5), measured=measured(0.6, 0.0, sigma=(1e-3, 1e-3, 1e-3)), is_view=False)
    estimate = slam.process(1, motion, detections([]), NOTHING_SEEN)
    assert estimate.T_map_base.x == pytest.approx(0.6, abs=0.01)


def test_a_measured_pose_is_used_at_the_scan_of_its_time():
    poses = [measured(float(k), 0.0, stamp_ns=k * 1000 * MS) for k in range(3)]
    records = [poses[0], scan(10 * MS), poses[1], scan(500 * MS), scan(1020 * MS), poses[2], scan(2000 * MS)]
    assert [s.measured and s.measured.T_map_base.x for s in steps(records, odometry="static")] == [
        0.0,
        None,
        1.0,
        2.0,
    ]
