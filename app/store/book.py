"""Records of runs (figures, maps, parameters) and of uploaded recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from sqlalchemy import Connection, Engine, Row, Select, delete, insert, select, update

from app.sources.request import SourceRequest
from app.store.database import maps as _maps
from app.store.database import records as _records
from app.store.database import revisions as _revisions
from app.store.database import runs as _runs
from app.store.database import uploads as _uploads
from app.store.records import UnknownError

MOST_LISTED = 500
# Time during which a deletion can be undone.
_KEPT_NS = 30 * 86_400 * 1_000_000_000
# Changes of the same parameters by one person within this time count as one change (a slider drag).
_ONE_MOVE_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class NewRun:
    """Start of a run: number of its source in the store, name, format, and the request that opened it."""

    run: int
    name: str
    kind: str
    request: SourceRequest


@dataclass(frozen=True, slots=True)
class RunFigures:
    """Current result of a run.

    Attributes:
        scans: Number of mapped scans.
        all_scans: Number of scans of the source, None if unknown.
        time_s: Time of the last mapped scan since the first [s].
        distance_m: Driven distance [m].
        trees: Number of confirmed trees.
        preset: Name of the preset.
        parameters: All values by dotted name.
        scores: Scores as shown on the page, or None.
        map: Trees, path and ground truth as plain lists.
    """

    scans: int
    all_scans: int | None
    time_s: float
    distance_m: float
    trees: int
    preset: str
    parameters: dict[str, Any]
    scores: dict[str, Any] | None
    map: dict[str, Any] = field(repr=False)


@dataclass(frozen=True, slots=True)
class Change:
    """A change of parameters by a person.

    Attributes:
        revision: Revision after the change.
        time_s: Time of the current scan [s since the first scan].
        who: Name of the person.
        preset: Name of the preset.
        changes: [before, after] by parameter name.
    """

    revision: int
    time_s: float
    who: str
    preset: str
    changes: dict[str, list[Any]]


class RunRecords:
    """Records of all runs. All calls block.

    Args:
        engine: Database engine of the store.
        clock: Returns the time in nanoseconds since 1970.
    """

    def __init__(self, engine: Engine, clock: Callable[[], int]) -> None:
        self._engine = engine
        self._clock = clock

    def begin(self, run: NewRun, figures: RunFigures) -> int:
        """Store the record of a new run and return its number."""
        now = self._clock()
        with self._engine.begin() as connection:
            _forget_deleted(connection, now - _KEPT_NS)
            uploaded = select(_uploads.c.name).where(_uploads.c.file == run.name)
            values = {
                "run": run.run,
                "name": connection.execute(uploaded).scalar() or run.name[:200],
                "uri": run.request.uri,
                "kind": run.kind[:200],
                "odometry": run.request.odometry,
                "seed": run.request.seed,
                "chosen": run.request.kept_choices(),
                "begun_ns": now,
                "changed_ns": now,
                **_figures(figures),
            }
            key = connection.execute(insert(_records).values(**values)).inserted_primary_key
            assert key is not None  # noqa: S101 - one row was inserted
            record = int(key[0])
            connection.execute(insert(_maps).values(record=record, map=figures.map))
            return record

    def update(self, record: int, figures: RunFigures) -> None:
        """Update the record of a run.

        Args:
            record: Number of the record.
            figures: Present results.
        """
        with self._engine.begin() as connection:
            values = {"changed_ns": self._clock(), **_figures(figures)}
            connection.execute(update(_records).where(_records.c.id == record).values(**values))
            connection.execute(update(_maps).where(_maps.c.record == record).values(map=figures.map))

    def revise_all(self, record: int, changes: Sequence[Change]) -> None:
        """Store changes of parameters in one transaction, the oldest first."""
        now = self._clock()
        with self._engine.begin() as connection:
            for change in changes:
                _revise(connection, record, change, now)

    def listed(self) -> list[dict[str, Any]]:
        """Return the runs without their maps, newest first, at most MOST_LISTED."""
        query = (
            _with_source()
            .where(_records.c.deleted_ns.is_(None))
            .order_by(_records.c.changed_ns.desc(), _records.c.id.desc())
            .limit(MOST_LISTED)
        )
        with self._engine.begin() as connection:
            return [_plain(row) for row in connection.execute(query).all()]

    def whole(self, record: int) -> dict[str, Any]:
        """Return a run with its map and its parameter revisions, oldest first.

        Raises:
            UnknownError: The run does not exist or was deleted.
        """
        with self._engine.begin() as connection:
            row = _found(connection, record)
            stored = connection.execute(select(_maps.c.map).where(_maps.c.record == record)).scalar_one()
            query = select(_revisions).where(_revisions.c.record == record).order_by(_revisions.c.id)
            changes = [_plain(each) for each in connection.execute(query).all()]
        return {**_plain(row), "map": stored, "revisions": changes}

    def rename(self, record: int, name: str) -> None:
        """Rename a run.

        Raises:
            UnknownError: The run does not exist or was deleted.
        """
        with self._engine.begin() as connection:
            _found(connection, record)
            connection.execute(update(_records).where(_records.c.id == record).values(name=name))

    def delete(self, record: int) -> None:
        """Delete a run; the deletion can be undone for one month.

        Raises:
            UnknownError: The run does not exist.
        """
        with self._engine.begin() as connection:
            _found(connection, record)
            connection.execute(
                update(_records).where(_records.c.id == record).values(deleted_ns=self._clock())
            )

    def bring_back(self, record: int) -> None:
        """Undo the deletion of a run.

        Raises:
            UnknownError: The run does not exist any more.
        """
        with self._engine.begin() as connection:
            found = connection.execute(
                update(_records).where(_records.c.id == record).values(deleted_ns=None)
            )
            if not found.rowcount:
                raise _unknown(record)

    # --- uploads ---------------------------------------------------------------------------------

    def add_upload(self, file: str, name: str, kind: str, size: int) -> None:
        """Store the original name of an uploaded file.

        Args:
            file: Name of the file in the folder of uploads.
            name: Original name.
            kind: Name of its format.
            size: Number of bytes.
        """
        values = {"name": name[:200], "kind": kind[:200], "bytes": size, "at_ns": self._clock()}
        with self._engine.begin() as connection:
            connection.execute(insert(_uploads).values(file=file, **values))

    def uploads(self) -> dict[str, dict[str, Any]]:
        """Return the records of uploaded files by their names in the folder."""
        with self._engine.begin() as connection:
            return {row.file: _plain(row) for row in connection.execute(select(_uploads)).all()}


def _revise(connection: Connection, record: int, change: Change, now: int) -> None:
    query = select(_revisions).where(_revisions.c.record == record).order_by(_revisions.c.id.desc())
    last = connection.execute(query.limit(1)).one_or_none()
    values = {"revision": change.revision, "at_ns": now, "time_s": change.time_s, "preset": change.preset}
    if last is not None and _is_one_move(last, change, now):
        changes = {name: [last.changes[name][0], after] for name, (_, after) in change.changes.items()}
        same = _revisions.c.id == last.id
        connection.execute(update(_revisions).where(same).values(**values, changes=changes))
        return
    inserted = {"record": record, "who": change.who, "changes": change.changes}
    connection.execute(insert(_revisions).values(**values, **inserted))


def _with_source() -> Select[Any]:
    """Return the query of records with `source`, which all runs of one recording share."""
    return select(_records, _runs.c.source).join(_runs, _runs.c.id == _records.c.run)


def _figures(figures: RunFigures) -> dict[str, Any]:
    """Return the columns of `run_records` that change while a run plays."""
    return {each.name: getattr(figures, each.name) for each in fields(figures) if each.name != "map"}


def _is_one_move(last: Row[Any], change: Change, now: int) -> bool:
    return bool(
        last.who == change.who
        and last.changes.keys() == change.changes.keys()
        and now - last.at_ns <= _ONE_MOVE_NS
    )


def _found(connection: Connection, record: int) -> Row[Any]:
    query = _with_source().where(_records.c.id == record, _records.c.deleted_ns.is_(None))
    row = connection.execute(query).one_or_none()
    if row is None:
        raise _unknown(record)
    return row


def _forget_deleted(connection: Connection, before_ns: int) -> None:
    gone = select(_records.c.id).where(_records.c.deleted_ns < before_ns)
    connection.execute(delete(_maps).where(_maps.c.record.in_(gone)))
    connection.execute(delete(_revisions).where(_revisions.c.record.in_(gone)))
    connection.execute(delete(_records).where(_records.c.deleted_ns < before_ns))


def _plain(row: Row[Any]) -> dict[str, Any]:
    return dict(row._mapping)


def _unknown(record: int) -> UnknownError:
    return UnknownError("there is no such run", where=f"run {record}", remedy="Load the list again")
