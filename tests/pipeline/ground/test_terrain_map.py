"""Terrain map: planes are reproduced from any pose, states are immutable, memory is bounded."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.ground import terrain_map
from pipeline.ground.scan_ground import find_terrain
from pipeline.ground.terrain_map import HeightMapper, PackedHeightMap, merged_terrain
from pipeline.io.checkpoints.codec import decode, encode
from tests.pipeline.ground.test_ground import SENSOR_HEIGHT, _rings

FOREST = preset("forest").ground
OFFSET = np.array([0.0, 0.0, SENSOR_HEIGHT])


def _driven(slope, uphill, poses):
    """A mapper that saw a plane from each pose, as a level sensor above it sees it."""
    mapper = HeightMapper()
    for pose in poses:
        terrain = find_terrain(_rings(slope, uphill - pose.yaw), FOREST)
        mapper.add(terrain, pose, OFFSET)
    return mapper


def _poses(uphill, n):
    return [Pose2(0.4 * k * np.cos(uphill), 0.4 * k * np.sin(uphill), 0.1 * k) for k in range(n)]


@pytest.mark.parametrize("slope", [0.0, 8.0, 15.0])
def test_a_plane_is_reproduced_along_the_path(slope):
    uphill = 0.7
    record = _driven(slope, uphill, _poses(uphill, 25)).record()
    middle = (record.place + 0.5) * record.cell
    true = np.tan(np.radians(slope)) * (middle @ [np.cos(uphill), np.sin(uphill)])
    near = np.hypot(*middle.T) < 10.0
    error = (record.height - true)[near]
    assert np.count_nonzero(near) > 500
    assert np.sqrt(np.mean(error**2)) < 0.02 + 0.006 * slope
    assert np.all(record.sigma > 0.0)
    assert 15 <= record.views.max() <= 25


def test_heights_at_places_use_known_neighbours():
    mapper = _driven(0.0, 0.0, _poses(0.0, 3))
    heights = mapper.heights(np.array([[3.2, 0.1], [500.0, 0.0]]))
    assert heights[0] == pytest.approx(0.0, abs=1e-4)
    assert np.isnan(heights[1])


def test_later_scans_do_not_change_a_state():
    poses = _poses(0.0, 12)
    mapper = _driven(10.0, 0.0, poses[:6])
    state = mapper.state
    before = PackedHeightMap.of(state)
    for pose in poses[6:]:
        mapper.add(find_terrain(_rings(10.0, -pose.yaw), FOREST), pose, OFFSET)
    after = PackedHeightMap.of(state)
    np.testing.assert_array_equal(before.cells, after.cells)
    np.testing.assert_array_equal(before.tile, after.tile)
    last = mapper.record()
    mapper.state = state
    for pose in poses[6:]:
        mapper.add(find_terrain(_rings(10.0, -pose.yaw), FOREST), pose, OFFSET)
    for column in ("place", "height", "sigma", "views"):
        np.testing.assert_array_equal(getattr(mapper.record(), column), getattr(last, column))


def test_a_saved_map_is_the_same_to_the_bit():
    state = _driven(10.0, 0.0, _poses(0.0, 4)).state
    tree, arrays = encode(PackedHeightMap.of(state))
    again = decode(PackedHeightMap, tree, arrays).unpacked()
    assert list(again.tiles) == list(state.tiles)
    assert all(np.array_equal(again.tiles[key], state.tiles[key]) for key in state.tiles)
    assert (again.sensor_z, again.scans) == (state.sensor_z, state.scans)


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(terrain_map, "MOST_TILES", 40)
    far = [Pose2(30.0 * k, 0.0, 0.0) for k in range(6)]
    state = _driven(0.0, 0.0, far).state
    assert len(state.tiles) == 40
    assert max(i for i, _ in state.tiles) * terrain_map.TILE > 130.0  # what was seen last is kept


def test_a_wrong_sensor_height_is_corrected_at_known_cells():
    mapper = _driven(0.0, 0.0, _poses(0.0, 5))
    points = _rings(0.0, 0.0) - np.array([0.0, 0.0, 0.3], np.float32)  # it stands on a log
    mapper.add(find_terrain(points, FOREST), Pose2(), OFFSET)
    assert mapper.state.sensor_z == pytest.approx(SENSOR_HEIGHT + 0.3, abs=0.01)
    assert np.abs(mapper.record().height).max() < 0.01


def test_the_terrain_of_a_second_run_is_moved_in_plan_and_height():
    slope, T = 8.0, Pose2(6.0, 2.0, 0.6)
    a = _driven(slope, 0.0, _poses(0.0, 10)).state
    b = _driven(slope, -T.yaw, _poses(0.0, 10)).state  # the same plane, seen from its own origin
    both = merged_terrain(a, b, T)
    middle = (both.record.place + 0.5) * both.record.cell
    near = np.hypot(*middle.T) < 12.0
    error = (both.record.height - np.tan(np.radians(slope)) * middle[:, 0])[near]
    assert np.sqrt(np.mean(error**2)) < 0.07
    assert abs(np.median(error)) < 0.04  # the error of each of the two maps
    known = {tuple(cell) for cell in both.record.place.tolist()}
    assert known > {tuple(cell) for cell in terrain_map._record(a.tiles).place.tolist()}
    assert both.sensor_z == pytest.approx(b.sensor_z + 6.0 * np.tan(np.radians(slope)), abs=0.05)
    assert both.scans == a.scans + b.scans


def test_terrain_without_common_ground_is_that_of_the_first_run():
    a = _driven(0.0, 0.0, _poses(0.0, 7)).state
    alone = merged_terrain(a, a, Pose2(500.0, 0.0, 0.0))
    assert alone.tiles is a.tiles
    assert alone.record.views.max() == 7
    assert merged_terrain(a, HeightMapper().state, Pose2()).tiles is a.tiles
