"""The ground truth of a run as JSON, to be carried in its recording as `stemmap_truth.json`."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.types.records import Sensor, Truth

NAME = "stemmap_truth.json"
MEDIA_TYPE = "application/json"


def truth_json(sensor: Sensor, truth: Truth | None) -> bytes:
    """Version 1: the sensor, the trees (dbh null where not known) and the path, as columns.

    A path that is not in the frame of the map, or has no yaw, is left out: the form promises both.
    """
    content: dict[str, Any] = {"version": 1, "sensor": asdict(sensor)}
    if truth is not None and truth.trees is not None:
        trees = truth.trees
        content["trees"] = {
            "x": trees.x.tolist(),
            "y": trees.y.tolist(),
            "dbh": [float(dbh) if np.isfinite(dbh) else None for dbh in trees.dbh],
            "kind": list(trees.kind),
        }
    if truth is not None and truth.path is not None:
        path = truth.path
        if path.same_frame and np.isfinite(path.yaw).all():
            content["path"] = {
                "stamp_ns": path.stamp_ns.tolist(),
                "x": path.x.tolist(),
                "y": path.y.tolist(),
                "yaw": path.yaw.tolist(),
            }
    return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
