"""PLY files, in text or binary: the vertices' columns that have one number each; faces are not read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.number_text import parse_numbers, rows_of
from pipeline.io.readers.point_files.table import Columns, check_axes, check_size, names_of, read_records
from pipeline.io.readers.scan_folder import ScanFileError

_HEADER_LIMIT = 64 << 10  # bytes
_BLOCK = 8 << 20  # bytes of text that are read at once
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_VERTEX = ("vertex", "point", "points")


@dataclass(slots=True)
class _Element:
    """One element of the header: how many there are, and what each has. A list has no type."""

    name: str
    count: int
    fields: list[tuple[str, str | None]]

    @property
    def fixed(self) -> bool:
        """Whether each has the same length."""
        return all(code is not None for _, code in self.fields)


@dataclass(frozen=True, slots=True)
class PlyTable:
    """The vertices of a PLY file (see `PointTable`).

    Attributes:
        path: The file.
        order: Of bytes; empty for text.
        start: Byte at which the first element begins.
        before: Lines of text, or bytes of binary data, that come before the vertices.
        dtype: Of a vertex.
        points: Number of vertices.
        names: Of the columns.
    """

    path: Path
    order: str
    start: int
    before: int
    dtype: np.dtype[np.void]
    points: int
    names: tuple[str, ...]

    @property
    def kind(self) -> str:
        """The format in words."""
        return "PLY binary" if self.order else "PLY text"

    def parts(self) -> Iterator[Columns]:
        """See `PointTable.parts`."""
        with self.path.open("rb") as file:
            if self.order:
                file.seek(self.start + self.before)
                for records in read_records(file, self.dtype, self.points):
                    yield {name: records[name] for name in self.names}
            else:
                file.seek(self.start)
                for rows in _read_text(file, len(self.dtype.names or ()), self.before, self.points):
                    yield {
                        name: rows[:, k]
                        for k, name in enumerate(self.dtype.names or ())
                        if name in self.names
                    }


def open_ply(path: Path) -> PlyTable:
    """Read and check the header.

    Raises:
        ScanFileError: It is no PLY file, contradicts itself or the file's size, or has no x, y and z.
        OSError: It cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        order, elements, start = _header(file.read(_HEADER_LIMIT))
    place = next((k for k, e in enumerate(elements) if e.name in _VERTEX), None)
    if place is None:
        raise ScanFileError("the PLY file has no vertices")
    vertex, earlier = elements[place], elements[:place]
    if not vertex.fixed or (order and not all(e.fixed for e in earlier)):
        raise ScanFileError("the PLY file has lists of varying length before its last vertex")
    dtype = _dtype(vertex, order)
    names = tuple(name for name in (dtype.names or ()) if not name.startswith("*"))
    check_axes(names)
    check_size(vertex.count, dtype.itemsize)
    before = sum(e.count * (_dtype(e, order).itemsize if order else 1) for e in earlier)
    # Least bytes of a vertex: in text a digit and what divides it from the next one.
    step = dtype.itemsize if order else 2 * len(vertex.fields)
    if start + before + step > size + 1:
        raise ScanFileError("the PLY file ends before its first vertex")
    return PlyTable(path, order, start, before, dtype, vertex.count, names)


def _header(head: bytes) -> tuple[str, list[_Element], int]:
    """Order of the bytes, elements, and length of the header."""
    order: str | None = None
    elements: list[_Element] = []
    at = 0
    while True:
        end = head.find(b"\n", at)
        if end < 0:
            raise ScanFileError("it has no header of a PLY file")
        words = head[at:end].decode("ascii", "replace").split()
        at = end + 1
        try:
            match words:
                case ["end_header"]:
                    break
                case ["format", form, *_]:
                    order = _ORDER[form]
                case ["element", name, number] if number.isdecimal() and len(number) < 18:
                    elements.append(_Element(name.lower(), int(number), []))
                case ["property", "list", _, _, name]:
                    elements[-1].fields.append((name, None))
                case ["property", kind, name]:
                    elements[-1].fields.append((name, _TYPES[kind]))
                case ["property" | "element", *_]:
                    raise ScanFileError("the header of the PLY file is damaged")
        except (KeyError, IndexError):
            raise ScanFileError("the header of the PLY file is damaged") from None
    if order is None:
        raise ScanFileError("the header of the PLY file does not say how its data is written")
    return order, elements, at


def _dtype(element: _Element, order: str) -> np.dtype[np.void]:
    """The record of one element; what cannot be used by its name begins with a star."""
    seen: set[str] = set()
    fields = []
    for k, name in enumerate(names_of([name for name, _ in element.fields])):
        fields.append(
            (f"*{k}" if not name or name in seen else name, (order or "<") + (element.fields[k][1] or "f8"))
        )
        seen.add(name)
    return np.dtype(fields)


def _read_text(file: IO[bytes], width: int, skip: int, points: int) -> Iterator[NDArray[np.float64]]:
    """Rows of numbers, shape (N, width) a part, until the first line that is none.

    Raises:
        ScanFileError: The first row has more numbers than the header names.
    """
    left, rest = points, b""
    while left > 0:
        block = file.read(_BLOCK)
        text = rest + block
        cut = len(text) if not block else text.rfind(b"\n") + 1
        at = 0
        while skip and at < cut:
            end = text.find(b"\n", at, cut)
            at, skip = (end + 1 if end >= 0 else cut), skip - 1
        whole, rest = text[at:cut], text[cut:]
        rows, other = rows_of(whole, width, left)
        if left == points and rows == 0 and other > width:
            raise ScanFileError(f"the rows of the PLY file have {other} numbers, its header names {width}")
        numbers = parse_numbers(whole, limit=rows * width)
        there = len(numbers) // width
        if there:
            yield numbers[: there * width].reshape(there, width)
        left -= there
        if not block or len(rest) > _BLOCK or there < rows or other:
            return
