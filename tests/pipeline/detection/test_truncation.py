"""Truncation: a partially visible trunk gets the verdict for the border of the view, a complete one never
does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.detection.free_space import BINS
from pipeline.detection.truncation import field_of_view
from pipeline.front_end import detect, segment
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.directions import bin_direction
from pipeline.geometry.poses import Pose3
from pipeline.types.records import Scan, Sensor, Step, Verdict

FOREST = preset("forest")
STEP = float(np.radians(0.2))
SENSOR = Sensor(name="16 rings", rings=16, ring_step=float(np.radians(2.0)), azimuth_step=STEP)
HEIGHT = 0.8  # m, of the sensor above level ground
RINGS = np.radians(np.arange(-15.0, 16.0, 2.0))


def scan(trunks, *, width=np.pi, mast=0.0):
    """Returns of level ground and of upright trunks (x, y, radius), looked at `width` to both sides of x.

    Behind all stands a wall 20 m away unless `mast` is given, then nothing does.
    """
    azimuth = np.arange(-width, width, STEP)
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, RINGS))
    reach = np.where(e < 0.0, HEIGHT / np.tan(np.maximum(-e, 1e-9)), np.inf)
    reach = np.minimum(reach, np.inf if mast else 20.0)
    for x, y, r in trunks:
        middle = x * np.cos(a) + y * np.sin(a)
        beside = y * np.cos(a) - x * np.sin(a)
        front = middle - np.sqrt(np.maximum(r * r - beside * beside, 0.0))
        reach = np.where((np.abs(beside) < r) & (middle > 0.0), np.minimum(reach, front), reach)
    seen = reach < 100.0
    a, e, reach = a[seen], e[seen], reach[seen]
    points = np.stack([reach * np.cos(a), reach * np.sin(a), reach * np.tan(e)], axis=1)
    return points.astype(np.float32)


def verdict_at(points, place, changes=None, sensor=SENSOR):
    """Of the cluster nearest to a place (x, y)."""
    step = Step(0, Scan(0, points), None)
    mounting = Pose3(np.eye(3), np.array([0.0, 0.0, HEIGHT]))
    p = FOREST.replace(changes or {})
    found = detect(segment(step, sensor, mounting, p), p.detection).clusters
    nearest = int(np.hypot(*(found.centroid[:, :2] - np.asarray(place)).T).argmin())
    assert np.hypot(*(found.centroid[nearest, :2] - np.asarray(place))) < 0.4
    return Verdict(int(found.verdict[nearest]))


TRUNK = (5.0, 0.0, 0.2)


@pytest.mark.parametrize("short", [0.1, 0.0])
@pytest.mark.parametrize(
    ("face", "trunk"),
    [
        ("filters.y_max", (5.0, 3.0, 0.2)),
        ("filters.y_min", (5.0, -3.0, 0.2)),
        ("filters.x_max", (5.0, 3.0, 0.2)),
        ("filters.x_min", (-5.0, 3.0, 0.2)),
    ],
)
def test_a_face_of_the_box_cuts_a_trunk(face, trunk, short):
    x, y, _ = trunk
    at = x if ".x_" in face else y
    points = scan([trunk])
    assert verdict_at(points, (x, y), {face: float(at - short * np.sign(at))}) is Verdict.AT_BORDER
    assert verdict_at(points, (x, y), {face: float(at + 0.5 * np.sign(at))}) is Verdict.TREE


def test_the_floor_and_the_roof_of_the_box_cut_nothing_off():
    assert verdict_at(scan([TRUNK]), TRUNK[:2], {"filters.z_max": 0.4, "filters.z_min": -0.4}) is Verdict.TREE


def test_the_greatest_and_the_least_range_cut_a_trunk():
    points = scan([TRUNK])
    assert verdict_at(points, TRUNK[:2], {"acquisition.range_max": 4.95}) is Verdict.AT_BORDER
    assert verdict_at(points, TRUNK[:2], {"acquisition.range_max": 5.5}) is Verdict.TREE
    assert verdict_at(points, TRUNK[:2], {"acquisition.range_min": 4.85}) is Verdict.AT_BORDER
    assert verdict_at(points, TRUNK[:2], {"acquisition.range_min": 4.5}) is Verdict.TREE
    assert (
        verdict_at(points, TRUNK[:2], {"acquisition.range_max": 4.95, "detection.whole": False})
        is Verdict.TREE
    )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_side_of_the_view_cuts_a_trunk_and_not_the_one_beside_it(side):
    edge = np.radians(35.0)
    at_edge = (6.0 * np.cos(edge), side * 6.0 * np.sin(edge), 0.25)
    inside = (6.0 * np.cos(0.8 * edge), side * 6.0 * np.sin(0.8 * edge), 0.2)
    points = scan([at_edge, inside], width=edge)
    assert verdict_at(points, at_edge[:2]) is Verdict.AT_BORDER
    assert verdict_at(points, inside[:2]) is Verdict.TREE
    assert verdict_at(scan([at_edge, inside]), at_edge[:2]) is Verdict.TREE, "all around it is whole"


def test_a_trunk_alone_in_the_view_is_no_border_of_it():
    """No ground and no wall: what ends at the trunk's sides is the trunk."""
    points = scan([TRUNK], width=np.radians(60.0), mast=1.0)
    lone = points[points[:, 2] > -0.45]
    assert verdict_at(lone, TRUNK[:2]) is not Verdict.AT_BORDER


@given(st.integers(0, 5 * BINS))
def test_a_sector_is_found_again_by_its_middle(k):
    x, y = bin_direction(k, BINS)
    assert direction_bin(x, y, BINS) == k % BINS
    assert np.hypot(x, y) == pytest.approx(1.0)


@given(st.floats(-np.pi, np.pi), st.floats(0.2, 2.2))
def test_the_view_is_told_by_where_returns_end(heading, half):
    turn = heading + np.linspace(-half, half, 800)
    points = np.stack([9.0 * np.cos(turn), 9.0 * np.sin(turn), 0.0 * turn], axis=1).astype(np.float32)
    view = field_of_view(points)
    middle = np.arctan2(view.s, view.c)
    off = np.angle(np.exp(1j * (middle + 0.5 * (view.left + view.right) - heading)))
    assert abs(off) < 1e-4
    assert view.left - view.right == pytest.approx(2.0 * half, abs=1e-4)


def test_who_looks_all_around_or_nowhere_has_no_sides():
    around = np.linspace(-np.pi, np.pi, 2000)
    ring = np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1).astype(np.float32)
    for points in (ring, np.zeros((0, 3), np.float32)):
        assert not np.isfinite([field_of_view(points).left, field_of_view(points).right]).any()
