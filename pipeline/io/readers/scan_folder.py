"""A folder with one file a scan as a source, whatever the format of the files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceDescription, SourceOptions, digest_of
from pipeline.io.readers.container import count_loss
from pipeline.io.readers.format_detection import named, recordings_in
from pipeline.io.readers.pose_files import TextError, pose_at, read_any_poses, read_times, seconds_ns
from pipeline.types.records import Int, Odometry, Record, Scan, Sensor, Truth

#: Scans of a folder without times are taken to follow each other at 10 Hz.
STEP_NS = 100_000_000
#: Names that poses beside scans usually have.
POSES = ("poses.txt", "poses.tum", "trajectory.txt", "trajectory.tum", "groundtruth.txt")
_TIME_NAME = re.compile(r"(?:[A-Za-z]+[_-])?([0-9]{10}[._][0-9]{1,9}|[0-9]{16}|[0-9]{19})", re.ASCII)
#: How many files may be unreadable at the start before the folder is refused.
_TRIES = 20


class ScanFileError(Exception):
    """A file that holds no scan; the text says why."""


#: Reads one file: (path, stamp_ns, losses) -> scan. Raises ScanFileError or OSError.
Loader = Callable[[Path, int, dict[str, int]], Scan]


@dataclass(frozen=True, slots=True)
class ScanFormat:
    """One format of scan files.

    Attributes:
        kind: In words.
        suffix: In lower case, with the dot.
        load: Reads one file.
        sensor: What the first scan tells about the LiDAR.
    """

    kind: str
    suffix: str
    load: Loader
    sensor: Callable[[Scan], Sensor]


class ScanFolder:
    """Scan files in the order of the numbers in their names.

    Poses (odometry; `poses.txt` and the other names of POSES, in KITTI's form or TUM's) and `times.txt` or
    `timestamps.txt` are taken from the folder or its parent. The number in a file's name is its row in
    them, or else its place in the folder when they have as many rows as there are files; if neither fits
    they are left aside with a warning. Without a file of times a name that is a time (1645000000.25.pcd)
    tells it, or else TUM's rows. TUM's rows belong to the scans by their times where both have some.

    Args:
        uri: As the user wrote it.
        path: One file, the folder with the files, or a folder with a folder `velodyne`.
        form: Their format.
        options: The mounting.

    Raises:
        SourceError: None of the first files holds a scan.
        OSError: The folder cannot be read.
    """

    def __init__(self, uri: str, path: Path, form: ScanFormat, options: SourceOptions) -> None:
        self._form = form
        self._warnings: list[str] = []
        self._texts: list[Path] = []
        self._losses: dict[str, int] = {}
        self._files = _scan_files(path, form.suffix)
        if not self._files:
            raise SourceError(f"the folder has no {form.suffix} files", where=uri)
        numbers = np.array([_number(file) for file in self._files], dtype=np.int64)
        by_time = all(_TIME_NAME.fullmatch(file.stem) for file in self._files)
        if by_time or len(np.unique(numbers)) < len(numbers) or (numbers < 0).any():
            numbers = np.arange(len(numbers), dtype=np.int64)
        folder = self._files[0].parent
        others = [name for name in recordings_in(folder) if Path(name).suffix.lower() != form.suffix]
        if others and not path.is_file():
            self._warnings.append(f"not part of this run are {named(others)}: open each by its name")
        places = [] if path.is_file() else [folder, folder.parent]
        self._timed = False
        self._stamp = self._read_stamps(places, numbers)
        self._T_base_lidar = options.T_base_lidar or Pose3.identity()
        self._poses = self._read_poses(places, numbers)
        first = self._first_scan(uri)
        self._description = SourceDescription(
            uri=uri,
            kind=form.kind,
            sensor=form.sensor(first),
            T_base_lidar=self._T_base_lidar,
            has_odometry=self._poses is not None,
            has_imu=False,
            scans=len(self._files),
            start_ns=int(self._stamp[0]),
            end_ns=int(self._stamp[-1]),
            digest=digest_of([*self._files, *self._texts]),
            warnings=tuple(self._warnings),
        )

    @property
    def description(self) -> SourceDescription:
        """What is known before reading."""
        return self._description

    @property
    def losses(self) -> dict[str, int]:
        """What was left out in the latest reading, by reason."""
        return dict(self._losses)

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield odometry and scans from `start_ns` on; earlier files are not opened."""
        self._losses = losses = dict[str, int]()
        begin = 0 if start_ns is None else int(np.searchsorted(self._stamp, start_ns))
        for index in range(begin, len(self._files)):
            stamp_ns = int(self._stamp[index])
            pose = None if self._poses is None else self._poses[index]
            if pose is not None:
                yield Odometry(stamp_ns, pose @ self._T_base_lidar.inverse())
            try:
                scan = self._form.load(self._files[index], stamp_ns, losses)
            except (ScanFileError, OSError):
                count_loss(losses, "scan files that cannot be read")
                continue
            if len(scan.points):
                yield scan
            else:
                count_loss(losses, "scans without points")

    def truth(self) -> Truth | None:
        """A folder of scans has none."""
        return None

    def close(self) -> None:
        """Nothing is held open."""

    def _first_scan(self, uri: str) -> Scan:
        reason = ""
        for file in self._files[:_TRIES]:
            try:
                scan = self._form.load(file, 0, {})
            except (ScanFileError, OSError) as error:
                reason = reason or f"{file.name} cannot be read: {error}"
                continue
            if len(scan.points):
                return scan
            reason = reason or f"{file.name} holds no points"
        raise SourceError(reason, where=uri, remedy=f"Files must be {self._form.kind} scans.")

    def _read_stamps(self, places: list[Path], numbers: Int) -> Int:
        for place in places:
            for name in ("times.txt", "timestamps.txt"):
                try:
                    times = read_times(place / name)
                except FileNotFoundError:
                    continue
                except (TextError, OSError) as error:
                    self._warnings.append(f"{name} is not used: {error}")
                    continue
                rows = self._rows(name, len(times), numbers)
                if rows is not None:
                    self._texts.append(place / name)
                    self._timed = True
                    return times[rows]
        named = _times_in_names(self._files)
        self._timed = named is not None
        return numbers * STEP_NS if named is None else named

    def _read_poses(self, places: list[Path], numbers: Int) -> list[Pose3 | None] | None:
        for path in [place / name for place in places for name in POSES]:
            try:
                times, poses = read_any_poses(path)
            except FileNotFoundError:
                continue
            except (TextError, OSError) as error:
                self._warnings.append(f"{path.name} is not used: {error}")
                continue
            found = self._fitting(path.name, times, poses, numbers)
            if found is not None:
                self._texts.append(path)
                return found
        return None

    def _fitting(
        self, name: str, times: Int | None, poses: list[Pose3], numbers: Int
    ) -> list[Pose3 | None] | None:
        """The pose of each scan, None where a file's rows do not belong to the scans."""
        if times is not None and self._timed:
            found = [pose_at(times, poses, int(stamp_ns)) for stamp_ns in self._stamp]
            if any(pose is not None for pose in found):
                return found
            self._warnings.append(f"{name} is not used: its times are not those of the scans")
            return None
        rows = self._rows(name, len(poses), numbers)
        if rows is None:
            return None
        if times is not None:
            self._stamp = times[rows]
        return [poses[row] for row in rows.tolist()]

    def _rows(self, name: str, count: int, numbers: Int) -> Int | None:
        """The row of each file in a text file with `count` rows, None when they do not fit."""
        if count > int(numbers[-1]):
            return numbers
        if count == len(numbers):
            return np.arange(count, dtype=np.int64)
        self._warnings.append(
            f"{name} is not used: it has {count} rows, the scans are numbered up to {int(numbers[-1])}"
        )
        return None


def _scan_files(path: Path, suffix: str) -> list[Path]:
    if path.is_file():
        return [path]
    folder = path
    if not any(file.suffix.lower() == suffix for file in path.iterdir()) and (path / "velodyne").is_dir():
        folder = path / "velodyne"
    files = (file for file in folder.iterdir() if file.suffix.lower() == suffix and file.is_file())
    found = sorted(files, key=lambda file: (_number(file), file.name))
    if all(_TIME_NAME.fullmatch(file.stem) for file in found):  # their last digits alone say nothing
        found.sort(key=lambda file: (_name_ns(file.stem), file.name))
    return found


def _times_in_names(files: list[Path]) -> Int | None:
    """The times that files are named by [ns], None where they are named otherwise."""
    if not all(_TIME_NAME.fullmatch(file.stem) for file in files):
        return None
    stamps = [_name_ns(file.stem) for file in files]
    return np.array(stamps, dtype=np.int64) if np.all(np.diff(stamps) > 0) else None


def _name_ns(stem: str) -> int:
    """A name that is a time, in seconds with decimals, microseconds or nanoseconds since 1970 [ns]."""
    match = _TIME_NAME.fullmatch(stem)
    word = match.group(1) if match else "0"
    if "." in word or "_" in word:
        return seconds_ns(word.replace("_", "."))
    return int(word) * (1000 if len(word) == 16 else 1)


def _number(file: Path) -> int:
    """The number at the end of a file's name, -1 when there is none."""
    digits = ""
    for letter in reversed(file.stem):
        if not letter.isdecimal() or not letter.isascii():
            break
        digits = letter + digits
    return int(digits) if 0 < len(digits) <= 9 else int(digits[-9:]) if digits else -1
