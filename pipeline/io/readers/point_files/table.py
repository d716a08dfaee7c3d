"""What a file of points is to those who read it: columns that come part by part."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.container import count_loss
from pipeline.io.readers.scan_columns import POINT_LIMIT
from pipeline.io.readers.scan_folder import ScanFileError

Columns = dict[str, NDArray[np.generic]]

PART = 1 << 18  # points
MOST_POINTS = 2_000_000_000
STEP_LIMIT = 64 << 10  # bytes of a point
#: Of what has to be held whole in memory: what a kind of file that cannot be read in parts unpacks to.
WHOLE_LIMIT = 1 << 30  # bytes
MISSING = "points that the files promise but do not hold"


class PointTable(Protocol):
    """A file whose header was read and found sound."""

    @property
    def kind(self) -> str:
        """The format in words, e.g. "PLY binary"."""

    @property
    def points(self) -> int:
        """Number of points that the header promises."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns with one number a point, in lower case; x, y and z are among them."""

    def parts(self) -> Iterator[Columns]:
        """All points from the first on, all columns of a part equally long; numbers as they stand there,
        which need not be finite. A file that ends early or is damaged gives what stands before that.

        Raises:
            ScanFileError: Nothing can be read.
            OSError: The disk refused.
        """


def read_columns(path: Path, losses: dict[str, int], *, limit: int = POINT_LIMIT) -> Columns:
    """Read one file as a whole, e.g. a scan; columns of shape (N,).

    Args:
        path: A PLY, NumPy or PCD file.
        losses: Gets what the header promises and the file does not hold.
        limit: A file that promises more points is refused before they are read.

    Raises:
        ScanFileError: It cannot be understood, or is too large.
        OSError: It cannot be read.
    """
    from pipeline.io.readers.point_files import open_table

    table = open_table(path)
    if table.points > limit:
        raise ScanFileError(f"its header promises {table.points} points, too many for one scan")
    parts = list(table.parts())
    columns = {
        name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0) for name in table.names
    }
    read = len(columns["x"])
    if read < table.points:
        count_loss(losses, MISSING, table.points - read)
    return columns


def names_of(fields: list[str]) -> list[str]:
    """Names of columns for those who look for them: in lower case, without what exporters put before."""
    return [field.lower().removeprefix("scalar_") for field in fields]


def check_axes(names: tuple[str, ...]) -> None:
    """That there is a place for each point.

    Raises:
        ScanFileError: x, y or z is missing.
    """
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise ScanFileError(f"its points have no {' and no '.join(missing)}")


def check_size(points: int, step: int) -> None:
    """That a table can be read.

    Raises:
        ScanFileError: It has no point, too many, or points of too many bytes.
    """
    if points == 0:
        raise ScanFileError("it holds no points")
    if points < 0 or points > MOST_POINTS or not 0 < step <= STEP_LIMIT:
        raise ScanFileError(f"its header promises {points} points of {step} bytes")


def read_records(file: IO[bytes], dtype: np.dtype[np.void], points: int) -> Iterator[NDArray[np.void]]:
    """Records of fixed length from where the file stands, part by part; what is cut off is left out."""
    rows = max(1, min(PART, (16 << 20) // dtype.itemsize))
    left = points
    while left > 0:
        block = file.read(min(rows, left) * dtype.itemsize)
        there = len(block) // dtype.itemsize
        if there == 0:
            return
        yield np.frombuffer(block, dtype, there)
        left -= there
        if there * dtype.itemsize < len(block):
            return
