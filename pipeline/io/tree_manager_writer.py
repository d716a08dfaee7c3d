"""The folder in which tools for relocalisation among stems exchange what they found.

`TreeManagerState_<i>.csv` has the stems of frame i in the frame of its sensor: a rotation whose third column
points along the stem, a place and a diameter in metres. Row i of `trajectory.txt`, counted from 0, is the
sensor's pose: time [s], x y z [m], quaternion qx qy qz qw. An empty field is not known.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path as FilePath

import numpy as np

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float, Pose2, Pose3
from pipeline.io.atomic_files import UNFINISHED
from pipeline.types.records import Int, Path, Trees

TRAJECTORY = "trajectory.txt"
AXIS = tuple(f"axis_{row}{column}" for row in range(3) for column in range(3))
PLACE = ("location_x", "location_y", "location_z")
DBH = "dbh"
COLUMNS = (*AXIS, *PLACE, DBH, "dbh_approximation", "score", "reconstructed", "number_clusters")


def state_name(frame: int) -> str:
    """The name of a frame's file."""
    return f"TreeManagerState_{frame}.csv"


def state_text(rows: Iterable[Sequence[float | bool]]) -> str:
    """A frame's file.

    Args:
        rows: One a stem, in the order of COLUMNS; NaN is written as an empty field.
    """
    lines = [",".join(_field(value) for value in row) for row in rows]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"


def trajectory_text(stamp_ns: Int, poses: Iterable[Pose3]) -> str:
    """The file of poses; times in nanoseconds, shape (N,)."""
    lines = []
    for stamp, pose in zip(stamp_ns.tolist(), poses, strict=True):
        w, x, y, z = pose.quaternion().tolist()
        lines.append(" ".join([f"{stamp * 1e-9:.9f}", *(f"{v:.9f}" for v in (*pose.t.tolist(), x, y, z, w))]))
    return "\n".join(lines) + "\n"


def write_tree_manager(folder: FilePath, path: Path, trees: Trees, reach: float) -> int:
    """Write a mapped run, whole or not at all.

    A frame has the trees that were seen by then and stand within `reach` of its pose, where the finished
    map has them. The map is a plane: poses have no tilt, and stems stand upright at height 0.

    Args:
        folder: Made; what it holds must not be overwritten, so it must be new or empty.
        path: Poses and times, N of them.
        trees: The map; only confirmed trees are written.
        reach: Trees farther from a pose are not in its frame [m].

    Returns:
        How many confirmed trees are in no frame.

    Raises:
        StemmapError: The folder is not empty, or cannot be written.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise StemmapError("it is not empty", where=str(folder), remedy="Name a new folder")
        folder.parent.mkdir(parents=True, exist_ok=True)
        staging = FilePath(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder.parent))
        try:
            left_out = _write(staging, path, trees, reach)
            staging.chmod(0o755)  # as any other new folder; a temporary one is its owner's alone
            if folder.exists():
                folder.rmdir()
            staging.rename(folder)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise
    except OSError as error:
        raise StemmapError(f"cannot write: {error.strerror}", where=str(folder)) from error
    return left_out


def _write(folder: FilePath, path: Path, trees: Trees, reach: float) -> int:
    poses = [Pose2(x, y, yaw) for x, y, yaw in zip(path.x, path.y, path.yaw, strict=True)]
    known = np.flatnonzero(trees.confirmed)
    position, first_ns = trees.position[known], trees.first_seen_ns[known]
    written = np.zeros(len(known), np.bool_)
    for frame, (pose, stamp_ns) in enumerate(zip(poses, path.stamp_ns.tolist(), strict=True)):
        place = pose.inverse().apply(position)
        here = (np.hypot(place[:, 0], place[:, 1]) <= reach) & (first_ns <= stamp_ns)
        written |= here
        rows = [_row(trees, known[k], place[k]) for k in np.flatnonzero(here)]
        (folder / state_name(frame)).write_text(state_text(rows), encoding="utf-8", newline="")
    full = [Pose3.from_euler(np.array([p.x, p.y, 0.0]), 0.0, 0.0, p.yaw) for p in poses]
    text = trajectory_text(path.stamp_ns, full)
    (folder / TRAJECTORY).write_text(text, encoding="utf-8", newline="")
    return int(np.count_nonzero(~written))


def _row(trees: Trees, k: int, place: Float) -> list[float | bool]:
    dbh = float(trees.dbh[k])
    upright = np.eye(3).ravel().tolist()
    fitted = math.isfinite(dbh)
    return [
        *upright,
        float(place[0]),
        float(place[1]),
        0.0,
        dbh,
        dbh,
        1.0,
        fitted,
        int(trees.observations[k]),
    ]


def _field(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(value)
    return f"{value:.9g}" if math.isfinite(value) else ""
