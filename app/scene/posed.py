"""Frames whose pose a browser always hears."""

from __future__ import annotations

import viser


def add_posed(scene: viser.SceneApi, name: str) -> viser.FrameHandle:
    """Add a frame without axes at the origin of its parent, and say that it stands there.

    viser doesn't send a pose that a new node has anyhow, and a node that is removed and added again at once
    reaches a browser as one that changed: it would go on standing where it stood before, in the last run's
    frame, for as long as its pose is the origin.
    """
    frame = scene.add_frame(name, show_axes=False)
    frame.position, frame.wxyz = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)  # of both only the last is sent
    frame.position, frame.wxyz = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    return frame
