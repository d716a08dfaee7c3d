"""Trials of a search, in memory or in a journal: a file with one line per trial."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from app.tuning.plan import Trial
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import hold

_LARGEST = 1 << 30
_DIFFERENCES = {
    "format": "another version of stemmap",
    "version": "another version of stemmap",
    "runs": "other runs or another truth",
    "goal": "another goal",
    "parameters": "other parameters or bounds (--over)",
    "start": "other parameters to begin with",
    "seed": "another seed",
    "odometry": "another --odometry",
}
_OTHER_FILE = "Name another file with --journal, or delete this one"


class Trials:
    """Trials of a search in memory, by number.

    Args:
        known: Earlier trials.

    Attributes:
        all: The trials.
    """

    def __init__(self, known: Sequence[Trial] = ()) -> None:
        self.all = list(known)

    def add(self, trial: Trial) -> Trial:
        """Store a trial under the next number, append it to `all`, and return it with its number.

        Raises:
            StemmapError: It cannot be stored.
        """
        self.all.append(msgspec.structs.replace(trial, number=len(self.all)))
        return self.all[-1]

    def close(self) -> None:
        """Close the file, if there is one."""


class Journal(Trials):
    """Trials in a file: a line of JSON with the identity of the search, then a line for each trial. A file
    that does not exist is created.

    A line is not waited for on the disk: trials that a power cut loses are repeated. An incomplete last line,
    which a killed process leaves, is removed.

    Args:
        path: The file.
        identity: All that decides the result of a trial, see `app.tuning.plan.identity`.

    Raises:
        StemmapError: The file cannot be used, is damaged or in use, or belongs to another search.
    """

    def __init__(self, path: Path, identity: dict[str, Any]) -> None:
        super().__init__()
        self._path = path
        try:
            self._file = path.open("a+b", buffering=0)
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            self._read({"search": json.loads(json.dumps(identity))})
        except BaseException:
            self.close()
            raise

    def add(self, trial: Trial) -> Trial:
        """Store a trial, see `Trials.add`. On a full disk nothing is written and StemmapError is raised."""
        added = super().add(trial)
        self._append(added)
        return added

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, header: dict[str, Any]) -> None:
        """Lock the file, read its trials into `all`, and remove an incomplete last line. The header is
        written into an empty file.

        Args:
            header: The first line that the file must have, with the identity of the search.

        Raises:
            StemmapError: Another process holds the lock, the file is larger than 1 GB or cannot be read, is
                not a journal, belongs to another search, or a line is invalid or missing.
        """
        try:
            hold(self._file)
            if self._file.seek(0, os.SEEK_END) > _LARGEST:
                raise StemmapError("the journal is larger than 1 GB", where=str(self._path))
            self._file.seek(0)
            content = self._file.read()
        except BlockingIOError:
            raise StemmapError(
                "another search writes to this journal",
                where=str(self._path),
                remedy="Wait until it has ended",
            ) from None
        except OSError as error:
            raise self._unwritable(error) from None
        end = content.rfind(b"\n") + 1
        first, *lines = content[: end - 1].split(b"\n") if end else (b"",)
        if end:
            self._check_header(first, header)
        elif not _line(header).startswith(content):
            raise self._foreign()
        try:
            self.all = [msgspec.json.decode(line, type=Trial) for line in lines]
            if [trial.number for trial in self.all] != list(range(len(lines))):
                raise ValueError("trials are missing")
        except (msgspec.MsgspecError, ValueError) as error:
            raise StemmapError(
                f"the journal is damaged: {error}", where=str(self._path), remedy=_OTHER_FILE
            ) from None
        self._file.truncate(end)
        if not end:
            self._append(header)

    def _check_header(self, line: bytes, expected: dict[str, Any]) -> None:
        """Compare the first line of the file with the expected header.

        Raises:
            StemmapError: The line is not a header, or belongs to another search; the message names what
                differs.
        """
        try:
            theirs = msgspec.json.decode(line, type=dict[str, dict[str, Any]])["search"]
        except (msgspec.MsgspecError, UnicodeDecodeError, KeyError):
            raise self._foreign() from None
        own = expected["search"]
        if theirs != own:
            differs = dict.fromkeys(_DIFFERENCES[key] for key in _DIFFERENCES if theirs.get(key) != own[key])
            raise StemmapError(
                f"the journal belongs to another search: {', '.join(differs)}",
                where=str(self._path),
                remedy=_OTHER_FILE,
            )

    def _append(self, record: object) -> None:
        """Append a record as one line of JSON. After a disk error the file has its earlier length, and
        StemmapError is raised."""
        begin, rest = self._file.seek(0, os.SEEK_END), memoryview(_line(record))
        try:
            while rest:  # a full disk may accept a part
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._file.truncate(begin)
            raise self._unwritable(error) from None

    def _foreign(self) -> StemmapError:
        """Return the error of a file that is not a journal."""
        return StemmapError("this is not the journal of a search", where=str(self._path), remedy=_OTHER_FILE)

    def _unwritable(self, error: OSError) -> StemmapError:
        """Return the error for people of a file that cannot be written."""
        reason = (error.strerror or str(error)).lower()
        return StemmapError(f"the trials cannot be kept: {reason}", where=str(self._path))


def _line(record: object) -> bytes:
    """Return a record as a line of JSON."""
    return msgspec.json.encode(record) + b"\n"
