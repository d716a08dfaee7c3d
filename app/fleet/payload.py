"""What the page of a fleet is told of each robot."""

from __future__ import annotations

from typing import Any

import numpy as np

from app.dashboard.dashboard import Dashboard
from app.dashboard.payload import clearance_payload, trees_payload
from pipeline.geometry.poses import Pose2

#: Of a path as many points as a picture of some hundred pixels shows.
MOST_POINTS = 400


def card(name: str, dashboard: Dashboard) -> dict[str, Any]:
    """State and figures of a robot."""
    status = dashboard.status
    clearance = None if dashboard.shown is None else dashboard.shown.frame.clearance
    return {
        "name": name,
        "source": status.source or dashboard.source.uri,
        "state": status.state,
        "detail": status.detail,
        "live": status.live,
        "time_s": round(status.time_s, 1),
        "rate_hz": round(status.scan_rate_hz, 1),
        "mapping_ms": round(status.mapping_ms, 1),
        "behind": status.scans_behind,
        "health": status.health,
        "trees": status.trees,
        "distance_m": round(status.distance_m, 1),
        "recording": status.recording,
        "warnings": len(status.warnings),
        "clearance": clearance_payload(clearance),
    }


def shown_map(dashboard: Dashboard) -> dict[str, Any] | None:
    """Trees, path and place of a robot in the frame of its own map; None before there is one."""
    shown = dashboard.shown
    if shown is None:
        return None
    pose = shown.frame.estimate.T_map_base
    step = max(1, -(-len(dashboard.path_xy) // MOST_POINTS))
    path = np.vstack([dashboard.path_xy[::step], dashboard.path_xy[-1:]])
    return {
        "trees": trees_payload(shown.frame, start_ns=dashboard.start_ns),
        "path": np.round(path, 2).tolist(),
        "pose": [round(pose.x, 3), round(pose.y, 3), round(pose.yaw, 4)],
    }


def drawn(own: dict[str, Any], pose: Pose2 | None, how: str) -> dict[str, Any]:
    """A map as the page draws it: [x, y, DBH in cm or none] of each tree, and where its frame stands."""
    return {
        "trees": [[round(t["x"], 2), round(t["y"], 2), t["dbh_cm"]] for t in own["trees"]],
        "path": own["path"],
        "pose": own["pose"],
        "common": None if pose is None else [pose.x, pose.y, pose.yaw],
        "how": how,
    }
