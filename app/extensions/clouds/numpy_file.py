"""NumPy's .npy and .npz files as tables of points; pickles are never read."""

from __future__ import annotations

import io
import lzma
import struct
import tokenize
import warnings
import zipfile
import zlib
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from pipeline.io.readers import head_of
from pipeline.io.readers.point_files import (
    MOST_FIELDS,
    MOST_POINTS,
    PointTable,
    ScanFileError,
    Stream,
    binary_table,
    column_names,
)

ARRAY = "Save x, y, z as an array of numbers of shape (N, 3)"  # of a sound file with other contents
#: What damaged data and zips raise when they are read.
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, ValueError, struct.error)
_NPY_HEADER_LIMIT = 16 << 10  # bytes; NumPy itself refuses headers of more than 10,000
_MOST_MEMBERS = 1000
_BEST_NAMES = ("points", "xyz", "cloud", "point_cloud", "pointcloud", "pts", "data", "arr_0")
_HEADER_DAMAGE = (
    *_DAMAGE, KeyError, TypeError, SyntaxError, tokenize.TokenError, MemoryError, OverflowError
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _MemberStream(Stream):
    """Records in a member of a zip, which cannot be read from its middle."""

    member: str

    def open(self, path: Path, stack: ExitStack) -> IO[bytes]:
        """Return the unpacked member; one of _DAMAGE if the zip is damaged."""
        return stack.enter_context(stack.enter_context(zipfile.ZipFile(path)).open(self.member))


@dataclass(frozen=True, slots=True)
class _NumpyArray:
    """An array of an .npy file or of a member of an .npz file.

    Attributes:
        member: Name of the array in the .npz; None for an .npy.
        start: Length of the header [bytes].
        room: Size [bytes] of the file, or of the unpacked member by the directory of the zip.
        shape, dtype, fortran: Shape, type and order of the array by its header.
    """

    member: str | None
    start: int
    room: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool

    def streams(self) -> list[Stream]:
        """Return the records of a table, or its columns if they are stored one after the other. The fields of
        a structured array keep their names; the columns of a plain table are x, y, z, with four or five
        columns also intensity, and the others are not used. Fields of text are not used either. Whether
        there are x, y and z is not checked.

        Raises:
            ScanFileError: The array has neither the shape (N, 3 to MOST_FIELDS) and numbers, nor the shape
                (N,) and fields of numbers or text.
        """
        form = f"an array of shape {self.shape} and type {self.dtype}"[:120]
        if len(self.shape) == 1 and self.dtype.names:
            fields = dict(self.dtype.fields or {})
            kinds = [fields[name][0] for name in self.dtype.names]
            if not all(_is_number(kind) or kind.kind in "VSU" for kind in kinds):
                raise ScanFileError(f"it holds {form}; it must be numbers", ARRAY)
            names = column_names(
                [n if _is_number(k) else "" for n, k in zip(self.dtype.names, kinds, strict=True)]
            )
            offsets = [fields[name][1] for name in self.dtype.names]
            record = {"names": names, "formats": kinds, "offsets": offsets, "itemsize": self.dtype.itemsize}
            return [self._stream(self.start, np.dtype(record))]  # type: ignore[call-overload]
        if len(self.shape) != 2 or not _is_number(self.dtype) or not 3 <= self.shape[1] <= MOST_FIELDS:
            raise ScanFileError(
                f"it holds {form}; it must be (N, 3) numbers or more columns, or have fields x, y and z",
                ARRAY,
            )
        # Four or five columns are those of KITTI and similar sets; six are x, y, z and a colour.
        known = ["x", "y", "z", *(["intensity"] if self.shape[1] in (4, 5) else [])]
        if self.fortran:
            return [self.column(name, k) for k, name in enumerate(known)]
        names = [*known, *(f"*{k}" for k in range(len(known), self.shape[1]))]
        return [self._stream(self.start, np.dtype([(name, self.dtype) for name in names]))]

    def column(self, name: str, number: int = 0) -> Stream:
        """Return the stream of the column with the index `number`, whose numbers are stored one after the
        other, with the name `name`."""
        start = self.start + number * self.shape[0] * self.dtype.itemsize
        return self._stream(start, np.dtype([(name, self.dtype)]))

    def _stream(self, start: int, dtype: np.dtype[Any]) -> Stream:
        """Return records of a type from an offset on."""
        if self.member is None:
            return Stream(start, dtype, self.room)
        return _MemberStream(start, dtype, self.room, self.member)


def open_numpy(path: Path) -> PointTable:
    """Return the table of an .npy or .npz file, see `_NumpyArray.streams` and `_open_npz`; errors are those
    of these."""
    head = head_of(path)
    if head.startswith(b"PK"):
        return _open_npz(path)
    array = _npy_header(io.BytesIO(head), None, path.stat().st_size)
    return binary_table(path, "NumPy .npy", array.shape[0], array.streams())


def _open_npz(path: Path) -> PointTable:
    """Return the table of the array with a usual name (_BEST_NAMES, the first of them), else of the first
    that is a table of points, else of arrays x, y, z and, if there is one, intensity of equal length. An
    array that cannot be used is skipped; only the first _MOST_MEMBERS members are searched.

    Raises:
        ScanFileError: The file is damaged or has no such array.
        OSError: The file cannot be read.
    """
    arrays: dict[str, _NumpyArray] = {}
    reason = "it holds no arrays"
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist()[:_MOST_MEMBERS]:
                if info.filename.endswith(".npy"):
                    try:
                        with archive.open(info) as file:
                            array = _npy_header(file, info.filename, info.file_size)
                            arrays[info.filename.removesuffix(".npy").lower()] = array
                    except ScanFileError as error:
                        reason = f"{info.filename[:40]}: {error}"
    except _DAMAGE as error:
        raise ScanFileError(f"the .npz file is damaged: {error}"[:200]) from None
    for name in sorted(arrays, key=lambda name: _BEST_NAMES.index(name) if name in _BEST_NAMES else 99):
        try:
            kind = f"NumPy .npz, its array {name[:40]}"
            return binary_table(path, kind, arrays[name].shape[0], arrays[name].streams(), (0,))
        except ScanFileError as error:
            reason = f"{name[:40]}: {error}"
    found = {name: arrays[name] for name in ("x", "y", "z", "intensity") if name in arrays}
    columns = {name: a for name, a in found.items() if len(a.shape) == 1 and _is_number(a.dtype)}
    if len(columns) >= 3 and len({array.shape for array in columns.values()}) == 1:
        streams = [array.column(name) for name, array in columns.items()]
        points = next(iter(columns.values())).shape[0]
        return binary_table(path, "NumPy .npz, its arrays x, y and z", points, streams, (0,))
    raise ScanFileError(f"no array of it holds points; {reason}", ARRAY)


def _npy_header(file: IO[bytes], member: str | None, size: int) -> _NumpyArray:
    """Return the description of an array from its header.

    Args:
        file: File at the beginning of the array.
        member: Name of the array in an .npz, None for an .npy.
        size: Size of the file or of the unpacked member [bytes].

    Raises:
        ScanFileError: The header is damaged or of a newer version than 2.0, or the array has no dimension,
            has more than MOST_POINTS entries along one, or holds Python objects (pickles).
    """
    head = io.BytesIO(file.read(_NPY_HEADER_LIMIT))  # no header decides how much is read
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # headers that Python 2 wrote
            shape, fortran, dtype = read[np.lib.format.read_magic(head)](head)
    except _HEADER_DAMAGE as error:
        raise ScanFileError(f"the header of the array is damaged: {error}"[:160]) from None
    if dtype.hasobject:
        raise ScanFileError("an array of Python objects is not read, because it could run code", ARRAY)
    if not shape or not all(0 <= n <= MOST_POINTS for n in shape) or dtype.subdtype:
        raise ScanFileError(f"the header of the array promises the shape {shape}"[:120])
    return _NumpyArray(member, head.tell(), size, tuple(shape), dtype, fortran)


def _is_number(dtype: np.dtype[Any]) -> bool:
    """Return whether a type is a real number of up to 8 bytes."""
    return dtype.kind in "fiu" and dtype.itemsize <= 8 and not dtype.shape
