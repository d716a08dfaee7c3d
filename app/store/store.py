"""Reads and edits annotations and saved parameter sets. The browser that made an edit of an annotation can
undo it.

Every change stores the content before and after it, and an annotation stores which change led to its current
content. A change can be undone while it is still the last one of its annotation.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from sqlalchemy import Connection, Engine, Insert, Row, delete, func, insert, select, update

from app.sources.request import SourceRequest, request_of_kept
from app.store import tables
from app.store.book import RunBook
from app.store.database import open_engine
from app.store.records import (
    MOST_ANNOTATIONS,
    MOST_SETS,
    Annotation,
    Author,
    Content,
    SavedSet,
    StaleError,
    UnknownError,
    moment,
)
from app.store.tables import parameter_sets as table
from pipeline.errors import StemmapError

_runs, _annotations, _records = tables.runs, tables.annotated, tables.records


@dataclass(frozen=True, slots=True)
class AnnotatedSource:
    """A source with its annotations.

    Attributes:
        source: Digest of the recording, or its URI where it has no digest.
        name: Name under which it was opened last.
        request: How it was mapped last, with its parameters; the defaults where it was never mapped.
        annotations: The annotations that are not deleted.
    """

    source: str
    name: str
    request: SourceRequest
    annotations: tuple[Content, ...]


def annotated_sources(engine: Engine) -> list[AnnotatedSource]:
    """All sources with annotations, in the order in which they were first opened."""
    a = _annotations.c
    query = select(a.run, a.x, a.y, a.kind, a.dbh).where(a.deleted.is_(False)).order_by(a.id)
    with engine.begin() as connection:
        contents: dict[int, list[Content]] = {}
        for row in connection.execute(query):
            contents.setdefault(row.run, []).append(Content(row.x, row.y, row.kind, row.dbh))
        found = []
        for run in connection.execute(select(_runs).where(_runs.c.id.in_(contents)).order_by(_runs.c.id)):
            newest = connection.execute(
                select(_records)
                .where(_records.c.run == run.id, _records.c.deleted_ns.is_(None), _records.c.scans > 0)
                .order_by(_records.c.changed_ns.desc(), _records.c.id.desc())
                .limit(1)
            ).one_or_none()
            found.append(
                AnnotatedSource(
                    run.source,
                    run.name,
                    SourceRequest(run.uri) if newest is None else request_of_record(newest, run.uri),
                    tuple(contents[run.id]),
                )
            )
    return found


def request_of_record(row: Row[Any], uri: str) -> SourceRequest:
    """Return how a recorded run was mapped, with the path at which its source was opened last."""
    return request_of_kept(
        uri,
        odometry=row.odometry,
        seed=row.seed,
        choices=row.chosen,
        preset=row.preset,
        parameters=row.parameters,
    )


class Sets:
    """Reads and writes the saved sets.

    Args:
        engine: On the database.
        clock: Nanoseconds since 1970.
    """

    def __init__(self, engine: Engine, clock: Callable[[], int]) -> None:
        self._engine, self._clock = engine, clock

    def all(self) -> list[SavedSet]:
        """Every set, by name."""
        with self._engine.begin() as connection:
            rows = connection.execute(select(table).order_by(table.c.name)).all()
        return [SavedSet(row.name, row.toml, row.who, row.at_ns) for row in rows]

    def save(self, name: str, toml: str, who: str) -> None:
        """Keep a set under a name; one that has the name already makes room for it.

        Raises:
            StemmapError: There would be too many.
        """
        with self._engine.begin() as connection:
            connection.execute(delete(table).where(table.c.name == name))
            if connection.execute(select(func.count()).select_from(table)).scalar_one() >= MOST_SETS:
                raise StemmapError(f"there are {MOST_SETS} saved sets already", remedy="Delete some first")
            values = {"name": name, "toml": toml, "who": who, "at_ns": self._clock()}
            connection.execute(insert(table).values(**values))

    def delete(self, name: str) -> None:
        """Forget a set.

        Raises:
            UnknownError: There is none of this name.
        """
        with self._engine.begin() as connection:
            if connection.execute(delete(table).where(table.c.name == name)).rowcount == 0:
                raise UnknownError("there is no saved set of this name", where=name)


# Longer ones were never the digests that all recordings have.
_LONGEST_KEY = 600
_annotations, _changes, _steps, _runs = tables.annotated, tables.changes, tables.steps, tables.runs


class Store:
    """The annotations of all runs, and in `book` what became of the runs.

    Args:
        folder: Where the database is kept; None keeps it in memory.
        clock: Nanoseconds since 1970.
        database: Address of a PostgreSQL database in place of the folder.

    Raises:
        StemmapError: The database cannot be used; the file is left as it is.
    """

    def __init__(
        self, folder: Path | None, clock: Callable[[], int] = time.time_ns, database: str = ""
    ) -> None:
        self._engine = open_engine(folder, database)
        self._clock = clock
        self.book = RunBook(self._engine, clock)

    @property
    def sets(self) -> Sets:
        """The parameters that were saved, of all runs."""
        return Sets(self._engine, self._clock)

    def close(self) -> None:
        """Let go of the file."""
        self._engine.dispose()

    def open_run(self, source: str, uri: str, name: str) -> int:
        """The number of a run; the same source is the same run, wherever it lies.

        Args:
            source: Digest of what was recorded, else the URI.
            uri, name: As it was opened now.
        """
        now = {"uri": uri, "name": name, "opened_ns": self._clock()}
        source = _key(source)
        with self._engine.begin() as connection:
            known = connection.execute(select(_runs.c.id).where(_runs.c.source == source)).scalar()
            if known is None:
                return _made(connection, insert(_runs).values(source=source, **now))
            connection.execute(update(_runs).where(_runs.c.id == known).values(**now))
            return int(known)

    def annotations(self, run: int) -> list[Annotation]:
        """Those that stand, in the order in which they were first made."""
        query = select(_annotations).where(_annotations.c.run == run, _annotations.c.deleted.is_(False))
        with self._engine.begin() as connection:
            rows = connection.execute(query.order_by(_annotations.c.id)).all()
        return [Annotation(row.id, _content(row), row.who, row.at_ns, row.version) for row in rows]

    def annotated_sources(self) -> list[AnnotatedSource]:
        """All sources with annotations, and how each was mapped last."""
        return annotated_sources(self._engine)

    def add(self, run: int, author: Author, contents: Sequence[Content]) -> list[int]:
        """Add annotations in one step; returns their ids.

        Raises:
            StemmapError: The run would have too many.
        """
        with self._engine.begin() as connection:
            standing = select(func.count()).where(
                _annotations.c.run == run, _annotations.c.deleted.is_(False)
            )
            if connection.execute(standing).scalar_one() + len(contents) > MOST_ANNOTATIONS:
                raise StemmapError(f"a run may have {MOST_ANNOTATIONS} annotations")
            step = self._step(connection, run, author)
            return [self._add(connection, run, step, author, content) for content in contents]

    def change(self, run: int, author: Author, id_: int, version: int, content: Content) -> None:
        """Say something else.

        Raises:
            UnknownError: There is none with this id in the run.
            StaleError: It is not of this version any more; who changed it and when is said.
        """
        self._edit(run, author, id_, version, content)

    def delete(self, run: int, author: Author, id_: int, version: int) -> None:
        """Take it away. Raises as `change` does."""
        self._edit(run, author, id_, version, None)

    def undo(self, run: int, author: Author) -> None:
        """Undo this browser's last step.

        Raises:
            StemmapError: There is none.
            StaleError: Somebody else has changed since what it changed; the step is passed over from now on.
        """
        self._turn(run, author, "undone")

    def redo(self, run: int, author: Author) -> None:
        """Do again the step that this browser undid last. Raises as `undo` does."""
        self._turn(run, author, "done")

    def steps(self, run: int, browser: str) -> tuple[int, int]:
        """How many steps a browser can undo and redo."""
        query = select(_steps.c.state, func.count()).where(
            _steps.c.run == run, _steps.c.browser == browser, _steps.c.state != "left"
        )
        with self._engine.begin() as connection:
            counts = {str(state): int(n) for state, n in connection.execute(query.group_by(_steps.c.state))}
        return counts.get("done", 0), counts.get("undone", 0)

    # --- one edit --------------------------------------------------------------------------------

    def _edit(self, run: int, author: Author, id_: int, version: int, content: Content | None) -> None:
        with self._engine.begin() as connection:
            row = connection.execute(
                select(_annotations).where(_annotations.c.id == id_, _annotations.c.run == run)
            ).one_or_none()
            if row is None:
                raise UnknownError("there is no such annotation", where=f"annotation {id_}")
            if row.version != version or row.deleted:
                raise _stale(row)
            if content == _content(row):
                return
            self._change(connection, self._step(connection, run, author), author, row, content)

    def _step(self, connection: Connection, run: int, author: Author) -> int:
        """A new step; what was undone before it cannot be done again."""
        of_browser = (_steps.c.run == run, _steps.c.browser == author.browser)
        connection.execute(update(_steps).where(*of_browser, _steps.c.state == "undone").values(state="left"))
        said = {"browser": author.browser, "who": author.who, "at_ns": self._clock(), "state": "done"}
        return _made(connection, insert(_steps).values(run=run, **said))

    def _add(self, connection: Connection, run: int, step: int, author: Author, content: Content) -> int:
        edit = {"who": author.who, "at_ns": self._clock(), "version": 1, "deleted": False, "made_by": 0}
        id_ = _made(connection, insert(_annotations).values(run=run, **asdict(content), **edit))
        values = {"step": step, "annotation": id_, "before": None, "after": asdict(content), "made_before": 0}
        change = _made(connection, insert(_changes).values(**values))
        connection.execute(update(_annotations).where(_annotations.c.id == id_).values(made_by=change))
        return id_

    def _change(
        self, connection: Connection, step: int, author: Author, row: Row[Any], content: Content | None
    ) -> None:
        values = {
            "step": step,
            "annotation": row.id,
            "before": asdict(_content(row)),
            "after": None if content is None else asdict(content),
            "made_before": row.made_by,
        }
        change = _made(connection, insert(_changes).values(**values))
        self._put(connection, author, row, values["after"], change)

    def _put(
        self, connection: Connection, author: Author, row: Row[Any], content: dict[str, Any] | None, by: int
    ) -> None:
        """Let this stand from now on; None: nothing."""
        edit = {"who": author.who, "at_ns": self._clock(), "version": row.version + 1, "made_by": by}
        connection.execute(
            update(_annotations)
            .where(_annotations.c.id == row.id)
            .values(**edit, deleted=content is None, **(content or {}))
        )

    # --- back and forth --------------------------------------------------------------------------

    def _turn(self, run: int, author: Author, to: Literal["done", "undone"]) -> None:
        with self._engine.begin() as connection:
            step = _next_step(connection, run, author, to)
            query = select(_changes).where(_changes.c.step == step).order_by(_changes.c.id)
            pairs = [
                (change, _row(connection, change.annotation)) for change in connection.execute(query).all()
            ]
            back = to == "undone"
            stale = next((row for c, row in pairs if row.made_by != (c.id if back else c.made_before)), None)
            state = to if stale is None else "left"
            connection.execute(update(_steps).where(_steps.c.id == step).values(state=state))
            for change, row in () if stale is not None else pairs:
                content, by = (change.before, change.made_before) if back else (change.after, change.id)
                self._put(connection, author, row, content, by)
        if stale is not None:  # not before: that the step is passed over must last
            raise _stale(stale)


def _next_step(connection: Connection, run: int, author: Author, to: str) -> int:
    """The step to be undone or done again."""
    # What was undone lies after what stands, and was undone from its end.
    newest, state = (func.max, "done") if to == "undone" else (func.min, "undone")
    query = select(newest(_steps.c.id)).where(
        _steps.c.run == run, _steps.c.browser == author.browser, _steps.c.state == state
    )
    step = connection.execute(query).scalar()
    if step is None:
        raise StemmapError(f"there is nothing to {'undo' if to == 'undone' else 'do again'}")
    return int(step)


def _row(connection: Connection, id_: int) -> Row[Any]:
    return connection.execute(select(_annotations).where(_annotations.c.id == id_)).one()


def _content(row: Row[Any]) -> Content:
    return Content(row.x, row.y, row.kind, row.dbh)


def _key(source: str) -> str:
    """A source as it is looked for: an index of PostgreSQL takes no entry of 2,700 bytes."""
    return source if len(source) <= _LONGEST_KEY else f"sha256 {sha256(source.encode()).hexdigest()}"


def _made(connection: Connection, statement: Insert) -> int:
    """Insert a row; returns its id."""
    key = connection.execute(statement).inserted_primary_key
    assert key is not None  # noqa: S101 - one row was inserted
    return int(key[0])


def _stale(row: Row[Any]) -> StaleError:
    done = "deleted" if row.deleted else "changed"
    return StaleError(
        f"annotation {row.id} was {done} by {row.who} at {moment(row.at_ns)}",
        remedy="Your edit was not made; look at what stands now, and try again",
    )
