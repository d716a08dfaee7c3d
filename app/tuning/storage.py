"""Where the trials of a search stand: a journal, which is a plain file, or a PostgreSQL database."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from pipeline.errors import StemmapError

SERVER = ("postgresql://", "postgresql+psycopg://")
_SCHEMA = "stemmap_tuning"  # Optuna's tables have names of their own there, and its own account of versions
_OPENING = 0x73746D70  # number of the lock; any that no other program takes
_LARGEST = 1 << 30
_MEANT = {
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
    """A journal of another search.

    Args:
        differs: In what, in words.
        where: The journal.
    """

    def __init__(self, differs: str, where: str) -> None:
        self.differs = differs
        remedy = "Name another file with --journal, or delete this one to begin anew"
        super().__init__(f"the journal is of another search: {differs}", where=where, remedy=remedy)


def is_server(storage: str) -> bool:
    """Whether it is the address of a database, and not the path of a journal."""
    return storage.startswith(SERVER)


def open_study(storage: str, identity: dict[str, Any]) -> tuple[Any, Any]:
    """The study of a search, with the trials that were made before, and the storage in which it stands.

    Raises:
        StemmapError: It cannot be written to, is damaged, or is of another search.
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
    except Exception as error:  # whatever a damaged file or a server that went makes of Optuna
        raise _refused(storage, error) from None
    return study, backend


def close_storage(backend: Any) -> None:  # noqa: ANN401 - Optuna has no types
    """Let go of a database; a journal needs no closing."""
    if (engine := getattr(backend, "engine", None)) is not None:
        backend.remove_session()
        engine.dispose()


def _name(identity: dict[str, Any]) -> str:
    text = json.dumps(identity, sort_keys=True).encode()
    return f"stemmap {hashlib.sha256(text).hexdigest()[:16]}"


def _journal(path: Path, identity: dict[str, Any]) -> Any:  # noqa: ANN401
    from optuna.storages import JournalStorage

    from app.tuning.journal import Journal

    try:
        known = _mended(path)
        storage = JournalStorage(Journal(str(path)))
    except OSError as error:
        raise unwritable(str(path), error) from None
    except Exception as error:  # a line of JSON that is none of Optuna's
        raise _damaged(path, error) from None
    if known:
        _check_same(path, storage, identity)
    return storage


def _mended(path: Path) -> bool:
    """Whether a journal with something in it stands there; its last line is whole from now on.

    Raises:
        StemmapError: It is no journal.
    """
    if not path.exists() or path.stat().st_size == 0:
        return False
    if path.stat().st_size > _LARGEST:
        raise StemmapError("the journal is larger than 1 GB", where=str(path))
    from app.tuning.journal import cut_half_line

    with path.open("rb") as file:
        first = file.readline(1 << 20)
    try:
        is_journal = "op_code" in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        is_journal = False
    if not is_journal:
        raise StemmapError(
            "this is no journal of a search", where=str(path), remedy="Name another file with --journal"
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
            "the journal is none of `stemmap tune`", where=str(path), remedy="Name another with --journal"
        )
    plain = json.loads(json.dumps(identity))
    if plain in before:
        return
    theirs = before[-1]
    differs = dict.fromkeys(_MEANT[key] for key in _MEANT if theirs.get(key) != plain[key])
    raise OtherSearchError(", ".join(differs), str(path))


def _server(address: str) -> Any:  # noqa: ANN401
    from optuna.storages import RDBStorage
    from sqlalchemy import create_engine, make_url, text
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(address).set(drivername="postgresql+psycopg")
    except (ArgumentError, ValueError):
        raise StemmapError("this is no address of a database") from None
    try:
        engine = create_engine(url, connect_args={"connect_timeout": 5}, isolation_level="AUTOCOMMIT")
        options = {"connect_timeout": 5, "options": f"-csearch_path={_SCHEMA}"}
        plain = url.render_as_string(hide_password=False)
        try:
            with engine.connect() as connection:
                # Of machines that begin at the same time one alone makes the tables. The lock goes with the
                # connection.
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
        remedy="Name another with --journal, or delete it to begin anew",
    )


def unwritable(storage: str, error: OSError) -> StemmapError:
    """What a person is told of a disk that refuses."""
    reason = (error.strerror or str(error)).lower()
    return StemmapError(f"the trials cannot be kept: {reason}", where=storage)


def unreadable(storage: str, error: OSError) -> StemmapError:
    """What a person is told of trials that cannot be read again."""
    reason = (error.strerror or str(error)).lower()
    return StemmapError(f"the trials cannot be read: {reason}", where=storage)
