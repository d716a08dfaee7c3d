"""PLY files as tables of points: text and binary, with lists that are skipped."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers import head_of
from pipeline.io.readers.point_files import (
    EXPORT,
    STEP_LIMIT,
    Columns,
    PointTable,
    ScanFileError,
    Stream,
    binary_table,
    check_size,
    column_names,
    text_table,
    usable_names,
    whole_number,
)
from pipeline.jit import compiled

_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class _PlyElement:
    """An element of the header.

    Attributes:
        name: Name in lower case.
        count: Number of its records.
        properties: Name, type of a number, and type of the count of a list ("" for a single number) of each
            property; types as for NumPy, without byte order.
    """

    name: str
    count: int
    properties: list[tuple[str, str, str]]

    @property
    def has_lists(self) -> bool:
        """Whether records have lists, and so different lengths."""
        return any(count for _, _, count in self.properties)

    @property
    def least(self) -> int:
        """Smallest length of a record, with empty lists [bytes]."""
        return sum(np.dtype(count or kind).itemsize for _, kind, count in self.properties)


def open_ply(path: Path) -> PointTable:
    """Return the table of the first element "vertex", "point" or "points" of a PLY file. Its points are read
    later; lists are skipped.

    Raises:
        ScanFileError: The header is damaged or promises too many points, there is no such element, it has no
            x, y or z, or the file ends before its first point. In a text file, also if a list stands before
            x, y and z.
        OSError: The file cannot be read.
    """
    order, elements, start = _ply_header(head_of(path))
    place = next((k for k, e in enumerate(elements) if e.name in ("vertex", "point", "points")), None)
    if place is None:
        raise ScanFileError("the PLY file has no vertices", EXPORT)
    before, vertex = elements[:place], elements[place]
    if not order:
        return _ply_text(path, vertex, start, sum(element.count for element in before))
    if any(element.has_lists for element in (*before, vertex)):
        return _ply_with_lists(path, order, before, vertex, start)
    names = column_names([name for name, _, _ in vertex.properties])
    dtype = np.dtype(
        [(name, order + kind) for name, (_, kind, _) in zip(names, vertex.properties, strict=True)]
    )
    start += sum(element.count * element.least for element in before)
    return binary_table(path, "PLY binary", vertex.count, [Stream(start, dtype, path.stat().st_size)])


def _ply_text(path: Path, vertex: _PlyElement, start: int, skipped: int) -> PointTable:
    """Return the table of a PLY file in text, of whose vertices the numbers before the first list are read.

    Args:
        path: The file.
        vertex: The element of the points.
        start: Length of the header [bytes].
        skipped: Number of lines before the points.

    Raises:
        ScanFileError: x, y or z is missing or stands after a list, or the file is too short.
    """
    fixed = list(takewhile(lambda each: not each[2], vertex.properties))
    names = column_names([name for name, _, _ in fixed])
    if vertex.has_lists and not set("xyz") <= set(names):
        raise ScanFileError("its points have a list before x, y and z", EXPORT)
    dtype = np.dtype([(name, "<" + kind) for name, (_, kind, _) in zip(names, fixed, strict=True)])
    return text_table(path, "PLY text", vertex.count, dtype, start, skipped, more=vertex.has_lists)


def _ply_with_lists(
    path: Path, order: str, before: list[_PlyElement], vertex: _PlyElement, start: int
) -> PointTable:
    """Return the table of a binary PLY file with lists in or before its vertices.

    Args:
        path: The file.
        order: Byte order, "<" or ">".
        before: Elements before the vertices.
        vertex: The element of the points.
        start: Length of the header [bytes].

    Raises:
        ScanFileError: x, y or z is missing, sizes are too large, or the file is too short.
        OSError: The size of the file cannot be read.
    """
    names = column_names([name if not count else "" for name, _, count in vertex.properties])
    usable = usable_names(names)
    check_size(vertex.count, vertex.least)
    if (
        start + sum(e.count * e.least for e in before) + vertex.least * bool(vertex.count)
        > path.stat().st_size
    ):
        raise ScanFileError("it ends before its first point")

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the points in parts, see PointTable; ScanFileError at a list that is too long."""
        del begin
        with path.open("rb") as file:
            file.seek(start)
            for element in before:
                if element.has_lists:
                    for _ in _walk(file, element, order):
                        pass
                else:
                    file.seek(element.count * element.least, io.SEEK_CUR)
            for block, at in _walk(file, vertex, order):
                columns = {}
                for k, (name, (_, kind, _)) in enumerate(zip(names, vertex.properties, strict=True)):
                    if name in usable:
                        dtype = np.dtype(order + kind)
                        places = at[:, k, None] + np.arange(dtype.itemsize)
                        columns[name] = block[places].view(dtype)[:, 0]
                yield columns

    return PointTable("PLY binary", vertex.count, usable, read, starts=(0,))


_WALKED = 4 << 20  # bytes whose records are found at once


def _walk(
    file: IO[bytes], element: _PlyElement, order: str
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.int64]]]:
    """Yield blocks of whole records of an element, and the place of each property in the block, shape (N,
    properties) [bytes]; the file is then behind the element, or at its end.

    Raises:
        ScanFileError: A record is longer than STEP_LIMIT.
    """
    sizes = np.array([np.dtype(kind).itemsize for _, kind, _ in element.properties], np.int64)
    counts = np.array([np.dtype(c).itemsize if c else 0 for _, _, c in element.properties], np.int64)
    left, at = element.count, file.tell()
    while left > 0:
        file.seek(at)
        block = np.frombuffer(file.read(_WALKED), np.uint8)
        rows = min(left, len(block) // max(element.least, 1), _WALKED // len(sizes))
        places = np.empty((rows, len(sizes)), np.int64)
        found, end = _find_records(block, sizes, counts, order == ">", places)
        if not found:
            if len(block) > STEP_LIMIT:
                raise ScanFileError("a list of it is too long")
            return
        yield block, places[:found]
        left, at = left - found, at + end
    file.seek(at)


@compiled
def _find_records(
    block: NDArray[np.uint8],
    sizes: NDArray[np.int64],
    counts: NDArray[np.int64],
    is_big: bool,
    places: NDArray[np.int64],
) -> tuple[int, int]:
    """Find records of varying length.

    Args:
        block: Bytes that begin with a record.
        sizes: Size of a number of each property [bytes].
        counts: Size of the count of each property that is a list [bytes]; 0 for a single number.
        is_big: Whether counts are big endian.
        places: Filled with the place of each property of each whole record [bytes].

    Returns:
        Number of whole records, at most that of the rows of `places`, and the end of the last one.
    """
    end = 0
    for row in range(len(places)):
        at = end
        for k in range(len(sizes)):
            places[row, k] = at
            number = 1
            if counts[k]:
                if at + counts[k] > len(block):
                    return row, end
                number = 0
                for byte in range(counts[k]):
                    shift = counts[k] - 1 - byte if is_big else byte
                    number += int(block[at + byte]) << (8 * shift)
                at += counts[k]
            at += number * sizes[k]
            if at > len(block) or at < 0:
                return row, end
        end = at
    return len(places), end


def _ply_header(head: bytes) -> tuple[str, list[_PlyElement], int]:
    """Return the byte order ("<", ">", or "" for text), the elements with names in lower case, and the length
    of the header [bytes]. Comments and unknown lines are ignored.

    Raises:
        ScanFileError: The bytes are not a complete header of a PLY file.
    """
    order: str | None = None
    elements: list[_PlyElement] = []
    at = 0
    while (end := head.find(b"\n", at)) >= 0:
        words = head[at:end].decode("ascii", "replace").split()
        at = end + 1
        try:
            match words:
                case ["end_header"]:
                    if order is None:
                        raise ScanFileError("the header of the PLY file does not say how its data is written")
                    return order, elements, at
                case ["format", form, *_]:
                    order = _PLY_ORDER[form]
                case ["element", name, number]:
                    elements.append(_PlyElement(name.lower(), whole_number(number), []))
                case ["property", "list", count, kind, name] if not _PLY_TYPES[count].startswith("f"):
                    elements[-1].properties.append((name, _PLY_TYPES[kind], _PLY_TYPES[count]))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, _PLY_TYPES[kind], ""))
                case ["property" | "element", *_]:
                    raise ScanFileError("the header of the PLY file is damaged")
        except (KeyError, IndexError, ValueError):
            raise ScanFileError("the header of the PLY file is damaged") from None
    raise ScanFileError("it has no header of a PLY file")
