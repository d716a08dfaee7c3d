"""PTX files: text with the points of the stations of a scanner, each with its pose."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from pipeline.io.readers.point_files import MOST_POINTS, Columns, PointTable, ScanFileError
from pipeline.io.readers.pose_files import read_rows
from pipeline.types.records import Float

_AXES = ("x", "y", "z")
#: Numbers in the lines of the header of a station: columns and rows of the scan; position and axes of the
#: scanner; and the matrix by which points in the frame of the scanner, as row vectors, become those of the
#: file.
_WIDTHS = [1, 1, 3, 3, 3, 3, 4, 4, 4, 4]
_LINE_LIMIT = 1 << 16
_BLOCK = 8 << 20  # bytes
_ORTHOGONAL = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class _Station:
    """Offset of the first point [bytes], number of points, rotation, shape (3, 3), and translation,
    shape (3,) [m], from the frame of the station to that of the file."""

    start: int
    points: int
    R: Float
    t: Float


def is_ptx(head: bytes) -> bool:
    """Return whether a text begins with the header of a station."""
    return [len(line.split()) for line in head.splitlines() if line.strip()][: len(_WIDTHS)] == _WIDTHS


def open_ptx(path: Path) -> PointTable:
    """Return the table of the positions of all stations of a PTX file in one frame, NaN for beams without
    a return.

    Raises:
        ScanFileError: The file is damaged before its first point, or several stations have the same pose.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        stations = list(_stations(file))
    if len(stations) > 1 and all(
        (s.R == stations[0].R).all() and (s.t == stations[0].t).all() for s in stations
    ):
        raise ScanFileError(
            f"its {len(stations)} stations are not registered: all of them have the same pose",
            "Register them, or export each station to a file",
        )
    starts = np.cumsum([0, *(station.points for station in stations)]).tolist()
    points = starts.pop()
    if not 0 < points <= MOST_POINTS:
        raise ScanFileError(f"its header promises {points} points")

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the coordinates of the points from the station of the point `begin` on, float64 [m]."""
        with path.open("rb") as file:
            for station in stations[bisect_right(starts, begin) - 1 :]:
                file.seek(station.start)
                for xyz in read_rows(file, 3, station.points, more=True):
                    xyz[(xyz == 0.0).all(axis=1)] = np.nan
                    yield dict(zip(_AXES, (xyz @ station.R.T + station.t).T, strict=True))

    kind = f"PTX, {len(stations)} station{'s' * (len(stations) != 1)}"
    return PointTable(kind, points, _AXES, read, has_voids=True, starts=tuple(starts))


def _stations(file: IO[bytes]) -> Iterator[_Station]:
    """Yield the stations of a file; the last one may have fewer points than its header promises.

    Raises:
        ScanFileError: A header is damaged.
        OSError: The file cannot be read.
    """
    while lines := _next_lines(file):
        try:
            rows = [np.array(line.split(), np.float64) for line in lines]
            if [len(row) for row in rows] != _WIDTHS:
                raise ValueError("other lines")
            count, matrix = int(rows[0][0]) * int(rows[1][0]), np.stack(rows[6:])
        except (ValueError, OverflowError):
            raise ScanFileError("the header of a station of the PTX file is damaged") from None
        R, t = matrix[:3, :3].T, matrix[3, :3]
        if (
            count < 0
            or not np.isfinite(matrix).all()
            or not np.allclose(R @ R.T, np.eye(3), atol=_ORTHOGONAL)
        ):
            raise ScanFileError("the matrix of a station of the PTX file is no pose")
        yield _Station(file.tell(), count, R, t)
        _skip(file, count)


def _next_lines(file: IO[bytes]) -> list[bytes]:
    """Return the next lines of a header; [] at the end of the file."""
    lines = list[bytes]()
    while len(lines) < len(_WIDTHS) and (line := file.readline(_LINE_LIMIT)):
        if not line.isspace():
            lines.append(line)
    return lines


def _skip(file: IO[bytes], lines: int) -> None:
    """Move a file to the end of a number of its next lines, or to its own end."""
    while lines and (block := file.read(_BLOCK)):
        ends = block.count(b"\n")
        if ends < lines:
            lines -= ends
            continue
        at = np.flatnonzero(np.frombuffer(block, np.uint8) == ord("\n"))[lines - 1] + 1
        file.seek(int(at) - len(block), 1)
        return
