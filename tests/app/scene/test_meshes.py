"""Meshes of the scene: closed, seen from outside, and of the size that they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from app.scene.nodes import Mesh, box, cylinder


@pytest.mark.parametrize(
    ("mesh", "volume", "bounds"),
    [
        (box(), 1.0, [[0, 0, 0], [1, 1, 1]]),
        (cylinder(20), 10.0 * math.sin(math.tau / 20), [[-1, -1, 0], [1, 1, 1]]),
    ],
    ids=["box", "cylinder"],
)
def test_a_mesh_is_closed_and_has_its_volume(mesh: Mesh, volume: float, bounds: list[list[float]]):
    solid = trimesh.Trimesh(*mesh, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(volume, rel=1e-6)  # positive: the faces look outwards
    np.testing.assert_allclose(solid.bounds, bounds, atol=1e-6)
