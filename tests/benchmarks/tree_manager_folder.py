"""The stems of Oxford Evo (Evo.npz) in the folder format in which they were published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from app.extensions.formats.tree_manager import state_name, state_text
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Int, TruthPath
from pipeline.types.records import Path as DrivenPath

_KEYS = ("xyz", "axis_z", "dbh", "dbh_approx", "score", "reconstructed", "n_clusters")


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """The run: columns of its stems by name, and the pose of the sensor at each frame."""

    stems: dict[str, np.ndarray]
    stamp_ns: Int
    poses: list[Pose3]

    @property
    def truth(self) -> TruthPath:
        """The recorded path."""
        path = self.path(self.poses)
        return TruthPath(path.stamp_ns, path.x, path.y, path.yaw, same_frame=False)

    def path(self, poses: Sequence[Pose3]) -> DrivenPath:
        """Poses of all frames as a path."""
        x, y, yaw = np.array([pose.planar().as_array() for pose in poses]).T
        return DrivenPath(self.stamp_ns, x, y, yaw, np.zeros(len(poses)))


def read_recorded(file: Path) -> Recorded:
    """Read the stored run; times are relative to its start."""
    evo = np.load(file)
    table = evo["trajectory"]
    poses = [Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
    stamp_ns = np.rint((table[:, 0] - table[0, 0]) * 1e9).astype(np.int64)
    return Recorded({key: evo[key] for key in ("frame", *_KEYS)}, stamp_ns, poses)


def write_states(recorded: Recorded, folder: Path, every: int = 1) -> None:
    """Write one TreeManagerState file per frame; only each `every`-th file has stems."""
    stems, frames = recorded.stems, len(recorded.poses)
    order = np.argsort(stems["frame"], kind="stable")
    begin = np.searchsorted(stems["frame"][order], np.arange(frames + 1))
    for frame in range(frames):
        rows = order[begin[frame] : begin[frame + 1] if frame % every == 0 else begin[frame]]
        (folder / state_name(frame)).write_text(state_text(_rows({key: stems[key][rows] for key in _KEYS})))


def _rows(stems: dict[str, np.ndarray]) -> list[list[float | bool]]:
    """The other two directions of the axis are not stored."""
    n = len(stems["xyz"])
    axes = np.full((n, 3, 3), np.nan)
    axes[:, :, 2] = stems["axis_z"]
    numbers = np.stack([stems[key] for key in ("dbh", "dbh_approx", "score")], axis=1)
    table = np.hstack([axes.reshape(n, 9), stems["xyz"], numbers]).tolist()
    known = zip(stems["reconstructed"].tolist(), stems["n_clusters"].tolist(), strict=True)
    return [[*row, bool(r), int(c)] for row, (r, c) in zip(table, known, strict=True)]


def perturbed(
    poses: Sequence[Pose3], *, distance: float, turn: float, bias: float, rng: np.random.Generator
) -> list[Pose3]:
    """Return the poses with the errors of a worse odometry; roll, pitch and height are unchanged.

    Args:
        poses: True poses.
        distance: Standard deviation of the length of a step, as a fraction of it.
        turn, bias: Noise [rad/sqrt(m)] and drift [rad/m] of the heading.
        rng: Random numbers of the noise.
    """
    at = poses[0].planar()
    told = [poses[0]]
    for before, after in pairwise(poses):
        step = before.planar().inverse() @ after.planar()
        d = float(np.hypot(step.x, step.y))
        n = rng.standard_normal(2)
        grown = 1.0 + distance * float(n[0])
        yaw = step.yaw + turn * float(np.sqrt(d) * n[1]) + bias * d
        at = at @ Pose2(step.x * grown, step.y * grown, yaw)
        roll, pitch, _ = after.euler()
        told.append(Pose3.from_euler(np.array([at.x, at.y, after.t[2]]), roll, pitch, at.yaw))
    return told
