"""A scan that is not mapped yet in the scene."""

from __future__ import annotations

import numpy as np
import viser

from app.scene import Scene
from app.worker.unmapped import unmapped_frame
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Scan, Step
from tests.app.scene.frames import make_frame


async def test_its_points_are_shown_and_the_first_mapped_scan_follows(scene: Scene):
    points = np.random.default_rng(0).normal(0.0, 5.0, (300, 3)).astype(np.float32)
    step = Step(0, Scan(1, points), Pose2(1.0, 2.0, 0.5))
    scene.show(unmapped_frame(step, Pose3.identity()), np.zeros((0, 4)))
    raw = scene._server.scene.get_handle_by_name("/world/robot/scan/raw")
    assert isinstance(raw, viser.PointCloudHandle)
    assert len(raw.points) == 300
    scene.show(make_frame(0), np.zeros((1, 4)))
