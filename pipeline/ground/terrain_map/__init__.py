"""Height map: the ground of all scans in the frame of the map, tile by tile."""

from pipeline.ground.terrain_map.fusion import HeightMapper, HeightMapState, no_height_map
from pipeline.ground.terrain_map.packed_terrain_map import PackedHeightMap

__all__ = ["HeightMapState", "HeightMapper", "PackedHeightMap", "no_height_map"]
