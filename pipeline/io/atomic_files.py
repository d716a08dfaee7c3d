"""Atomic writing of files: a file is complete or does not exist."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import StemmapError

# Prefix of a folder in which files are written before all of them are complete.
UNFINISHED = ".unfinished-"


@contextmanager
def write_beside(path: Path) -> Iterator[Path]:
    """Write a temporary file and move it to its path when it is complete. An existing file at the path is
    replaced.

    Yields a path in the same folder; write and close that file. At the end of the block it is flushed to the
    disk and replaces `path` in one step; if the block raises, it is removed and `path` does not change.

    Raises:
        StemmapError: The folder does not exist, `path` is a folder, or writing fails. An OSError of the block
            is raised as StemmapError.
    """
    if not path.parent.is_dir():
        raise StemmapError(
            "there is no such folder to write to", where=str(path.parent), remedy="Create it or name another"
        )
    if path.is_dir():
        raise StemmapError("this is a folder, not a file", where=str(path), remedy="Name a file in it")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        _to_disk(partial)
        partial.replace(path)
        _to_disk(path.parent)
    except OSError as error:
        raise StemmapError(f"cannot write the file: {error.strerror or error}", where=str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


def write_texts(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts to files of a folder, each complete or unchanged; return their paths. The folder is created
    if necessary, and existing files are replaced.

    Args:
        folder: The folder.
        texts: Dict from names of files to their texts, which are written as UTF-8.

    Raises:
        OSError: The folder cannot be created.
        StemmapError: A file cannot be written; those before it stay written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with write_beside(folder / name) as partial:
            partial.write_text(text, encoding="utf-8", newline="")
    return [folder / name for name in texts]


def _to_disk(path: Path) -> None:
    """Wait until a file or folder is written to the disk, so that after a power cut either the old or the new
    file exists. Nothing for folders on Windows.

    Raises:
        OSError: The file or folder cannot be opened or written to the disk.
    """
    if path.is_dir() and os.name == "nt":
        return  # Windows cannot open folders
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
