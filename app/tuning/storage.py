"""Trials of a search: in memory, in a file with one line per trial, or in a PostgreSQL database that several
machines share."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from app.tuning.plan import Trial
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import hold

if TYPE_CHECKING:
    from sqlalchemy import Connection

SERVER = ("postgresql://", "postgresql+psycopg://")
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


def is_server(storage: str) -> bool:
    """Return whether this is the address of a PostgreSQL database (one of the prefixes SERVER) and not the
    path of a journal."""
    return storage.startswith(SERVER)


def open_trials(storage: str, identity: dict[str, Any], known: Sequence[Trial] = ()) -> Trials:
    """Open the trials of a search: `SharedTrials`, `Journal` or `Trials`. A journal that does not exist is
    created.

    Args:
        storage: Path of a journal, address of a database, or "" for the memory.
        identity: All that decides the result of a trial, see `app.tuning.plan.identity`.
        known: Earlier trials, for the memory; ignored by the other storages, which read their own.

    Raises:
        StemmapError: The storage cannot be written, is damaged, or belongs to another search.
    """
    if is_server(storage):
        return SharedTrials(storage, identity)
    return Journal(Path(storage), identity) if storage else Trials(known)


class Trials:
    """Trials of a search in memory, by number.

    Args:
        known: Earlier trials.

    Attributes:
        all: The trials.
        slot: Number of this process among those that share the trials now.
    """

    slot = 0

    def __init__(self, known: Sequence[Trial] = ()) -> None:
        self.all = list(known)

    def refresh(self) -> None:
        """Read the trials that other machines have added; only `SharedTrials` does anything."""

    def add(self, trial: Trial, most: int) -> Trial | None:
        """Store a trial under the next number, append it to `all`, and return it with its number.

        Args:
            trial: The trial; its number is ignored.
            most: Number of trials of the search; where there are so many, nothing is stored and None is
                returned.

        Raises:
            StemmapError: It cannot be stored.
        """
        if len(self.all) >= most:
            return None
        self.all.append(msgspec.structs.replace(trial, number=len(self.all)))
        return self.all[-1]

    def close(self) -> None:
        """Close the file or the connection, if there is one."""


class Journal(Trials):
    """Trials in a file: a line of JSON with the identity of the search, then a line for each trial.

    A line is not waited for on the disk: trials that a power cut loses are repeated. An incomplete last line,
    which a killed process leaves, is removed.

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

    def add(self, trial: Trial, most: int) -> Trial | None:
        """Store a trial, see `Trials.add`. On a full disk nothing is written and StemmapError is raised."""
        added = super().add(trial, most)
        if added is not None:
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


_LOCK = 0x73746D70  # number of the advisory lock
_TABLES = (
    "CREATE SCHEMA IF NOT EXISTS stemmap_search",
    "CREATE TABLE IF NOT EXISTS stemmap_search.trials "
    "(search text NOT NULL, number integer NOT NULL, trial text NOT NULL, PRIMARY KEY (search, number))",
)


class SharedTrials(Trials):
    """Trials in a table of a PostgreSQL database. Every machine reads the trials of the others. The schema
    and the table are created if they do not exist.

    Args:
        address: Address of the database, postgresql://user:password@host/name.
        identity: All that decides the result of a trial; only trials under the same identity are read.

    Raises:
        StemmapError: The address is invalid, the driver is not installed, or the database cannot be used.
    """

    def __init__(self, address: str, identity: dict[str, Any]) -> None:
        from sqlalchemy import create_engine, make_url, text
        from sqlalchemy.exc import ArgumentError

        super().__init__()
        digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode())
        self._search = digest.hexdigest()
        try:
            url = make_url(address).set(drivername="postgresql+psycopg")
        except (ArgumentError, ValueError):
            raise StemmapError("this is not the address of a database") from None
        self._where = url.render_as_string(hide_password=True)
        try:
            self._engine = create_engine(url, connect_args={"connect_timeout": 5}, pool_pre_ping=True)
            with self._locked() as connection:
                for statement in _TABLES:
                    connection.execute(text(statement))
            # The lock of a slot ends with its connection, also that of a machine that is killed.
            self._present = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
            take = text("SELECT pg_try_advisory_lock(:lock, :slot)")
            lock = int.from_bytes(digest.digest()[:4], "big", signed=True)
            self.slot = next(
                slot
                for slot in itertools.count()
                if self._present.execute(take, {"lock": lock, "slot": slot}).scalar()
            )
        except ImportError:
            raise StemmapError(
                "the driver of PostgreSQL is missing", remedy="Install stemmap[postgres]"
            ) from None
        except Exception as error:
            raise self._refused(error) from None
        self.refresh()

    def refresh(self) -> None:
        """Read the trials that other machines have added.

        Raises:
            StemmapError: The database cannot be read.
        """
        from sqlalchemy.exc import SQLAlchemyError

        try:
            with self._engine.begin() as connection:
                self._read(connection)
        except (SQLAlchemyError, msgspec.MsgspecError) as error:
            raise self._refused(error) from None

    def add(self, trial: Trial, most: int) -> Trial | None:
        """Store a trial, see `Trials.add`. It is atomic among the processes that share the database; trials
        that others have added are read first and count against `most`."""
        from sqlalchemy import text
        from sqlalchemy.exc import SQLAlchemyError

        insert = text("INSERT INTO stemmap_search.trials VALUES (:search, :number, :trial)")
        try:
            with self._locked() as connection:
                self._read(connection)
                added = super().add(trial, most)
                if added is not None:
                    values = {"number": added.number, "trial": msgspec.json.encode(added).decode()}
                    connection.execute(insert, {"search": self._search, **values})
        except (SQLAlchemyError, msgspec.MsgspecError) as error:
            raise self._refused(error) from None
        return added

    def close(self) -> None:
        """Close the connections."""
        self._present.close()
        self._engine.dispose()

    @contextmanager
    def _locked(self) -> Iterator[Connection]:
        """Begin a transaction during which no other machine changes the table. It is committed at the end,
        and rolled back after an exception."""
        from sqlalchemy import text

        with self._engine.begin() as connection:
            connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _LOCK})
            yield connection

    def _read(self, connection: Connection) -> None:
        """Append the trials of this search to `all` that it does not have yet."""
        from sqlalchemy import text

        select = text(
            "SELECT trial FROM stemmap_search.trials WHERE search = :search AND number >= :known "
            "ORDER BY number"
        )
        rows = connection.execute(select, {"search": self._search, "known": len(self.all)}).scalars()
        self.all += [msgspec.json.decode(row, type=Trial) for row in rows]

    def _refused(self, error: Exception) -> StemmapError:
        """Return the error for people, with at most 200 characters of the reason and without the password of
        the address."""
        reason = " ".join(str(getattr(error, "orig", None) or error).split())[:200]
        return StemmapError(f"the database cannot be used: {reason}", where=self._where)
