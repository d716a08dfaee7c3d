"""Whole clouds of plots, read part by part: LAS, LAZ, E57, PLY, NumPy's arrays, PCD."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import SourceError
from pipeline.inventory.cloud import Cloud

LAS, E57 = b"LASF", b"ASTM-E57"
#: Whole clouds unless somebody says otherwise; one .pcd file is a scan unless somebody says otherwise.
SUFFIXES = (".las", ".laz", ".ply", ".npy", ".npz", ".e57")
READABLE = "LAS, LAZ, PLY, E57, .npy, .npz and PCD"


def is_cloud(uri: str) -> bool:
    """Whether it names a file that is taken for a whole cloud, by its first bytes or its name."""
    from pipeline.io.readers.point_files import MAGIC

    path = Path(uri).expanduser()
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except (OSError, ValueError, RuntimeError):
        return False
    return head.startswith((LAS, E57, *MAGIC[".ply"], *MAGIC[".npy"])) or path.suffix.lower() in SUFFIXES


def open_cloud(uri: str) -> Cloud:
    """Open a whole cloud.

    Raises:
        SourceError: It is not there, of a kind that cannot be read, or damaged.
    """
    from pipeline.io.readers.clouds.las import LasCloud
    from pipeline.io.readers.clouds.table_cloud import TableCloud

    try:
        path = Path(uri).expanduser()
        with path.open("rb") as file:
            head = file.read(8)
        if head == E57 or path.suffix.lower() == ".e57":
            from pipeline.io.readers.clouds.e57 import E57Cloud

            return E57Cloud(uri, path)
        is_las = head.startswith(LAS) or path.suffix.lower() in (".las", ".laz")
        return LasCloud(uri, path) if is_las else TableCloud(uri, path)
    except MemoryError:
        raise SourceError("it is too large for the memory of this machine", where=uri) from None
    except (OSError, ValueError, RuntimeError) as error:  # a path with a zero byte, a home of nobody
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights"
        ) from None
