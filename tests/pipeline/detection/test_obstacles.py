"""Obstacles: distances along the path ahead in closed form, symmetries, and unknown or invisible space."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.config import Parameters, preset
from pipeline.config.stages import Obstacles
from pipeline.detection.obstacles import BESIDE, TIGHTEST, find_clearance, path_curvature
from pipeline.errors import ParameterError
from pipeline.front_end import segment
from pipeline.geometry.poses import Pose3
from pipeline.ground.scan_ground import RINGS, SECTORS, Terrain
from pipeline.types.records import Clearance, Sensor, Step, Zone
from tests.pipeline.strategies import scan

P = Obstacles()
SENSOR = np.array([0.1, 0.0, 0.8])
FORWARD = (0.8, 0.0, 0.0)
# Far behind the slow zone, so that the sensor is seen to look along the way.
LOOKS = np.array([[x, y, 0.0] for x in (-30.0, 30.0) for y in np.linspace(-5.0, 5.0, 20)])
HALF = 0.5 * P.width
NOTHING = np.zeros((0, 3), np.float32)


def post(x: float, y: float, height: float = 1.0, points: int = P.min_points) -> np.ndarray:
    """Returns of something thin in the base frame."""
    return np.tile([[x, y, height]], (points, 1))


def clearance(
    *things: np.ndarray,
    twist: tuple[float, float, float] = FORWARD,
    terrain: Terrain | None = None,
    parameters: Obstacles = P,
    near: np.ndarray = NOTHING,
    sensor: np.ndarray = SENSOR,
) -> Clearance:
    base = np.vstack([LOOKS, *things])
    points, close = ((place - sensor).astype(np.float32) for place in (base, near))
    found = find_clearance(points, close, terrain, sensor, twist, parameters)
    assert found is not None
    return found


def on_arc(s: float, curvature: float, off: float = 0.0) -> tuple[float, float]:
    """The place so far along an arc from the base and so far outside of it."""
    radius = 1.0 / abs(curvature)
    theta = s / radius
    x = (radius + off) * math.sin(theta)
    y = radius - (radius + off) * math.cos(theta)
    return x, math.copysign(1.0, curvature) * y


def test_a_free_way_is_clear():
    found = clearance()
    assert (found.zone, found.ahead, found.beside) == (Zone.CLEAR, math.inf, math.inf)
    assert math.isnan(found.x)


@given(st.floats(0.05, P.slow_distance - 0.05), st.floats(-HALF + 0.02, HALF - 0.02))
def test_straight_on_it_is_the_distance_from_the_robots_end(distance: float, y: float):
    found = clearance(post(P.reach + distance, y))
    assert found.ahead == pytest.approx(distance, abs=1e-5)
    assert (found.x, found.y) == pytest.approx((P.reach + distance, y), abs=1e-5)
    assert found.zone == (Zone.STOP if found.ahead < P.stop_distance else Zone.SLOW)
    assert found.beside == 0.0


@given(
    st.floats(0.05, P.slow_distance - 0.05),
    st.floats(-1.0, 1.0).filter(lambda k: abs(k) > 0.02),
    st.floats(-HALF + 0.02, HALF - 0.02),
    st.booleans(),
)
@example(2.75, 1.0, 0.0, False)
@example(2.7, -1.0, 0.1, True)
def test_on_an_arc_it_is_the_length_of_the_arc(distance: float, curvature: float, off: float, back: bool):
    x, y = on_arc(P.reach + distance, curvature, off)
    way = -1.0 if back else 1.0
    # Driving back along the same circle the turn has the other sign; x is mirrored, the centre stays.
    found = clearance(post(way * x, y), twist=(way * 0.8, 0.0, 0.8 * way * curvature))
    assert found.curvature == pytest.approx(curvature)
    assert found.backward is back
    # Half a turn at most lies before the robot; what lies farther along a tight circle is behind it.
    around = (P.reach + distance) * abs(curvature)
    assume(abs(around - math.pi) > 1e-3)
    assert found.ahead == pytest.approx(distance if around < math.pi else math.inf, abs=1e-4)


@given(st.floats(0.1, P.slow_distance - 0.1), st.floats(HALF + 0.02, HALF + BESIDE - 0.02), st.booleans())
def test_beside_the_way_it_is_the_distance_from_the_robots_side(distance: float, y: float, right: bool):
    found = clearance(post(P.reach + distance, -y if right else y))
    assert found.beside == pytest.approx(y - HALF, abs=1e-5)
    assert (found.zone, found.ahead) == (Zone.CLEAR, math.inf)


@given(
    arrays(np.float64, (40, 3), elements=st.floats(-5.0, 5.0)),
    st.floats(-1.0, 1.0),
    st.randoms(use_true_random=False),
)
def test_order_mirror_and_more_points(points, turn, shuffle):
    twist = (0.8, 0.0, turn)
    found = clearance(points, twist=twist)
    order = list(range(len(points)))
    shuffle.shuffle(order)
    assert clearance(points[order], twist=twist).ahead == found.ahead
    mirrored = clearance(points * [1.0, -1.0, 1.0], twist=(0.8, 0.0, -turn))
    assert mirrored.ahead == pytest.approx(found.ahead, abs=1e-5)
    fewer = clearance(points[: len(points) // 2], twist=twist)
    assert fewer.ahead >= found.ahead
    assert fewer.beside >= found.beside


@pytest.mark.parametrize(
    ("thing", "seen"),
    [
        (post(2.0, 0.0, P.height_min - 0.02), False),  # driven over
        (post(2.0, 0.0, P.height_min + 0.02), True),
        (post(2.0, 0.0, P.height_max + 0.02), False),  # driven under
        (post(2.0, 0.0, points=P.min_points - 1), False),  # rain
        (post(2.0, HALF + 0.02), False),  # beside the way
        (post(-2.0, 0.0), False),  # behind
        (post(P.reach - 0.05, HALF - 0.02), True),  # at its side
        (post(-P.reach - 0.05, 0.0), False),  # just behind it
        (post(P.reach + P.slow_distance + 0.05, 0.0), False),  # far
    ],
)
def test_what_counts_as_an_obstacle(thing: np.ndarray, seen: bool):
    assert (clearance(thing).zone is not Zone.CLEAR) is seen


def test_single_returns_along_the_way_are_no_obstacle():
    rain = np.array([[P.reach + 0.6 * k, 0.0, 1.0] for k in range(1, 6)])
    assert clearance(rain).zone is Zone.CLEAR


def test_on_a_slope_heights_are_above_the_ground():
    """A hillside of 30 degrees ahead stands above the robot's base and is no obstacle, a person on it is."""
    rise = math.tan(math.radians(30.0))
    turn = (np.arange(SECTORS) + 0.5) / SECTORS * 4.0 - 1.0
    x = np.where(
        turn < 1.0, turn, 2.0 - turn
    )  # of the diamond's directions, see pipeline.geometry.azimuth_bins
    side = 1.0 - np.abs(x)
    ring = (np.arange(RINGS) + 0.5) * 20.0 / (RINGS - np.arange(RINGS) - 0.5)
    height = (x / np.hypot(x, side))[:, None] * ring * rise - 0.8
    hill = Terrain(height, np.ones_like(height, dtype=np.bool_))
    d = np.linspace(0.6, 3.0, 40)
    ground = np.column_stack([d + 0.1, np.zeros(40), d * rise])
    assert clearance(ground).zone is Zone.STOP
    assert clearance(ground, terrain=hill).zone is Zone.CLEAR
    person = ground[20:26] + np.array([0.0, 0.0, 1.0])
    assert clearance(ground, person, terrain=hill).zone is Zone.SLOW


def test_what_the_sensor_does_not_look_at_is_not_free():
    blind = LOOKS[LOOKS[:, 0] < 0.0].astype(np.float32)
    for points, twist in ((blind, FORWARD), (np.zeros((0, 3), np.float32), FORWARD)):
        found = find_clearance(points, NOTHING, None, SENSOR, twist, P)
        assert found is not None
        assert found.zone is Zone.UNKNOWN
    backward = find_clearance(blind, NOTHING, None, SENSOR, (-0.8, 0.0, 0.0), P)
    assert backward is not None
    assert backward.zone is Zone.CLEAR


def test_what_stands_at_the_robot_is_told_whatever_the_sensor_looks_at():
    blind = LOOKS[LOOKS[:, 0] < 0.0]
    for distance, zone in ((0.4, Zone.STOP), (2.0, Zone.SLOW)):
        points = np.vstack([blind, post(P.reach + distance, 0.4)]) - SENSOR
        aside = find_clearance(points.astype(np.float32), NOTHING, None, SENSOR, FORWARD, P)
        assert aside is not None
        few = find_clearance(points[-P.min_points :].astype(np.float32), NOTHING, None, SENSOR, FORWARD, P)
        assert few is not None
        # The near post lies more than 30 degrees aside of the sensor: it alone is no look along the way.
        assert (aside.zone, few.zone) == (zone, zone)


@given(
    st.floats(0.0, 1.2),
    st.floats(-HALF + 0.02, HALF - 0.02),
    st.floats(-0.6, 0.6),
    st.floats(-0.3, 0.3),
    st.booleans(),
)
def test_what_is_nearer_than_the_nearest_return_stops_the_robot(
    away: float, y: float, ahead: float, left: float, back: bool
):
    """Wherever the sensor stands: returns within the robot are the robot, those before it are obstacles."""
    sensor, way = np.array([ahead, left, 0.8]), -1.0 if back else 1.0
    end = max(P.reach, way * ahead)
    at = end + 0.01 + away
    found = clearance(near=post(way * at, y), sensor=sensor, twist=(way * 0.8, 0.0, 0.0))
    assert found.begins == pytest.approx(end)
    assert found.ahead == pytest.approx(at - end, abs=1e-5)
    assert found.zone is (Zone.STOP if found.ahead < P.stop_distance else Zone.SLOW)
    own = clearance(near=post(way * (end - 0.01), y), sensor=sensor, twist=(way * 0.8, 0.0, 0.0))
    assert (own.zone, own.ahead, own.beside) == (Zone.CLEAR, math.inf, math.inf)


@pytest.mark.parametrize("name", ["laser2d", "forest"])
@pytest.mark.parametrize("speed", [0.8, -0.8])
def test_no_preset_has_a_gap_between_the_robot_and_the_stop_zone(name: str, speed: float):
    """A post is told STOP from the zone's end to the robot's end, and the robot itself is no obstacle."""
    p = preset(name)
    bearing = np.radians(np.arange(-180.0, 180.0, 0.5))
    far = 30.0 * np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(len(bearing))])
    mounting = Pose3(np.eye(3), np.array([0.2, 0.1, 0.5]))
    body = np.column_stack([np.full(20, -0.25), np.linspace(-0.4, 0.4, 20), np.zeros(20)])
    zones = []
    for distance in np.arange(p.obstacles.reach + 0.05, p.obstacles.reach + p.obstacles.stop_distance, 0.05):
        thing = post(np.sign(speed) * distance, 0.0, 0.5, points=8) - mounting.t
        step = Step(0, scan(1, np.vstack([far, body, thing])), None, twist=(speed, 0.0, 0.0))
        zones.append(segment(step, Sensor(rings=1), mounting, p).clearance)
    assert {found.zone for found in zones if found is not None} == {Zone.STOP}
    assert len(zones) > 15
    step = Step(0, scan(1, np.vstack([far, body])), None, twist=(speed, 0.0, 0.0))
    free = segment(step, Sensor(rings=1), mounting, p).clearance
    assert free is not None
    assert free.zone is Zone.CLEAR


def test_where_nobody_knows_how_high_the_sensor_stands_nothing_is_free():
    """Without a ground and a mounting a trunk close ahead shows only below the lowest obstacle."""
    unknown = np.zeros(3)
    trunk = np.repeat([[1.2, 0.0, z] for z in np.linspace(-0.3, 0.2, 6)], 5, axis=0)
    assert clearance(trunk, sensor=unknown).zone is Zone.UNKNOWN
    assert clearance(sensor=unknown).zone is Zone.UNKNOWN
    assert clearance(trunk, post(3.0, 0.0), sensor=unknown).zone is Zone.UNKNOWN
    assert clearance(post(1.0, 0.0), sensor=unknown).zone is Zone.STOP
    laser = preset("laser2d").obstacles
    assert clearance(sensor=unknown, parameters=laser).zone is Zone.CLEAR
    assert clearance(trunk, sensor=unknown, parameters=laser).zone is Zone.STOP
    flat = Terrain(np.full((SECTORS, RINGS), -0.8), np.ones((SECTORS, RINGS), dtype=np.bool_))
    assert clearance(sensor=unknown, terrain=flat).zone is Zone.CLEAR
    assert clearance(trunk, sensor=unknown, terrain=flat).zone is Zone.STOP


def test_what_is_no_number_is_passed_over():
    bad = np.array([[np.nan, 0.0, 1.0], [1.0, np.nan, 1.0], [2.0, 0.0, np.nan], [np.inf, 0.0, 1.0]])
    bad = np.repeat(bad, 10, axis=0)
    assert clearance(bad).zone is Zone.CLEAR
    assert clearance(bad, post(2.0, 0.0)).ahead == pytest.approx(2.0 - P.reach, abs=1e-5)


@pytest.mark.parametrize(
    "twist", [(math.nan, 0.0, 1.0), (1.0, 0.0, math.nan), (0.0, 0.0, 9.0), (1.0, 0.0, math.inf)]
)
def test_velocities_that_tell_no_way_lead_straight_on(twist: tuple[float, float, float]):
    assert path_curvature(twist) == 0.0
    assert clearance(post(2.0, 0.0), twist=twist).zone is Zone.SLOW


def test_no_way_is_tighter_than_a_robot_turns():
    assert path_curvature((0.1, 0.0, 9.0)) == 1.0 / TIGHTEST


def test_it_can_be_switched_off_and_zones_are_ordered():
    off = Obstacles(method="none")
    assert find_clearance(LOOKS.astype(np.float32), NOTHING, None, SENSOR, FORWARD, off) is None
    with pytest.raises(
        ParameterError, match=r"stop_distance = 5\.0 must be less than obstacles\.slow_distance"
    ):
        Parameters().replace({"obstacles.stop_distance": 5.0})
