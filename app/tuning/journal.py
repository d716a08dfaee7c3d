"""Optuna's journal, written without waiting for the disk."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from app.tuning.storage import unreadable, unwritable

_PART = 1 << 16


class Journal(JournalFileBackend):  # type: ignore[misc]
    """A journal that survives a process that is killed. A trial takes a dozen lines, and with a disk that is
    waited for after each it took longer than mapping a short run; what a power cut takes is made again.

    Args:
        path: Of the file.
    """

    def __init__(self, path: str) -> None:
        super().__init__(path, lock_obj=JournalFileOpenLock(path))
        self._file = Path(path)

    def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:
        """The lines from one on.

        Raises:
            StemmapError: They cannot be read, as of a file that somebody took away.
        """
        try:
            yield from super().read_logs(log_number_from)
        except OSError as error:
            raise unreadable(str(self._file), error) from None

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Add lines, all at once or none of them.

        Raises:
            StemmapError: The disk refuses, as a full one does.
        """
        text = "".join(f"{json.dumps(log, separators=(',', ':'))}\n" for log in logs)
        try:
            with _alone_with(self._file) as file:
                _cut(file)
                _append(file, text.encode())
        except OSError as error:
            raise unwritable(str(self._file), error) from None


def cut_half_line(path: Path) -> None:
    """A last line without an end is of a process that was killed while it wrote: the trial that it told of is
    made again."""
    with path.open("rb") as file:
        if _is_whole(file):
            return
    with _alone_with(path) as file:  # looked at again: another process may have been writing
        _cut(file)


@contextmanager
def _alone_with(path: Path) -> Iterator[IO[bytes]]:
    """The file, that no other process writes to meanwhile."""
    lock = JournalFileOpenLock(str(path))
    lock.acquire()
    try:
        with path.open("a+b", buffering=0) as file:
            yield file
    finally:
        with suppress(RuntimeError):  # somebody took the lock's file away
            lock.release()


def _is_whole(file: IO[bytes]) -> bool:
    if not file.seek(0, os.SEEK_END):
        return True
    file.seek(-1, os.SEEK_END)
    return file.read(1) == b"\n"


def _cut(file: IO[bytes]) -> None:
    end = file.seek(0, os.SEEK_END)
    if _is_whole(file):
        return
    while end:
        begin = max(end - _PART, 0)
        file.seek(begin)
        last = file.read(end - begin).rfind(b"\n")
        end = begin + last + 1 if last >= 0 else begin
        if last >= 0:
            break
    file.truncate(end)


def _append(file: IO[bytes], data: bytes) -> None:
    begin, rest = file.seek(0, os.SEEK_END), memoryview(data)
    try:
        while rest:  # a disk that gets full takes a part first, and refuses the rest
            rest = rest[file.write(rest) :]
    except OSError:
        file.truncate(begin)
        raise
