"""PCD files (Point Cloud Library), version 0.7: ascii, binary and binary_compressed.

Read by our own code because other readers end the process on some damaged files.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.container import count_loss
from pipeline.io.readers.lzf import LzfError, lzf_decompress
from pipeline.io.readers.number_text import parse_numbers
from pipeline.io.readers.scan_columns import POINT_LIMIT
from pipeline.io.readers.scan_folder import ScanFileError

FILE_LIMIT = 1 << 30
_HEADER_LIMIT = 16 << 10
_STEP_LIMIT = 64 << 10
_TYPES = {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
    **{("I", size): f"<i{size}" for size in (1, 2, 4, 8)},
    **{("U", size): f"<u{size}" for size in (1, 2, 4, 8)},
}
Columns = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """The header of a PCD file.

    Attributes:
        names: Of the fields, "_" for padding.
        types: NumPy's code of each field.
        counts: Number of values of each field.
        points: Number of points.
        data: "ascii", "binary" or "binary_compressed".
        length: Bytes of the header.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    data: str
    length: int

    @property
    def step(self) -> int:
        """Bytes of one point."""
        return sum(int(code[2]) * count for code, count in zip(self.types, self.counts, strict=True))


def read_pcd(path: Path, losses: dict[str, int], *, most_points: int = POINT_LIMIT) -> Columns:
    """Read the fields that have one value a point, each of shape (N,).

    A file that ends early gives the points that are whole, and a loss is counted.

    Raises:
        ScanFileError: It is no PCD file, too large, or its header contradicts itself or the data.
        OSError: It cannot be read.
    """
    if path.stat().st_size > FILE_LIMIT:
        raise ScanFileError("the file is too large for one scan")
    content = path.read_bytes()
    header = parse_header(content, most_points=most_points)
    body = memoryview(content)[header.length :]
    if header.data == "ascii":
        columns = _ascii(header, body)
    elif header.data == "binary":
        columns = _binary(header, body)
    else:
        columns = _compressed(header, body)
    read = len(next(iter(columns.values())))
    if read < header.points:
        count_loss(losses, "points that the files promise but do not hold", header.points - read)
    return columns


def parse_header(content: bytes, *, most_points: int = POINT_LIMIT) -> PcdHeader:
    """Read and check the header.

    Args:
        content: The beginning of the file.
        most_points: More are refused, and so is what takes more than FILE_LIMIT bytes, where the points
            are read at once: a scan, or data that is not binary.

    Raises:
        ScanFileError: It is no header of a PCD file or contradicts itself.
    """
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = content.find(b"\n", at, _HEADER_LIMIT)
        if end < 0:
            raise ScanFileError("it has no header of a PCD file")
        words = content[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        return _checked(entries, at, most_points)
    except (KeyError, IndexError, ValueError) as error:
        raise ScanFileError(f"its header is damaged at {error}") from error


def _checked(entries: dict[str, list[str]], length: int, most_points: int) -> PcdHeader:
    names = tuple(entries["FIELDS"])
    sizes = [_whole(word) for word in entries["SIZE"]]
    counts = tuple(_whole(word) for word in entries.get("COUNT", ["1"] * len(names)))
    if not len(names) == len(sizes) == len(entries["TYPE"]) == len(counts) <= 1000:
        raise ScanFileError("its header names another number of fields than of sizes, types or counts")
    types = tuple(_TYPES[kind, size] for kind, size in zip(entries["TYPE"], sizes, strict=True))
    width, height = _whole(entries["WIDTH"][0]), _whole(entries.get("HEIGHT", ["1"])[0])
    points = _whole(entries["POINTS"][0]) if "POINTS" in entries else width * height
    if points != width * height:
        raise ScanFileError(f"its header promises {points} points and {width} x {height}")
    header = PcdHeader(names, types, counts, points, entries["DATA"][0].lower(), length)
    in_parts = most_points > POINT_LIMIT and header.data == "binary"
    limit = most_points * header.step if in_parts else FILE_LIMIT
    if points > most_points or header.step > _STEP_LIMIT or points * header.step > limit:
        raise ScanFileError(
            f"its header promises {points} points of {header.step} bytes, too many to be read"
        )
    if header.data not in ("ascii", "binary", "binary_compressed"):
        raise ScanFileError(f"its data is of the unknown kind {header.data[:20]!r}")
    for axis in "xyz":
        place = names.index(axis) if axis in names else -1
        if place < 0 or not types[place].startswith("<f") or counts[place] != 1:
            raise ScanFileError(f"it has no field {axis} of floating numbers")
    return header


def _whole(word: str) -> int:
    if not word.isdecimal() or len(word) > 18:
        raise ValueError(word[:20])
    return int(word)


def _ascii(header: PcdHeader, body: memoryview) -> Columns:
    width = sum(header.counts)
    # A word needs two bytes, so a small file cannot make us take much memory.
    numbers = parse_numbers(body, limit=header.points * width)
    table = numbers[: len(numbers) // width * width].reshape(-1, width)
    columns: Columns = {}
    at = 0
    for name, code, count in zip(header.names, header.types, header.counts, strict=True):
        if count == 1 and name not in columns:
            columns[name] = _converted(table[:, at], code)
        at += count
    return columns


def _converted(numbers: NDArray[np.float64], code: str) -> NDArray[np.generic]:
    """Numbers of a text in the type that the header names; whole numbers stay within its bounds."""
    if code[1] == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(code)
    bounds = np.iinfo(code)
    return np.clip(
        np.nan_to_num(numbers), bounds.min, bounds.max / 2 if code[2] == "8" else bounds.max
    ).astype(code)


def record_type(header: PcdHeader) -> np.dtype[np.void]:
    """One point of binary data: the fields that have one value."""
    names, formats, offsets, at = [], [], [], 0
    for name, code, count in zip(header.names, header.types, header.counts, strict=True):
        if count == 1 and name not in names:
            names.append(name)
            formats.append(code)
            offsets.append(at)
        at += int(code[2]) * count
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": header.step})


def _binary(header: PcdHeader, body: memoryview) -> Columns:
    table = np.frombuffer(body, record_type(header), count=min(header.points, len(body) // header.step))
    return {name: table[name] for name in table.dtype.names or ()}


def _compressed(header: PcdHeader, body: memoryview) -> Columns:
    """The fields follow each other, each with all its points."""
    if len(body) < 8:
        raise ScanFileError("its packed data is missing")
    packed, size = struct.unpack_from("<II", body)
    if size != header.points * header.step or packed > len(body) - 8:
        raise ScanFileError("its packed data is cut or has another size than the header promises")
    try:
        raw = lzf_decompress(body[8 : 8 + packed], size)
    except LzfError as error:
        raise ScanFileError(str(error)) from error
    columns: Columns = {}
    at = 0
    for name, code, count in zip(header.names, header.types, header.counts, strict=True):
        length = int(code[2]) * count * header.points
        if count == 1 and name not in columns:
            columns[name] = raw[at : at + length].view(code)
        at += length
    return columns
