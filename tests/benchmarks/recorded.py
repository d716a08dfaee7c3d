"""Steps of a run in a folder, so that both sides read the same data and neither of them simulates."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScan:
    """A scan with its motion, in NumPy and Python alone.

    Attributes:
        points: float32, shape (N, 3) [m], sensor frame; offset_ns: int32, shape (N,), or None.
        index, stamp_ns, pose, roll, pitch, tilt_known, twist: As in `pipeline.types.records.Step`; the pose
            is x, y [m], yaw [rad].
    """

    points: Float32
    offset_ns: NDArray[np.int32] | None
    index: int
    stamp_ns: int
    pose: tuple[float, float, float]
    roll: float
    pitch: float
    tilt_known: bool
    twist: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A run: its scans, the sensor and its mounting; everything except the points is in memory.

    Attributes:
        folder: Folder of the files.
        steps: One dictionary per scan.
        rotation, translation: Of T_base_lidar, shapes (3, 3) and (3,) [m].
        sensor: Fields of `pipeline.types.records.Sensor`.
    """

    folder: Path
    steps: list[dict[str, Any]]
    rotation: Float
    translation: Float
    sensor: dict[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Recording:
        """Read what `write` wrote."""
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        return cls(
            folder, run["steps"], np.array(run["rotation"]), np.array(run["translation"]), run["sensor"]
        )

    def __len__(self) -> int:
        return len(self.steps)

    def scan(self, k: int) -> RecordedScan:
        """The k-th scan."""
        step = dict(self.steps[k])
        offset = self.folder / f"{k}.offset.npy"
        pose, twist = tuple(step.pop("pose")), tuple(step.pop("twist"))
        return RecordedScan(
            points=np.load(self.folder / f"{k}.points.npy"),
            offset_ns=np.load(offset) if offset.is_file() else None,
            pose=pose,
            twist=twist,
            **step,
        )


def write(uri: str, folder: Path, *, stride: int, scans: int) -> None:
    """Write every `stride`-th scan of a source, at most `scans` of them."""
    from dataclasses import asdict

    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps
    from pipeline.types.records import Step

    def chosen() -> Iterable[Step]:
        for step in steps(source.records()):
            if step.index >= stride * scans:
                return
            if step.index % stride == 0:
                yield step

    source = open_source(uri)
    described = []
    for k, step in enumerate(chosen()):
        np.save(folder / f"{k}.points.npy", step.scan.points)
        if step.scan.offset_ns is not None:
            np.save(folder / f"{k}.offset.npy", step.scan.offset_ns)
        described.append(_described(k, step))
    source.close()
    run = {
        "steps": described,
        "rotation": source.description.T_base_lidar.R.tolist(),
        "translation": source.description.T_base_lidar.t.tolist(),
        "sensor": asdict(source.description.sensor),
    }
    (folder / "run.json").write_text(json.dumps(run), encoding="utf-8")


def _described(k: int, step: Any) -> dict[str, Any]:
    T = step.T_odom_base
    return {
        "index": k,
        "stamp_ns": step.scan.stamp_ns,
        "pose": [T.x, T.y, T.yaw] if T is not None else [0.0, 0.0, 0.0],
        "roll": step.roll,
        "pitch": step.pitch,
        "tilt_known": step.tilt_known,
        "twist": list(step.twist),
    }
