"""Whole clouds in PLY, NumPy and PCD files, read part by part."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.inventory.cloud import CloudDescription
from pipeline.io.readers.base import digest_of
from pipeline.io.readers.clouds.coordinate_offset import is_place, offset_for
from pipeline.io.readers.container import count_loss
from pipeline.io.readers.point_files import Columns, open_table
from pipeline.io.readers.point_files.table import MISSING
from pipeline.io.readers.scan_folder import ScanFileError
from pipeline.types.records import Float, Float32

_REMEDY = "Copy the file again, or export it again"


class TableCloud:
    """A file with a column for each coordinate (see `pipeline.inventory.cloud.Cloud`).

    Raises:
        SourceError: It is no such file, or damaged.
        OSError: It cannot be read.
    """

    def __init__(self, uri: str, path: Path) -> None:
        self.losses: dict[str, int] = {}
        try:
            self._table = open_table(path)
            middle = self._first_places().mean(axis=0)
        except ScanFileError as error:
            raise SourceError(str(error), where=uri, remedy=_REMEDY) from None
        if not np.isfinite(middle).all():
            raise SourceError("the coordinates of the cloud are no coordinates", where=uri, remedy=_REMEDY)
        self.description = CloudDescription(
            uri=uri,
            kind=self._table.kind,
            points=self._table.points,
            offset=offset_for(middle),
            crs="",
            digest=digest_of([path]),
            attributes=tuple(name for name in self._table.names if name not in ("x", "y", "z")),
        )

    def parts(self) -> Iterator[Float32]:
        """All points, part by part."""
        self.losses = {}
        read = 0
        try:
            for columns in self._table.parts():
                with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers may be of any size
                    xyz = _places(columns) - self.description.offset
                good = is_place(xyz)
                read += len(xyz)
                if not good.all():
                    count_loss(self.losses, "points without coordinates", int(np.count_nonzero(~good)))
                yield xyz[good].astype(np.float32)
        except ScanFileError as error:
            raise SourceError(str(error), where=self.description.uri, remedy=_REMEDY) from None
        if read < self._table.points:
            count_loss(self.losses, MISSING, self._table.points - read)

    def _first_places(self) -> Float:
        """The first places that are some, shape (N, 3) [m]; empty where there is none."""
        for columns in self._table.parts():
            xyz = _places({axis: columns[axis][:10_000] for axis in "xyz"})
            xyz = xyz[is_place(xyz)][:1000]
            if len(xyz):
                return xyz
        return np.full((1, 3), np.nan)


def _places(columns: Columns) -> Float:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
