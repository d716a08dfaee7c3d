"""Sources of records: `open_source` opens a file, a folder or a URI. Formats are detected by the contents
first, then by the names."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.errors import SourceError, UsageError
from pipeline.io.readers.base import Source, SourceDescription, SourceOptions
from pipeline.io.readers.message_formats import MessageFormat, ReadingFormat

if TYPE_CHECKING:
    from pipeline.io.readers.point_files import PointTable

__all__ = [
    "MessageFormat",
    "ReadingFormat",
    "Source",
    "SourceDescription",
    "SourceOptions",
    "open_source",
    "path_of",
]

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+]+):")
_LIVE = ("udp", "tcp", "ros2")
_FILE_SCHEME = re.compile(r"file:(//)?", re.IGNORECASE)


def open_source(uri: str, options: SourceOptions | None = None) -> Source:
    """Open a run to be read; close it after use.

    Args:
        uri: A simulated scenario ("sim:stand"), a file or a folder. The format is detected by the contents
            first, then by the name. A folder that is no run is the only recording or run in it (`runs_in`).
        options: Choices of the user; None for the defaults.

    Raises:
        SourceError: The file or folder does not exist, has an unknown format or is damaged, or the URI is
            that of a live robot.
        UsageError: The scheme of the URI is unknown, or its scenario or options are not valid.
    """
    chosen = options or SourceOptions()
    scheme = _SCHEME.match(uri)
    try:
        if scheme is not None and not Path(uri).exists():
            return _open_scheme(scheme.group(1).lower(), uri, chosen)
        path = Path(uri).expanduser()
        if path.is_dir() and folder_opener(path) is None:
            names = runs_in(path)
            if len(names) == 1:
                return open_source(str(path / names[0]), chosen)
        return _find_opener(path, uri)(uri, path, chosen)
    except RuntimeError as error:  # the home folder of an unknown user
        raise SourceError("there is no such user", where=uri, remedy="Look at the path.") from error
    except (OSError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or "too large for the memory of this machine"
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights."
        ) from error


def path_of(uri: str) -> str:
    """Return a URI without the scheme `file:` or `file://`; another text as it is."""
    scheme = _FILE_SCHEME.match(uri)
    return uri if scheme is None else uri[scheme.end() :]


def check_existence(uri: str) -> None:
    """Check that a URI without a scheme names a file or a folder; a URI with a scheme is not checked.

    Raises:
        SourceError: There is no such file or folder, or the path is not valid.
    """
    try:
        if _SCHEME.match(uri) is None and not Path(uri).expanduser().exists():
            raise _no_such_file(uri)
    except (RuntimeError, ValueError, OSError):  # an unknown home, a zero byte, a name that is too long
        raise _no_such_file(uri) from None


def _no_such_file(uri: str) -> SourceError:
    return SourceError("there is no such file or folder", where=uri, remedy="Look at the path.")


def _open_scheme(scheme: str, uri: str, options: SourceOptions) -> Source:
    """Open a source by the scheme of its URI: "sim" or "file".

    Raises:
        SourceError: The scheme is that of a live robot, or the source cannot be opened.
        UsageError: The scheme is unknown, or the scenario or its options are not valid.
    """
    kind = format_of_address(uri)
    if kind is not None:
        return kind.open(uri, Path(), options)
    if scheme == "sim":
        from pipeline.io.readers.simulated import open_simulated

        return open_simulated(uri, options)
    if scheme == "file":
        return open_source(path_of(uri), options)
    if scheme in ("zenoh", "velodyne"):
        raise SourceError("a live robot cannot be read as a file", where=uri, remedy="Watch it or map it.")
    if scheme in _LIVE:
        raise SourceError(
            f"this version does not read {scheme}: live",
            where=uri,
            remedy="ROS 2 is heard over Zenoh, as zenoh:tcp/host:7447; or record it and open the file.",
        )
    raise UsageError(f"unknown kind of source {scheme!r}", where=uri, remedy=readable())


def _find_opener(path: Path, uri: str) -> Opener:
    """Return the opener for a path. `uri` is the path as the user wrote it, for errors.

    Raises:
        SourceError: The path does not exist, is an empty file, is neither a file nor a folder, or has an
            unknown format.
        OSError: The file or folder cannot be read.
    """
    if "\0" in uri or not path.exists():
        raise _no_such_file(uri)
    if path.is_dir():
        opener = folder_opener(path)
        if opener is None:
            inside = named(runs_in(path))
            raise SourceError(
                "the folder is no run" if inside else "nothing in the folder can be read",
                where=uri,
                remedy=f"Open what is in it: {inside}." if inside else readable(),
            )
        return opener
    if not path.is_file():
        raise SourceError("neither a file nor a folder", where=uri, remedy=readable())
    head = head_of(path)
    if not head:
        raise SourceError(
            "the file is empty",
            where=uri,
            remedy="Compare it with the original: if that is empty too, nothing was recorded.",
        )
    kind = file_format(path, head)
    if kind is None:
        promised = expected_format(path)
        what = (
            f"the contents are not those of a {promised.words} file" if promised else "not a LiDAR recording"
        )
        raise SourceError(what, where=uri, remedy=readable())
    return opener_of(kind)


# --- formats ---------------------------------------------------------------------------------------

Opener = Callable[[str, Path, SourceOptions], Source]


def _later(module: str, function: str) -> Callable[..., Any]:
    """Return a function that imports `module` of this package and calls its `function` when a file is opened,
    so that formats which are not used are not imported."""
    return lambda *given: getattr(import_module(f"pipeline.io.readers.{module}"), function)(*given)


_recording: Opener = _later("live", "open_recording")
_scans: Opener = _later("scan_folder", "ScanFolder")


@dataclass(frozen=True, slots=True)
class Form:
    """What a file of points is.

    Attributes:
        is_cloud: Whether it is a whole cloud; else it is one scan.
        why: Reason for people, as the end of a sentence with "because"; "" if its points do not decide.
    """

    is_cloud: bool
    why: str = ""

    @property
    def words(self) -> str:
        """The decision, its reason and the flag that changes it."""
        forms = ("a whole cloud", "one scan (--as scan)"), ("one scan", "a whole cloud (--as cloud)")
        kind, other = forms[0 if self.is_cloud else 1]
        return f"taken as {kind}, because {self.why}; it can be read as {other}"


def form_of(path: Path, options: SourceOptions | None) -> Form:
    """Return whether a file of points is a whole cloud or one scan, see `Format.form`; a scan if no format
    opens whole clouds."""
    form = next((kind.form for kind in formats() if kind.form is not None), None)
    return Form(False) if form is None else form(path, options)


def _points(uri: str, path: Path, options: SourceOptions) -> Source:
    """Open a file of points: one scan, or a whole cloud as a run, by the format that does so."""
    if not form_of(path, options).is_cloud:
        return _scans(uri, path, options)
    return opener_of(next(kind for kind in formats() if kind.form is not None))(uri, path, options)


@dataclass(frozen=True, slots=True)
class Format:
    """A kind of file.

    Attributes:
        words: Name for the user.
        magic: Possible first bytes of the file; () if only its name identifies it.
        suffixes: Usual suffixes in lower case.
        open: Function of URI, path and options that opens the source; by default that of files of points.
        table: Opens the table of a file of points (`PointTable`): a whole cloud or one scan. None for others.
        scans: Name of such files if they may also be the scans of a drive in a folder, e.g. "PCD"; else "".
        accepts: Whether a file with these first bytes (up to _HEAD) is of this format, for a format without
            magic bytes whose suffixes others have, too; None for other formats.
        scheme: Beginning of the addresses that it opens, such as "sim:cloud"; "" for none. Options `file` and
            `truth` of such an address are files, which the dashboard lets only permitted people name.
        check: Raises UsageError for an address with other options; None for no check.
        form: Of the format that opens whole clouds as runs: returns whether a file of points is one, by the
            choices of the user, the format and the points; for None, whether the points of a file in a folder
            of scans are those of a cloud. None for other formats.
        is_folder: Whether a folder with files of these names is of this format; None for a format of files.
        refusal: Why it cannot be used, as the remedy of an error; "" if it can.
    """

    words: str
    magic: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    open: Opener = _points
    table: Callable[[Path], PointTable] | None = None
    scans: str = ""
    accepts: Callable[[bytes], bool] | None = None
    scheme: str = ""
    check: Callable[[str], object] | None = None
    form: Callable[[Path, SourceOptions | None], Form] | None = None
    is_folder: Callable[[Collection[str]], bool] | None = None
    refusal: str = ""


def format_of_address(uri: str) -> Format | None:
    """Return the format that opens an address, by its beginning up to "?"; None if there is none. Raises
    SourceError if it cannot be used."""
    beginning = uri.partition("?")[0]
    kind = next((kind for kind in formats() if kind.scheme and kind.scheme == beginning), None)
    if kind is not None and kind.refusal:
        raise SourceError(f"{kind.words} needs an extension", where=uri, remedy=kind.refusal)
    return kind


def opener_of(kind: Format) -> Opener:
    """Return the opener of a format; it raises a SourceError if the format cannot be used."""

    def refused(uri: str, path: Path, options: SourceOptions) -> Source:
        """Raise the error."""
        del path, options
        raise SourceError(f"{kind.words} needs an extension", where=uri, remedy=kind.refusal)

    return refused if kind.refusal else kind.open


FILES = (
    Format("ROS 2 .mcap", (b"\x89MCAP",), (".mcap",), _recording),
    Format("ROS 2 .db3", (b"SQLite format 3\x00",), (".db3",), _recording),
    Format("ROS 1 .bag", (b"#ROSBAG V",), (".bag",), _recording),
    Format("KITTI .bin", (), (".bin",), table=_later("point_files", "open_rows"), scans=".bin"),
    Format(
        ".pcd (whole cloud or scan)",
        (b"# .PCD", b"VERSION", b"FIELDS"),
        (".pcd",),
        table=_later("point_files", "open_pcd"),
        scans="PCD",
    ),
)

_MOST_NAMED = 5
AnyFormat = Format | MessageFormat | ReadingFormat
K = TypeVar("K")
_further: list[Callable[[], Iterable[AnyFormat]]] = []


def add_formats(further: Callable[[], Iterable[AnyFormat]]) -> None:
    """Add formats to those of this package, which go first. The function is called whenever a file is
    opened."""
    _further.append(further)


def formats() -> tuple[Format, ...]:
    """Return all formats of files and folders in the order in which they are tried."""
    return (*FILES, *added(Format))


def added(kind: type[K]) -> tuple[K, ...]:
    """Return the formats of a kind, for example `MessageFormat`, that were added."""
    return tuple(each for further in _further for each in further() if isinstance(each, kind))


def readable() -> str:
    """Return what can be opened, as the remedy of an error."""
    usable = [kind for kind in formats() if not kind.refusal]
    scans = ", ".join(dict.fromkeys(suffix for kind in usable if kind.scans for suffix in kind.suffixes))
    folders = (
        f"a folder of scans ({scans})",
        "a rosbag2 folder",
        "sim:stand and the other sim: scenarios.",
    )
    return "Supported formats: " + ", ".join([*(kind.words for kind in usable if not kind.form), *folders])


def file_format(path: Path, head: bytes) -> Format | None:
    """Return the format of a file, None if it is unknown. The first bytes decide; the suffix decides for .npz
    and for formats without magic bytes; of several with this suffix, or for an unknown suffix or none, the
    one that accepts the first bytes.

    Args:
        path: The file; it is not opened.
        head: First bytes of the file, as many as its first lines have.
    """
    if path.suffix.lower() == ".npz":  # a .zip by its contents
        return expected_format(path)
    for kind in formats():
        if any(head.startswith(mark) for mark in kind.magic):
            return kind
    expected, suffix = expected_format(path), path.suffix.lower()
    if expected is not None and expected.magic:
        return None
    kinds = (kind for kind in formats() if expected is None or suffix in kind.suffixes)
    return next((kind for kind in kinds if kind.accepts is not None and kind.accepts(head)), expected)


_HEAD = 64 << 10  # bytes by which a format is found


def head_of(path: Path) -> bytes:
    """Return the first bytes of a file; OSError if it cannot be read."""
    with path.open("rb") as file:
        return file.read(_HEAD)


def expected_format(path: Path) -> Format | None:
    """Return the format by the suffix of a file, in upper or lower case; None for another suffix."""
    suffix = path.suffix.lower()
    return next((kind for kind in formats() if suffix in kind.suffixes), None)


def points_format(uri: str) -> Format | None:
    """Return the format of a file of points by its first bytes or its name; None for other files and for one
    that cannot be read."""
    try:
        path = Path(uri).expanduser()
        kind = file_format(path, head_of(path)) or expected_format(path)
    except (OSError, ValueError, RuntimeError):
        return None
    return kind if kind is not None and kind.table is not None else None


def is_recording(path: Path) -> bool:
    """Return whether a file is a run or a cloud by its suffix, and where others have it, too, by its first
    bytes; False for one that cannot be read, and for a format that cannot be used."""
    expected = expected_format(path)
    if expected is None or expected.refusal or expected.accepts is None:
        return expected is not None and not expected.refusal
    try:
        return expected.accepts(head_of(path))
    except OSError:
        return False


def recordings_in(folder: Path) -> list[str]:
    """Return the sorted names of the files in a folder (not in folders in it) that are runs or clouds, see
    `is_recording`; OSError if it cannot be read."""
    return sorted(path.name for path in folder.iterdir() if path.is_file() and is_recording(path))


def runs_in(folder: Path) -> list[str]:
    """Return the names of the runs in a folder that is no run itself. A single recording is the only run,
    whatever folders are beside it; otherwise all recordings and folders with runs are returned. OSError if
    the folder cannot be read."""
    names = recordings_in(folder)
    return names if len(names) == 1 else names + folders_of_runs(folder)


def folders_of_runs(folder: Path) -> list[str]:
    """Return the sorted names, with a slash, of the folders in a folder that are runs or contain recordings
    or runs, also one level below. Left out are folders of results (with run.json), and those that cannot be
    read; no file is opened, so that texts do not count. OSError if the folder itself cannot be read."""
    return sorted(f"{path.name}/" for path in folder.iterdir() if _has_runs(path, levels=2))


def _has_runs(folder: Path, levels: int) -> bool:
    """Return whether a path is a folder that is a run or contains recordings or runs, up to some levels."""
    with suppress(OSError):
        if levels and folder.is_dir() and not (folder / "run.json").is_file():
            return (
                folder_opener(folder) is not None
                or any(_is_recording_by_name(path) and path.is_file() for path in folder.iterdir())
                or any(_has_runs(path, levels - 1) for path in folder.iterdir())
            )
    return False


def _is_recording_by_name(path: Path) -> bool:
    """Return whether a file is a run or a cloud by its suffix alone."""
    expected = expected_format(path)
    return expected is not None and not expected.refusal and expected.accepts is None


def named(names: list[str]) -> str:
    """Return the first five names as text for a message, with the number of the others; "" if there are no
    names."""
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def folder_opener(folder: Path) -> Opener | None:
    """Return the opener of a folder by the names of the files in it, and of `velodyne/*.bin`; None if nothing
    in it can be read, or it has several ROS recordings without metadata.yaml, which are runs of their own.
    Where several formats fit, the order is formats that were added, ROS recording, scans, added formats that
    cannot be used. OSError if the folder cannot be read."""
    names = {path.name for path in folder.iterdir() if path.is_file()}
    added = [kind for kind in formats() if kind.is_folder is not None and kind.is_folder(names)]
    usable = [kind for kind in added if not kind.refusal]
    if usable:
        return usable[0].open
    suffixes = [Path(name).suffix.lower() for name in names]
    bags = suffixes.count(".mcap") + suffixes.count(".db3")
    if bags > 1 and "metadata.yaml" not in names:
        return None
    if bags or ".zstd" in suffixes:
        return _recording
    inside = folder / "velodyne"
    is_kitti = inside.is_dir() and any(inside.glob("*.bin"))
    of_scans = [kind for kind in formats() if kind.scans and not set(kind.suffixes).isdisjoint(suffixes)]
    if is_kitti or not all(kind.refusal for kind in of_scans):
        return _scans
    return next((opener_of(kind) for kind in (*of_scans, *added)), None)
