"""The stems of Oxford Evo (Evo.npz) as the folder of files that they were published as."""

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
    """The run: columns of its stems by name, and where the sensor was, one pose a frame."""

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
    """The run as it was kept; times count from its start."""
    evo = np.load(file)
    table = evo["trajectory"]
    poses = [Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
    stamp_ns = np.rint((table[:, 0] - table[0, 0]) * 1e9).astype(np.int64)
    return Recorded({key: evo[key] for key in ("frame", *_KEYS)}, stamp_ns, poses)


def write_states(recorded: Recorded, folder: Path, every: int = 1) -> None:
    """Write one TreeManagerState file a frame; only every so many-th has stems, the others are empty."""
    stems, frames = recorded.stems, len(recorded.poses)
    order = np.argsort(stems["frame"], kind="stable")
    begin = np.searchsorted(stems["frame"][order], np.arange(frames + 1))
    for frame in range(frames):
        rows = order[begin[frame] : begin[frame + 1] if frame % every == 0 else begin[frame]]
        (folder / state_name(frame)).write_text(state_text(_rows({key: stems[key][rows] for key in _KEYS})))


def _rows(stems: dict[str, np.ndarray]) -> list[list[float | bool]]:
    """The axis' other two directions were not kept."""
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
    """The poses as a worse odometry would tell them; roll, pitch and height stay.

    Args:
        poses: True ones.
        distance: Standard deviation of a step's length, as a part of it.
        turn: Of the heading [rad/sqrt(m)]; bias: its drift [rad/m].
        rng: Draws the noise.
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
