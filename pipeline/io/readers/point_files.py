"""Point files as tables with one column per value: PCD, .bin, and the parts of other formats.

A table is read part by part (a whole cloud) or at once (a scan). Headers are compared with the size of the
file before memory is taken. The reader of PCD is our own: Open3D ends the process on some damaged PCD files
and returns an empty cloud for others.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Pose3
from pipeline.io.readers import expected_format, file_format, head_of, readable
from pipeline.io.readers.base import COORDINATE_LIMIT, count_loss
from pipeline.io.readers.pose_files import read_rows
from pipeline.io.readers.scan_columns import POINT_LIMIT
from pipeline.jit import compiled
from pipeline.types.records import Float

Columns = dict[str, NDArray[np.generic]]

PART = 1 << 18  # points
MOST_POINTS = 2_000_000_000
STEP_LIMIT = 64 << 10  # bytes per point
#: Largest compressed PCD data, which is held in memory as a whole.
WHOLE_LIMIT = 1 << 30  # bytes
MISSING = "points that the files promise but do not hold"
MOST_FIELDS = 1000


REMEDY = "Copy the file again, or export it again"  # of a damaged file
EXPORT = "Export it with x, y and z, as .laz or .ply"  # of a sound file with other contents
#: Reason and remedy of a cloud whose positions are longitudes and latitudes.
DEGREES = (
    "its positions are degrees of longitude and latitude",
    "Convert it to a projected reference system in metres, such as the UTM zone of the plot",
)


class ScanFileError(Exception):
    """A file does not hold a scan or a cloud.

    Args:
        what: The reason, the message of the error.
        remedy: What a person can do, one sentence.
    """

    def __init__(self, what: str, remedy: str = REMEDY) -> None:
        self.remedy = remedy
        super().__init__(what)


@contextmanager
def errors_as_damage(what: str) -> Iterator[None]:
    """Raise any exception of a library as ScanFileError with the text `what` and the reason; ScanFileError
    and OSError pass unchanged."""
    try:
        yield
    except (ScanFileError, OSError):
        raise
    except BaseException as error:
        # A panic of the LAZ decoder is no Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise ScanFileError(f"{what}: {reason}") from None


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """A point file with a valid header.

    Attributes:
        kind: Name of the format, e.g. "PLY binary".
        points: Number of points by the header.
        names: Names of the columns with one number per point, in lower case; x, y and z are among them.
        read: Function that yields the points in parts, dicts from names to columns of equal length, from the
            point with the given index on, or, where the format cannot skip, from an earlier one. Numbers need
            not be finite. It may raise any exception at damaged data; see `parts`.
        attributes: Names of the values of a point that are not read, besides its coordinates.
        crs: Coordinate reference system as WKT or "EPSG:32632"; empty when unknown.
        low, high: Corners by the header, shape (3,) [m]; not checked. None if unknown.
        cut_above: Whether the field of view of a sensor cuts the trees, as in the cloud of a drive.
        invalid: What is counted for a point whose coordinates are not finite or too large.
        has_voids: Whether a point with NaN is stated by the file to be none, which is not counted.
        starts: Points from which `read` can begin without reading those before; () for any.
        units: Units of x and y, and of z, by the file itself, as in `SourceOptions`; "" if it names none.
        exact: Whether `points` is a number that the file promises, and no estimate.
        view: Pose of the sensor by the file (PCD); None if it names none or the identity.
        height: Rows of an organised cloud; 1 for others.
    """

    kind: str
    points: int
    names: tuple[str, ...]
    read: Callable[[int], Iterator[Columns]]
    attributes: tuple[str, ...] = ()
    crs: str = ""
    low: Float | None = None
    high: Float | None = None
    cut_above: bool = False
    invalid: str = "points without coordinates"
    has_voids: bool = False
    starts: tuple[int, ...] = ()
    units: tuple[str, str] = ("", "")
    exact: bool = True
    view: Pose3 | None = None
    height: int = 1

    def parts(self, begin: int = 0) -> Iterator[Columns]:
        """Yield the points in parts from the point `begin` on, see `read`. Of a file that is cut or damaged,
        or cannot be read on, the points before that place are yielded.

        Raises:
            ScanFileError: The data is damaged before its first point.
            OSError: The file cannot be read before its first point.
        """
        read = 0
        try:
            with errors_as_damage("its data is damaged"):
                for part in self.read(begin):
                    read += len(part["x"])
                    yield part
        except (ScanFileError, OSError):
            if read == 0:
                raise


def open_table(path: Path) -> PointTable:
    """Return the table of a file, whose format is found by its contents, then by its name; only the header is
    read.

    Raises:
        ScanFileError: The file has an unknown format, or one that cannot be used, contradicts itself, or has
            no x, y and z.
        OSError: The file cannot be read.
    """
    kind = file_format(path, head_of(path)) or expected_format(path)
    if kind is None or kind.table is None:
        raise ScanFileError("not a file of points", readable())
    if kind.refusal:
        raise ScanFileError(f"{kind.words} needs an extension", kind.refusal)
    return kind.table(path)


_ROW = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])


def open_rows(path: Path) -> PointTable:
    """Return the table of a .bin file of KITTI: rows of x, y, z and reflectance as float32, without a header.

    Raises:
        ScanFileError: It is too large, or shorter than a point.
        OSError: The file cannot be read.
    """
    return rows_table(path, "KITTI .bin", _ROW)


def rows_table(path: Path, kind: str, dtype: np.dtype[Any]) -> PointTable:
    """Return the table of rows without a header, see `open_rows`. An incomplete last row is a promised point,
    which its reader counts as missing."""
    size = path.stat().st_size
    return binary_table(path, kind, -(-size // dtype.itemsize), [Stream(0, dtype, size)])


def read_columns(table: PointTable, losses: dict[str, int]) -> Columns:
    """Return a dict from the names of the columns of a table to the columns, shape (N,) each; of a damaged
    file, with the points before the damage.

    Args:
        table: The table.
        losses: Dict from reasons to numbers; the number of points in the header that the file does not have
            is added in place.

    Raises:
        ScanFileError: The header has more than POINT_LIMIT points, or none of its points can be read. A
            header with 0 points gives empty columns.
        OSError: The file cannot be read.
    """
    if table.points > POINT_LIMIT:
        raise ScanFileError(f"its header promises {table.points} points, too many for one scan")
    parts = list(table.parts())
    columns = {
        name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0) for name in table.names
    }
    read = len(columns["x"])
    if read < table.points:
        count_loss(losses, MISSING, table.points - read)
    return columns


def column_names(fields: list[str]) -> list[str]:
    """Return the names of columns in lower case without the prefix "scalar_" of CloudCompare. Empty and
    repeated names, and "_", become "*" and the index of the column; such columns are not used."""
    names: list[str] = []
    for k, field in enumerate(fields):
        name = field.lower().removeprefix("scalar_")
        names.append(f"*{k}" if name in ("", "_", *names) else name)
    return names


def usable_names(names: list[str]) -> tuple[str, ...]:
    """Return the names of the columns that can be used, in their order: those that do not begin with "*".

    Raises:
        ScanFileError: x, y or z is missing.
    """
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise ScanFileError(f"its points have no {' and no '.join(missing)}", EXPORT)
    return tuple(name for name in names if not name.startswith("*"))


def check_size(points: int, step: int) -> None:
    """Check the number of points and the bytes of one point in a header.

    Raises:
        ScanFileError: There are not 0 to MOST_POINTS points of 1 to STEP_LIMIT bytes.
    """
    if not 0 <= points <= MOST_POINTS or not 0 < step <= STEP_LIMIT:
        raise ScanFileError(f"its header promises {points} points of {step} bytes, too many to be read")


# --- data ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Stream:
    """Binary records of the points, or of some of their columns.

    Attributes:
        start: Offset of the first byte in the file that `open` opens.
        dtype: Type of one record.
        room: Size of that file [bytes].
    """

    start: int
    dtype: np.dtype[Any]
    room: int

    def open(self, path: Path, stack: ExitStack) -> IO[bytes]:
        """Return the file with the records, which the stack closes."""
        return stack.enter_context(path.open("rb"))

    def records(self, path: Path, points: int, stack: ExitStack, begin: int) -> Iterator[NDArray[Any]]:
        """Yield the records of the points part by part, as structured arrays of shape (n,).

        Args:
            path: The file.
            points: Number of points by the header. If the file has fewer, only whole records are yielded.
            begin: The first point that is read.
            stack: Stack on which the file is opened; the caller closes it.

        Raises:
            Exception: The file cannot be read.
        """
        file, step = self.open(path, stack), self.dtype.itemsize
        file.seek(self.start + begin * step)
        points -= begin
        rows = max(1, min(PART, (16 << 20) // step))
        while points > 0:
            block = file.read(min(rows, points) * step)
            whole = len(block) // step
            if whole:
                yield np.frombuffer(block, self.dtype, whole)
            if whole * step < len(block) or not whole:
                return
            points -= whole


def binary_table(
    path: Path, kind: str, points: int, streams: Sequence[Stream], starts: tuple[int, ...] = ()
) -> PointTable:
    """Return the table of streams with the same points.

    Args:
        path: The file.
        kind: Name of the format.
        points: Number of points by the header.
        streams: Records of the points; several streams have different columns.
        starts: As in `PointTable`.

    Raises:
        ScanFileError: x, y or z is missing, sizes are too large, or the file ends before its first point.
    """
    usable = usable_names([name for stream in streams for name in stream.dtype.names or ()])
    for stream in streams:
        check_size(points, stream.dtype.itemsize)
        if points and stream.start + stream.dtype.itemsize > stream.room:
            raise ScanFileError("it ends before its first point")

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the points in parts, see `PointTable`."""
        with ExitStack() as stack:
            for records in zip(*(s.records(path, points, stack, begin) for s in streams), strict=False):
                n = min(map(len, records))
                columns = {name: part[name][:n] for part in records for name in part.dtype.names or ()}
                yield {name: columns[name] for name in usable}

    return PointTable(kind, points, usable, read, starts=starts)


def text_table(
    path: Path, kind: str, points: int, dtype: np.dtype[Any], start: int, skipped: int = 0, more: bool = False
) -> PointTable:
    """Return the table of lines of text. Damaged lines are left out of its parts; these raise ScanFileError
    if no line is valid.

    Args:
        path: The file.
        kind: Name of the format.
        points: Number of points by the header.
        dtype: Types of the numbers of a point; a field of several values has its count as shape.
        start: Offset of the first byte after the header.
        skipped: Number of lines before the points.
        more: Whether a line may have further numbers, as those of a list.

    Raises:
        ScanFileError: x, y or z is missing, sizes are too large, or the file is too short.
    """
    usable = usable_names(list(dtype.names or ()))
    check_size(points, dtype.itemsize)
    counts = [int(np.prod(dtype[name].shape)) for name in dtype.names or ()]
    first = dict(zip(dtype.names or (), np.cumsum([0, *counts]).tolist(), strict=False))
    # A point needs a digit and a separator per number.
    if points and start + skipped + 2 * sum(counts) > path.stat().st_size + 1:
        raise ScanFileError("it ends before its first point")

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield all points in parts, see PointTable; damaged lines are left out.

        Raises:
            ScanFileError: There should be points, and no line is valid.
            OSError: It cannot be read.
        """
        del begin  # see `starts`
        with path.open("rb") as file:
            file.seek(start)
            for _ in range(skipped):
                file.readline()
            at, rows = file.tell(), None
            for rows in read_rows(file, sum(counts), points, more=more):
                yield {name: _as_type(rows[:, first[name]], dtype[name]) for name in usable}
            if rows is None and points:
                file.seek(at)
                numbers = len(next((words for line in file if (words := line.split())), []))
                raise ScanFileError(f"its rows have {numbers} numbers, its header names {sum(counts)}")

    return PointTable(kind, points, usable, read, starts=(0,))


def _as_type(numbers: NDArray[np.float64], dtype: np.dtype[Any]) -> NDArray[np.generic]:
    """Return numbers of a text file, shape (N,), as the type of the header: floating numbers unchanged as
    float64; integers truncated and clipped to the range of the type (for 8 bytes, to half of its largest
    number), NaN as 0."""
    if dtype.kind == "f":
        return numbers
    bounds = np.iinfo(dtype)
    high = bounds.max / 2 if dtype.itemsize == 8 else bounds.max
    return np.clip(np.nan_to_num(numbers), bounds.min, high).astype(dtype)


# --- PCD (Point Cloud Library), version 0.7 --------------------------------------------------------

_PCD_TYPES = {("F", 4): "<f4", ("F", 8): "<f8"}
_PCD_TYPES |= {(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}


def open_pcd(path: Path) -> PointTable:
    """Return the table of a PCD file.

    Raises:
        ScanFileError: The header is damaged, lacks x, y or z, or promises too many points, or packed data of
            more than WHOLE_LIMIT bytes.
        OSError: The file cannot be read.
    """
    dtype, points, data, start, height, view = _pcd_header(head_of(path))
    kind = f"PCD {data}"
    if data == "ascii":
        return replace(text_table(path, kind, points, dtype, start), view=view, height=height)
    if data == "binary":
        table = binary_table(path, kind, points, [Stream(start, dtype, path.stat().st_size)])
        return replace(table, view=view, height=height)
    usable = usable_names(list(dtype.names or ()))
    if points * dtype.itemsize > WHOLE_LIMIT:
        raise ScanFileError("its packed data is too large", "Write it as DATA binary")

    def read(begin: int = 0) -> Iterator[Columns]:
        """Yield the points as one part. The data has one field after the other, each with all points.

        Raises:
            ScanFileError: The packed data is missing, cut, or of another size than in the header.
            OSError: It cannot be read.
        """
        del begin
        with path.open("rb") as file:
            file.seek(start)
            body = file.read(min(WHOLE_LIMIT, path.stat().st_size))  # read() takes memory for all it may
        if len(body) < 8:
            raise ScanFileError("its packed data is missing")
        packed, size = struct.unpack_from("<II", body)
        if size != points * dtype.itemsize or packed > len(body) - 8:
            raise ScanFileError("its packed data is cut or has another size than the header promises")
        raw = lzf_decompress(memoryview(body)[8 : 8 + packed], size)
        lengths = [dtype[name].itemsize * points for name in dtype.names or ()]
        fields = dict(zip(dtype.names or (), np.split(raw, np.cumsum(lengths)[:-1]), strict=True))
        columns = {name: fields[name].view(dtype[name]) for name in usable}
        for first in range(0, points, PART):
            yield {name: column[first : first + PART] for name, column in columns.items()}

    return PointTable(kind, points, usable, read, starts=(0,), view=view, height=height)


def _pcd_header(head: bytes) -> tuple[np.dtype[np.void], int, str, int, int, Pose3 | None]:
    """Return the type of a point, the number of points, the kind of the data ("ascii", "binary" or
    "binary_compressed"), the length of the header [bytes], the rows of an organised cloud, and the pose of
    the sensor (None for the identity or a damaged one). A field of several values has its count as shape, and
    a name that is not used.

    Raises:
        ScanFileError: The bytes are not a header of a PCD file, or the header contradicts itself.
    """
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = head.find(b"\n", at)
        if end < 0:
            raise ScanFileError("it has no header of a PCD file")
        words = head[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        fields, data = entries["FIELDS"], entries["DATA"][0].lower()
        sizes = [whole_number(word) for word in entries["SIZE"]]
        counts = [whole_number(word) for word in entries.get("COUNT", ["1"] * len(fields))]
        if not len(fields) == len(sizes) == len(entries["TYPE"]) == len(counts) <= MOST_FIELDS:
            raise ScanFileError("its header names another number of fields than of sizes, types or counts")
        types = [_PCD_TYPES[kind, size] for kind, size in zip(entries["TYPE"], sizes, strict=True)]
        width, height = whole_number(entries["WIDTH"][0]), whole_number(entries.get("HEIGHT", ["1"])[0])
        points = whole_number(entries["POINTS"][0]) if "POINTS" in entries else width * height
    except (KeyError, IndexError, ValueError) as error:
        raise ScanFileError(f"its header is damaged at {error}") from error
    if points != width * height:
        raise ScanFileError(f"its header promises {points} points and {width} x {height}")
    if data not in ("ascii", "binary", "binary_compressed"):
        raise ScanFileError(f"its data is of the unknown kind {data[:20]!r}")
    check_size(points, sum(size * count for size, count in zip(sizes, counts, strict=True)))
    names = column_names(fields)
    for axis in "xyz":
        column = names.index(axis) if axis in names else -1
        if column < 0 or counts[column] != 1:
            raise ScanFileError(f"it has no field {axis}", EXPORT)
    parts = [
        (name, kind) if count == 1 else (f"*{name}", kind, (count,))
        for name, kind, count in zip(names, types, counts, strict=True)
    ]
    return np.dtype(parts), points, data, at, height, _view(entries.get("VIEWPOINT", []))


def _view(words: list[str]) -> Pose3 | None:
    """Return the pose of the words x y z qw qx qy qz; None for the identity and for other words."""
    try:
        numbers = np.array([float(word) for word in words], np.float64)
        if numbers.shape != (7,) or not (np.abs(numbers) < COORDINATE_LIMIT).all():
            return None
        pose = Pose3.from_quaternion(numbers[:3], numbers[3:])
    except ValueError:
        return None
    return None if np.allclose(pose.t, 0.0) and np.allclose(pose.R, np.eye(3)) else pose


def whole_number(word: str) -> int:
    """Return the integer of a word of up to 18 decimal digits.

    Raises:
        ValueError: The word is not such a number.
    """
    if not word.isdecimal() or len(word) > 18:
        raise ValueError(word[:20])
    return int(word)


def lzf_decompress(block: bytes | memoryview, size: int) -> NDArray[np.uint8]:
    """Return the `size` decompressed bytes of an LZF block, uint8, shape (size,).

    Raises:
        ScanFileError: The block is damaged or has another size.
    """
    if size > 88 * (len(block) + 1):  # three bytes of LZF give at most 264 bytes
        raise ScanFileError("the packed data cannot grow to the size in its header")
    unpacked = np.empty(size, dtype=np.uint8)
    if _unpack_lzf(np.frombuffer(block, dtype=np.uint8), unpacked) != size:
        raise ScanFileError("the packed data is damaged")
    return unpacked


@compiled
def _unpack_lzf(block: NDArray[np.uint8], unpacked: NDArray[np.uint8]) -> int:
    """Decompress an LZF block into `unpacked`. Return the number of bytes written, -1 if the block refers to
    bytes outside of either array."""
    at, out = 0, 0
    while at < len(block):
        control = int(block[at])
        at += 1
        if control < 32:
            run = control + 1
            if at + run > len(block) or out + run > len(unpacked):
                return -1
            for k in range(run):
                unpacked[out + k] = block[at + k]
            at += run
        else:
            run = control >> 5
            if run == 7:
                if at >= len(block):
                    return -1
                run += int(block[at])
                at += 1
            if at >= len(block):
                return -1
            source = out - ((control & 31) << 8) - int(block[at]) - 1
            at += 1
            run += 2
            if source < 0 or out + run > len(unpacked):
                return -1
            # Source and target may overlap, which repeats bytes, so they are copied one by one.
            for k in range(run):
                unpacked[out + k] = unpacked[source + k]
        out += run
    return out
