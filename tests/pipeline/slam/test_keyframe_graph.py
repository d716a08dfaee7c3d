"""Graph of keyframes: exact without errors, the same minimum as two other solvers, robust and bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.optimize import least_squares

from pipeline.geometry.pose_arrays import composed, inverse
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.slam import graph_solver
from pipeline.slam.graph_solver import CAUCHY
from pipeline.slam.keyframe_graph import (
    KEYFRAMES_MAX,
    STEMS_MAX,
    Keyframe,
    KeyframeGraph,
    ScanDetections,
    combined,
)
from pipeline.slam.places import REVISIT_DISTANCE
from tests.pipeline.strategies import seeds

STEMS = np.array([[2.0, 3.0], [4.0, -3.0], [-1.0, 4.0], [6.0, 2.5], [0.5, -4.0], [9.0, 4.0]])
SIGMA, Q = 0.05, np.diag(np.square([0.05, 0.05, 0.01]))


def arc(n, radius=8.0, turn=0.15):
    """True poses along an arc, x, y [m], yaw [rad]."""
    a = turn * np.arange(n)
    return np.column_stack([radius * np.sin(a), radius * (1.0 - np.cos(a)), wrap_angle(a)])


def graph_of(true, rng=None, stems=STEMS, birth=None):
    """A graph of noisy motions and detections whose first guess is the path by odometry."""
    noise = (lambda *size: rng.normal(size=size)) if rng else (lambda *size: np.zeros(size))
    birth = np.arange(len(stems)) if birth is None else birth
    graph, pose = KeyframeGraph(), true[0]
    for k, T in enumerate(true):
        motion = np.zeros(3)
        if k:
            motion = composed(inverse(true[k - 1 : k]), true[k : k + 1])[0] + noise(3) * np.sqrt(np.diag(Q))
            pose = composed(pose[None], motion[None])[0]
        centre = Pose2(*T).inverse().apply(stems) + SIGMA * noise(len(stems), 2)
        R = np.tile([SIGMA**2, 0.0, SIGMA**2], (len(stems), 1))
        graph = graph.with_keyframe(Keyframe(k, 0, float(k), motion, Q, birth, centre, R), pose)
    return graph


def off(pose, true):
    """Distances from the truth [m]."""
    return np.hypot(*(pose - true)[:, :2].T)


def residuals(graph, x, birth, place):
    """Whitened errors, scaled such that the sum of their squares is the robust cost."""
    rows = []
    for k, keyframe in enumerate(graph.keyframes):
        if k:
            e = composed(inverse(x[k - 1 : k]), x[k : k + 1])[0] - keyframe.motion
            e[2] = wrap_angle(e[2])
            rows.append(np.linalg.solve(np.linalg.cholesky(Q), e))
        e = (
            Pose2(*x[k]).inverse().apply(place[np.searchsorted(birth, keyframe.birth)]) - keyframe.centre
        ) / SIGMA
        d2 = np.maximum((e * e).sum(axis=1), 1e-12)
        rows.append((e * np.sqrt(CAUCHY**2 * np.log1p(d2 / CAUCHY**2) / d2)[:, None]).ravel())
    return np.concatenate(rows)


def test_without_errors_the_truth_is_found():
    true = arc(12)
    solution = graph_of(true).solve()
    np.testing.assert_allclose(solution.pose, true, atol=1e-6)
    np.testing.assert_allclose(solution.position, STEMS, atol=1e-6)


@given(seeds)
@settings(max_examples=5)
def test_the_minimum_is_that_of_a_dense_solver(seed):
    true = arc(8)
    graph = graph_of(true, np.random.default_rng(seed))
    solution = graph.solve()
    n = 3 * (len(true) - 1)

    def errors(v):
        return residuals(
            graph, np.vstack([graph.pose[:1], v[:n].reshape(-1, 3)]), solution.birth, v[n:].reshape(-1, 2)
        )

    start = np.concatenate([solution.pose[1:].ravel(), solution.position.ravel()])
    best = least_squares(errors, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert 0.5 * (errors(start) ** 2).sum() <= best.cost * 1.002 + 1e-9
    np.testing.assert_allclose(solution.pose[1:].ravel(), best.x[:n], atol=0.01)


def test_the_minimum_and_its_covariance_are_those_of_gtsam():
    gtsam = pytest.importorskip("gtsam")
    true = arc(10)
    graph = graph_of(true, np.random.default_rng(4))
    solution = graph.solve()
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    held = gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
    factors.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(*graph.pose[0]), held))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
    # Far from the robot a circular error of the position is one of bearing and range.
    for k, keyframe in enumerate(graph.keyframes):
        values.insert(X(k), gtsam.Pose2(*graph.pose[k]))
        if k:
            noise = gtsam.noiseModel.Gaussian.Covariance(Q)
            factors.add(gtsam.BetweenFactorPose2(X(k - 1), X(k), gtsam.Pose2(*keyframe.motion), noise))
        for j, z in zip(keyframe.birth, keyframe.centre, strict=True):
            r = np.hypot(*z)
            sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([SIGMA / r, SIGMA]))
            robust = gtsam.noiseModel.Robust.Create(cauchy, sigmas)
            factors.add(
                gtsam.BearingRangeFactor2D(X(k), L(int(j)), gtsam.Rot2(np.arctan2(z[1], z[0])), r, robust)
            )
    for j, place in zip(solution.birth, solution.position, strict=True):
        values.insert(L(int(j)), place)
    best = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    theirs = np.array([[(p := best.atPose2(X(k))).x(), p.y(), p.theta()] for k in range(len(true))])
    # Both are estimates of the same poses, whose errors of linearisation are far below their sigma.
    sigma = np.sqrt(solution.covariance[:, 0, 0] + solution.covariance[:, 1, 1])
    assert np.all(off(solution.pose, theirs) < 0.2 * sigma + 2e-3)
    last = len(true) - 1
    Sigma = gtsam.Marginals(factors, best).marginalCovariance(X(last))
    C = np.eye(3)
    C[:2, :2] = Pose2(*theirs[last]).rotation()
    np.testing.assert_allclose(solution.covariance[last], C @ Sigma @ C.T, rtol=0.25, atol=1e-5)


def test_a_long_chain_is_solved_to_its_end():
    # It bends with a tiny share of its stiffness, which no damping may hold.
    true = np.column_stack([np.arange(400.0), np.zeros(400), np.zeros(400)])
    row, side = np.divmod(np.arange(800), 2)
    stems = np.column_stack([row - 0.5, np.where(side, 6.0, -6.0)])
    graph = KeyframeGraph()
    rng = np.random.default_rng(1)
    bend = 1e-3 * np.arange(400)
    bent = np.column_stack([np.cumsum(np.cos(bend)), np.cumsum(np.sin(bend)), bend])
    for k, T in enumerate(true):
        seen = np.flatnonzero(np.abs(stems[:, 0] - k) < 4.0)
        centre = stems[seen] - T[:2] + SIGMA * rng.normal(size=(len(seen), 2))
        R = np.tile([SIGMA**2, 0.0, SIGMA**2], (len(seen), 1))
        motion = np.array([float(k > 0), 0.0, 1e-3])
        graph = graph.with_keyframe(Keyframe(k, 0, float(k), motion, 9.0 * Q, seen, centre, R), bent[k])
    first = graph.solve()
    assert first is not None
    again = replace(graph, pose=first.pose).solve()
    assert again is not None
    sigma = np.sqrt(first.covariance[-1, 2, 2])
    assert abs(wrap_angle(again.pose[-1, 2] - first.pose[-1, 2])) < 0.1 * sigma


def test_a_step_to_a_cost_that_is_no_number_is_no_solution(monkeypatch: pytest.MonkeyPatch):
    graph, linearised = graph_of(arc(6), np.random.default_rng(1)), graph_solver.Problem._linearised
    calls = []

    def broken(problem, x, l, quadratic_loops):  # noqa: E741
        cost, normal = linearised(problem, x, l, quadratic_loops)
        calls.append(cost)
        return cost if len(calls) == 1 else np.nan, normal

    monkeypatch.setattr(graph_solver.Problem, "_linearised", broken)
    assert graph.solve() is None
    assert len(calls) > 2, "larger dampings were tried"


def test_a_wrong_association_is_switched_off():
    true = arc(12)
    graph = graph_of(true, np.random.default_rng(1))
    wrong = graph.keyframes[6]
    birth = wrong.birth.copy()
    birth[[0, 1]] = birth[[1, 0]]  # two trees 6 m apart
    keyframes = (*graph.keyframes[:6], replace(wrong, birth=birth), *graph.keyframes[7:])
    assert off(replace(graph, keyframes=keyframes).solve().pose, true).max() < 0.1


def with_full_weight_first(graph):
    """The solution from where the loop has its full weight, as when a loop is closed."""
    return replace(graph, pose=graph.solve(added=1).pose).solve()


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_a_wrong_loop_has_no_effect_on_a_graph_that_contradicts_it(shift):
    true = arc(40)
    graph = graph_of(true, np.random.default_rng(2))
    place = Pose2(true[-1, 0] + shift, true[-1, 1], true[-1, 2])
    graph = graph.with_loop(0, place, np.diag(np.square([0.05, 0.05, 0.01])), graph.pose)
    assert off(with_full_weight_first(graph).pose, true).max() < 0.3


@pytest.mark.parametrize("drift", [0.0, 3.0])
def test_the_support_is_the_number_of_revisits_that_fit(drift):
    """Four trees at the beginning of a lap, seen again at its end at a pose that may have drifted."""
    true = arc(42, turn=2.0 * np.pi / 41.0, radius=40.0)
    graph = lap(true, drift, takes_for_known=drift == 0.0)
    revisit, known = graph.revisit(3), 16.0 if drift == 0.0 else 0.0
    assert graph.support(revisit, graph.solve()) == pytest.approx(known, abs=1.0)
    closed = graph.with_loop(0, Pose2(*true[-1]), 1e-4 * np.eye(3), graph.pose)
    first = closed.solve(added=1)
    assert off(first.pose, true)[-1] < 0.1
    # The trees of the second visit get the names of the first one.
    again = replace(closed.renamed(np.arange(100, 104), np.arange(4)), pose=first.pose)
    assert again.support(revisit, again.solve()) == pytest.approx(16.0, abs=1.0)


def test_a_loop_corrects_the_drift_of_the_way_between():
    true = arc(42)
    bare = graph_of(true, np.random.default_rng(3), STEMS[:0])
    loop = bare.with_loop(0, Pose2(*true[-1]), 1e-6 * np.eye(3), bare.pose).solve(added=1)
    assert off(loop.pose, true)[-1] < 0.01
    assert off(loop.pose, true).mean() < 0.7 * off(bare.pose, true).mean()


def test_the_covariance_of_a_pose_is_that_given_all_others_and_that_of_the_map():
    solution = graph_of(arc(10), np.random.default_rng(4)).solve()
    np.testing.assert_allclose(solution.of_map[-1] + solution.conditional, solution.covariance[-1], atol=1e-9)
    np.testing.assert_array_equal(solution.of_map[0], solution.of_map[1])
    assert np.linalg.eigvalsh(solution.of_map).min() > -1e-15


@pytest.mark.parametrize("most", [0, 4])
def test_stems_that_remain_unknowns_have_the_solution_of_eliminated_ones(monkeypatch, most):
    graph = graph_of(arc(80, radius=40.0, turn=0.02), np.random.default_rng(3))
    eliminated = graph.solve()
    monkeypatch.setattr(graph_solver, "VIEWS_MAX", most)
    remaining = graph.solve()
    for name in ("pose", "position", "covariance", "of_map", "conditional"):
        np.testing.assert_allclose(
            getattr(remaining, name), getattr(eliminated, name), rtol=1e-7, atol=1e-9, err_msg=name
        )


def test_the_part_of_the_map_is_interpolated_from_the_second_keyframe_on(monkeypatch):
    """The covariance of the first keyframe is zero, because it is fixed; that of its stems is not."""
    graph = graph_of(arc(80, radius=40.0, turn=0.02), np.random.default_rng(2))
    interpolated = graph.solve().of_map
    monkeypatch.setattr(graph_solver, "MARGINALS", len(graph.keyframes))
    exact = graph.solve().of_map
    np.testing.assert_allclose(interpolated[1], exact[1], rtol=1e-6)
    sigma, expected = (np.sqrt(np.trace(part[:, :2, :2], axis1=1, axis2=2)) for part in (interpolated, exact))
    np.testing.assert_allclose(sigma, expected, rtol=0.25)


def test_a_keyframe_without_odometry_and_detections_does_not_prevent_a_solution():
    graph = graph_of(arc(6))
    lost = replace(
        graph.keyframes[3],
        covariance=np.full((3, 3), np.inf),
        birth=np.zeros(0, np.int64),
        centre=np.zeros((0, 2)),
        R=np.zeros((0, 3)),
    )
    after = replace(graph.keyframes[4], covariance=np.full((3, 3), np.inf))
    assert (
        replace(graph, keyframes=(*graph.keyframes[:3], lost, after, graph.keyframes[5])).solve() is not None
    )


def test_the_covariance_of_a_loop_is_turned_into_the_axes_of_its_first_keyframe():
    true = arc(5)
    true[:, 2] += 0.6
    graph = graph_of(true, np.random.default_rng(3), STEMS[:0])
    covariance = np.array([[0.09, 0.01, 0.002], [0.01, 0.01, 0.0], [0.002, 0.0, 0.001]])
    yaw = graph.pose[0, 2]
    assert abs(np.sin(2.0 * yaw)) > 0.5
    C = np.eye(3)
    C[:2, :2] = Pose2(0.0, 0.0, yaw).rotation().T
    edge = graph.with_loop(0, Pose2(*true[-1]), covariance, graph.pose).loops[-1]
    np.testing.assert_allclose(edge.covariance, C @ covariance @ C.T, atol=1e-12)


def test_a_loop_is_relative_to_the_estimated_path_and_not_to_single_particles():
    true = arc(5)
    graph = graph_of(true, np.random.default_rng(3), STEMS[:0])
    path = np.repeat(true, 10, axis=0)
    keyframes = tuple(replace(k, scan=10 * row) for row, k in enumerate(graph.keyframes))
    graph = replace(graph, keyframes=keyframes, pose=true + np.array([0.1, 0.0, 0.01]))
    edge = graph.with_loop(15, Pose2(*true[-1]), np.eye(3), path).loops[-1]
    assert edge.scans == (10, 40)
    np.testing.assert_allclose(edge.motion, composed(inverse(true[1:2]), true[-1:])[0], atol=1e-12)


def lap(true, drift, *, takes_for_known):
    """A lap whose path drifts in y. Its first and last four keyframes see four trees, which the last ones
    take for the known ones or, with other names, for new ones."""
    known, graph = true[:4, :2] + [0.0, 3.0], KeyframeGraph()
    path = true + np.linspace(0.0, 1.0, len(true))[:, None] * [0.0, drift, 0.0]
    for k, T in enumerate(path):
        motion = composed(inverse(path[k - 1 : k]), T[None])[0] if k else np.zeros(3)
        again = k > len(true) - 5
        sees = known if k < 4 or again else STEMS[:0]
        # Associations at a drifted pose agree with it, with trees that are elsewhere.
        centre = Pose2(*(T if takes_for_known else true[k])).inverse().apply(sees)
        R = np.tile([SIGMA**2, 0.0, SIGMA**2], (len(sees), 1))
        birth = np.arange(len(sees)) + (100 if again and not takes_for_known else 0)
        graph = graph.with_keyframe(Keyframe(k, 4 * k, 6.0 * k, motion, 4.0 * Q, birth, centre, R), T)
    return graph


def test_a_loop_keeps_the_associations_of_earlier_revisits():
    """A way of 300 m on which four trees are seen at 0, at 120 to 150 and from 210 m on."""
    graph, none = KeyframeGraph(), np.zeros((0, 2))
    for k in range(31):
        sees = np.full((4, 2), 3.0) if k == 0 or 12 <= k <= 15 or k >= 21 else none
        birth, R = np.arange(len(sees)), np.tile([SIGMA**2, 0.0, SIGMA**2], (len(sees), 1))
        T = np.array([10.0 * k, 0.0, 0.0])
        motion = np.array([10.0 if k else 0.0, 0.0, 0.0])
        graph = graph.with_keyframe(Keyframe(k, 4 * min(k, 1), 10.0 * k, motion, Q, birth, sees, R), T)
    kept = [len(k.birth) > 0 for k in graph.without(graph.revisit(0)).keyframes]
    assert np.flatnonzero(kept).tolist() == [0, 12, 13, 14, 15]
    assert graph.without(graph.revisit(29)).keyframes == graph.keyframes, "they are no revisit so soon"


def test_a_loop_overrules_associations_by_the_drifted_path():
    """The path had drifted by 3 m, and its last keyframes take stems for known ones 3 m away."""
    true = arc(42, turn=2.0 * np.pi / 41.0, radius=40.0)
    graph = lap(true, 3.0, takes_for_known=True)
    graph = graph.without(graph.revisit(3))
    assert [len(k.birth) for k in graph.keyframes] == [4] * 4 + [0] * 38
    solution = with_full_weight_first(graph.with_loop(0, Pose2(*true[-1]), 1e-4 * np.eye(3), graph.pose))
    assert off(solution.pose, true)[-1] < 0.1


def test_two_names_of_one_tree_become_one():
    true = arc(6)
    graph = graph_of(true, birth=np.array([0, 1, 2, 3, 4, 9]))
    renamed = graph.renamed(np.array([9]), np.array([5]))
    assert renamed.keyframes[0].birth.tolist() == [0, 1, 2, 3, 4, 5]
    assert graph.renamed(np.zeros(0, np.int64), np.zeros(0, np.int64)) is graph


def test_a_part_that_nothing_connects_stays():
    true = arc(6)
    graph = graph_of(true, stems=STEMS[:0])
    cut = replace(graph.keyframes[3], covariance=np.full((3, 3), np.inf))
    graph = replace(graph, keyframes=(*graph.keyframes[:3], cut, *graph.keyframes[4:]))
    solution = graph.solve()
    np.testing.assert_allclose(solution.pose, graph.pose, atol=1e-9)
    assert KeyframeGraph().solve() is None


def test_a_graph_whose_newest_pose_nothing_observes_has_no_solution():
    graph = graph_of(arc(6), stems=STEMS[:0])
    cut = replace(graph.keyframes[-1], covariance=np.full((3, 3), np.inf))
    assert replace(graph, keyframes=(*graph.keyframes[:-1], cut)).solve() is None


def test_a_keyframe_replaces_that_of_the_same_scan():
    graph = graph_of(arc(4))
    again = graph.with_keyframe(replace(graph.keyframes[-1], birth=STEMS[:0, 0].astype(int)), np.ones(3))
    assert again.scans.tolist() == [0, 1, 2, 3]
    assert len(again.keyframes[-1].birth) == 0
    assert again.pose[-1].tolist() == [1.0, 1.0, 1.0]


def test_the_first_birth_after_a_scan_is_that_of_the_next_keyframe_or_of_the_newest():
    graph = KeyframeGraph()
    none = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3))
    for scan, first_birth in ((2, 0), (5, 3), (9, 7)):
        keyframe = Keyframe(scan, first_birth, float(scan), np.zeros(3), Q, *none)
        graph = graph.with_keyframe(keyframe, np.zeros(3))
    assert [graph.first_birth_after(scan) for scan in (0, 2, 4, 5, 8, 9, 20)] == [0, 3, 3, 7, 7, 7, 7]


def test_the_graph_stays_bounded_and_keeps_its_motion():
    graph = KeyframeGraph()
    none = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3))
    rng = np.random.default_rng(0)
    total = np.zeros(3)
    for k in range(KEYFRAMES_MAX + 1):
        motion = rng.normal(0.0, 0.1, 3) if k else np.zeros(3)
        total = composed(total[None], motion[None])[0]
        graph = graph.with_keyframe(Keyframe(k, k, float(k), motion, Q, *none), total)
    assert len(graph.keyframes) < KEYFRAMES_MAX
    assert graph.scans[-1] == KEYFRAMES_MAX
    chain = np.zeros(3)
    for keyframe in graph.keyframes:
        chain = composed(chain[None], keyframe.motion[None])[0]
    np.testing.assert_allclose(chain[:2], total[:2], atol=1e-9)
    assert abs(wrap_angle(chain[2] - total[2])) < 1e-9


def test_loops_stay_at_their_scans_when_the_graph_is_thinned():
    true = arc(42)
    graph = graph_of(true[:40], np.random.default_rng(3), STEMS[:0])
    graph = graph.with_loop(5, Pose2(*true[39]), 1e-6 * np.eye(3), graph.pose)
    for k in (40, 41):
        motion = composed(inverse(true[k - 1 : k]), true[k : k + 1])[0]
        none = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3))
        graph = graph.with_keyframe(Keyframe(k, 0, float(k), motion, Q, *none), true[k])
    thin = graph.thinned()
    assert len(thin.keyframes) == 24
    assert thin.loops[0].scans == (5, 39)
    one, other = graph.solve(added=1), thin.solve(added=1)
    # The noise of the dropped keyframes is the same, but spread over fewer motions.
    np.testing.assert_allclose(other.pose, one.pose[np.searchsorted(graph.scans, thin.scans)], atol=0.02)


def test_a_thinned_graph_keeps_the_detections():
    """Each landmark is seen by one keyframe of two, which is sometimes the one that is dropped."""
    true = arc(21)
    graph = KeyframeGraph()
    for k, T in enumerate(true):
        motion = composed(inverse(true[k - 1 : k]), T[None])[0] if k else np.zeros(3)
        sees = np.arange(k % 2, len(STEMS), 2)
        R = np.tile([SIGMA**2, 0.0, SIGMA**2], (len(sees), 1))
        centre = Pose2(*T).inverse().apply(STEMS[sees])
        graph = graph.with_keyframe(Keyframe(k, 0, float(k), motion, Q, sees, centre, R), T)
    thin = graph.thinned()
    assert len(thin.keyframes) == 11
    assert all(len(k.birth) == len(STEMS) for k in thin.keyframes[1:])
    for keyframe, T in zip(thin.keyframes, thin.pose, strict=True):
        np.testing.assert_allclose(Pose2(*T).apply(keyframe.centre), STEMS[keyframe.birth], atol=1e-9)
    solution = thin.solve()
    assert solution is not None
    np.testing.assert_allclose(solution.pose, true[::2], atol=1e-6)


def test_a_solution_is_due_when_trees_are_seen_again_after_long():
    def keyframe(k, birth, way):
        n = len(birth)
        R = np.tile([SIGMA**2, 0.0, SIGMA**2], (n, 1))
        return Keyframe(k, 10 * k, way, np.zeros(3), Q, np.array(birth, np.int64), np.zeros((n, 2)), R)

    graph = KeyframeGraph()
    for k in range(20):
        graph = graph.with_keyframe(keyframe(k, [10 * k, 10 * k + 1], 4.0 * k), np.zeros(3))
    assert not graph.is_due, "every tree is new"
    again = graph.with_keyframe(keyframe(20, [190, 191], 80.0), np.zeros(3))
    assert not again.is_due, f"these were seen within {REVISIT_DISTANCE} m"
    assert graph.with_keyframe(keyframe(20, [0, 1], 80.0), np.zeros(3)).is_due


def test_two_keyframes_take_the_same_stems_as_far_as_both_see_them():
    rng = np.random.default_rng(0)
    stems = rng.uniform(-15.0, 15.0, (90, 2))
    R = np.tile([1e-2, 0.0, 1e-2], (90, 1))
    taken = []
    for seen in (np.arange(80), np.arange(10, 90)):
        scan = ScanDetections(0, 0.0, seen, stems[seen], R[seen])
        birth, centre, _ = combined((scan,), np.zeros((1, 3)))
        np.testing.assert_allclose(centre, stems[birth])
        taken.append(set(birth.tolist()))
    assert len(taken[0]) == len(taken[1]) == STEMS_MAX
    assert len(taken[0] & taken[1]) > 0.7 * STEMS_MAX
    distance = np.hypot(*stems[list(taken[0])].T)
    assert distance.min() < 6.0
    assert distance.max() > 12.0


def test_the_covariance_of_a_detection_turns_with_the_pose_of_its_scan():
    yaw = 0.7
    view = ScanDetections(0, 0.0, np.array([4]), np.array([[3.0, 1.0]]), np.array([[0.09, 0.02, 0.01]]))
    _, _, R = combined((view,), np.array([[0.0, 0.0, yaw]]))
    C = Pose2(0.0, 0.0, yaw).rotation()
    expected = C @ np.array([[0.09, 0.02], [0.02, 0.01]]) @ C.T
    np.testing.assert_allclose(R[0], expected[[0, 0, 1], [0, 1, 1]], atol=1e-12)


def test_detections_between_two_keyframes_are_combined_by_their_weight():
    true = arc(5, turn=0.02)
    T = composed(inverse(true[-1:]).repeat(5, axis=0), true)
    views = []
    for k, pose in enumerate(true):
        centre = Pose2(*pose).inverse().apply(STEMS)
        R = np.tile([0.01 * (k + 1), 0.0, 0.01 * (k + 1)], (len(STEMS), 1))
        views.append(ScanDetections(k, float(k), np.arange(len(STEMS)), centre, R))
    birth, centre, R = combined(tuple(views), T)
    expected = Pose2(*true[-1]).inverse().apply(STEMS)[birth]
    np.testing.assert_allclose(centre, expected, atol=1e-9)
    weight = 1.0 / (0.02 * np.arange(1, 6))
    np.testing.assert_allclose(R[:, 0], (weight**2 * 0.01 * np.arange(1, 6)).sum() / weight.sum() ** 2)


@pytest.mark.parametrize("Q_of_one", [np.diag([-1.0, 1.0, 1.0]), np.diag([1e-2, 1e-2, -1.0])])
def test_a_covariance_that_is_not_positive_definite_gives_no_solution(Q_of_one):
    graph = graph_of(arc(4))
    first, *others = graph.keyframes
    broken = replace(graph, keyframes=(first, replace(others[0], covariance=Q_of_one), *others[1:]))
    assert graph.solve() is not None
    assert broken.solve() is None
