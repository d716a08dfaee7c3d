"""Storage of the trials of a search: a journal, which is a plain file, or a PostgreSQL database."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from pipeline.errors import StemmapError

SERVER = ("postgresql://", "postgresql+psycopg://")
_SCHEMA = "stemmap_tuning"  # keeps Optuna's tables and their version apart from stemmap's
_OPENING = 0x73746D70  # number of the advisory lock
_LARGEST = 1 << 30
_PART = 1 << 16
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
_IDENTITY = "stemmap"


class OtherSearchError(StemmapError):
    """The journal belongs to another search.

    Args:
        differs: The difference, as text.
        where: The journal.
    """

    def __init__(self, differs: str, where: str) -> None:
        self.differs = differs
        remedy = "Name another file with --journal, or delete this one"
        super().__init__(f"the journal belongs to another search: {differs}", where=where, remedy=remedy)


def is_server(storage: str) -> bool:
    """Whether this is the address of a database and not the path of a journal."""
    return storage.startswith(SERVER)


def open_study(storage: str, identity: dict[str, Any]) -> tuple[Any, Any]:
    """Open or create Optuna's study of a search. Returns the study, with its earlier trials, and its storage.

    Raises:
        StemmapError: The storage cannot be written, is damaged, or belongs to another search.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    backend = _server(storage) if is_server(storage) else _journal(Path(storage), identity)
    try:
        study = optuna.create_study(
            storage=backend, study_name=_name(identity), direction="minimize", load_if_exists=True
        )
        if _IDENTITY not in study.user_attrs:
            study.set_user_attr(_IDENTITY, identity)
    except StemmapError:
        raise
    except OSError as error:
        raise unwritable(storage, error) from None
    except Exception as error:  # Optuna raises many kinds for a damaged file or a lost server
        raise _refused(storage, error) from None
    return study, backend


def close_storage(backend: Any) -> None:  # noqa: ANN401 - Optuna has no types
    """Close the connection to a database. A journal needs no closing."""
    if (engine := getattr(backend, "engine", None)) is not None:
        backend.remove_session()
        engine.dispose()


def _name(identity: dict[str, Any]) -> str:
    text = json.dumps(identity, sort_keys=True).encode()
    return f"stemmap {hashlib.sha256(text).hexdigest()[:16]}"


def _journal(path: Path, identity: dict[str, Any]) -> Any:  # noqa: ANN401
    from optuna.storages import JournalStorage

    try:
        known = _mended(path)
        storage = JournalStorage(Journal(str(path)))
    except OSError as error:
        raise unwritable(str(path), error) from None
    except Exception as error:  # a line of JSON that Optuna did not write
        raise _damaged(path, error) from None
    if known:
        _check_same(path, storage, identity)
    return storage


def _mended(path: Path) -> bool:
    """Return whether the journal exists and is not empty, after the removal of an incomplete last line.

    Raises:
        StemmapError: The file is not a journal.
    """
    if not path.exists() or path.stat().st_size == 0:
        return False
    if path.stat().st_size > _LARGEST:
        raise StemmapError("the journal is larger than 1 GB", where=str(path))
    with path.open("rb") as file:
        first = file.readline(1 << 20)
    try:
        is_journal = "op_code" in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        is_journal = False
    if not is_journal:
        raise StemmapError(
            "this is not the journal of a search", where=str(path), remedy="Name another file with --journal"
        )
    cut_half_line(path)
    return True


def _check_same(path: Path, storage: Any, identity: dict[str, Any]) -> None:  # noqa: ANN401
    import optuna

    try:
        names = optuna.get_all_study_names(storage)
        attributes = [optuna.load_study(study_name=name, storage=storage).user_attrs for name in names]
    except Exception as error:
        raise _damaged(path, error) from None
    before = [known[_IDENTITY] for known in attributes if isinstance(known.get(_IDENTITY), dict)]
    if not before:
        raise StemmapError(
            "`stemmap tune` did not write this journal", where=str(path), remedy="Name another with --journal"
        )
    plain = json.loads(json.dumps(identity))
    if plain in before:
        return
    theirs = before[-1]
    differs = dict.fromkeys(_DIFFERENCES[key] for key in _DIFFERENCES if theirs.get(key) != plain[key])
    raise OtherSearchError(", ".join(differs), str(path))


def _server(address: str) -> Any:  # noqa: ANN401
    from optuna.storages import RDBStorage
    from sqlalchemy import create_engine, make_url, text
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(address).set(drivername="postgresql+psycopg")
    except (ArgumentError, ValueError):
        raise StemmapError("this is not the address of a database") from None
    try:
        engine = create_engine(url, connect_args={"connect_timeout": 5}, isolation_level="AUTOCOMMIT")
        options = {"connect_timeout": 5, "options": f"-csearch_path={_SCHEMA}"}
        plain = url.render_as_string(hide_password=False)
        try:
            with engine.connect() as connection:
                # Of several machines that begin at the same time only one makes the tables. The lock ends
                # with the connection.
                connection.execute(text(f"SELECT pg_advisory_lock({_OPENING})"))
                connection.execute(text(f"CREATE SCHEMA IF NOT EXISTS {_SCHEMA}"))
                return RDBStorage(plain, engine_kwargs={"connect_args": options, "pool_pre_ping": True})
        finally:
            engine.dispose()
    except ImportError:
        raise StemmapError(
            "the driver of PostgreSQL is missing", remedy="Install stemmap[postgres]"
        ) from None
    except Exception as error:
        raise _refused(address, error) from None


def _refused(storage: str, error: Exception) -> StemmapError:
    if not is_server(storage):
        return _damaged(Path(storage), error)
    from sqlalchemy import make_url

    reason = " ".join(str(getattr(error, "orig", None) or error).split())[:200]
    where = make_url(storage).render_as_string(hide_password=True)
    return StemmapError(f"the database cannot be used: {reason}", where=where)


def _damaged(path: Path, error: Exception) -> StemmapError:
    if isinstance(error, StemmapError):
        return error
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    return StemmapError(
        f"the journal is damaged: {reason}",
        where=str(path),
        remedy="Name another with --journal, or delete it",
    )


def unwritable(storage: str, error: OSError) -> StemmapError:
    """Return the error of trials that cannot be written to a storage."""
    reason = (error.strerror or str(error)).lower()
    return StemmapError(f"the trials cannot be kept: {reason}", where=storage)


def unreadable(storage: str, error: OSError) -> StemmapError:
    """Return the error of trials that cannot be read from a storage."""
    reason = (error.strerror or str(error)).lower()
    return StemmapError(f"the trials cannot be read: {reason}", where=storage)


# --- the journal ------------------------------------------------------------------


class Journal(JournalFileBackend):  # type: ignore[misc]
    """Optuna's journal, without waiting for the disk. It survives a process that is killed; trials that a
    power cut loses are repeated. A trial writes a dozen lines; waiting for the disk after each line took
    longer than mapping a short run.

    Args:
        path: Path of the file.
    """

    def __init__(self, path: str) -> None:
        super().__init__(path, lock_obj=JournalFileOpenLock(path))
        self._file = Path(path)

    def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:
        """Yield the log entries from number `log_number_from` onwards.

        Raises:
            StemmapError: The file cannot be read.
        """
        try:
            yield from super().read_logs(log_number_from)
        except OSError as error:
            raise unreadable(str(self._file), error) from None

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append all entries or none.

        Raises:
            StemmapError: The file cannot be written, for example on a full disk.
        """
        text = "".join(f"{json.dumps(log, separators=(',', ':'))}\n" for log in logs)
        try:
            with _locked(self._file) as file:
                _cut(file)
                _append(file, text.encode())
        except OSError as error:
            raise unwritable(str(self._file), error) from None


def cut_half_line(path: Path) -> None:
    """Remove an incomplete last line, which a process leaves that is killed while it writes."""
    with path.open("rb") as file:
        if _is_whole(file):
            return
    with _locked(path) as file:  # checked again: another process may have been writing
        _cut(file)


@contextmanager
def _locked(path: Path) -> Iterator[IO[bytes]]:
    """Open the file while no other process writes to it."""
    lock = JournalFileOpenLock(str(path))
    lock.acquire()
    try:
        with path.open("a+b", buffering=0) as file:
            yield file
    finally:
        with suppress(RuntimeError):  # the lock file was deleted
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
        while rest:  # a full disk may accept a part
            rest = rest[file.write(rest) :]
    except OSError:
        file.truncate(begin)
        raise
