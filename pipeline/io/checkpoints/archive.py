"""The file of a saved state: a zip with `tree.json`, which is words and numbers, and `arrays.bin`.

The same state gives the same bytes. What is read is held to what was declared before memory is taken.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from typing import Any

from pipeline.errors import StemmapError

TREE, ARRAYS = "tree.json", "arrays.bin"
LARGEST_TREE, LARGEST_ARRAYS = 64 << 20, 4 << 30  # bytes
MOST_RATIO, FREE = 100, 64 << 20  # a real state is packed to half; a small file unpacks to no gigabytes
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_archive(tree: Any, blob: bytes) -> bytes:  # noqa: ANN401 - any JSON
    """The file's bytes.

    Args:
        tree: JSON without NaN; blob: the arrays that it points into.
    """
    text = json.dumps(tree, allow_nan=False, separators=(",", ":")).encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in ((TREE, text), (ARRAYS, blob)):
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data, compresslevel=1)
    return file.getvalue()


def read_archive(data: bytes, where: str) -> tuple[Any, bytes]:
    """The tree and the arrays of a file.

    Raises:
        StemmapError: It is damaged, is something else, or declares more than a map can need.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            text = _entry(archive, TREE, LARGEST_TREE)
            blob = _entry(archive, ARRAYS, LARGEST_ARRAYS)
        return json.loads(text), blob
    except (zipfile.BadZipFile, zipfile.LargeZipFile, KeyError, ValueError, EOFError, OSError,
            NotImplementedError, RuntimeError, RecursionError, MemoryError, zlib.error) as error:  # fmt: skip
        raise damaged(where, str(error) or type(error).__name__) from None


def damaged(where: str, why: str) -> StemmapError:
    """What to say of a saved state that cannot be used."""
    return StemmapError(f"the saved state is damaged: {why}", where=where, remedy="Map the run again")


def _entry(archive: zipfile.ZipFile, name: str, largest: int) -> bytes:
    entry = archive.getinfo(name)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed in another way")
    declared = entry.file_size
    if declared > min(largest, FREE + MOST_RATIO * entry.compress_size):
        raise ValueError(f"{name} declares {declared} bytes")
    with archive.open(name) as file:
        data = file.read(declared + 1)
    if len(data) != declared:
        raise ValueError(f"{name} has not the size that it declares")
    return data
