"""The SHA-256 of what a source reads, so that a result names exactly what it was made of."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

#: Above this many bytes (about 1 s of work) only the ends of each file are hashed, and the digest says so.
WHOLE_LIMIT = 1 << 30
_BLOCK = 1 << 20
_PARTIAL_ENDS = 16 << 20


def digest_of(paths: Sequence[Path], *, whole_limit: int = WHOLE_LIMIT) -> str:
    """SHA-256 (hex) of one file's contents, or of the names and contents of several.

    Args:
        paths: One file, or the files of a folder in the order in which they are read.
        whole_limit: Above this many bytes in all, only sizes and the first and last 16 MB of each
            file are hashed, and the digest begins with "partial:".

    Raises:
        OSError: A file cannot be read.
    """
    total = sum(path.stat().st_size for path in paths)
    state = hashlib.sha256()
    for path in paths:
        size = path.stat().st_size
        if len(paths) > 1 or total > whole_limit:
            state.update(f"{path.name}\0{size}\0".encode())
        with path.open("rb", buffering=0) as file:
            if total <= whole_limit:
                while block := file.read(_BLOCK):
                    state.update(block)
            else:
                state.update(file.read(_PARTIAL_ENDS))
                file.seek(max(size - _PARTIAL_ENDS, 0))
                state.update(file.read(_PARTIAL_ENDS))
    return state.hexdigest() if total <= whole_limit else f"partial:{state.hexdigest()}"
