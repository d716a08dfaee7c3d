"""E57 clouds of terrestrial scanners (the extra `e57`)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.io.readers.point_files import (
    MOST_POINTS,
    PART,
    Columns,
    PointTable,
    ScanFileError,
    errors_as_damage,
)
from pipeline.types.records import Float

MOST_STATIONS = 10_000
AXES = ("x", "y", "z")
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_STATES = ("cartesianInvalidState", "sphericalInvalidState")


def open_e57(path: Path) -> PointTable:
    """Return the table of the positions of all stations of an E57 file (ASTM E2807) in one frame; invalid
    points are NaN.

    Raises:
        ScanFileError: pye57 is not installed, the file is damaged, or there are too many stations or points.
        OSError: The file cannot be read.
    """
    try:
        from pye57 import E57
    except ImportError:
        raise ScanFileError("E57 files need pye57", "Install it with: uv sync --extra e57") from None
    with errors_as_damage("the E57 file is damaged"), closing(E57(str(path))) as file:
        stations = int(file.scan_count)
        if stations > MOST_STATIONS:
            raise ScanFileError(f"it promises {stations} stations")
        points = [int(file.get_header(k).point_count) for k in range(stations)]
    if not all(0 <= n <= MOST_POINTS for n in points) or sum(points) > MOST_POINTS:
        raise ScanFileError("it promises more points than there can be")

    starts = np.cumsum([0, *points])[:-1].tolist()

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the coordinates of the points of all stations from the one of the point `begin` on, float64
        [m]."""
        with closing(E57(str(path))) as file:
            for station in range(bisect_right(starts, begin) - 1, stations):
                for xyz in _station(file, station):
                    yield dict(zip(AXES, xyz.T, strict=True))

    kind = f"E57, {stations} station{'s' * (stations != 1)}"
    return PointTable(kind, sum(points), AXES, read, has_voids=True, starts=tuple(starts), units=("m", "m"))


def _station(file: Any, station: int) -> Iterator[Float]:  # noqa: ANN401 - pye57 has no types
    """Yield the points of a station in the frame of the file in parts, shape (N, 3) [m]; NaN for invalid
    ones.

    Raises:
        ScanFileError: The points have no coordinates.
    """
    header = file.get_header(station)
    there = set(header.point_fields)
    axes = _CARTESIAN if there.issuperset(_CARTESIAN) else _SPHERICAL
    if not there.issuperset(axes):
        raise ScanFileError("its points have no coordinates")
    wanted = [*axes, *(name for name in _STATES if name in there)]
    R, t = _pose(header)
    arrays, buffers = file.make_buffers(wanted, PART)
    with closing(header.points.reader(buffers)) as reader:
        while count := reader.read():
            columns = {name: np.array(arrays[name][:count], dtype=np.float64) for name in wanted}
            with np.errstate(over="ignore", invalid="ignore"):
                xyz = _cartesian(columns, axes) @ R.T + t
            for name in wanted[3:]:
                xyz[columns[name] != 0] = np.nan
            yield xyz


def _pose(header: Any) -> tuple[Float, Float]:  # noqa: ANN401
    """Return rotation, shape (3, 3), and translation, shape (3,) [m], of a station in the frame of the file;
    those of the identity if the header has no pose."""
    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    return np.asarray(header.rotation_matrix, np.float64), np.asarray(header.translation, np.float64)


def _cartesian(columns: dict[str, Float], axes: tuple[str, ...]) -> Float:
    """Return positions, shape (N, 3) [m], from the three columns of `columns` with the names `axes`:
    Cartesian, or range [m], azimuth and elevation [rad]."""
    first, second, third = (columns[name] for name in axes)
    if axes == _CARTESIAN:
        return np.stack([first, second, third], axis=1)
    flat = first * np.cos(third)
    return np.stack([flat * np.cos(second), flat * np.sin(second), first * np.sin(third)], axis=1)
