"""Tracker: Kalman filter, numbers, identity by landmarks, merging, diameter and observed sides."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.detection.cylinder_fit import BEAM
from pipeline.geometry.poses import Pose2
from pipeline.tracking import Tracker
from pipeline.tracking.kalman import ENGINES, H, process_noise, transition
from pipeline.tracking.observation import (
    EDGE,
    ONE_VIEW,
    RADIUS_GAIN,
    SECTORS,
    UNEVEN,
    FigureLimits,
    one_sidedness,
    seen_sides,
    shape_sigma,
)
from pipeline.tracking.tracker import SHARED_SIGMA
from tests.pipeline.strategies import detections, seeds, track

FOREST = preset("forest").tracking
PAPER = preset("paper").tracking
SURE = np.zeros((3, 3))


def tracker(**changes: Any):
    """A tracker with the preset forest."""
    return Tracker(FOREST.model_copy(update=changes))


def show(t, k, centre, *, pose=None, pose_covariance=SURE, births=None, gone=(), score=None, **rest: Any):
    """Give a tracker the detections of scan k, in the base frame, and return its trees; see `track`."""
    found = detections(centre, **rest)
    track(t, k * 100_000_000, pose or Pose2(), pose_covariance, found, births=births, gone=gone, score=score)
    return t.trees()


# --- the Kalman filter ----------------------------------------------------------------------------


@given(seeds, st.floats(0.0, 30.0), st.floats(0.0, 1.0), st.integers(1, 6))
def test_both_engines_give_the_same_numbers(seed, dt, acceleration, trees):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(trees, 4))
    A = rng.normal(size=(trees, 4, 4))
    P = A @ A.transpose(0, 2, 1) + np.eye(4) * 1e-3
    B = rng.normal(size=(trees, 2, 2))
    R = B @ B.transpose(0, 2, 1) + np.eye(2) * 1e-3
    z, rows = rng.normal(size=(trees, 2)), rng.permutation(trees)
    told = {}
    for name, engine in ENGINES.items():
        told[name] = (x.copy(), P.copy())
        engine(*told[name], rows, np.full(trees, dt), acceleration, z, R)
    np.testing.assert_allclose(told["compiled"][0], told["filterpy"][0], atol=1e-9, rtol=1e-9)
    np.testing.assert_allclose(told["compiled"][1], told["filterpy"][1], atol=1e-9, rtol=1e-9)
    for C in told["compiled"][1]:
        np.testing.assert_allclose(C, C.T, atol=1e-9)
        assert np.linalg.eigvalsh(C).min() > -1e-9


def test_the_model_is_constant_velocity_with_white_acceleration():
    np.testing.assert_allclose(transition(0.5) @ [1.0, 2.0, 4.0, -6.0], [3.0, -1.0, 4.0, -6.0])
    G = np.array([[0.125, 0.0], [0.0, 0.125], [0.5, 0.0], [0.0, 0.5]])
    np.testing.assert_allclose(process_noise(0.5, 0.3), 0.09 * G @ G.T)


def test_without_noise_of_the_velocity_the_state_is_the_mean_of_the_views():
    rng = np.random.default_rng(0)
    t = tracker()
    views = np.array([3.0, 1.0]) + rng.normal(0, 0.05, (40, 2))
    trees = t.trees()
    for k, view in enumerate(views):
        trees = show(t, k, [view], sigma=0.05)
    np.testing.assert_allclose(trees.position, [views.mean(axis=0)], atol=1e-9)
    np.testing.assert_allclose(t.tracks.P[0, :2, :2], np.eye(2) * 0.05**2 / 40, rtol=1e-6)
    # What is told to people does not shrink for ever: views of a trunk share an error.
    assert np.hypot(SHARED_SIGMA, 0.05 / np.sqrt(40)) < np.sqrt(trees.covariance[0, 0, 0]) < 0.022


@given(seeds)
def test_a_whole_run_is_the_same_with_both_engines(seed):
    rng = np.random.default_rng(seed)
    world = rng.uniform(-8, 8, (8, 2))
    told = []
    for engine in ENGINES:
        t = Tracker(PAPER.model_copy(update={"engine": engine}))
        noise = np.random.default_rng(seed)
        trees = t.trees()
        for k in range(15):
            trees = show(t, k, world + noise.normal(0, 0.05, world.shape))
        told.append(trees)
    np.testing.assert_array_equal(told[0].number, told[1].number)
    for column in ("position", "covariance", "eccentricity", "dbh", "coverage"):
        np.testing.assert_allclose(getattr(told[0], column), getattr(told[1], column), atol=1e-9)


# --- numbers --------------------------------------------------------------------------------------


@given(seeds)
def test_numbers_never_change_and_are_never_used_twice(seed):
    rng = np.random.default_rng(seed)
    t = tracker()
    gone: set[int] = set()
    alive: set[int] = set()
    last = 0
    for k in range(25):
        seen = rng.uniform(-6, 6, (rng.integers(0, 7), 2))
        births = rng.permutation(12)[: len(seen)] + 2 * (k // 5)
        trees = show(t, k, seen, births=births, gone=np.arange(rng.integers(0, 20)))
        numbers = trees.number.tolist()
        assert numbers == sorted(set(numbers))
        now = set(numbers)
        assert not now & gone, "a number came back"
        assert all(number > last for number in now - alive), "a new tree has an old number"
        gone |= alive - now
        alive, last = now, max([last, *numbers])
        assert np.all(trees.observations >= 1)
        assert np.all(trees.observations <= k + 1), "seen in more scans than there were"


def test_a_tree_keeps_its_number_while_others_come_and_go():
    t = tracker()
    trees = show(t, 0, [[3.0, 0.0]])
    for k in range(1, 10):
        trees = show(t, k, [[3.0, 0.0], [k, 6.0]], births=[0, k], gone=[k - 1])
    assert trees.number.tolist() == [1, 10]
    np.testing.assert_allclose(trees.position[0], [3.0, 0.0])


# --- identity -------------------------------------------------------------------------------------


def test_a_detection_belongs_to_the_tree_of_its_landmark_however_near_another_one_is():
    t = tracker()
    show(t, 0, [[5.0, 0.0], [5.0, 1.0]], births=[3, 8])
    trees = show(t, 1, [[5.0, 0.05], [5.0, 0.95]], births=[3, 8])
    assert trees.number.tolist() == [1, 2]
    assert trees.observations.tolist() == [2, 2]
    np.testing.assert_allclose(trees.position[:, 1], [0.025, 0.975], atol=1e-9)


def test_a_detection_without_landmark_belongs_to_no_tree():
    t = tracker()
    assert len(show(t, 0, [[5.0, 0.0]], births=[-1]).number) == 0
    show(t, 1, [[5.0, 0.0]], births=[4])
    assert show(t, 2, [[5.0, 0.0]], births=[-1]).observations.tolist() == [1]


def test_a_tree_goes_with_its_landmark():
    t = tracker()
    show(t, 0, [[5.0, 0.0], [8.0, 0.0]], births=[0, 1])
    assert show(t, 1, [], gone=[0]).number.tolist() == [2]


def test_a_tree_continues_with_another_landmark_at_its_position():
    """Another particle is the best one, and began the landmark of the same trunk at another scan."""
    t = tracker()
    show(t, 0, [[5.0, 0.0], [8.0, 0.0]], births=[0, 1])
    trees = show(t, 1, [[5.05, 0.0], [8.0, 0.0]], births=[7, 1], gone=[0])
    assert trees.number.tolist() == [1, 2]
    assert trees.observations.tolist() == [2, 2]
    assert t.tracks.landmark.tolist() == [7, 1]


def test_a_landmark_far_from_a_tree_does_not_continue_it():
    t = tracker()
    show(t, 0, [[5.0, 0.0]], births=[0])
    trees = show(t, 1, [[5.0, 0.9]], births=[7], gone=[0])
    assert trees.number.tolist() == [2]
    assert trees.observations.tolist() == [1]


def test_trees_whose_landmarks_were_merged_are_one_with_the_older_number():
    t = tracker(proximity_radius=0.0)
    for k in range(3):
        show(t, k, [[5.0, 0.1], [5.0, 0.0]], births=[4, 9])
    trees = show(t, 3, [[5.0, 0.05]], births=[4], gone=[9])
    assert trees.number.tolist() == [1]
    assert trees.first_seen_ns.tolist() == [0]
    assert trees.last_seen_ns.tolist() == [300_000_000]
    assert trees.observations.tolist() == [6], "a scan that shows both halves counts once"
    assert show(t, 99, [[20.0, 0.0]], births=[30]).number.tolist() == [1, 3], "2 is not given again"


@pytest.mark.parametrize(("radius", "numbers"), [(0.4, [1]), (0.0, [1, 2])])
def test_a_landmark_next_to_a_tree_is_a_part_of_its_trunk(radius, numbers):
    t = tracker(proximity_radius=radius)
    trees = t.trees()
    for k in range(4):
        trees = show(t, k, [[5.0, 0.0], [5.0, 0.3]])
    assert trees.number.tolist() == numbers
    assert set(trees.observations.tolist()) == {4}


@pytest.mark.parametrize(
    ("k", "seen", "births", "score", "landmark", "observations"),
    [
        (50, [[5.0, 0.12]], [7], {0: 2.0, 7: 3.0}, [7], [2]),
        (50, [[5.0, 0.12]], [7], {0: 3.0, 7: 3.0}, [0], [1]),
        (50, [[5.0, 0.0], [5.0, 0.12]], [0, 7], {0: 2.0, 7: 3.0}, [0], [2]),
        (50, [[5.0, 0.45]], [7], {0: 2.0, 7: 3.0}, [0, 7], [1, 1]),
        (101, [[5.0, 0.12]], [7], {0: 2.0, 7: 3.0}, [0], [1]),
    ],
    ids=["better", "not better", "both detected", "another tree", "long ago"],
)
def test_of_two_landmarks_of_a_trunk_the_tree_takes_the_better_one(
    k, seen, births, score, landmark, observations
):
    """The first views can be wrong by more than the gate of later ones, which begin a second landmark."""
    t = tracker(proximity_radius=0.4)
    show(t, 0, [[5.0, 0.0]], births=[0])
    trees = show(t, k, seen, births=births, score=score)
    assert t.tracks.landmark.tolist() == landmark
    assert trees.observations.tolist() == observations


def test_trees_that_come_nearer_than_the_radius_are_merged():
    t = tracker(proximity_radius=0.4)
    show(t, 0, [[5.0, 0.0], [5.0, 0.45]])
    trees = show(t, 1, [[5.0, 0.0], [5.0, 0.3]])
    assert trees.number.tolist() == [1]
    assert trees.observations.tolist() == [3]


def test_a_merged_tree_follows_the_better_landmark_of_both():
    """A bush beside a trunk is often seen first, and the trunk more often."""
    t = tracker(proximity_radius=0.4)
    show(t, 0, [[5.0, 0.45]], births=[0])
    for k in range(1, 20):
        show(t, k, [[5.0, 0.0]], births=[7], score={0: 1.0, 7: float(k)})
    trees = show(t, 20, [[5.0, 0.3], [5.0, 0.0]], births=[0, 7], score={0: 2.0, 7: 20.0})
    assert trees.number.tolist() == [1]
    assert t.tracks.landmark.tolist() == [7]
    for k in range(21, 25):
        trees = show(t, k, [[5.0, 0.6], [5.0, 0.0]], births=[0, 7], score={0: 2.0, 7: float(k)})
    np.testing.assert_allclose(trees.position[0], [5.0, 0.0], atol=0.02)


def test_two_trees_farther_apart_than_the_radius_stay_two():
    t = tracker(proximity_radius=0.4)
    trees = t.trees()
    for k in range(5):
        trees = show(t, k, [[5.0, 0.0], [5.0, 0.41]])
    assert trees.number.tolist() == [1, 2]


def test_three_tracks_within_the_radius_are_merged_to_one():
    t = tracker(proximity_radius=0.4)
    trees = show(t, 0, [[5.0, 0.0], [5.0, 0.3], [5.2, 0.15]])
    assert trees.number.tolist() == [1]


def test_a_tree_whose_detection_is_beyond_the_gate_restarts_at_its_landmark():
    t = tracker(velocity_sigma=0.1)
    for k in range(20):
        show(t, k, [[5.0, 0.0]])
    trees = show(t, 20, [[5.8, 0.0]])
    np.testing.assert_allclose(trees.position, [[5.8, 0.0]], atol=1e-6)
    assert trees.observations.tolist() == [21]
    assert np.linalg.eigvalsh(t.tracks.P[0]).min() > -1e-12


def test_positions_and_covariances_are_transformed_by_the_pose():
    t = tracker()
    pose = Pose2(10.0, -3.0, 0.7)
    trees = show(t, 0, [[4.0, 1.0]], pose=pose)
    np.testing.assert_allclose(trees.position, pose.apply(np.array([[4.0, 1.0]])))
    np.testing.assert_allclose(t.tracks.P[0, :2, :2], np.eye(2) * 0.03**2, atol=1e-12)


def test_heading_variance_grows_across_the_ray_with_distance():
    t = tracker()
    show(t, 0, [[10.0, 0.0]], pose_covariance=np.diag([0.0, 0.0, 0.01**2]), sigma=0.01)
    np.testing.assert_allclose(np.diag(t.tracks.P[0])[:2], [1e-4, 1e-4 + 0.1**2], rtol=1e-9)


@pytest.mark.parametrize("breast_height", [1.3, 1.0])
def test_diameters_refer_to_breast_height(breast_height):
    t = tracker(dbh_arc_min=0.0, dbh_sigma_max=0.5, breast_height=breast_height)
    seen = detections([[5.0, 0.0]], radius=0.2)
    for k, height in enumerate((0.7, 1.0, 1.6, np.nan)):
        track(t, k * 100_000_000, Pose2(), SURE, seen, heights=np.array([height]))
    above = np.array([0.7, 1.0, 1.6, breast_height]) - breast_height
    lost = np.average(np.where(above < 0.0, 0.01, 0.005) * above, weights=1.0 / (1.0 + (above / 0.5) ** 2))
    assert t.trees().dbh[0] == pytest.approx(2.0 * (0.2 + lost))


def test_the_measurement_is_the_position_of_the_state():
    assert (H @ np.array([1.0, 2.0, 3.0, 4.0])).tolist() == [1.0, 2.0]


def test_a_diameter_needs_three_radii_and_weighs_them():
    t = tracker(dbh_arc_min=0.0, dbh_sigma_max=0.5)
    for k in range(3):
        assert np.isnan(show(t, k, [[5.0, 0.0]], radius=np.nan).dbh).all()
    trees = t.trees()
    for k in range(2):
        trees = show(t, 3 + k, [[5.0, 0.0]], radius=0.2)
    assert np.isnan(trees.dbh[0])
    trees = show(t, 6, [[5.0, 0.0]], radius=0.26)
    assert trees.dbh[0] == pytest.approx(2 * (0.2 + 0.2 + 0.26) / 3)
    tracks, p = t.tracks, t.parameters
    weight, dbh = tracks.radius_weight[0], trees.dbh[0]
    reach, above = tracks.radius_reach[0] / weight, tracks.radius_above[0] / weight
    views = 1.0 / (weight * reach**2) + (EDGE * BEAM * reach + UNEVEN) ** 2
    one_sided = 1.0 + RADIUS_GAIN**2  # all views are from one place
    stem = (p.out_of_round * dbh) ** 2 * one_sided + (p.taper_sigma * above) ** 2
    assert trees.dbh_sigma[0] == pytest.approx(np.sqrt(4.0 * views + stem))
    assert 0.02 < trees.dbh_sigma[0] < 0.1
    assert trees.observations.tolist() == [6]


@pytest.mark.parametrize("views", [1, 4, 8, 12, 18])
def test_the_errors_of_an_oval_stem_are_those_of_circles_that_are_fitted_to_it(views):
    """Views 10 degrees apart: the closed form beside least squares, for all directions of the oval."""
    oval = 0.01
    across = np.linspace(-ONE_VIEW / 2, ONE_VIEW / 2, 201)
    turned = np.radians(10.0) * np.arange(views)

    def fitted(oval_at):
        """Mean radius less 1 and mean centre over the views."""
        results = []
        for view in turned:
            angle = view + across
            r = 1.0 + oval * np.cos(2.0 * (angle - oval_at))
            x, y, weight = r * np.cos(angle), r * np.sin(angle), np.sqrt(np.cos(across))  # even in bearing
            design = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])  # small ovals
            centre_radius = np.linalg.lstsq(
                design * weight[:, None], (np.hypot(x, y) - 1.0) * weight, rcond=None
            )
            results.append(centre_radius[0])
        return np.mean(results, axis=0)

    errors = np.array([fitted(at) for at in np.linspace(0.0, np.pi, 24, endpoint=False)]) / oval
    out_of_round = np.sqrt(0.5)  # of an amplitude of 1
    seen = ONE_VIEW + np.radians(10.0) * views
    by_shape = out_of_round * RADIUS_GAIN * one_sidedness(seen, 2)
    assert np.sqrt(np.mean(errors[:, 2] ** 2)) == pytest.approx(by_shape, abs=0.1)
    limits = FigureLimits(3, 0, 0.0, 0.5, out_of_round, 0.0)
    centre = np.sqrt(np.mean(errors[:, :2] ** 2))
    sigma = shape_sigma(2.0, 2.0, seen, limits)  # radius 1
    assert centre == pytest.approx(sigma, abs=0.1)


def test_confirmation_comes_with_the_hits():
    t = tracker(hits_to_confirm=3, confirm_time=0.0)
    told = [bool(show(t, k, [[5.0, 0.0]]).confirmed[0]) for k in range(4)]
    assert told == [False, False, True, True]


def test_confirmation_comes_with_the_time_between_detections():
    t = tracker(hits_to_confirm=3, confirm_time=1.0)
    scans = (0, 1, 2, 9, 10, 11)  # 0.1 s apart
    told = [bool(show(t, k, [[5.0, 0.0]]).confirmed[0]) for k in scans]
    assert told == [False, False, False, False, True, True]


def test_times_are_those_of_the_first_and_the_last_view():
    t = tracker()
    trees = t.trees()
    for k in (2, 5, 9):
        trees = show(t, k, [[5.0, 0.0]])
    show(t, 11, [])
    assert trees.first_seen_ns.tolist() == [200_000_000]
    assert t.trees().last_seen_ns.tolist() == [900_000_000]


def test_an_infinite_eccentricity_does_not_spoil_the_mean():
    t = tracker()
    views = detections([[5.0, 0.0]])
    for k, e in enumerate((4.0, np.inf, 6.0)):
        views.eccentricity[0] = e
        track(t, k, Pose2(), SURE, views)
    assert t.trees().eccentricity.tolist() == [5.0]


# --- coverage -------------------------------------------------------------------------------------

STEP = 2 * np.pi / SECTORS


def sectors(bearing, arc):
    """The sectors that one view shows."""
    bits = int(seen_sides(bearing, arc))
    return {k for k in range(64) if bits >> k & 1}


def test_completely_observed_sectors_are_set():
    assert sectors(STEP, 2 * STEP) == {0, 1}
    assert sectors(STEP, 1.9 * STEP) == set()
    assert sectors(0.0, 2 * STEP) == {SECTORS - 1, 0}
    assert sectors(1.0, 0.0) == set()
    assert len(sectors(0.0, 2 * np.pi)) == SECTORS


@given(st.floats(-10, 10), st.floats(0, 2 * np.pi))
def test_coverage_is_never_more_than_the_arc_and_at_most_two_sectors_less(bearing, arc):
    seen = sectors(bearing, arc)
    assert seen <= set(range(SECTORS))
    assert arc - 2 * STEP - 1e-6 <= len(seen) * STEP <= arc + 1e-6


@given(st.floats(-10, 10), st.floats(0, 3 * np.pi))
def test_each_sector_is_seen_that_lies_within_the_arc(bearing, arc):
    first = int(np.ceil((bearing - arc / 2) / STEP - 1e-9))
    last = int(np.floor((bearing + arc / 2) / STEP + 1e-9))
    assert sectors(bearing, arc) == {k % SECTORS for k in range(first, last)}


def test_walking_around_a_tree_covers_it():
    t = tracker()
    trees = t.trees()
    for k, angle in enumerate(np.arange(0, 2 * np.pi, 0.3)):
        pose = Pose2(5.0 * np.cos(angle), 5.0 * np.sin(angle), angle + np.pi)
        trees = show(t, k, [[5.0, 0.0]], pose=pose, arc=2.0)
    assert len(trees.number) == 1
    assert trees.coverage[0] == pytest.approx(2 * np.pi)


@given(
    st.floats(1.0, 40.0),
    st.floats(-3.1, 3.1),
    st.lists(st.tuples(st.floats(0.02, 0.9), st.floats(0.0, 2.0 * np.pi)), min_size=1, max_size=8),
)
def test_views_from_one_place_cover_no_more_than_one_can_show(distance, bearing, views):
    """From tangent to tangent: 2 arccos(r / d), whatever arc the noise of a fit claims."""
    t = tracker(dbh_arc_min=180.0)
    away = distance * np.array([np.cos(bearing), np.sin(bearing)])
    for k, (radius, arc) in enumerate(views):
        show(t, k, [away], radius=radius, arc=arc)
    trees = t.trees()
    widest = max(min(arc, 2.0 * np.arccos(radius / distance)) for radius, arc in views)
    assert trees.coverage[0] == pytest.approx(len(sectors(bearing + np.pi, widest)) * STEP)
    assert trees.coverage[0] <= widest + 1e-6 < np.pi
    assert np.isnan(trees.dbh[0])


def test_a_view_without_a_circle_uses_the_radius_of_other_views():
    def covered(*radii: float):
        t = tracker()
        for k, radius in enumerate(radii):
            show(t, k, [[1.0, 0.0]], radius=radius, arc=6.0 if np.isnan(radius) else 0.0)
        return t.trees().coverage[0]

    assert covered(0.5, np.nan) == pytest.approx(np.radians(120.0))  # 2 arccos(0.5)
    assert covered(np.nan) == 0.0
    assert covered(0.5) == 0.0
    assert covered(1.2, np.nan) == 0.0, "a robot within a stem sees nothing of it"


@pytest.mark.parametrize(("radius", "share"), [(0.1, 1.0), (0.15, 1.0), (0.3, 2.0), (0.6, 4.0)])
def test_the_largest_sigma_of_a_diameter_is_in_proportion_to_it_above_30_cm(radius: float, share: float):
    t = tracker(dbh_arc_min=0.0, dbh_sigma_max=0.5)
    for k in range(4):
        show(t, k, [[5.0, 0.0]], radius=radius)
    sigma = t.trees().dbh_sigma[0]
    for factor, is_measured in ((1.001, True), (0.999, False)):
        t.parameters = t.parameters.model_copy(update={"dbh_sigma_max": factor * sigma / share})
        assert np.isfinite(t.trees().dbh[0]) == is_measured
        assert np.isfinite(t.trees().dbh_sigma[0]) == is_measured


def test_a_diameter_needs_half_the_trunk():
    def seen_from(bearings):
        t = tracker()
        trees = t.trees()
        for k, bearing in enumerate(bearings):
            pose = Pose2(5.0 * np.cos(bearing), 5.0 * np.sin(bearing), bearing + np.pi)
            trees = show(t, k, [[5.0, 0.0]], pose=pose, radius=0.2, arc=np.radians(100.0))
        return trees

    assert np.isnan(seen_from([0.0, 0.1, 0.2, 0.3]).dbh).all()
    around = seen_from([0.0, 1.0, 2.0, 3.0])
    assert around.dbh[0] == pytest.approx(0.4)
    assert around.coverage[0] >= np.pi
