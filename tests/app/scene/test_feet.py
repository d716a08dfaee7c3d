"""Where drawn stems begin: on the terrain, and where none was mapped, within their own points."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from app.scene import Scene
from app.scene.nodes import scan_in_map
from pipeline.config import preset
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.lidar_odometry import LidarOdometry
from pipeline.odometry.odometry_override import OdometryOverride
from pipeline.odometry.synchroniser import steps
from tests.app.scene.feet import ROUNDED, bases, on_terrain, path_of, within
from tests.app.scene.frames import make_frame

SCANS = 40
PARKS = [f"park_trunks/{name}" for name in ("00", "03", "04", "08")]


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("uri", [*PARKS, "sim:wild?seed=3"])
async def test_the_base_of_each_drawn_stem_is_within_its_own_points_or_on_the_terrain(
    uri: str, scene: Scene, shared_data: Path
):
    source = open_source(uri if uri.startswith("sim:") else str(shared_data / uri))
    known = source.description
    if not known.has_odometry:
        source = OdometryOverride(source, LidarOdometry(known.T_base_lidar, known.sensor))
    mapper = Mapper(preset("forest"), sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=0)
    clustered, whole, ground = [], [], None
    for count, step in enumerate(steps(source.records())):
        frame = mapper.process(step)
        scene.show(frame, path_of(frame))
        ground = frame.ground or ground
        clustered.append(scan_in_map(frame, frame.filtered[frame.labels >= 0]))
        whole.append(scan_in_map(frame, frame.raw))
        fits = bases(scene, "/world/robot/scan/fits")
        if len(frame.detections.cluster):
            assert within(clustered[-1], clustered[-1], fits).all()
        if count == SCANS:
            break
    source.close()
    trees = bases(scene, "/world/trees")
    assert len(trees) > 5
    right = on_terrain(ground, trees) | within(np.vstack(whole), np.vstack(clustered), trees)
    assert right.all(), trees[~right]


def test_a_tree_keeps_its_foot_when_it_is_out_of_view_and_without_any_points_has_that_of_its_neighbour(
    scene: Scene,
):
    frame = make_frame(0, trees=3)
    places = np.vstack([frame.clusters.centroid[:2, :2], [[60.0, 0.0]]])
    trees = dataclasses.replace(frame.trees, position=places + frame.sensor_offset[:2])
    seen = dataclasses.replace(frame, trees=trees, base_z=1.0)
    points = scan_in_map(seen, seen.filtered)
    lowest = [points[seen.labels == k, 2].min() for k in (0, 1)]
    scene.show(seen, path_of(seen))
    before = bases(scene, "/world/trees")[:, 2]
    np.testing.assert_allclose(before[:2], lowest, atol=ROUNDED)
    assert np.min(np.abs(before[2] - lowest)) <= ROUNDED
    away = dataclasses.replace(make_frame(1, trees=3, clusters=0), trees=trees, base_z=5.0)
    scene.show(away, path_of(away))
    np.testing.assert_array_equal(bases(scene, "/world/trees")[:, 2], before)
