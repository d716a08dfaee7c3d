"""Our side of the comparison: `python -m tests.benchmarks.ours FOLDER FILE`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pipeline.config import Parameters
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.types.records import Frame, Scan, Sensor, Step
from tests.benchmarks.recorded import RecordedScan, Recording
from tests.benchmarks.turns import StageTimes, serve

PERIOD_NS = 100_000_000  # of the scans that both sides map

PEERS_NAME = {
    "clustering": "clustering",
    "shape": "shape and detection",
    "free view": "shape and detection",
    "detection": "shape and detection",
    "slam": "SLAM",
    "tracking": "tracking",
}


class Ours:
    """The mapper, with the stage names that both sides use."""

    def __init__(self, recording: Recording, values: dict[str, Any], seed: int = 0) -> None:
        self._mapper = Mapper(
            Parameters().replace(values),
            sensor=Sensor(**recording.sensor),
            T_base_lidar=Pose3(recording.rotation, recording.translation),
            seed=seed,
            timer=self._watch,
        )
        self._times = StageTimes()
        self._frame: Frame | None = None

    @contextmanager
    def _watch(self, stage: str) -> Iterator[None]:
        with self._times(PEERS_NAME.get(stage, "acquisition and filters")):
            yield

    def process(self, scan: RecordedScan, watch: StageTimes) -> None:
        """Map one scan."""
        self._times = watch
        self._frame = self._mapper.process(step_of(scan))

    def result(self) -> dict[str, Any]:
        """The map."""
        path = self._mapper.path
        rows = [[float(x), float(y)] for x, y in zip(path.x, path.y, strict=True)]
        if self._frame is None:
            return {"trees": [], "path": rows, "landmarks": 0}
        trees = self._frame.trees
        return {
            "trees": trees.position[trees.confirmed].tolist(),
            "path": rows,
            "landmarks": len(self._frame.estimate.landmarks),
        }


def step_of(scan: RecordedScan) -> Step:
    """Return a scan as the record that the mapper processes."""
    return Step(
        index=scan.index,
        scan=Scan(scan.stamp_ns, scan.points, offset_ns=scan.offset_ns),
        T_odom_base=Pose2(*scan.pose),
        roll=scan.roll,
        pitch=scan.pitch,
        tilt_known=scan.tilt_known,
        twist=scan.twist,
        elapsed_ns=scan.index * PERIOD_NS,
        period_ns=PERIOD_NS,
    )


if __name__ == "__main__":
    serve(Ours)
