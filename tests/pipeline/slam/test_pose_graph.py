"""The pose graph: exact where nothing errs, bent by a loop, and with the same face as FastSLAM."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from pipeline.config import Parameters, preset, stages
from pipeline.errors import ParameterError
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.slam import BackEnd, FastSlam, GraphState, Motion, SlamState
from pipeline.slam.pose_graph.joint import correct_by_pose, moved_joint, recognise_jointly
from pipeline.slam.poses import composed, interpolated, inverse
from pipeline.slam.scan_statistics import RECOGNISED, TOLD
from pipeline.types.records import PoseMeasurement
from tests.pipeline.strategies import ALL_FREE, NOTHING_SEEN, detections, seeds

FOREST = preset("forest").slam
WORLD = np.stack(np.meshgrid(np.arange(-6.0, 31.0, 4.0), [-4.0, 3.0]), axis=-1).reshape(-1, 2)
SIGMA = 0.03


def graph(**changes: float):
    """A pose graph with the parameters of the preset `forest`."""
    pytest.importorskip("gtsam", reason="the pose graph needs the extra `graph`")
    return BackEnd(FOREST.model_copy(update={"method": "graph", **changes}), 0)


def seen(pose, world=WORLD, reach=9.0, rng=None):
    """Detections of the world's trees from a pose."""
    centre = pose.inverse().apply(world)
    centre = centre[np.hypot(*centre.T) < reach]
    return detections(centre + (rng.normal(0, SIGMA, centre.shape) if rng else 0.0), sigma=SIGMA)


def circle(k, scans=120, radius=6.0):
    """The pose at scan k of a circle that begins at the origin."""
    a = 2.0 * np.pi * k / scans
    return Pose2(radius * np.sin(a), radius * (1.0 - np.cos(a)), a)


def driven(slam, poses, error=lambda _k: (0.0, 0.0, 0.0), rng=None, reach=9.0, look=lambda _k: True):
    """Estimates along poses with an error a step of the odometry."""
    estimates = []
    for k, T in enumerate(poses):
        step = Pose2() if k == 0 else poses[k - 1].inverse() @ T
        dx, dy, dyaw = error(k) if k else (0.0, 0.0, 0.0)
        step = Pose2(step.x + dx, step.y + dy, step.yaw + dyaw)
        at = seen(T, reach=reach if look(k) else 0.0, rng=rng)
        estimates.append(slam.process(k, step, at, NOTHING_SEEN))
    return estimates


def as_rows(poses):
    """Poses as an array, shape (N, 3)."""
    return np.array([T.as_array() for T in poses])


def off(slam, poses):
    """Distances of the path from the truth [m]."""
    return np.hypot(*(slam.path() - as_rows(poses))[:, :2].T)


def test_a_loop_without_noise_is_exact():
    slam, poses = graph(), [circle(k) for k in range(240)]
    estimates = driven(slam, poses)
    assert np.abs([e.T_map_base.x for e in estimates] - as_rows(poses)[:, 0]).max() < 1e-6
    assert off(slam, poses).max() < 1e-6
    mean = slam.landmarks().position
    away = np.hypot(*(mean[:, None] - WORLD[None]).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 1e-6
    assert len(mean) == len(set(away.argmin(axis=1)))  # no tree twice


def test_coming_back_bends_the_path_in_between():
    # Trees are seen at the start and after a whole turn; between them the odometry turns too much.
    poses = [circle(k, radius=8.0) for k in range(135)]
    slam = graph(noise_turn_distance=1.0)
    bias = 0.15 / 120  # rad a step
    look = lambda k: k < 12 or k >= 118  # noqa: E731
    driven(slam, poses[:118], error=lambda _k: (0.0, 0.0, bias), look=look)
    before = off(slam, poses[:118])
    state = slam.state.copy()
    slam = graph(noise_turn_distance=1.0)
    slam.state = state
    for k in range(118, 135):
        step = poses[k - 1].inverse() @ poses[k]
        slam.process(k, Pose2(step.x, step.y, step.yaw + bias), seen(poses[k]), NOTHING_SEEN)
    after = off(slam, poses)
    assert before[60:].max() > 0.5
    assert after[:118].max() < 0.5 * before.max()
    assert after[-1] < 0.05


@given(seeds)
@settings(max_examples=settings().max_examples // 8)  # each example maps 80 scans twice
def test_graph_and_particles_agree_within_what_both_allow(seed):
    poses = [Pose2(0.1 * k) for k in range(80)]
    told = []
    for slam in (graph(), FastSlam(FOREST, 0)):
        rng, noise = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        error = lambda _k, noise=noise: (*noise.normal(0, 0.009, 2), noise.normal(0, 0.002))  # noqa: E731
        told.append(driven(slam, poses, error=error, rng=rng)[-1])
    a, b = told
    sigma = np.sqrt(a.covariance[0, 0] + b.covariance[0, 0] + SIGMA**2)
    assert abs(a.T_map_base.x - b.T_map_base.x) < 4.0 * sigma
    assert abs(a.T_map_base.y - b.T_map_base.y) < 4.0 * sigma
    assert a.health.state == "good"
    assert 0.2 < a.health.sigma_xy / b.health.sigma_xy < 5.0


def test_a_state_goes_on_to_the_same_bytes():
    poses, slam = [circle(k) for k in range(100)], graph()

    def go_on():
        rng = np.random.default_rng(3)
        for k in range(60, 100):
            step = poses[k - 1].inverse() @ poses[k]
            slam.process(k, step, seen(poses[k], rng=rng), ALL_FREE)
        return slam.path().tobytes(), slam.landmarks().position.tobytes()

    driven(slam, poses[:60], rng=np.random.default_rng(0))
    kept = slam.state.copy()
    first = go_on()
    slam.state = kept.copy()
    assert len(slam.path()) == 60
    assert go_on() == first
    slam.state = kept
    assert go_on() == first


def test_what_is_seen_once_never_enters_the_graph_and_what_is_gone_vanishes():
    slam = graph()
    ghost = np.array([[2.0, 1.0]])
    slam.process(0, Pose2(), detections(np.vstack([WORLD[:4], ghost]), sigma=SIGMA), ALL_FREE)
    for k in range(1, 30):
        pose = Pose2(0.3 * k)
        slam.process(k, Pose2(0.3), seen(pose), ALL_FREE)
    mean = slam.landmarks().position
    assert np.hypot(*(mean - ghost).T).min() > 0.5
    assert slam.state.smoother.landmarks <= len(WORLD)


def test_two_trees_of_one_scan_stay_two():
    slam = graph()
    pair = np.array([[5.0, 0.0], [5.0, 0.5], [2.0, 3.0], [2.0, -3.0]])
    for k in range(12):
        centre = Pose2(0.26 * k).inverse().apply(pair)
        slam.process(k, Pose2(0.26 if k else 0.0), detections(centre, sigma=SIGMA), NOTHING_SEEN)
    assert len(slam.landmarks().position) == 4


def test_a_measured_pose_is_taken_and_a_placing_moves_the_robot():
    slam = graph()
    driven(slam, [Pose2(0.3 * k) for k in range(5)])
    measured = PoseMeasurement(0, Pose2(2.0, 0.5, 0.0), np.eye(3) * 1e-4)
    assert slam.process(5, Motion(Pose2(0.3), measured=measured), seen(Pose2(), reach=0.0), NOTHING_SEEN)
    moved = slam.process(6, Pose2(), seen(Pose2(), reach=0.0), NOTHING_SEEN)
    assert 0.0 < moved.T_map_base.y <= 0.5  # robust: between what the odometry says and what was measured
    slam.place(7, Pose2(3.0, 1.0, 0.5), np.eye(3) * 1e-4)
    placed = slam.estimate(moved)
    assert placed.T_map_base == Pose2(3.0, 1.0, 0.5)
    assert len(slam.path()) == 7
    assert np.all(np.isfinite(slam.path()))


def test_particles_and_graph_take_over_from_one_another():
    slam, poses = graph(), [circle(k) for k in range(90)]
    driven(slam, poses[:60])
    mean, path = slam.landmarks().position, slam.path()
    slam.parameters = FOREST
    taken_over: object = slam.state
    assert isinstance(taken_over, SlamState)
    np.testing.assert_allclose(slam.landmarks().position, mean)
    np.testing.assert_allclose(slam.path(), path, atol=1e-5)
    for k in range(60, 75):
        slam.process(k, poses[k - 1].inverse() @ poses[k], seen(poses[k]), NOTHING_SEEN)
    slam.parameters = FOREST.model_copy(update={"method": "graph"})
    again: object = slam.state
    assert isinstance(again, GraphState)
    for k in range(75, 90):
        slam.process(k, poses[k - 1].inverse() @ poses[k], seen(poses[k]), NOTHING_SEEN)
    assert off(slam, poses).max() < 0.1
    assert len(slam.landmarks().position) <= len(WORLD)


def test_without_gtsam_the_choice_names_the_extra(monkeypatch):
    monkeypatch.setattr(stages, "find_spec", lambda _name: None)
    with pytest.raises(ParameterError, match=r"stemmap\[graph\]"):
        Parameters().replace({"slam.method": "graph"})
    assert Parameters().replace({"slam.method": "fastslam1"}).slam.method == "fastslam1"


@given(seeds)
def test_the_joint_update_is_the_textbook_one(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(0, 0.05, (7, 7))
    m, Sigma = np.array([1.0, 2.0, rng.uniform(-3, 3), 6.0, 2.0, -3.0, 1.0]), A @ A.T + np.eye(7) * 1e-6
    R = np.eye(2) * SIGMA**2
    z = Pose2(*m[:3]).inverse().apply(m[3:5][None] + rng.normal(0, 0.02, (1, 2)))
    expected, P = m.copy(), Sigma.copy()
    c, s = np.cos(m[2]), np.sin(m[2])
    C = np.array([[c, -s], [s, c]])
    a = C @ z[0]
    H = np.zeros((2, 7))
    H[:, :2], H[:, 2], H[:, 3:5] = np.eye(2), [-a[1], a[0]], -np.eye(2)
    y = m[:2] + a - m[3:5]
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + C @ R @ C.T)
    expected, P = expected - K @ y, P - K @ H @ P
    told, hits = np.zeros(TOLD), np.array([5, 5], np.int32)
    assert recognise_jointly(m, Sigma, z, R[None], hits, 50.0, 5.0, 3, told).tolist() == [0]
    np.testing.assert_allclose(m, expected, atol=1e-9)
    np.testing.assert_allclose(Sigma, P, atol=1e-9)
    assert told[RECOGNISED] == 1.0


def test_a_shared_error_is_taken_from_all_landmarks_by_the_first():
    # Three trees, all a metre off together and known well with respect to each other.
    m = np.array([0.0, 0.0, 0.0, 5.0, 0.0, 6.2, 0.0, 4.0, 3.0])
    Sigma = np.eye(9) * 1e-4
    Sigma[3::2, 3::2] += 1.0
    z = np.array([[6.0, 0.0], [7.2, 0.0], [5.0, 3.0]])
    R = np.tile(np.eye(2) * 1e-3, (3, 1, 1))
    hits = np.full(3, 9, np.int32)
    found = recognise_jointly(m, Sigma, z, R, hits, 3.5, 1.5, 3, np.zeros(TOLD))
    assert found.tolist() == [0, 1, 2]


@given(seeds)
def test_moving_a_joint_gaussian_moves_its_pose_and_turns_the_noise_into_the_map(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(5, 5))
    m, Sigma = rng.normal(size=5), A @ A.T
    before, covariance = m.copy(), Sigma.copy()
    motion, Q = rng.normal(size=3), np.diag(rng.uniform(0, 1, 3))
    moved_joint(m, Sigma, motion, Q)
    expected = Pose2(*before[:3]) @ Pose2(*motion)
    np.testing.assert_allclose(m[:2], [expected.x, expected.y])
    assert np.cos(m[2] - expected.yaw) == pytest.approx(1.0)
    np.testing.assert_allclose(m[3:], before[3:])
    np.testing.assert_allclose(Sigma, Sigma.T, atol=1e-9)
    c, s = np.cos(before[2]), np.sin(before[2])
    F, G = np.eye(5), np.zeros((5, 3))
    F[:2, 2] = -s * motion[0] - c * motion[1], c * motion[0] - s * motion[1]
    G[:3] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(Sigma, F @ covariance @ F.T + G @ Q @ G.T, atol=1e-9)
    correct_by_pose(m, Sigma, m[:3] + 0.1, np.eye(3) * 1e-12)
    assert np.abs(Sigma[:3]).max() < 1e-5


@given(seeds)
def test_between_keyframes_the_path_ends_where_the_next_one_is(seed):
    rng = np.random.default_rng(seed)
    keyframes = rng.normal(size=(3, 3))
    motions = np.vstack([np.full(3, np.nan), rng.normal(size=(2, 3))])
    keyframe = np.array([0, 0, 0, 0, 1, 1, 2])
    since = np.zeros((7, 3))
    since[1:4] = motions[1] * np.array([0.25, 0.5, 0.75])[:, None]
    since[5] = motions[2] * 0.5
    path = interpolated(keyframes, motions, keyframe, since)
    keyframes[:, 2] = wrap_angle(keyframes[:, 2])
    np.testing.assert_allclose(path[[0, 4, 6]], keyframes, atol=1e-12)
    exact = np.vstack([motions[:1], composed(inverse(keyframes[:-1]), keyframes[1:])])
    held = interpolated(keyframes, exact, keyframe, since)
    np.testing.assert_allclose(held, composed(keyframes[keyframe], since), atol=1e-9)


def test_the_mapper_goes_on_from_what_it_saved():
    pytest.importorskip("gtsam", reason="the pose graph needs the extra `graph`")
    source = open_source("sim:paper?duration=4")
    known = source.description
    parameters = preset(known.preset).replace({"slam.method": "graph"})

    def mapper():
        return Mapper(parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=0)

    first, every = mapper(), list(steps(source.records()))[:40]
    for step in every[:25]:
        first.process(step)
    snapshot, saved = first.snapshot(), SavedMap.of(first)
    ends = [first.process(step) for step in every[25:]][-1]
    first.restore(snapshot)
    assert len(first.path.x) == 25
    again = [first.process(step) for step in every[25:]][-1]
    assert again.estimate.T_map_base == ends.estimate.T_map_base
    second = mapper()
    second.load(saved.state(), saved.stamp_ns, saved.sigma_xy, saved.motion)
    other = [second.process(step) for step in every[25:]][-1]
    away = other.estimate.T_map_base.inverse() @ ends.estimate.T_map_base
    assert np.hypot(away.x, away.y) < 0.1
    assert len(second.path.x) == len(every)
    assert len(other.trees.number) == len(ends.trees.number)
