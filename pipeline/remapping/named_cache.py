"""What is kept of a recording's scans, in a file that the next opening of the recording finds again.

The file begins with who may read it: the digest of the recording, how its steps are made, and the code that
looked at the scans. Any of these another, and it is begun anew. Then follow the scans, each with a row that
says how long it is and bears a sum of its own, so that a file that was cut or damaged is good up to there.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pipeline
from pipeline.io.atomic_files import hold, is_held
from pipeline.remapping.packing import HEAD

KEY = 16
ROW = np.dtype(
    [("at", "<i8"), ("length", "<i8"), ("crc", "<u4"), ("key", f"V{KEY}"), ("head", HEAD), ("sum", "<u4")]
)
MOST_IN_FOLDER = 8 << 30
SUFFIX = ".scans"
_MAGIC = b"stemmap scans 2\n"
BEGIN = len(_MAGIC) + 32

OTHER = "what was kept of this recording is of another version or source: its scans are looked at again"
CUT = "what was kept of this recording is cut or damaged from scan {} on: they are looked at again"


@dataclass(frozen=True, slots=True)
class Name:
    """Where scans are kept, and who may read them.

    Attributes:
        folder: Made when it is needed.
        identity: Of recording, steps and code, 32 bytes.
    """

    folder: Path
    identity: bytes

    @property
    def path(self) -> Path:
        """Of the file; of one recording there is one, whatever the version."""
        return self.folder / (self.identity[:16].hex() + SUFFIX)


def name_of(folder: Path, digest: str, steps: str) -> Name:
    """The name of a recording.

    Args:
        folder: For all recordings.
        digest: Of what is read.
        steps: How it becomes steps: odometry, seed.
    """
    source = hashlib.sha256(f"{digest}\n{steps}".encode()).digest()
    return Name(folder, source[:16] + hashlib.sha256(source + _code()).digest()[:16])


def open_named(name: Name) -> tuple[Any, NDArray[Any], str]:
    """The file, held by this process; the rows of the scans that are whole in it; and what a person should
    know of the others.

    Raises:
        OSError: The disk refuses, or another process has it.
    """
    name.folder.mkdir(parents=True, exist_ok=True)
    _make_room(name)
    descriptor = os.open(name.path, os.O_RDWR | os.O_CREAT, 0o600)
    file = os.fdopen(descriptor, "r+b", buffering=0)
    try:
        hold(file)
        size = os.fstat(descriptor).st_size
        if size and file.read(BEGIN) == _MAGIC + name.identity:
            rows, end = _rows(file, size)
            file.truncate(end)
            return file, rows, CUT.format(len(rows)) if end < size else ""
        file.truncate(0)
        file.seek(0)
        file.write(_MAGIC + name.identity)
    except OSError:
        file.close()
        raise
    return file, np.zeros(0, ROW), OTHER if size else ""


def sealed(row: Any) -> bytes:  # noqa: ANN401 - of ROW
    """The bytes of a row with their sum."""
    row["sum"] = 0
    row["sum"] = zlib.crc32(row.tobytes())
    told: bytes = row.tobytes()
    return told


def _rows(file: Any, size: int) -> tuple[NDArray[Any], int]:  # noqa: ANN401 - a file
    """The rows up to the first that is not whole, and where that one begins."""
    rows: list[NDArray[Any]] = []
    at = BEGIN
    while at + ROW.itemsize <= size:
        file.seek(at)
        told = file.read(ROW.itemsize)
        if len(told) < ROW.itemsize:
            break
        row = np.frombuffer(bytearray(told), ROW)
        wanted = row["sum"][0]
        sealed(row)
        first, length = at + ROW.itemsize, int(row["length"][0])
        whole = row["sum"][0] == wanted and row["at"][0] == first and row["head"]["index"][0] == len(rows)
        if not whole or length < 0 or first + length > size:
            break
        rows.append(row)
        at = first + length
    return np.concatenate([np.zeros(0, ROW), *rows]), at


def _make_room(name: Name) -> None:
    """Forget the recordings that were opened longest ago, where all together take too much."""
    sizes: list[tuple[float, int, Path]] = []
    for path in name.folder.glob(f"*{SUFFIX}"):
        with contextlib.suppress(OSError):
            told = path.stat()
            sizes.append((told.st_mtime, told.st_size, path))
    total = sum(size for _, size, _ in sizes)
    for _, size, path in sorted(sizes):
        if total <= MOST_IN_FOLDER:
            return
        if path != name.path and not is_held(path):
            path.unlink(missing_ok=True)
            total -= size


@cache
def _code() -> bytes:
    """Of all sources of the pipeline: what they look for in a scan may change with any of them."""
    folder = Path(pipeline.__file__).parent
    state = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        state.update(path.relative_to(folder).as_posix().encode())
        state.update(path.read_bytes())
    return state.digest()
