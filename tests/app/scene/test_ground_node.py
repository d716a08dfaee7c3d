"""The surface of the ground, and what stands on it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from app.scene import Scene
from app.scene.nodes import MOST_CELLS, raster, surface, without_small_holes
from pipeline.types.records import HeightMap
from tests.app.scene.frames import make_frame

PATH = np.column_stack([0.05 * np.arange(50), np.zeros(50)] * 2)


def make_ground(side: int, slope: float = 0.2) -> HeightMap:
    """A square of known cells around the origin that rises along x."""
    i, j = (axis.ravel() - side // 2 for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    place = np.stack([i, j], axis=1).astype(np.int32)
    height = (slope * 0.5 * (i + 0.5)).astype(np.float32)
    return HeightMap(0.5, place, height, np.full(len(i), 0.03, np.float32), np.ones(len(i), np.int32))


def node(scene: Scene, name: str):
    handle = scene._server.scene.get_handle_by_name(name)
    assert handle is not None, name
    return handle


def test_a_square_of_known_cells_is_two_triangles_each_seen_from_above():
    vertices, faces = surface(*raster(make_ground(5)))
    assert vertices.shape == (25, 3)
    assert faces.shape == (32, 3)
    np.testing.assert_allclose(vertices[:, 2], 0.2 * vertices[:, 0], atol=1e-6)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0.0)


@pytest.mark.parametrize(("wide", "left"), [(1, 0), (3, 0), (5, 21)])
def test_small_holes_are_closed_at_the_height_around_them_and_large_ones_stay(wide: int, left: int):
    """Of a hole of 5 x 5 cells only the four corners are closed."""
    ground = make_ground(11)
    known, low, cell = raster(ground)
    holed = known.copy()
    half = wide // 2
    holed[5 - half : 6 + half, 5 - half : 6 + half] = np.nan
    closed = without_small_holes(holed)
    assert np.count_nonzero(np.isnan(closed)) == left
    np.testing.assert_allclose(closed[np.isfinite(closed)], known[np.isfinite(closed)], atol=0.12)
    assert (len(surface(closed, low, cell)[1]) == 200) == (left == 0)


def test_the_ground_is_not_extended():
    known = raster(make_ground(5))[0]
    outer = np.pad(known, 3, constant_values=np.nan)
    np.testing.assert_array_equal(without_small_holes(outer), outer)


def test_a_large_map_is_shown_with_larger_cells():
    grid, _, cell = raster(make_ground(300))
    assert cell == 1.0
    assert np.count_nonzero(np.isfinite(grid)) <= MOST_CELLS


def test_trees_and_robot_stand_on_the_ground_and_the_surface_is_sent_once(scene: Scene):
    frame = dataclasses.replace(make_frame(0), ground=make_ground(120), base_z=0.4)
    scene.show(frame, PATH[:1])
    assert node(scene, "/world/surface").visible
    feet = node(scene, "/world/trees").batched_positions
    np.testing.assert_allclose(feet[:, 2], 0.2 * feet[:, 0], atol=0.11)
    assert node(scene, "/world/robot/wheels").vertices[:, 2].min() == pytest.approx(0.4, abs=1e-6)
    assert node(scene, "/world").position[2] == -0.4
    before = scene.messages
    scene.show(dataclasses.replace(frame, ground=None), PATH[:1])
    assert scene.messages == before


def test_the_switch_hides_the_surface(scene: Scene):
    scene.show(dataclasses.replace(make_frame(0), ground=make_ground(40)), PATH[:1])
    scene.choose("ground", False)
    assert not node(scene, "/world/surface").visible
    scene.choose("ground", True)
    assert node(scene, "/world/surface").visible


def test_without_a_height_map_there_is_no_surface(scene: Scene):
    scene.show(make_frame(0), PATH[:1])
    assert not node(scene, "/world/surface").visible
