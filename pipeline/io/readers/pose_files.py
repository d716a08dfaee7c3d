"""Text files with poses and times."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable, Iterator
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import COORDINATE_LIMIT
from pipeline.types.records import Float, Int

TEXT_LIMIT = 64 << 20
#: Rotation from the axes of a camera (x right, y down, z forward) to those of a LiDAR.
R_LIDAR_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_STILL = 0.05
#: Tolerance of the length of a quaternion: numbers with two decimals are off by up to 0.01.
_UNIT_LENGTH = 0.01
#: A number of a frame, as KITTI-360 writes it before a matrix; seconds since 1970 have more digits.
_FRAME = re.compile(r"[0-9]{1,9}", re.ASCII)
TUM_COLUMNS, KITTI_COLUMNS = 8, 12
POSE_ROWS = "t x y z qx qy qz qw (TUM) or the 12 numbers of a 3 x 4 matrix (KITTI), also after a time"


class TextError(Exception):
    """A text file does not have the expected contents; the message gives the reason."""


class PoseRows(NamedTuple):
    """Rows of a file of poses.

    Attributes:
        times: Times of the rows [ns], int64, shape (N,); None without times.
        frames: Numbers of the scans to which the rows belong, int64, shape (N,); None without numbers.
        poses: Poses of the LiDAR (x forward), N.
    """

    times: Int | None
    frames: Int | None
    poses: list[Pose3]


def read_any_poses(path: Path) -> tuple[Int | None, list[Pose3]]:
    """Return times and poses of a file, see `read_pose_rows`; TextError also if its rows have numbers of
    frames, which belong to the names of scan files."""
    times, frames, poses = read_pose_rows(path)
    if frames is not None:
        raise TextError(
            "its rows begin with numbers of frames in place of times; as poses.txt in the folder of the scan "
            "files it is read"
        )
    return times, poses


def read_pose_rows(path: Path) -> PoseRows:
    """Return the poses of the LiDAR (x forward) in a file: TUM rows t x y z qx qy qz qw or rows of a time and
    a 3 x 4 matrix with times, KITTI rows of a matrix, or KITTI-360 rows of a number of a frame and a matrix.

    Blanks, commas or semicolons separate the numbers. The names in a first line, such as
    `#sec,nsec,x,y,z,qx,qy,qz,qw`, tell the columns of a time and a TUM pose; names that do not tell them are
    refused. Without names, the number of columns tells them. KITTI writes the poses of its left camera (x
    right, y down, z forward); others write those of the LiDAR. If a file `calib.txt` with a valid row `Tr:`
    is in the same folder, they are KITTI poses. Otherwise the motion decides: a robot moves along z of a
    camera or along x of a LiDAR. KITTI-360 writes the poses of its IMU (x forward, y right, z down) in a
    world with z up; its calibration is read from the folder `calibration` beside that of the drives.

    Raises:
        TextError: The file has neither format, names that do not tell the columns, times that do not strictly
            ascend or cannot be read, a quaternion whose length is not 1 within _UNIT_LENGTH, or positions of
            COORDINATE_LIMIT or more.
        OSError: The file cannot be read.
    """
    names, lines = _named_lines(path)
    if not lines:
        raise TextError("it has no rows")
    columns = len(lines[0])
    found = _named_columns(names) if names else _COLUMNS.get(columns)
    if found is None:
        raise TextError(f"its rows have {columns} column{'s' * (columns != 1)}; readable are {POSE_ROWS}")
    if names:
        columns = len(names)
    if any(len(line) != columns for line in lines):
        raise TextError(f"its rows do not have {columns} numbers")
    time, pose = found
    rows = _table([[line[k] for k in pose] for line in lines], len(pose))
    times = _times([[line[k] for k in time] for line in lines]) if time else None
    if times is not None and np.any(np.diff(times) <= 0):
        raise TextError("its times do not ascend")
    if len(pose) == KITTI_COLUMNS:
        matrices = rows.reshape(-1, 3, 4)
        if times is not None and all(_FRAME.fullmatch(line[time[0]]) for line in lines):
            frames = times // 1_000_000_000
            is_imu = bool(np.median(matrices[:, 2, 2]) < 0.0)  # a LiDAR has z up
            T_imu_lidar = _calibration_of_imu(path) if is_imu else Pose3.identity()
            poses = _poses_of_matrices(matrices, Pose3.identity())
            return PoseRows(None, frames, [pose @ T_imu_lidar for pose in poses])
        T_camera_lidar = None if time else _calibration(path.with_name("calib.txt"))
        return PoseRows(times, None, _poses_of_matrices(matrices, T_camera_lidar))
    _check_positions(rows[:, :3])
    if np.any(np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0) > _UNIT_LENGTH):
        raise TextError("it has quaternions whose length is not 1")
    poses = [Pose3.from_quaternion(row[:3], row[[6, 3, 4, 5]]) for row in rows]
    return PoseRows(times, None, poses)


def _poses_of_matrices(rows: Float, T_camera_lidar: Pose3 | None) -> list[Pose3]:
    """Return poses of the LiDAR from matrices, shape (N, 3, 4), see `read_pose_rows`.

    Args:
        rows: The matrices.
        T_camera_lidar: Pose of the LiDAR in the frame whose poses they are; None if it is unknown.

    Raises:
        TextError: They are not rotations, or positions are COORDINATE_LIMIT or more.
    """
    _check_positions(rows[:, :, 3])
    R, t = rows[:, :, :3], rows[:, :, 3]
    if not _are_rotations(R):
        raise TextError("its matrices are no rotations")
    if T_camera_lidar is None and _moves_along_z(R, t):
        T_camera_lidar = Pose3(R_LIDAR_CAMERA.T, np.zeros(3))
    poses = [Pose3(_nearest_rotation(rotation), shift) for rotation, shift in zip(R, t, strict=True)]
    if T_camera_lidar is None:
        return poses
    T_lidar_camera = T_camera_lidar.inverse()
    return [T_lidar_camera @ pose @ T_camera_lidar for pose in poses]


#: Columns of the time and of the pose (x y z qx qy qz qw or a matrix) by the number of columns; two columns
#: of a time are its seconds and nanoseconds.
_COLUMNS: dict[int, tuple[list[int], list[int]]] = {
    KITTI_COLUMNS: ([], list(range(12))),
    TUM_COLUMNS: ([0], list(range(1, 8))),
    TUM_COLUMNS + 1: ([0, 1], list(range(2, 9))),
    KITTI_COLUMNS + 1: ([0], list(range(1, 13))),
}
#: Names of the columns x y z qx qy qz qw, in lower case without a unit in brackets.
_AXES = tuple(re.compile(rf"(?:[pt]|p.*_|pos.*[._])?{axis}(?:_?m)?") for axis in "xyz") + tuple(
    re.compile(rf"(?:q|q.*_|.*rot.*[._]|.*orient.*[._]){axis}") for axis in "xyzw"
)
_TIME = re.compile(r"(?:.*[._])?(?:t|[a-z]*time|[a-z]*stamp)s?(?:_(?:s|ns|us|ms))?")
_SECONDS, _NANOSECONDS = (
    re.compile(rf"(?:.*[._])?(?:{unit})") for unit in ("secs?|seconds", "n_?secs?|nanosec.*|ns")
)
_UNIT = re.compile(r"\[.*?\]|\(.*?\)|[%#\s\"']")


def _named_columns(names: list[str]) -> tuple[list[int], list[int]]:
    """Return the columns of time and pose, as in _COLUMNS, by their names; TextError if these do not tell
    exactly one column of each. Seven columns have no time."""
    pose = [[k for k, name in enumerate(names) if axis.fullmatch(name)] for axis in _AXES]
    parts = [[k for k, name in enumerate(names) if part.fullmatch(name)] for part in (_SECONDS, _NANOSECONDS)]
    times = [k for k, name in enumerate(names) if _TIME.fullmatch(name)]
    if len(names) == TUM_COLUMNS - 1:
        parts = []
    elif [len(part) for part in parts] != [1, 1]:
        parts = [sorted({*times, *parts[0], *parts[1]})]
    if any(len(found) != 1 for found in [*pose, *parts]):
        raise TextError(f"the names of its columns do not tell time and pose: {' '.join(names)[:100]}")
    return [found[0] for found in parts], [found[0] for found in pose]


def _named_lines(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of the columns in the first line, in lower case without units and signs of a comment,
    and the words of the rows; errors as `_lines`. The names are [] if the line has numbers, too few
    words for a pose, or is a comment with another number of words than a row."""
    text = _text(path)
    first, _, rest = text.partition("\n")
    line = first.strip().rstrip(",; ")
    split = re.split(r"[,;]", line) if re.search(r"[,;]", line) else line.lstrip("%# ").split()
    names = [_UNIT.sub("", word).lower() for word in split]
    if not any(re.search(r"[a-df-z]", name) and not name.startswith(("nan", "inf")) for name in names):
        return [], _words(text)
    rows = _words(rest)
    is_comment = first.startswith(("#", "%")) and rows and len(names) != len(rows[0])
    is_header = rows and not is_comment and len(names) >= TUM_COLUMNS - 1
    return (names, rows) if is_header else ([], _words(text))


def _times(stamps: Iterable[list[str]]) -> Int:
    """Return times as nanoseconds, int64, shape (N,): a float has too few digits for them.

    Args:
        stamps: Words of each time: one (see `time_ns`), or whole seconds and nanoseconds.

    Raises:
        TextError: A word is not a number, or too large.
    """
    try:
        found = [
            time_ns(words[0]) if len(words) == 1 else int(words[0]) * 1_000_000_000 + int(words[1])
            for words in stamps
        ]
        return np.array([_in_bounds(time) for time in found], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise TextError("its times are no seconds") from error


#: Factors by which a time since 1970 without decimals becomes nanoseconds, by its digits.
_DIGITS = {13: 1_000_000, 16: 1000, 19: 1}


def time_ns(text: str) -> int:
    """Return a time as integer nanoseconds: decimal seconds (see `seconds_ns`, also for errors), or milli-,
    micro- or nanoseconds since 1970, whose decimals are zeros."""
    whole = re.sub(r"\.0*$", "", text)
    factor = _DIGITS.get(len(whole)) if whole.isascii() and whole.isdigit() else None
    return seconds_ns(text) if factor is None else _in_bounds(int(whole) * factor)


def seconds_ns(text: str) -> int:
    """Return decimal seconds as integer nanoseconds: exactly for plain digits (further decimals are cut off),
    otherwise rounded to a float.

    Raises:
        ValueError: The text is not a number, or the number is too large.
        OverflowError: The number is infinite.
    """
    whole, dot, fraction = text.partition(".")
    plain = whole.isascii() and whole.isdigit() and (not dot or (fraction.isascii() and fraction.isdigit()))
    nanoseconds = (
        int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0") or "0")
        if plain and len(whole) < 12
        else round(float(text) * 1e9)
    )
    return _in_bounds(nanoseconds)


def _in_bounds(time_ns: int) -> int:
    """Return a time [ns]; ValueError if its magnitude is not less than 2^62."""
    if abs(time_ns) >= 1 << 62:
        raise ValueError("too far away in time")
    return time_ns


def read_times(path: Path) -> Int:
    """Return the times of a file [ns], int64, shape (N,), one per row, in seconds or as dates with times of
    day (UTC). Empty lines and lines that begin with # are skipped.

    Raises:
        TextError: The file has another format, no rows, or times that decrease; equal times are accepted.
        OSError: The file cannot be read.
    """
    lines = [" ".join(words) for words in _lines(path)]
    try:
        times = _times([[line] for line in lines])
    except TextError:
        times = np.array([_date(line) for line in lines], dtype=np.int64)
    if not len(times):
        raise TextError("it has no times")
    if np.any(np.diff(times) < 0):
        raise TextError("its times go back")
    return times


def _check_positions(positions: Float) -> None:
    """Check positions [m].

    Raises:
        TextError: A coordinate is NaN, or its magnitude is not less than COORDINATE_LIMIT.
    """
    if not (np.abs(positions) < COORDINATE_LIMIT).all():
        raise TextError(f"it has positions beyond {COORDINATE_LIMIT:.0e} m")


def _text(path: Path) -> str:
    """Return the text of a file, without a byte order mark.

    Raises:
        TextError: The file is larger than TEXT_LIMIT, or is not UTF-8.
        OSError: The file cannot be read.
    """
    if path.stat().st_size > TEXT_LIMIT:
        raise TextError(f"it is longer than {TEXT_LIMIT >> 20} MB")
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TextError("it is no text") from error


def _lines(path: Path) -> list[list[str]]:
    """Return the words of each line that is not empty and does not begin with #.

    Raises:
        TextError: The file is larger than TEXT_LIMIT, or is not UTF-8.
        OSError: The file cannot be read.
    """
    return _words(_text(path))


def _words(text: str) -> list[list[str]]:
    """Return the words of each line that is not empty and does not begin with # or %, separated by blanks,
    commas or semicolons."""
    lines = (line for line in text.split("\n") if line.strip() and not line.startswith(("#", "%")))
    return [re.sub(r"[,;]", " ", line).split() for line in lines]


def _table(lines: list[list[str]], columns: int) -> Float:
    """Return the words of lines as finite numbers with magnitudes below 1e10, shape (rows, columns).

    Raises:
        TextError: There are no rows, a row has another length, or a word is not such a number.
    """
    if not lines or any(len(line) != columns for line in lines):
        raise TextError(f"its rows do not have {columns} numbers")
    try:
        numbers = np.array(lines, dtype=np.float64)
    except ValueError as error:
        raise TextError("it has words where numbers should be") from error
    if not np.all(np.abs(numbers) < 1e10):
        raise TextError("it has numbers that are not finite or too large")
    return numbers


def _date(line: str) -> int:
    """Return a time like 2011-09-26 13:02:25.964389445 as nanoseconds since 1970 (UTC); further digits are
    ignored.

    Raises:
        TextError: The line is not such a time.
    """
    whole, _, fraction = line.partition(".")
    try:
        moment = datetime.fromisoformat(whole + "+00:00")
        return int(moment.timestamp()) * 1_000_000_000 + int((fraction or "0").ljust(9, "0")[:9])
    except ValueError as error:
        raise TextError("its rows are no times") from error


def _calibration(path: Path) -> Pose3 | None:
    """Return `T_camera_lidar` of the calib.txt of KITTI; None if there is none or it cannot be used."""
    try:
        rows = [line.split() for line in _text(path).split("\n") if line.startswith("Tr:")]
        return _pose_of_numbers(rows[0][1:])
    except (OSError, TextError, ValueError, IndexError):
        return None


def _calibration_of_imu(path: Path) -> Pose3:
    """Return `T_imu_lidar` of the calibration of KITTI-360 for `data_poses/<drive>/<path>`; that of an IMU at
    the place of the LiDAR if it cannot be read."""
    folder = path.absolute().parents[:3][-1] / "calibration"
    try:
        words = _text(folder / "calib_cam_to_pose.txt").partition("image_00:")[2].split()[:12]
        T_imu_camera = _pose_of_numbers(words)
        T_lidar_camera = _pose_of_numbers(_text(folder / "calib_cam_to_velo.txt").split())
        return T_imu_camera @ T_lidar_camera.inverse()
    except (OSError, TextError, ValueError):
        return Pose3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


def _pose_of_numbers(words: list[str]) -> Pose3:
    """Return the pose of the 12 numbers of a 3 x 4 matrix; ValueError if they are none."""
    matrix = np.array([float(word) for word in words]).reshape(3, 4)
    if not (np.isfinite(matrix).all() and _are_rotations(matrix[:, :3])):
        raise ValueError("no pose")
    return Pose3(_nearest_rotation(matrix[:, :3]), matrix[:, 3])


def _moves_along_z(R: Float, t: Float) -> bool:
    """Return whether the steps between poses, in the frame of the pose before, sum up to more along z than
    along x, and to more than _STILL; False for a single pose.

    Args:
        R, t: Rotations, shape (N, 3, 3), and positions, shape (N, 3) [m].
    """
    steps = np.einsum("nji,nj->ni", R[:-1], np.diff(t, axis=0))
    x, _, z = np.abs(steps).sum(axis=0)
    return bool(z > x and z > _STILL)


def _are_rotations(R: Float) -> bool:
    """Return whether finite matrices, shape (..., 3, 3), are rotations up to rounding: orthogonal to 0.01,
    and no reflections."""
    orthogonal = np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=1e-2)
    return orthogonal and bool(np.all(np.linalg.det(R) > 0.0))


def _nearest_rotation(matrix: Float) -> Float:
    """Return the rotation matrix nearest to a matrix, shape (3, 3) (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(matrix)
    R: Float = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R


#: A time farther from all rows has no pose [ns].
_FAR_NS = 1_000_000_000


def pose_at(times: Int, poses: list[Pose3], stamp_ns: int) -> Pose3 | None:
    """Return the pose interpolated at a time. Outside of the times it is the nearest pose; None if the time
    is more than _FAR_NS from both neighbouring rows. One near row is enough, however long the gap is.

    Args:
        times: Times of the poses, ascending, shape (N,), N >= 1 [ns].
        poses: The N poses.
        stamp_ns: The time [ns].
    """
    after = int(np.searchsorted(times, stamp_ns))
    before = max(after - 1, 0)
    after = min(after, len(poses) - 1)
    if min(abs(int(times[before]) - stamp_ns), abs(int(times[after]) - stamp_ns)) > _FAR_NS:
        return None
    span = int(times[after]) - int(times[before])
    if span <= 0 or not int(times[before]) <= stamp_ns <= int(times[after]):
        near = before if abs(int(times[before]) - stamp_ns) <= abs(int(times[after]) - stamp_ns) else after
        return poses[near]
    return between(poses[before], poses[after], (stamp_ns - int(times[before])) / span)


def between(first: Pose3, second: Pose3, fraction: float) -> Pose3:
    """Return the pose between two poses: the position on a line, the attitude by slerp along the smaller
    rotation.

    Args:
        first, second: The poses, finite.
        fraction: Position between them, from 0 (first) to 1 (second).
    """
    q, p = first.quaternion(), second.quaternion()
    dot = float(q @ p)
    if dot < 0.0:
        p, dot = -p, -dot
    if dot > 0.9995:
        mixed = (1.0 - fraction) * q + fraction * p
    else:
        angle = np.arccos(min(dot, 1.0))
        mixed = (np.sin((1.0 - fraction) * angle) * q + np.sin(fraction * angle) * p) / np.sin(angle)
    return Pose3.from_quaternion((1.0 - fraction) * first.t + fraction * second.t, mixed)


_LINES = 1 << 18  # read at once
_LINE_LIMIT = 1 << 16  # bytes; a longer line is cut, and its parts are damaged lines


def parse_table(text: bytes, columns: int, *, more: bool = False) -> tuple[Float, int]:
    """Parse lines of numbers separated by blanks; a text without lines gives shape (0, columns).

    Empty lines are skipped. A line with another number of words, or with a word that is not a number, is
    damaged and left out; "nan" is a number.

    Args:
        text: Text in ASCII.
        columns: Numbers per line.
        more: Whether a line may have further numbers, which are left out.

    Returns:
        The numbers, float64, shape (rows, columns), and the number of damaged lines.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            wanted = range(columns) if more else None
            table = np.loadtxt(io.BytesIO(text), comments=None, ndmin=2, encoding="latin1", usecols=wanted)
        if table.shape[1] == columns and table.size:
            return table, 0
    except ValueError:
        pass  # at least one line is damaged: find out which
    lines = [words for line in text.split(b"\n") if (words := line.split())]
    if more:
        lines = [words[:columns] for words in lines]
    rows = [row for words in lines if len(words) == columns and (row := _numbers(words)) is not None]
    return np.array(rows, np.float64).reshape(-1, columns), len(lines) - len(rows)


def read_rows(file: IO[bytes], columns: int, lines: int, *, more: bool = False) -> Iterator[Float]:
    """Yield the numbers of the next lines of a file part by part, each of shape (N, columns), N >= 1.

    Empty lines are skipped, and damaged lines are left out; see `parse_table`. A line of more than
    _LINE_LIMIT bytes counts as several lines.

    Args:
        file: Open at the beginning of the first line.
        columns: Numbers per line.
        lines: Maximum number of lines that are not empty, including damaged ones.
        more: Whether a line may have further numbers, which are left out.
    """
    left = lines
    while left > 0:
        found = (line for line in iter(lambda: file.readline(_LINE_LIMIT), b"") if not line.isspace())
        block = list(islice(found, min(left, _LINES)))
        if not block:
            return
        left -= len(block)
        rows, _ = parse_table(b"".join(block), columns, more=more)
        if len(rows):
            yield rows


def _numbers(words: list[bytes]) -> list[float] | None:
    """Return words as numbers; None if one is not a number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None
