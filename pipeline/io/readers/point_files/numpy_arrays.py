"""NumPy's files: .npy with one array, .npz with several. Arrays of objects are pickles and refused."""

from __future__ import annotations

import io
import lzma
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from pipeline.io.readers.point_files.table import (
    MOST_POINTS,
    STEP_LIMIT,
    WHOLE_LIMIT,
    Columns,
    check_axes,
    check_size,
    names_of,
    read_records,
)
from pipeline.io.readers.scan_folder import ScanFileError

_MEMBERS = 1000
_HEAD = 16 << 10  # bytes; NumPy itself takes no longer header than 10,000
_COLUMNS = 1000
_BEST = ("points", "xyz", "cloud", "point_cloud", "pointcloud", "pts", "data", "arr_0")
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    RuntimeError,
    NotImplementedError,
    ValueError,
    struct.error,
)
_HEADER_DAMAGE = (
    *_DAMAGE,
    KeyError,
    TypeError,
    SyntaxError,
    tokenize.TokenError,
    RecursionError,
    MemoryError,
    OverflowError,
)


@dataclass(frozen=True, slots=True)
class _Array:
    """One array of a file.

    Attributes:
        member: Its name in the .npz, None in an .npy.
        start: Bytes of its header.
        size: Bytes of the file or of what the member says to unpack to.
        shape, dtype, by_columns: As its header says.
    """

    member: str | None
    start: int
    size: int
    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    by_columns: bool

    @property
    def points(self) -> int:
        """Number of rows."""
        return self.shape[0]

    def names(self) -> tuple[str, ...]:
        """Of its columns; what has no name begins with a star.

        Raises:
            ScanFileError: It is no table of numbers.
        """
        told = f"an array of shape {self.shape} and type {self.dtype}"[:120]
        if len(self.shape) == 1 and self.dtype.names:
            kinds = [field[0] for field in (self.dtype.fields or {}).values()]
            if not all(_is_number(kind) or kind.kind in "VSU" for kind in kinds) or self.dtype.hasobject:
                raise ScanFileError(f"it holds {told}; it must be numbers")
            names = names_of(list(self.dtype.names))
            return tuple(
                f"*{k}" if not _is_number(kind) or name in names[:k] else name
                for k, (name, kind) in enumerate(zip(names, kinds, strict=True))
            )
        if len(self.shape) != 2 or not _is_number(self.dtype) or not 3 <= self.shape[1] <= _COLUMNS:
            raise ScanFileError(
                f"it holds {told}; it must be (N, 3) numbers or more columns, or have fields x, y and z"
            )
        rest = (
            ["intensity"] if self.shape[1] in (4, 5) else []
        )  # of KITTI and its kin; six are x, y, z and a colour
        names = ["x", "y", "z", *rest]
        return (*names, *(f"*{k}" for k in range(len(names), self.shape[1])))


@dataclass(frozen=True, slots=True)
class NumpyTable:
    """The points of an .npy or .npz file (see `PointTable`): one array, or one each for x, y and z."""

    path: Path
    kind: str
    arrays: tuple[_Array, ...]
    points: int
    names: tuple[str, ...]

    def parts(self) -> Iterator[Columns]:
        """See `PointTable.parts`."""
        read = 0
        try:
            with ExitStack() as stack:
                streams = [self._columns(stack, array) for array in self.arrays]
                for parts in zip(*streams, strict=False):
                    columns = {name: part[name] for part in parts for name in part}
                    n = min(len(column) for column in columns.values())
                    read += n
                    yield {name: column[:n] for name, column in columns.items() if name in self.names}
        except _DAMAGE as error:
            if read == 0:
                raise ScanFileError(f"the NumPy file is damaged: {error}"[:200]) from None

    def _columns(self, stack: ExitStack, array: _Array) -> Iterator[Columns]:
        file: IO[bytes]
        if array.member is None:
            file = stack.enter_context(self.path.open("rb"))
        else:
            archive = stack.enter_context(zipfile.ZipFile(self.path))
            file = stack.enter_context(archive.open(array.member))
        file.seek(array.start)
        if len(array.shape) == 1 and array.dtype.names is None:
            names: tuple[str, ...] = (_stem(array.member),)
            dtype = np.dtype([(names[0], array.dtype)])
        elif array.dtype.names is None:
            names = array.names()
            if array.by_columns:
                return iter([_by_columns(file, array, names)])
            dtype = np.dtype([(name, array.dtype) for name in names])
        else:
            names, dtype = array.names(), np.dtype((np.void, array.dtype))
        fields = dtype.names or ()
        return (
            {name: records[field] for name, field in zip(names, fields, strict=True) if name[0] != "*"}
            for records in read_records(file, dtype, array.points)
        )


def open_npy(path: Path) -> NumpyTable:
    """Read and check the header.

    Raises:
        ScanFileError: It holds no table of points, or ends before the first.
        OSError: It cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        array = _header(file, None, size)
    return _table(path, "NumPy .npy", (array,))


def open_npz(path: Path) -> NumpyTable:
    """Find the points among the arrays: a table by its name or else the first, or x, y and z apart.

    Raises:
        ScanFileError: None holds points, or it is damaged.
        OSError: It cannot be read.
    """
    arrays: dict[str, _Array] = {}
    reason = "it holds no arrays"
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist()[:_MEMBERS]:
                if not info.filename.endswith(".npy"):
                    continue
                try:
                    with archive.open(info) as file:
                        arrays[_stem(info.filename)] = _header(file, info.filename, info.file_size)
                except ScanFileError as error:
                    reason = f"{_stem(info.filename)[:40]}: {error}"
    except _DAMAGE as error:
        raise ScanFileError(f"the .npz file is damaged: {error}"[:200]) from None
    for name in sorted(arrays, key=lambda name: _BEST.index(name) if name in _BEST else len(_BEST)):
        try:
            return _table(path, f"NumPy .npz, its array {name[:40]}", (arrays[name],))
        except ScanFileError as error:
            reason = f"{name[:40]}: {error}"
    apart = [arrays[axis] for axis in "xyz" if axis in arrays]
    rest = [arrays[name] for name in ("intensity",) if name in arrays]
    if len(apart) == 3:
        same = [a for a in (*apart, *rest) if a.shape == apart[0].shape]
        if len(same) >= 3 and all(len(a.shape) == 1 and _is_number(a.dtype) for a in same):
            return _table(path, "NumPy .npz, its arrays x, y and z", tuple(same))
    raise ScanFileError(f"no array of it holds points; {reason}")


def _table(path: Path, kind: str, arrays: tuple[_Array, ...]) -> NumpyTable:
    points = arrays[0].points
    names = tuple(_stem(a.member) for a in arrays) if len(arrays) > 1 else arrays[0].names()
    names = tuple(name for name in names if not name.startswith("*"))
    check_axes(names)
    for array in arrays:
        step = array.dtype.itemsize * (array.shape[1] if len(array.shape) == 2 else 1)
        check_size(points, step)
        if array.start + step > array.size:
            raise ScanFileError("it ends before its first point")
        if array.by_columns and points * step > min(WHOLE_LIMIT, array.size - array.start):
            raise ScanFileError("it is written column by column and is too large, or cut off")
    return NumpyTable(path, kind, arrays, points, names)


def _header(file: IO[bytes], member: str | None, size: int) -> _Array:
    """What stands before the numbers of an array.

    Raises:
        ScanFileError: It is not understood.
    """
    head = io.BytesIO(file.read(_HEAD))  # no header decides how much is read
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # files of Python 2 are as good
            version = np.lib.format.read_magic(head)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[
                version
            ]
            shape, by_columns, dtype = read(head)
    except _HEADER_DAMAGE as error:
        raise ScanFileError(f"the header of the array is damaged: {error}"[:160]) from None
    if dtype.hasobject:
        raise ScanFileError("an array of Python objects is not read, because it could run code")
    if not all(0 <= n <= MOST_POINTS for n in shape) or dtype.itemsize > STEP_LIMIT or dtype.subdtype:
        raise ScanFileError(f"the header of the array promises the shape {shape}"[:120])
    return _Array(member, head.tell(), size, tuple(shape), dtype, by_columns and len(shape) == 2)


def _by_columns(file: IO[bytes], array: _Array, names: tuple[str, ...]) -> Columns:
    block = file.read(array.points * array.shape[1] * array.dtype.itemsize)
    if len(block) < array.points * array.shape[1] * array.dtype.itemsize:
        raise EOFError("it is cut off")
    table = np.frombuffer(block, array.dtype).reshape(array.shape[1], array.points)
    return {name: table[k] for k, name in enumerate(names) if name[0] != "*"}


def _is_number(dtype: np.dtype[np.generic]) -> bool:
    return dtype.kind in "fiu" and dtype.itemsize <= 8 and dtype.names is None and not dtype.shape


def _stem(member: str | None) -> str:
    return (member or "").removesuffix(".npy").lower()
