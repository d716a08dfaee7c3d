"""A real PostgreSQL server, started for the tests where the machine has one."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

# Debian's packages keep the programs of a server there, out of sight of the shell.
_PACKAGED = Path("/usr/lib/postgresql")


def _program(name: str) -> str | None:
    found = sorted(_PACKAGED.glob(f"*/bin/{name}"), key=lambda path: (len(path.parts[-3]), path))
    return shutil.which(name) or (str(found[-1]) if found else None)


def _as_somebody() -> tuple[list[str], tuple[int, int] | None]:
    """How to run a program that refuses root, and whose files it writes then."""
    if os.name != "posix" or os.geteuid() != 0:
        return [], None
    import pwd

    try:
        person = pwd.getpwnam("postgres")
    except KeyError:
        pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
    if shutil.which("setpriv") is None:
        pytest.skip("PostgreSQL does not run as root, and there is no setpriv")
    ids = ["--reuid", str(person.pw_uid), "--regid", str(person.pw_gid), "--clear-groups"]
    return ["setpriv", *ids], (person.pw_uid, person.pw_gid)


@contextmanager
def running() -> Iterator[str]:
    """Address of an empty database of a server of our own; it listens on a socket in a folder alone."""
    if given := os.environ.get("STEMMAP_TEST_DATABASE"):
        yield given
        return
    pytest.importorskip("psycopg", reason="the driver of PostgreSQL is not installed")
    initdb, pg_ctl = _program("initdb"), _program("pg_ctl")
    if initdb is None or pg_ctl is None:
        pytest.skip("there is no PostgreSQL server here (on Debian: sudo apt-get install postgresql)")
    prefix, owner = _as_somebody()
    # The path of a socket may not be long.
    folder = Path(f"/tmp/stemmap-{os.getpid()}")  # noqa: S108 - made here, and it must not be there before
    folder.mkdir(mode=0o700)
    try:
        if owner is not None:
            os.chown(folder, *owner)
        data = folder / "data"

        def run(*words: str) -> None:
            told = subprocess.run(
                [*prefix, *words], cwd=folder, capture_output=True, text=True, timeout=120, check=False
            )
            assert told.returncode == 0, told.stderr

        run(initdb, "-D", str(data), "-U", "stemmap", "-A", "trust", "--no-sync", "-E", "UTF8", "--locale=C")
        options = f"-c listen_addresses='' -k {folder} -F"
        run(pg_ctl, "-D", str(data), "-w", "-l", str(folder / "log"), "-o", options, "start")
        try:
            yield f"postgresql://stemmap@/postgres?host={folder}"
        finally:
            run(pg_ctl, "-D", str(data), "-w", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder)


def empty(server: str, schema: str) -> None:
    """Leave nothing in a schema, which stands there afterwards."""
    engine = create_engine(server.replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        connection.execute(text(f"DROP SCHEMA IF EXISTS {schema} CASCADE"))
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    engine.dispose()
