"""Ray statistics: rays that end at a column, pass it or stop before it; features of free upper ends and of
gaps below crowns."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.classification.column_extraction import PROFILE
from pipeline.classification.features import COUNT, NAMES, UNSEEN, features
from pipeline.classification.ray_statistics import NEAR, count_rays, update_visibility, view_by_direction
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.detection.free_space import BEHIND, BINS
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Pose2
from pipeline.ground.scan_ground import SECTORS

FLAT = np.full((SECTORS, 200), -1.0)  # the ground 1 m below the sensor
AXIS = np.array([[6.0, 0.5, 0.0, 0.0, 1.0]])


def looked(points, pose=(0.0, 0.0, 0.0), offset=(0.0, 0.0, 0.0), farthest=25.0):
    """Rays that met the column and that passed it, by slice; points in the level sensor frame."""
    met, passed = np.zeros((1, SLICES), np.int32), np.zeros((1, SLICES), np.int32)
    _, depth = view_by_direction(np.array(points, np.float32).reshape(-1, 3), np.zeros(3), True)
    count_rays(AXIS, met, passed, np.array(pose), depth, np.array(offset), FLAT, farthest)
    return met[0], passed[0]


def on_ray(height, rho):
    """A point at a horizontal distance on the ray through the column's axis at a height above the ground."""
    reach = np.hypot(AXIS[0, 0], AXIS[0, 1])
    return (*(AXIS[0, :2] * rho / reach), (height - 1.0) * rho / reach)


@pytest.mark.parametrize("height", [0.5, 1.3, 2.5, 4.0])
def test_what_ends_at_the_column_met_it_and_what_ends_behind_passed_it(height):
    met, passed = looked([on_ray(height, 6.0)])
    assert met.sum() == 1
    assert abs((met.argmax() + 0.5) * SLICE - height) <= SLICE
    assert passed.sum() == 0
    met, passed = looked([on_ray(height, 12.0)])
    assert passed.sum() == 1
    assert abs((passed.argmax() + 0.5) * SLICE - height) <= SLICE
    assert met.sum() == 0


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize(
    ("free", "present", "absent"),
    [
        (-NEAR - 0.01, 0, 0),
        (-NEAR + 0.01, 1, 0),
        (NEAR - 0.01, 1, 0),
        (BEHIND - 0.01, int(BEHIND < NEAR), 0),
        (BEHIND + 0.01, 0, 1),
        (20.0, 0, 1),
    ],
)
def test_a_column_is_absent_where_the_free_range_ends_behind_it(free, present, absent, yaw):
    """`free` is the range beyond the axis at which the free range in its direction ends [m]."""
    pose = np.array([1.0, -2.0, yaw])
    dx, dy = AXIS[0, :2] - pose[:2]
    reach = np.hypot(dx, dy)
    clear, steepest = np.zeros(BINS), np.full(BINS, -1.0)
    x, y = Pose2(0.0, 0.0, -yaw).apply(np.array([dx, dy]))
    there = direction_bin(x, y, BINS)
    clear[there], steepest[there] = reach + free, 0.2
    for range_max, seen in ((reach + 0.1, True), (reach - 0.1, False)):
        viewed, was, was_not, lately = np.full(1, -1.0), np.zeros(1), np.zeros(1), np.full(1, 3.0)
        update_visibility(
            AXIS,
            viewed,
            was,
            was_not,
            lately,
            pose,
            clear,
            steepest,
            np.array([0.0, 0.0, 1.0]),
            FLAT,
            range_max,
        )
        assert (was[0], was_not[0]) == ((present, absent) if seen else (0, 0))
        assert lately[0] == ((0 if present else 3 + absent) if seen else 3)
        assert viewed[0] == pytest.approx(0.2 * reach + 1.0 if seen else -1.0)


def test_a_ray_that_is_stopped_before_or_goes_elsewhere_tells_nothing():
    before, beside = on_ray(1.3, 4.0), (6.0, -2.0, 0.3)
    for points in ([before], [beside], [], [before, on_ray(1.3, 12.0)]):
        met, passed = looked(points)
        assert met.sum() == passed.sum() == 0


def test_what_is_told_does_not_hang_on_where_the_robot_stands_and_looks():
    T = (2.0, -1.0, 0.7)
    c, s = np.cos(T[2]), np.sin(T[2])
    x, y = AXIS[0, 0] - T[0], AXIS[0, 1] - T[1]
    ahead, left = c * x + s * y - 0.1, c * y - s * x
    met, passed = looked([(ahead, left, 0.3), (1.5 * ahead, 1.5 * left, 1.5)], pose=T, offset=(0.1, 0.0, 0.0))
    assert met.sum() == passed.sum() == 1
    far = looked([(ahead, left, 0.3)], pose=T, offset=(0.1, 0.0, 0.0), farthest=3.0)
    assert far[0].sum() == 0


def figures(filled, met=(), passed=()):
    """Of a column with returns at the axis in some slices, and rays in some."""
    rows = np.zeros((1, SLICES, PROFILE))
    rows[0, list(filled), 0] = 10.0
    rows[0, list(filled), 3] = 3.0
    rays = np.zeros((2, 1, SLICES), np.int32)
    rays[0, 0, list(met)], rays[1, 0, list(passed)] = 3, 1
    out = np.zeros((1, COUNT))
    one = np.ones(1)
    features(AXIS, rows, one, one, 0.0 * one, rays[0], rays[1], out)
    return dict(zip(NAMES, out[0], strict=True))


def test_a_pole_ends_in_free_air_and_a_trunk_that_nobody_looked_over_does_not():
    pole = figures(range(1, 16), met=range(1, 16), passed=range(16, 22))
    assert pole["free above the highest return"] == pytest.approx(6 * SLICE)
    assert pole["free above what is clean"] == pytest.approx(6 * SLICE)
    assert pole["rays up to"] == pytest.approx(21 * SLICE)
    trunk = figures(range(1, 16), met=range(1, 16))
    assert trunk["free above the highest return"] == trunk["free above what is clean"] == 0.0
    assert trunk["opaque 0.2-0.8 m"] == 1.0
    assert trunk["opaque 3.2-6 m"] == UNSEEN


def test_a_crown_over_a_pole_leaves_a_gap_and_one_around_a_trunk_does_not():
    under = figures([*range(1, 12), *range(20, 26)], met=range(1, 12), passed=range(12, 20))
    assert under["free above what is clean"] == pytest.approx(8 * SLICE)
    assert under["nothing above what is clean"] == pytest.approx(8 * SLICE)
    assert under["free above the highest return"] == 0.0
    inside = figures(range(1, 26), met=range(1, 26))
    assert inside["nothing above what is clean"] == inside["free above what is clean"] == 0.0


def test_leaves_let_part_of_the_rays_through():
    leaves = figures(range(1, 8), met=range(1, 4), passed=range(1, 4))
    assert leaves["opaque 0.2-0.8 m"] == pytest.approx(0.75)
