"""A robot is found in a stored map, never in the map of another place, and a wrong place is withdrawn."""

from __future__ import annotations

import re

import numpy as np
import pytest

from app.extensions.maps.localisation import Localisation, Localiser, State
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.types.records import Detections
from tests.app.extensions.maps.localisation.stands import drive, planted, stand, stored, trees_at, way

SIDE = 100.0


def last(localiser, place, poses, seed):
    """True T_map_odom and the localisation at the end of a drive."""
    return list(drive(localiser, place, poses, seed))[-1]


def errors(a: Pose2, b: Pose2) -> tuple[float, float]:
    """Distance [m] and turn [rad] between two poses."""
    off = a.inverse() @ b
    return float(np.hypot(off.x, off.y)), abs(off.yaw)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", range(6))
def test_a_robot_is_found_and_followed(seed):
    place = stand(seed)
    true, got = last(Localiser(stored(place)), place, way(seed, SIDE), seed)
    assert got.state is State.FOUND
    assert got.found_at <= 60.0
    assert got.stems >= 0.9 * got.of
    assert got.withdrawn == 0
    distance, turn = errors(true, got.T_map_odom)
    assert distance < 0.3  # at the origin of odom, far from the stems
    assert turn < 0.01
    assert got.text.startswith(f"found: {got.stems} of {got.of} stems in view agree, 0.0")


@pytest.mark.parametrize("seed", range(3))
def test_a_third_of_the_stems_may_be_gone(seed):
    place = stand(seed)
    kept = np.random.default_rng(seed).random(len(place)) > 1.0 / 3.0
    true, got = last(Localiser(stored(place[kept])), place, way(seed, SIDE), seed)
    assert got.state is State.FOUND
    assert errors(true, got.T_map_odom)[0] < 0.4


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("kind", [stand, planted])
def test_another_stand_is_never_found(kind, seed):
    here, there = kind(seed), kind(seed + 100)
    for _, got in drive(Localiser(stored(there)), here, way(seed, SIDE), seed):
        assert got.state is not State.FOUND


@pytest.mark.parametrize("seed", range(3))
def test_a_plantation_is_found_at_the_right_trees_or_not_at_all(seed):
    place = planted(seed)
    for true, got in drive(Localiser(stored(place)), place, way(seed, SIDE), seed):
        if got.state is State.FOUND:
            assert errors(true, got.T_map_odom)[0] < 0.5


@pytest.mark.parametrize("seed", range(2))
def test_equal_rows_are_not_found(seed):
    """A plantation without gaps: each place looks like all others."""
    grid = np.stack(np.meshgrid(np.arange(0.0, 100.0, 3.0), np.arange(0.0, 100.0, 2.0)), axis=-1)
    place = grid.reshape(-1, 2) + np.random.default_rng(seed).normal(0.0, 0.05, (grid.size // 2, 2))
    for _, got in drive(Localiser(stored(place)), place, way(seed, SIDE), seed):
        assert got.state is State.SEARCHING


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_upside_down_is_not_found(seed):
    """It sees the mirror image of the stand."""
    place = stand(seed)
    for _, got in drive(Localiser(stored(place * [1.0, -1.0])), place, way(seed, SIDE), seed):
        assert got.state is not State.FOUND


@pytest.mark.parametrize("motion", [Pose2(100.0, -50.0, 2.5), Pose2(0.0, 0.0, np.pi), Pose2(-7.0, 1e4, -0.4)])
def test_a_moved_map_gives_the_moved_fix(motion):
    place, poses = stand(1), way(1, SIDE, 30.0)
    _, one = last(Localiser(stored(place)), place, poses, 1)
    _, two = last(Localiser(stored(motion.apply(place))), place, poses, 1)
    moved = motion @ one.T_map_odom
    assert two.state is State.FOUND
    assert (two.stems, two.of) == (one.stems, one.of)
    assert np.hypot(moved.x - two.T_map_odom.x, moved.y - two.T_map_odom.y) < 1e-6
    assert abs(wrap_angle(moved.yaw - two.T_map_odom.yaw)) < 1e-8


@pytest.mark.slow
def test_a_place_of_many_stems_outside_of_the_map_is_said_to_be_none_of_it():
    here, there = stand(3, density=0.08), stand(4)
    _, got = last(Localiser(stored(there)), here, way(3, SIDE), 3)
    assert got.state is State.ABSENT
    assert got.text == "nothing of this map is here"


def test_few_stems_say_nothing():
    _, got = last(
        Localiser(stored(stand(1))), np.array([[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]]), way(1, SIDE), 1
    )
    assert got.state is State.SEARCHING
    assert got.text == "not found yet"


def test_an_empty_map_is_never_found():
    _, got = last(Localiser(stored(np.zeros((0, 2)))), stand(1), way(1, SIDE, 20.0), 1)
    assert got.state is State.SEARCHING


def test_stems_of_another_place_withdraw_a_fix():
    """The robot is found, then carried to another forest without a word of its odometry."""
    place, other = stand(1), stand(2, density=0.05)
    localiser = Localiser(stored(place))
    true, got = last(localiser, place, way(1, SIDE, 30.0), 1)
    assert got.state is State.FOUND
    pose = true.inverse() @ way(1, SIDE, 30.0)[-1]
    for k in range(20):
        pose = pose @ Pose2(1.0, 0.0, 0.0)
        near = other[np.hypot(*(other - [pose.x + 50.0, pose.y + 50.0]).T) < 14.0] - 50.0
        stamp = (100 + k) * 2_000_000_000
        got = localiser.update(stamp, pose, trees_at(near, stamp))
    assert got.state is not State.FOUND
    assert got.withdrawn == 1
    assert np.isnan(got.found_at)
    assert "contradicted" in got.text or got.state is State.ABSENT


def seen_at(base: Pose2, place) -> Detections:
    """Stems of the local frame as detections of a scan with a standard deviation of 5 cm."""
    n = len(place)
    unknown = np.full(n, np.nan)
    covariance = np.tile(0.05**2 * np.eye(2), (n, 1, 1))
    return Detections(
        np.arange(n), base.inverse().apply(place), covariance, unknown, unknown, unknown, unknown
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_few_stems_that_agree_elsewhere_by_chance_do_not_move_a_found_robot(seed):
    """A scan shows five of the stems 0.7 m beside their places, and three of none."""
    place, poses = stand(seed), way(seed, SIDE, 30.0)
    localiser = Localiser(stored(place))
    true, got = last(localiser, place, poses, seed)
    base = true.inverse() @ poses[-1]
    near = place[np.argsort(np.hypot(*(place - [poses[-1].x, poses[-1].y]).T))[:5]]
    rng = np.random.default_rng(seed)
    others = np.array([poses[-1].x, poses[-1].y]) + rng.uniform(-8.0, 8.0, (3, 2))
    view = seen_at(base, true.inverse().apply(np.vstack([near + np.array([0.7, 0.0]), others])))
    base = base @ Pose2(1.5, 0.0, 0.0)
    none = trees_at(np.zeros((0, 2)))
    got = localiser.update(10**11, base, none, view=view)
    if got.T_map_odom is not None:
        assert errors(true @ base, got.T_map_odom @ base)[0] < 0.2
    base = base @ Pose2(1.5, 0.0, 0.0)
    all_near = place[np.hypot(*(place - (true @ base).as_array()[:2]).T) < 14.0]
    got = localiser.update(10**11 + 1, base, none, view=seen_at(base, true.inverse().apply(all_near)))
    assert got.state is State.FOUND
    assert got.withdrawn == 0
    assert errors(true @ base, got.T_map_odom @ base)[0] < 0.1


def test_no_pose_is_given_while_the_stems_in_view_disagree():
    """The pose is withdrawn by the sum of the odds of several scans, of which none decides alone."""
    place, poses = stand(1), way(1, SIDE, 30.0)
    localiser = Localiser(stored(place))
    true, got = last(localiser, place, poses, 1)
    base, states = true.inverse() @ poses[-1], []
    rng = np.random.default_rng(1)
    for k in range(6):
        base = base @ Pose2(1.5, 0.0, 0.0)
        there = (true @ base).as_array()[:2] + rng.uniform(-6.0, 6.0, (300, 2))
        away = np.min(np.hypot(*(there[:, None] - place[None]).transpose(2, 0, 1)), axis=1)
        view = seen_at(base, true.inverse().apply(there[away > 0.8][:6]))
        got = localiser.update(10**11 + k, base, trees_at(np.zeros((0, 2))), view=view)
        states.append((got.state, got.withdrawn))
        assert got.T_map_odom is None
    assert states[0] == (State.SEARCHING, 0)
    assert states[-1] == (State.SEARCHING, 1)


def test_outside_of_the_map_the_covariance_grows_until_the_robot_is_searched_again():
    place = stand(1, side=60.0)
    localiser = Localiser(stored(place))
    x = [20.0 + 2.0 * k for k in range(50)]
    poses = [Pose2(at, 30.0, 0.0) for at in (*x, *x[-2::-1])]  # there and back
    got = list(drive(localiser, place, poses, 1))
    states = [now.state for _, now in got]
    left = next(k for k, (_, now) in enumerate(got) if now.state is State.FOUND and now.of == 0)
    sigma = [np.sqrt(now.covariance[0, 0]) for _, now in got]
    lost = left + states[left:].index(State.SEARCHING)
    assert lost > left
    assert sigma[left - 1] > 0.0
    assert (np.diff(sigma[left - 1 : lost]) > 0.0).all()
    assert got[lost][1].T_map_odom is None
    assert got[lost][1].reason == "outside of the map"
    assert got[left][1].text.startswith("found: too few stems in view, 0.")
    assert re.fullmatch(r"found at \d+ m, lost since: outside of the map", got[lost][1].text)
    assert State.FOUND not in states[lost:50]
    true, last_one = got[-1]
    assert last_one.state is State.FOUND
    assert last_one.withdrawn == 0
    assert errors(true, last_one.T_map_odom)[0] < 0.4


def test_a_robot_that_left_the_map_among_many_stems_was_found_in_it():
    place, outside = stand(1, side=60.0), stand(3, density=0.08) + np.array([62.0, -20.0])
    localiser = Localiser(stored(place))
    poses = [Pose2(20.0 + 2.0 * k, 30.0, 0.0) for k in range(65)]
    got = [now for _, now in drive(localiser, np.vstack([place, outside]), poses, 1)]
    assert State.FOUND in [now.state for now in got]
    assert State.ABSENT not in [now.state for now in got]
    end = localiser.end()
    assert end.state is State.NOT_FOUND
    assert re.match(r"found at \d+ m, lost since: ", end.text)


def test_a_fix_after_a_withdrawn_one_is_told_when_it_is_lost():
    lost = Localisation(found_at=30.0, driven=300.0, withdrawn=1, reason="outside of the map")
    assert lost.text == "found at 30 m, lost since: outside of the map"
    assert Localisation(withdrawn=1).text == "not found: the stems contradicted the place that was found"


@pytest.mark.slow
def test_a_map_of_few_stems_is_never_said_to_be_elsewhere():
    for few in (1, 3, 6, 12):
        here = stand(3, density=0.08)
        place = np.random.default_rng(few).uniform(0.0, 20.0, (few, 2)) + 500.0
        localiser = Localiser(stored(place))
        _, got = last(localiser, here, way(3, SIDE), 3)
        assert got.state is State.SEARCHING, few
        assert got.text == "not found yet"
        end = localiser.end()
        assert end.state is State.NOT_FOUND
        assert end.text == f"not found in {end.driven:.0f} m of driving"


def test_the_same_input_gives_the_same_fix():
    place, poses = stand(5), way(5, SIDE, 30.0)
    a, b = (last(Localiser(stored(place)), place, poses, 5)[1] for _ in range(2))
    assert a.T_map_odom == b.T_map_odom
    np.testing.assert_array_equal(a.covariance, b.covariance)
