"""The stems of Oxford Evo (Evo.npz) as the folder of files that they were published as."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.exchange import state_name, state_text
from pipeline.geometry import Pose2, Pose3
from pipeline.records import Float

_KEYS = ("xyz", "axis_z", "dbh", "dbh_approx", "score", "reconstructed", "n_clusters")


def write_states(evo: dict[str, np.ndarray], folder: Path, every: int = 1) -> None:
    """Write one TreeManagerState file a frame; frames that are not `every`-th get no file."""
    order = np.argsort(evo["frame"], kind="stable")
    begin = np.searchsorted(evo["frame"][order], np.arange(len(evo["trajectory"]) + 1))
    for frame in range(0, len(evo["trajectory"]), every):
        rows = order[begin[frame] : begin[frame + 1]]
        (folder / state_name(frame)).write_text(state_text(_rows({k: evo[k][rows] for k in _KEYS})))


def _rows(stems: dict[str, np.ndarray]) -> list[list[float | bool]]:
    """The axis' other two directions were not kept."""
    n = len(stems["xyz"])
    axes = np.full((n, 3, 3), np.nan)
    axes[:, :, 2] = stems["axis_z"]
    numbers = np.stack([stems[key] for key in ("dbh", "dbh_approx", "score")], axis=1)
    table = np.hstack([axes.reshape(n, 9), stems["xyz"], numbers]).tolist()
    known = zip(stems["reconstructed"].tolist(), stems["n_clusters"].tolist(), strict=True)
    return [[*row, bool(r), int(c)] for row, (r, c) in zip(table, known, strict=True)]


def trajectory_poses(table: Float) -> list[Pose3]:
    """Poses of rows t x y z qx qy qz qw, shape (N, 8)."""
    return [Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]


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
