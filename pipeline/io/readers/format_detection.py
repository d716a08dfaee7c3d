"""Formats of files and folders, detected by their contents first, then by their names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from pipeline.io.readers.base import Source, SourceOptions

Opener = Callable[[str, Path, SourceOptions], Source]


def _opener(module: str, function: str) -> Opener:
    """Return a function that imports `module` of this package and calls its `function` when a file is
    opened."""

    def opened(uri: str, path: Path, options: SourceOptions) -> Source:
        found: Opener = getattr(import_module(f"pipeline.io.readers.{module}"), function)
        return found(uri, path, options)

    return opened


_recording = _opener("live", "open_recording")
_kitti = _opener("scan_folder", "open_kitti")
_pcd = _opener("scan_folder", "open_pcd")
_scan_tables = _opener("scan_folder", "open_table_scans")
_cloud = _opener("simulated", "open_cloud_drive")
_tree_manager = _opener("tree_manager", "TreeManagerSource")


@dataclass(frozen=True, slots=True)
class Format:
    """A kind of file.

    Attributes:
        words: Name for the user.
        magic: First bytes of the file; () when only its name identifies it.
        suffixes: Usual suffixes in lower case.
        open: Opens the source.
        is_cloud: Whether it is a whole cloud.
    """

    words: str
    magic: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    open: Opener
    is_cloud: bool = False


FILES = (
    Format("ROS 2 .mcap", (b"\x89MCAP",), (".mcap",), _recording),
    Format("ROS 2 .db3", (b"SQLite format 3\x00",), (".db3",), _recording),
    Format("ROS 1 .bag", (b"#ROSBAG V",), (".bag",), _recording),
    Format(
        "Velodyne .pcap",
        (
            b"\xd4\xc3\xb2\xa1",
            b"\xa1\xb2\xc3\xd4",
            b"\x4d\x3c\xb2\xa1",
            b"\xa1\xb2\x3c\x4d",
            b"\x0a\x0d\x0d\x0a",
        ),
        (".pcap",),
        _opener("velodyne", "PcapSource"),
    ),
    Format(
        "Victoria Park .zip (LASER.txt, DRS.txt)",
        (b"PK\x03\x04",),
        (".zip",),
        _opener("victoria_park", "VictoriaParkSource"),
    ),
    Format(".pcd", (b"# .PCD", b"VERSION", b"FIELDS"), (".pcd",), _pcd),
    Format("whole cloud .laz or .las", (b"LASF",), (".laz", ".las"), _cloud, is_cloud=True),
    Format("whole cloud .e57", (b"ASTM-E57",), (".e57",), _cloud, is_cloud=True),
    Format("whole cloud .ply", (b"ply\n", b"ply\r"), (".ply",), _cloud, is_cloud=True),
    Format("whole cloud .npy or .npz", (b"\x93NUMPY",), (".npy", ".npz"), _cloud, is_cloud=True),
    Format("KITTI .bin", (), (".bin",), _kitti),
)

_MOST_NAMED = 5
READABLE = ", ".join(
    [kind.words for kind in FILES]
    + [
        "a folder of .bin, .pcd, .ply, .npy, .npz, .las or .laz scans",
        "a rosbag2 folder",
        "a folder of TreeManagerState_<i>.csv with trajectory.txt",
        "sim:stand and the other sim: scenarios",
    ]
)


def file_format(path: Path, head: bytes) -> Format | None:
    """Return the format of a file, None if it is unknown.

    Args:
        path: The file; its name decides for formats without magic bytes.
        head: Its first bytes.
    """
    if path.suffix.lower() == ".npz":  # a .zip by its contents
        return expected_format(path)
    for kind in FILES:
        if any(head.startswith(mark) for mark in kind.magic):
            return kind
    suffix = path.suffix.lower()
    return next((kind for kind in FILES if not kind.magic and suffix in kind.suffixes), None)


def expected_format(path: Path) -> Format | None:
    """Return the format by the suffix of a file."""
    return next((kind for kind in FILES if path.suffix.lower() in kind.suffixes), None)


def recordings_in(folder: Path) -> list[str]:
    """Return the names of the files in a folder that are runs or clouds by their suffixes."""
    return sorted(path.name for path in folder.iterdir() if path.is_file() and expected_format(path))


def named(names: list[str]) -> str:
    """Return the first few names as text for a message."""
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def folder_opener(folder: Path) -> Opener | None:
    """Return the opener of a folder, None when nothing in it can be read."""
    names = {path.name for path in folder.iterdir() if path.is_file()}
    if any(name.startswith("TreeManagerState_") for name in names):
        return _tree_manager
    suffixes = {Path(name).suffix.lower() for name in names}
    if suffixes & {".mcap", ".db3", ".zstd"}:
        return _recording
    inside = folder / "velodyne"
    if ".bin" in suffixes or (inside.is_dir() and any(inside.glob("*.bin"))):
        return _kitti
    if ".pcd" in suffixes:
        return _pcd
    return _scan_tables if suffixes & {".ply", ".npy", ".npz", ".las", ".laz"} else None
