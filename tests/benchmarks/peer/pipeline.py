"""The peer's whole pipeline, and its process: `python -m tests.benchmarks.peer.pipeline FOLDER FILE`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.benchmarks.peer import stages
from tests.benchmarks.peer.fastslam import FastSlam, wrap
from tests.benchmarks.peer.stages import Parameters
from tests.benchmarks.peer.trees import TreeMap
from tests.benchmarks.recorded import RecordedScan, Recording
from tests.benchmarks.turns import StageTimes, serve


class Peer:
    """Maps a recording with libraries, without levelling and ground, as in the paper."""

    def __init__(self, recording: Recording, p: Parameters, seed: int = 0) -> None:
        self.p = p
        self._rotation, self._offset = recording.rotation, recording.translation
        self._sigma = float(recording.sensor["range_sigma"])
        self._slam = FastSlam(p, seed)
        self._map = TreeMap(p)
        self._pose: tuple[float, float, float] | None = None
        self._path: list[tuple[float, float]] = []

    def process(self, scan: RecordedScan, watch: StageTimes) -> None:
        """Map one scan."""
        with watch("acquisition and filters"):
            points = stages.acquire(scan.points.astype(np.float64), self._rotation, self.p)
            points = stages.voxel_grid(stages.pass_through(points, self.p), self.p)
        with watch("clustering"):
            labels = stages.cluster(points, self.p)
        with watch("shape and detection"):
            found = stages.detect(points, labels, self._offset, self._sigma, self.p)
        with watch("SLAM"):
            self._slam.process(self._motion(scan.pose), found)
            pose, covariance = self._slam.estimate()
            self._slam.resample_if_needed()
        with watch("tracking"):
            self._map.process(scan.stamp_ns, pose, covariance, found)
        self._path.append((float(pose[0]), float(pose[1])))

    def _motion(self, now: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the odometry step in the frame of the previous pose."""
        before, self._pose = self._pose, now
        if before is None:
            return 0.0, 0.0, 0.0
        dx, dy = now[0] - before[0], now[1] - before[1]
        c, s = math.cos(before[2]), math.sin(before[2])
        return c * dx + s * dy, c * dy - s * dx, wrap(now[2] - before[2])

    def result(self) -> dict[str, Any]:
        """The map."""
        best = max(self._slam.particles, key=lambda particle: particle.weight)
        return {"trees": self._map.confirmed(), "path": self._path, "landmarks": len(best.landmarks)}


if __name__ == "__main__":
    serve(Peer)
