"""Points as lines of text: .xyz, .txt, .asc, .csv, .pts, as CloudCompare, scanners and phones export them.

Separator, decimal sign, header and columns are found in the first lines. The lines are parsed in blocks, so
that the text is never in memory as a whole.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.extensions.formats.ptx import is_ptx, open_ptx
from pipeline.io.readers.base import COORDINATE_LIMIT
from pipeline.io.readers.point_files import DEGREES, MOST_POINTS, Columns, PointTable, ScanFileError
from pipeline.types.records import Float

HEAD = 64 << 10  # bytes in which the layout is found
_BLOCK = 8 << 20  # bytes that are parsed at once
_LINE_LIMIT = 1 << 16  # bytes
#: A text with fewer rows is a table of something else: one section of one stem has as many points.
LEAST_ROWS = 100
BAD_LINES = "lines that are no points"
_COUNTED = 20  # rows in which the first column counts; so many coordinates in steps of exactly 1 are no cloud

_NAMES = {
    "x": "x px posx pointx xcoord coordx xcoordinate easting east rechtswert points:0 points0 pointsmxyz:0",
    "y": "y py posy pointy ycoord coordy ycoordinate northing north hochwert points:1 points1 pointsmxyz:1",
    "z": "z pz posz pointz zcoord coordz zcoordinate elevation elev altitude alt height hoehe "
    "points:2 points2 pointsmxyz:2",
    "intensity": "intensity intensities reflectance reflectivity i",
    "red": "r red",
    "green": "g green",
    "blue": "b blue",
}
_AXIS_OF = {name: axis for axis, names in _NAMES.items() for name in names.split()}
#: Columns by which a table is something else, and what a person does with it.
_TRUTH = "Give true trees with --truth"
_OTHER_TABLES = (
    (r"dbh|diameter|dia|d130|d13|bhd|species|art|sigmadbh|girth", "a table of trees", _TRUTH),
    (r"verdict|radialstd|eccentricity|sigmaxy|yawrad|views|nearestm", "a result of `stemmap map`",
     "Open the source of the run"),
    (r"qx|qy|qz|qw|quaternion.*|yaw|roll|pitch", "a list of poses", "Give poses with --odometry file:PATH"),
)  # fmt: skip
_DEGREES = ("lat", "latitude", "lon", "long", "longitude")
_TREE_NUMBER = ("tree", "treeid", "treenumber", "treeno", "id", "stem", "stemid")
_UNITS = {"m": "m", "meter": "m", "metre": "m", "mm": "mm", "cm": "cm", "ft": "ft", "feet": "ft",
          "foot": "ft", "usft": "us-ft", "ftus": "us-ft"}  # fmt: skip
_NUMBER = re.compile(
    rb"[-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eEdD][-+]?[0-9]+)?|[-+]?(?:nan|inf)", re.I
)
_COMMENT = (b"#", b"//", b"%")


@dataclass(frozen=True, slots=True)
class _Layout:
    """How the lines of a text are written.

    Attributes:
        start: Offset of the first line of points [bytes].
        separator: b";", b"|", b"," or b" "; the last stands for any blanks.
        decimal_comma: Whether a comma is the decimal sign.
        columns: Index of each column that is read, by its name; x, y and z are among them.
        names: Names of the other columns.
        count: Number of points by the line before the first point (.pts); None without it.
        unit: Unit by the names of the columns, such as "mm"; "" if they name none.
    """

    start: int
    separator: bytes
    decimal_comma: bool
    columns: dict[str, int]
    names: tuple[str, ...]
    count: int | None
    unit: str


def is_text_of_points(head: bytes) -> bool:
    """Return whether a file is a text of points by its first HEAD bytes."""
    if is_ptx(head):
        return True
    if len(head) < HEAD and len(head.splitlines()) < LEAST_ROWS:
        return False
    try:
        find_layout(head)
    except ScanFileError:
        return False
    return True


def open_text(path: Path) -> PointTable:
    """Return the table of a text file; only its first lines are read, and its lines are counted.

    Raises:
        ScanFileError: The first lines are no points, or there are too few or too many lines.
        OSError: The file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEAD)
        if is_ptx(head):
            return open_ptx(path)
        layout = find_layout(head)
        file.seek(layout.start)
        lines = ends = 0
        last = b"\n"
        mark = b"\n" if b"\n" in head else b"\r"
        while block := file.read(_BLOCK):
            ends += block.count(mark)
            last = block[-1:]
    lines = ends + (last not in b"\r\n")
    points = lines if layout.count is None else layout.count
    if lines < LEAST_ROWS:
        raise ScanFileError(
            f"the text has only {lines} rows of numbers, which is a table and no cloud", "Name the cloud"
        )
    if points > MOST_POINTS:
        raise ScanFileError("the text promises too many points", "Cut it into smaller plots")

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the points in parts from about the line `begin` on; a line that is no point is a row of
        NaN."""
        with path.open("rb") as file:
            file.seek(layout.start + (size - layout.start) * begin // max(points, 1))
            if begin:
                file.readline(_LINE_LIMIT)
            rest = b""
            while block := file.read(_BLOCK):
                block = (rest + block).replace(b"\r", b"\n")
                whole = block.rfind(b"\n") + 1
                rest = block[whole:]
                if len(rest) > _LINE_LIMIT:  # no text
                    rest = b""
                if whole:
                    yield _parse(block[:whole], layout)
            if rest:
                yield _parse(rest, layout)

    return PointTable(
        "text",
        points,
        tuple(layout.columns),
        read,
        attributes=layout.names,
        invalid=BAD_LINES,
        units=(layout.unit, layout.unit),
        exact=layout.count is not None,
    )


def find_layout(head: bytes) -> _Layout:
    """Return the layout of a text by its first bytes.

    Raises:
        ScanFileError: They are no text, or no lines of points; the reason names what they are instead.
    """
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ScanFileError("it is text in UTF-16", "Save it as UTF-8")
    if b"\0" in head:
        raise ScanFileError("it is no text of points", "Export it as .laz, .ply or text with x, y, z")
    mark = b"\n" if b"\n" in head else b"\r"
    lines = head.split(mark)
    if len(head) >= HEAD:
        lines.pop()  # cut off
    at = 3 if head.startswith(b"\xef\xbb\xbf") else 0
    lines[0] = lines[0][at:]
    header: bytes | None = None
    count: int | None = None
    for k, line in enumerate(lines):
        text = line.strip()
        if not text or text.startswith(_COMMENT):
            header = text.lstrip(b"#/% \t") or header
        elif (rows := _rows(lines[k:])) is None:
            if count is None and text.isdigit() and len(text) < 12 and _rows(lines[k + 1 :]) is not None:
                count, header = int(text), None
            elif k and header is not None and count is not None:
                break
            else:
                header = text
        else:
            start = at + sum(len(before) + 1 for before in lines[:k])
            return _layout_of(rows, header, start, count)
    first = next((line.strip() for line in lines if line.strip()), b"")[:60].decode("utf-8", "replace")
    from pipeline.io.readers import readable

    raise ScanFileError(f"not a LiDAR recording: its lines are no points, such as {first!r}", readable())


def _rows(lines: list[bytes]) -> tuple[bytes, bool, list[list[bytes]]] | None:
    """Return separator, decimal comma and the cells of the next lines (at most 50); None if the first of them
    does not begin with three numbers or most of the others do not."""
    texts = [line.strip() for line in lines[:200] if line.strip() and not line.strip().startswith(_COMMENT)][
        :50
    ]
    if not texts:
        return None
    first = texts[0].replace(b'"', b"")
    blanks = first.split()
    if mark := next((mark for mark in (b";", b"|") if mark in first), b""):
        separator, decimal_comma = mark, b"," in first
    elif (
        len(blanks) >= 3
        and all(_NUMBER.fullmatch(word) for word in blanks[:3])
        and (b"," not in first or any(b"," in word for word in blanks[:3]))
    ):
        separator, decimal_comma = b" ", any(b"," in word for word in blanks[:3])
    else:
        separator, decimal_comma = b",", False
    cells = [_cells(text.replace(b'"', b""), separator) for text in texts]
    good = [sum(bool(_NUMBER.fullmatch(cell)) for cell in row) >= 3 for row in cells]
    return (separator, decimal_comma, cells) if good[0] and 2 * sum(good) > len(good) else None


def _cells(text: bytes, separator: bytes) -> list[bytes]:
    """Return the cells of a line without blanks around them."""
    return text.split() if separator == b" " else [cell.strip() for cell in text.split(separator)]


def _layout_of(
    rows: tuple[bytes, bool, list[list[bytes]]], header: bytes | None, start: int, count: int | None
) -> _Layout:
    """Return the layout by the first rows and the header.

    Args:
        rows: As from `_rows`.
        header: The line before the rows, without comment signs; None without one.
        start, count: As in `_Layout`.

    Raises:
        ScanFileError: The rows are poses, or the header names other things than points.
    """
    separator, decimal_comma, cells = rows
    width = min(map(len, cells))
    names = _header_cells(header, separator, len(cells[0])) if header else []
    columns, unit = _named(names) if names else ({}, "")
    if not columns:
        if _are_poses(cells, decimal_comma):
            raise ScanFileError(*_poses())
        first = int(_are_numbered(cells) or _are_timed(cells, decimal_comma))
        columns = dict(zip("xyz", range(first, first + 3), strict=True))
        if not all(_NUMBER.fullmatch(cell) for cell in cells[0][first : first + 3]):
            raise ScanFileError(
                "its first three columns are no numbers, and no header names x, y and z",
                "Export it with x, y and z first, or with a header",
            )
        width -= first
        if width > 3:
            columns["intensity"] = first + 3
        if width == 6 or width > 7:  # x y z r g b, maybe more
            del columns["intensity"]
    used = set(columns.values())
    others = tuple(name for k, name in enumerate(names) if k not in used and name)
    return _Layout(start, separator, decimal_comma, columns, others, count, unit)


def _poses() -> tuple[str, str]:
    return "it is a list of poses, not a cloud", "Give poses with --odometry file:PATH"


def _header_cells(header: bytes, separator: bytes, width: int) -> list[str]:
    """Return the names in a header; [] if it has none, such as a remark in words."""
    text = header.replace(b'"', b"").decode("utf-8", "replace")
    for split in (separator.decode(), ";", "|", ",", "\t", " "):
        names = text.split() if split == " " else [cell.strip() for cell in text.split(split)]
        if abs(len(names) - width) <= 1 and len(names) >= 3:
            return names
    words = re.split(r"[\s;|,]+", text.strip())
    return words if sum(_name(word)[0] in _AXIS_OF for word in words) >= 2 else []


def _name(cell: str) -> tuple[str, str]:
    """Return the name of a column without its unit, signs and case, and the unit ("" without one): ("x",
    "mm") for "X [mm]", ("easting", "") for "Easting"."""
    text = cell.lower().strip().lstrip("/#").removeprefix("scalar_").strip().replace("ö", "oe")
    match = re.fullmatch(r"(.*?)[\s_]*[\[(]?([a-z]+)[\])]?", text)
    if match and match.group(2) in _UNITS and match.group(1):
        return re.sub(r"[^a-z0-9:]", "", match.group(1)), _UNITS[match.group(2)]
    return re.sub(r"[^a-z0-9:]", "", text), ""


def _named(names: list[str]) -> tuple[dict[str, int], str]:
    """Return the columns of a header by their names, and their unit; no columns if it names neither x nor y
    nor anything else that is known.

    Raises:
        ScanFileError: The header is that of another table, or lacks one of x, y and z.
    """
    plain = [_name(name) for name in names]
    for words, what, remedy in _OTHER_TABLES:
        for cell, (name, _) in zip(names, plain, strict=True):
            if re.fullmatch(words, name):
                raise ScanFileError(f"it is {what}, not a cloud: it has a column {cell[:40]!r}", remedy)
    columns: dict[str, int] = {}
    for k, (name, _) in enumerate(plain):
        if name in _AXIS_OF:
            columns.setdefault(_AXIS_OF[name], k)
    there = [axis for axis in "xyz" if axis in columns]
    known = {name for name, _ in plain}
    if len(there) < 3 and not known.isdisjoint(_DEGREES):
        raise ScanFileError(*DEGREES)
    if not there:
        return {}, ""
    if plain[columns.get("z", 0)][0] == "height" and not known.isdisjoint(_TREE_NUMBER):
        raise ScanFileError("it is a table of trees with heights, not a cloud", _TRUTH)
    if len(there) < 3:
        missing = " and no ".join(axis for axis in "xyz" if axis not in columns)
        raise ScanFileError(
            f"its header names no {missing}: {', '.join(names)[:100]}",
            "A cloud has x, y and z; true trees go to --truth",
        )
    units = {plain[columns[axis]][1] for axis in "xyz"}
    order = ("x", "y", "z", "intensity", "red", "green", "blue")
    return {axis: columns[axis] for axis in order if axis in columns}, units.pop() if len(units) == 1 else ""


def _are_numbered(cells: list[list[bytes]]) -> bool:
    """Return whether the first of at least four columns counts the rows: digits that increase by one."""
    if len(cells) < _COUNTED or any(len(row) < 4 or not row[0].isdigit() for row in cells):
        return False
    numbers = [int(row[0]) for row in cells]
    return all(number == numbers[0] + k for k, number in enumerate(numbers))


def _are_timed(cells: list[list[bytes]], decimal_comma: bool) -> bool:
    """Return whether the first of at least four columns has times since 1970 or 1980, which are larger than
    any coordinate."""
    return all(
        len(row) >= 4 and _NUMBER.fullmatch(row[0]) and _as_float(row[0], decimal_comma) >= COORDINATE_LIMIT
        for row in cells
    )


def _are_poses(cells: list[list[bytes]], decimal_comma: bool) -> bool:
    """Return whether rows without a header are poses: quaternions of length 1 in the last four of 7 or 8
    columns, or the 12 numbers of matrices whose rows have length 1."""
    width = len(cells[0])
    if width not in (7, 8, 12) or any(len(row) != width for row in cells):
        return False
    try:
        table = np.array([[_as_float(cell, decimal_comma) for cell in row] for row in cells])
    except ValueError:
        return False
    parts = table.reshape(-1, 3, 4)[:, :, :3] if width == 12 else table[:, -4:]
    return bool(np.all(np.abs(np.linalg.norm(parts, axis=-1) - 1.0) < 0.01))


def _as_float(cell: bytes, decimal_comma: bool) -> float:
    return float(cell.replace(b",", b".") if decimal_comma else cell)


def _parse(text: bytes, layout: _Layout) -> dict[str, NDArray[np.generic]]:
    """Return the columns of whole lines with "\\n"; rows of NaN for lines that are no points. Empty lines,
    comments and numbers of points between blocks are left out."""
    separator = layout.separator
    if b'"' in text:
        text = text.replace(b'"', b"")
    if b"#" in text or b"//" in text or b"%" in text:
        text = b"\n".join(line for line in text.split(b"\n") if not line.lstrip().startswith(_COMMENT))
    if layout.decimal_comma:
        text = text.replace(b",", b".")
    delimiter = None if separator == b" " else separator.decode()
    wanted = list(layout.columns.values())
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            table = np.loadtxt(
                io.BytesIO(text),
                comments=None,
                delimiter=delimiter,
                usecols=wanted,
                ndmin=2,
                encoding="latin1",
            )
    except ValueError:
        table = _line_by_line(text, layout, wanted)
    return dict(zip(layout.columns, table.reshape(-1, len(wanted)).T, strict=True))


def _line_by_line(text: bytes, layout: _Layout, wanted: list[int]) -> Float:
    """Return the wanted columns of each line, shape (N, len(wanted)); NaN for a line without x, y and z."""
    rows = []
    for line in text.split(b"\n"):
        if not (stripped := line.strip()):
            continue
        if layout.count is not None and stripped.isdigit():
            continue  # the number of points of the next block
        cells = _cells(line, layout.separator)
        rows.append([_cell(cells, k) for k in wanted])
    return np.array(rows, np.float64).reshape(-1, len(wanted))


def _cell(cells: list[bytes], k: int) -> float:
    """Return a cell as a number, NaN if it is none or is missing."""
    try:
        return float(cells[k])
    except (ValueError, IndexError):
        return np.nan
