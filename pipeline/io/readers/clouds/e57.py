"""E57 files (ASTM E2807): the clouds of terrestrial scanners, station by station, by pye57 (an extra)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import SourceError
from pipeline.inventory.cloud import CloudDescription
from pipeline.io.readers.base import digest_of
from pipeline.io.readers.clouds.coordinate_offset import is_place, offset_for
from pipeline.io.readers.clouds.e57_pages import Pages
from pipeline.io.readers.container import count_loss
from pipeline.types.records import Float, Float32

MAGIC = b"ASTM-E57"
PART = 1 << 18  # points
MOST_POINTS = 2_000_000_000
MOST_STATIONS = 10_000
_REMEDY = "Copy the file again, or export it again"
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


class E57Cloud:
    """An .e57 file (see `pipeline.inventory.cloud.Cloud`): all stations in its common frame.

    Raises:
        SourceError: It is no such file, or damaged, or pye57 is not installed.
    """

    def __init__(self, uri: str, path: Path) -> None:
        self._uri, self._path = uri, path
        self.losses: dict[str, int] = {}
        file = self._open()
        try:
            stations = self._guarded(lambda: int(file.scan_count))
            if stations > MOST_STATIONS:
                raise SourceError(f"it promises {stations} stations", where=uri, remedy=_REMEDY)
            points = self._guarded(lambda: [int(file.get_header(k).point_count) for k in range(stations)])
            if not all(0 <= n <= MOST_POINTS for n in points) or sum(points) > MOST_POINTS:
                raise SourceError("it promises more points than there can be", where=uri, remedy=_REMEDY)
            first = next((part[good] for part, good in self._places(file) if good.any()), None)
        finally:
            file.close()
        if first is None:
            raise SourceError("the cloud has no points", where=uri, remedy=_REMEDY)
        self.description = CloudDescription(
            uri=uri,
            kind=f"E57, {stations} station{'s' * (stations != 1)}",
            points=sum(points),
            offset=offset_for(first[:1000].mean(axis=0)),
            crs="",
            digest=digest_of([path]),
        )

    def parts(self) -> Iterator[Float32]:
        """All points, part by part."""
        self.losses = {}
        read = 0
        file = self._open()
        try:
            for xyz, good in self._places(file):
                read += len(xyz)
                if not good.all():
                    count_loss(self.losses, "points without coordinates", int(np.count_nonzero(~good)))
                yield (xyz[good] - self.description.offset).astype(np.float32)
        except SourceError:
            if read == 0:
                raise
        finally:
            file.close()
        if read < self.description.points:
            count_loss(self.losses, "points after the damage in the file", self.description.points - read)

    def _places(self, file: Any) -> Iterator[tuple[Float, Any]]:  # noqa: ANN401 - pye57 has no types
        """Points of all stations in the file's frame, shape (N, 3) [m], and which of them are some."""
        for station in range(self._guarded(lambda: int(file.scan_count))):
            yield from self._station(file, station)

    def _station(self, file: Any, station: int) -> Iterator[tuple[Float, Any]]:  # noqa: ANN401
        header = self._guarded(lambda: file.get_header(station))
        there = set(self._guarded(lambda: list(header.point_fields)))
        axes = _CARTESIAN if there.issuperset(_CARTESIAN) else _SPHERICAL
        if not there.issuperset(axes):
            raise SourceError("its points have no coordinates", where=self._uri, remedy=_REMEDY)
        wanted = [*axes, *(name for name in _INVALID if name in there)]
        R, t = self._guarded(lambda: _pose(header))
        arrays, buffers = self._guarded(lambda: file.make_buffers(wanted, PART))
        if not self._pages.are_sound(station):
            raise self._damaged("a checksum does not fit")
        reader = self._guarded(lambda: header.points.reader(buffers))
        try:
            while count := self._guarded(reader.read):
                columns = {name: np.array(arrays[name][:count], dtype=np.float64) for name in wanted}
                with np.errstate(over="ignore", invalid="ignore"):
                    xyz = _cartesian(columns, axes) @ R.T + t
                good = is_place(xyz)
                for name in wanted[3:]:
                    good &= columns[name] == 0
                yield xyz, good
        finally:
            self._guarded(reader.close)

    def _open(self) -> Any:  # noqa: ANN401
        try:
            from pye57 import E57
        except ImportError:
            raise SourceError(
                "E57 files need pye57", where=self._uri, remedy="Install it with: uv sync --extra e57"
            ) from None
        self._pages = Pages(self._path)
        if self._pages.damage:
            raise self._damaged(self._pages.damage)
        return self._guarded(lambda: E57(str(self._path)))

    def _guarded(self, work: Any) -> Any:  # noqa: ANN401
        """Whatever libE57 throws is damage."""
        try:
            return work()
        except Exception as error:
            reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise self._damaged(reason) from None

    def _damaged(self, reason: str) -> SourceError:
        return SourceError(f"the E57 file is damaged: {reason}", where=self._uri, remedy=_REMEDY)


def _pose(header: Any) -> tuple[Float, Float]:  # noqa: ANN401
    """Where a station stands in the file's frame; in the origin where it does not say."""
    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    return np.asarray(header.rotation_matrix, np.float64), np.asarray(header.translation, np.float64)


def _cartesian(columns: dict[str, Float], axes: tuple[str, ...]) -> Float:
    first, second, third = (columns[name] for name in axes)
    if axes == _CARTESIAN:
        return np.stack([first, second, third], axis=1)
    flat = first * np.cos(third)
    return np.stack([flat * np.cos(second), flat * np.sin(second), first * np.sin(third)], axis=1)
