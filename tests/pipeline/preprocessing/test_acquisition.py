"""De-skewing and levelling: scans of a moving, tilted robot reproduce a static world."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose3
from pipeline.preprocessing import HOUSING, acquire, acquire_near
from pipeline.types.records import Step
from tests.pipeline.strategies import scan

FOREST = preset("forest").acquisition
MOUNTING = Pose3.from_euler(np.array([0.3, -0.1, 0.8]), 0.02, -0.05, 0.4)


def _world(seed, n=40):
    rng = np.random.default_rng(seed)
    away = rng.uniform([2, -np.pi, 0], [16, np.pi, 3], (n, 3))  # none nearer than the sensor reads
    return np.stack([away[:, 0] * np.cos(away[:, 1]), away[:, 0] * np.sin(away[:, 1]), away[:, 2]], axis=1)


def _seen(world, T_world_base):
    """The points of the world as the LiDAR sees them, each from the base's pose at its time."""
    return np.array(
        [(T @ MOUNTING).inverse().apply(p[None])[0] for p, T in zip(world, T_world_base, strict=True)]
    )


@given(st.integers(0, 999), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_tilted_robot_gives_the_upright_world(seed, roll, pitch):
    world = _world(seed)
    tilt = Pose3.from_euler(np.zeros(3), roll, pitch, 0.0)
    step = Step(0, scan(1, _seen(world, [tilt] * len(world))), None, roll, pitch, tilt_known=True)
    points, offset = acquire(step, MOUNTING, FOREST)
    np.testing.assert_allclose(points + offset, world, atol=1e-5)


def test_without_a_tilt_or_with_levelling_off_points_are_not_rotated():
    world = _world(1)
    still = scan(1, _seen(world, [Pose3.identity()] * len(world)))
    unknown, _ = acquire(Step(0, still, None, 0.3, 0.2, tilt_known=False), MOUNTING, FOREST)
    unwanted, _ = acquire(
        Step(0, still, None, 0.3, 0.2, tilt_known=True),
        MOUNTING,
        FOREST.model_copy(update={"level": "none"}),
    )
    np.testing.assert_allclose(unknown + MOUNTING.t, world, atol=1e-5)
    np.testing.assert_array_equal(unknown, unwanted)


@given(st.integers(0, 999), st.floats(-3.0, 3.0), st.floats(-0.5, 0.5))
def test_translation_is_compensated(seed, forward, left):
    world = _world(seed)
    dt = np.random.default_rng(seed).integers(-50_000_000, 100_000_000, len(world))
    poses = [Pose3(np.eye(3), np.array([forward, left, 0.0]) * t * 1e-9) for t in dt]
    step = Step(0, scan(1, _seen(world, poses), dt), None, twist=(forward, left, 0.0))
    points, offset = acquire(step, MOUNTING, FOREST)
    np.testing.assert_allclose(points + offset, world, atol=1e-5)


@given(st.integers(0, 999), st.floats(-2.0, 2.0))
def test_rotation_is_compensated(seed, turn):
    world = _world(seed)
    dt = np.random.default_rng(seed).integers(-100_000_000, 100_000_000, len(world))
    poses = [Pose3.from_euler(np.zeros(3), 0.0, 0.0, turn * t * 1e-9) for t in dt]
    step = Step(0, scan(1, _seen(world, poses), dt), None, twist=(0.0, 0.0, turn))
    points, offset = acquire(step, MOUNTING, FOREST)
    np.testing.assert_allclose(points + offset, world, atol=1e-4)


def test_a_curve_with_tilt_is_compensated_to_millimetres():
    world, turn, speed = _world(3), 0.6, 1.0
    dt = np.linspace(0, 100_000_000, len(world)).astype(np.int64)
    t = dt * 1e-9
    arc = np.stack([np.sin(turn * t), 1 - np.cos(turn * t), 0 * t], axis=1) * speed / turn
    poses = [
        Pose3.from_euler(p, 0.0, 0.0, turn * s) @ Pose3.from_euler(np.zeros(3), 0.1, -0.2, 0.0)
        for p, s in zip(arc, t, strict=True)
    ]
    step = Step(0, scan(1, _seen(world, poses), dt), None, 0.1, -0.2, True, (speed, 0.0, turn))
    points, offset = acquire(step, MOUNTING, FOREST)
    np.testing.assert_allclose(points + offset, world, atol=0.5 * turn * speed * 0.1**2 + 1e-4)


def test_deskewing_can_be_switched_off():
    step = Step(0, scan(1, [[3, 0, 0]], [100_000_000]), None, twist=(1.0, 0.0, 0.0))
    off = FOREST.model_copy(update={"deskew": False})
    np.testing.assert_allclose(acquire(step, Pose3.identity(), FOREST)[0], [[3.1, 0, 0]], atol=1e-6)
    np.testing.assert_array_equal(acquire(step, Pose3.identity(), off)[0], [[3, 0, 0]])


def test_range_limits_are_inclusive_and_nan_is_removed():
    p = FOREST.model_copy(update={"range_min": 0.5, "range_max": 40.0})
    rows = [[0.5, 0, 0], [0, 40, 0], [0, 0, 0.49], [0, 0, 40.01], [np.nan, 1, 1], [np.inf, 1, 1], [0, 0, 0]]
    points, _ = acquire(Step(0, scan(1, rows), None), Pose3.identity(), p)
    np.testing.assert_array_equal(points, np.array([[0.5, 0, 0], [0, 40, 0]], np.float32))


@given(st.integers(0, 999), st.floats(0.0, 3.0))
def test_each_return_is_either_near_or_used_or_out_of_range(seed, nearest):
    rng = np.random.default_rng(seed)
    rows = rng.uniform(-3.0, 3.0, (60, 3)).astype(np.float32)
    rows[::7] = np.nan
    p = FOREST.model_copy(update={"range_min": nearest, "deskew": False})
    step = Step(0, scan(1, rows), None, 0.2, -0.1, tilt_known=True)
    taken, near = acquire(step, MOUNTING, p)[0], acquire_near(step, MOUNTING, p)
    distance = np.linalg.norm(rows.astype(np.float64), axis=1)
    assert len(taken) == np.count_nonzero(distance >= nearest)
    assert len(near) == np.count_nonzero((distance < nearest) & (distance >= HOUSING))
    assert near.dtype == np.float32
    whole = acquire(step, MOUNTING, p.model_copy(update={"range_min": 0.0}))[0]
    chosen = distance[np.isfinite(distance)]
    np.testing.assert_allclose(near, whole[(chosen < nearest) & (chosen >= HOUSING)], atol=1e-6)


def test_near_returns_are_not_deskewed():
    step = Step(0, scan(1, [[0.3, 0, 0], [0, 0, 0]], [100_000_000] * 2), None, twist=(2.0, 0.0, 0.0))
    np.testing.assert_allclose(acquire_near(step, Pose3.identity(), FOREST), [[0.3, 0, 0]])


@pytest.mark.parametrize("offsets", [None, []])
def test_an_empty_scan_stays_empty(offsets):
    points, _ = acquire(Step(0, scan(1, [], offsets), None, twist=(1.0, 0, 0)), MOUNTING, FOREST)
    assert points.shape == (0, 3)
    assert points.dtype == np.float32
