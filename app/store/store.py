"""Reads and edits annotations, saved parameter sets, and records of runs and uploaded recordings. The browser
that made an edit of an annotation can undo it.

Every change stores the content before and after it, and an annotation stores which change led to its current
content. A change can be undone while it is still the last one of its annotation.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from sqlalchemy import (
    ColumnElement,
    Connection,
    Engine,
    Insert,
    Row,
    ScalarSelect,
    Select,
    case,
    delete,
    func,
    insert,
    select,
    true,
    update,
)

from app.sources.request import SourceRequest, request_of_kept
from app.store.database import annotated as _annotations
from app.store.database import changes as _changes
from app.store.database import maps as _maps
from app.store.database import open_engine
from app.store.database import parameter_sets as _sets
from app.store.database import records as _records
from app.store.database import revisions as _revisions
from app.store.database import runs as _runs
from app.store.database import steps as _steps
from app.store.database import uploads as _uploads
from app.store.records import (
    FRAME,
    KINDS,
    MOST_ANNOTATIONS,
    MOST_SETS,
    REPAIR,
    SKIPPED,
    Annotation,
    Author,
    Change,
    Changed,
    Content,
    NewRun,
    NoFilesError,
    RunFigures,
    SavedSet,
    StaleError,
    UnknownError,
    moment,
)
from pipeline.errors import StemmapError


@dataclass(frozen=True, slots=True)
class AnnotatedSource:
    """A source with its annotations.

    Attributes:
        source: Digest of the recording, or its URI where it has no digest.
        name: Name under which it was opened last.
        request: How it was mapped last, with its parameters; the defaults where it was never mapped.
        annotations: The annotations of KINDS that are not deleted.
    """

    source: str
    name: str
    request: SourceRequest
    annotations: tuple[Content, ...]


class Sets:
    """Saved parameter sets.

    Args:
        engine: Database engine.
        clock: Returns the time in nanoseconds since 1970.
    """

    def __init__(self, engine: Engine, clock: Callable[[], int]) -> None:
        self._engine, self._clock = engine, clock

    def all(self) -> list[SavedSet]:
        """Return every set, sorted by name."""
        with self._engine.begin() as connection:
            rows = connection.execute(select(_sets).order_by(_sets.c.name)).all()
        return [SavedSet(row.name, row.toml, row.who, row.at_ns) for row in rows]

    def save(self, name: str, toml: str, who: str) -> None:
        """Save a set under a name; it replaces a set of the same name. The contents are not checked.

        Args:
            name: Name of the set.
            toml: Contents of its file.
            who: Name of the person.

        Raises:
            StemmapError: There are MOST_SETS other sets; nothing changes.
        """
        with self._engine.begin() as connection:
            connection.execute(delete(_sets).where(_sets.c.name == name))
            if connection.execute(select(func.count()).select_from(_sets)).scalar_one() >= MOST_SETS:
                raise StemmapError(f"there are {MOST_SETS} saved sets already", remedy="Delete some first")
            values = {"name": name, "toml": toml, "who": who, "at_ns": self._clock()}
            connection.execute(insert(_sets).values(**values))

    def delete(self, name: str) -> None:
        """Delete a set.

        Raises:
            UnknownError: No set has this name.
        """
        with self._engine.begin() as connection:
            if connection.execute(delete(_sets).where(_sets.c.name == name)).rowcount == 0:
                raise UnknownError("there is no saved set of this name", where=name)


# Longer keys are URIs, never digests.
_LONGEST_KEY = 600


MOST_LISTED = 500
# The page returns places and diameters rounded to 0.1 mm, which moves them by up to half of it.
_ROUNDED_M = 0.00006
# Time during which a deletion can be undone.
_KEPT_NS = 30 * 86_400 * 1_000_000_000
# Changes of the same parameters by one person within this time count as one change (a slider drag).
_ONE_MOVE_NS = 3_000_000_000


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
        """Store the record of a new run and return its number. For an uploaded file the record gets its
        original name; names are cut to 200 characters. Runs that were deleted more than 30 days ago are
        removed for good."""
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
            record = _inserted(connection, insert(_records).values(**values))
            connection.execute(insert(_maps).values(record=record, map=figures.map))
            return record

    def update(self, record: int, figures: RunFigures) -> None:
        """Update results and map of a record, also of a deleted one; nothing happens if it does not exist.

        Args:
            record: Number of the record.
            figures: Present results.
        """
        with self._engine.begin() as connection:
            values = {"changed_ns": self._clock(), **_figures(figures)}
            connection.execute(update(_records).where(_records.c.id == record).values(**values))
            connection.execute(update(_maps).where(_maps.c.record == record).values(map=figures.map))

    def revise_all(self, record: int, changes: Sequence[Change]) -> None:
        """Store changes of parameters of an existing record in one transaction, the oldest first. Successive
        changes of the same parameters by one person within 3 s become one revision, which is removed if all
        values are as before it."""
        now = self._clock()
        with self._engine.begin() as connection:
            for change in changes:
                _revise(connection, record, change, now)

    def listed(self) -> list[dict[str, Any]]:
        """Return at most MOST_LISTED runs that are not deleted, the last changed first. Each is a dict of the
        columns of `run_records` and `source`, the key of the recording."""
        query = (
            _with_source()
            .where(_records.c.deleted_ns.is_(None))
            .order_by(_records.c.changed_ns.desc(), _records.c.id.desc())
            .limit(MOST_LISTED)
        )
        with self._engine.begin() as connection:
            return [_plain(row) for row in connection.execute(query).all()]

    def whole(self, record: int) -> dict[str, Any]:
        """Return a run as in `listed` with two further keys: `map`, see `RunFigures`, and `revisions`, a list
        of dicts of the columns of `parameter_revisions`, the oldest first.

        Raises:
            UnknownError: The run does not exist or was deleted.
        """
        with self._engine.begin() as connection:
            row = _found(connection, record)
            stored = connection.execute(select(_maps.c.map).where(_maps.c.record == record)).scalar_one()
            query = select(_revisions).where(_revisions.c.record == record).order_by(_revisions.c.id)
            changes = [_plain(each) for each in connection.execute(query).all()]
        return {**_plain(row), "map": stored, "revisions": changes}

    def map(self, record: int) -> dict[str, Any]:
        """Return the map of a run, see `RunFigures`, also of a deleted one; one without trees for an unknown
        run."""
        with self._engine.begin() as connection:
            stored = connection.execute(select(_maps.c.map).where(_maps.c.record == record)).scalar()
        return stored or {"trees": []}

    def put_files(self, record: int, files: bytes) -> None:
        """Store the result files of a run, a zip archive; nothing happens if it does not exist."""
        with self._engine.begin() as connection:
            connection.execute(update(_maps).where(_maps.c.record == record).values(files=files))

    def files(self, record: int) -> bytes:
        """Return the result files of a run, a zip archive.

        Raises:
            UnknownError: The run does not exist or was deleted.
            NoFilesError: The record has no files.
        """
        with self._engine.begin() as connection:
            _found(connection, record)
            files = connection.execute(select(_maps.c.files).where(_maps.c.record == record)).scalar()
        if files is None:
            raise NoFilesError(
                "this run was recorded without its result files",
                remedy="Replay it; then it can be used here",
            )
        return bytes(files)

    def rename(self, record: int, name: str) -> None:
        """Rename a run.

        Raises:
            UnknownError: The run does not exist or was deleted.
        """
        self._set(record, _records.c.deleted_ns.is_(None), name=name)

    def delete(self, record: int) -> None:
        """Delete a run; the deletion can be undone for 30 days.

        Raises:
            UnknownError: The run does not exist or was deleted.
        """
        self._set(record, _records.c.deleted_ns.is_(None), deleted_ns=self._clock())

    def bring_back(self, record: int) -> None:
        """Undo the deletion of a run; nothing happens if it was not deleted.

        Raises:
            UnknownError: The run does not exist any more.
        """
        self._set(record, deleted_ns=None)

    def _set(self, record: int, *conditions: ColumnElement[bool], **values: object) -> None:
        """Set columns of the record of a run.

        Raises:
            UnknownError: The record does not exist or does not meet the conditions.
        """
        chosen = update(_records).where(_records.c.id == record, *conditions)
        with self._engine.begin() as connection:
            if not connection.execute(chosen.values(**values)).rowcount:
                raise _unknown(record)

    # --- uploads ---------------------------------------------------------------------------------

    def add_upload(self, file: str, name: str, kind: str, size: int) -> None:
        """Store the original name of an uploaded file. An error of the database is raised if `file` has a
        record.

        Args:
            file: Name of the file in the folder of uploads.
            name: Original name; 200 characters are stored.
            kind: Name of its format; 200 characters are stored.
            size: Number of bytes.
        """
        values = {"name": name[:200], "kind": kind[:200], "bytes": size, "at_ns": self._clock()}
        with self._engine.begin() as connection:
            connection.execute(insert(_uploads).values(file=file, **values))

    def uploads(self) -> dict[str, dict[str, Any]]:
        """Return a dict from the name of each uploaded file in the folder to a dict with `file` (this name),
        `name` (the original name), `kind`, `bytes` (size) and `at_ns`."""
        with self._engine.begin() as connection:
            return {row.file: _plain(row) for row in connection.execute(select(_uploads)).all()}


def _revise(connection: Connection, record: int, change: Change, now: int) -> None:
    """Store a change of parameters, or extend the last revision of the record if both are one move. The
    revision is deleted if all its values are then as before it.

    Args:
        connection: Connection with an open transaction.
        record: Number of the record.
        change: The change.
        now: Time [ns since 1970].
    """
    query = select(_revisions).where(_revisions.c.record == record).order_by(_revisions.c.id.desc())
    last = connection.execute(query.limit(1)).one_or_none()
    values = {"revision": change.revision, "at_ns": now, "time_s": change.time_s, "preset": change.preset}
    if last is not None and _is_one_move(last, change, now):
        changed = {name: [last.changes[name][0], after] for name, (_, after) in change.changes.items()}
        changes = {name: [before, after] for name, (before, after) in changed.items() if before != after}
        same = _revisions.c.id == last.id
        if changes:
            connection.execute(update(_revisions).where(same).values(**values, changes=changes))
        else:  # the slider is back where it was
            connection.execute(delete(_revisions).where(same))
        return
    inserted = {"record": record, "who": change.who, "changes": change.changes}
    connection.execute(insert(_revisions).values(**values, **inserted))


def _with_source() -> Select[Any]:
    """Return the query of records with `source`, which all runs of one recording share."""
    return select(_records, _runs.c.source).join(_runs, _runs.c.id == _records.c.run)


def _figures(figures: RunFigures) -> dict[str, Any]:
    """Return a dict from the columns of `run_records` that change while a run plays to values: all fields of
    `figures` except `map`."""
    return {each.name: getattr(figures, each.name) for each in fields(figures) if each.name != "map"}


def _is_one_move(last: Row[Any], change: Change, now: int) -> bool:
    """Return whether a change continues the last revision: same person and parameters, within 3 s.

    Args:
        last: Row of the last revision.
        change: The change.
        now: Time of the change [ns since 1970].
    """
    return bool(
        last.who == change.who
        and last.changes.keys() == change.changes.keys()
        and now - last.at_ns <= _ONE_MOVE_NS
    )


def _found(connection: Connection, record: int) -> Row[Any]:
    """Return a record with its source; raises UnknownError if it does not exist or was deleted."""
    query = _with_source().where(_records.c.id == record, _records.c.deleted_ns.is_(None))
    row = connection.execute(query).one_or_none()
    if row is None:
        raise _unknown(record)
    return row


def _forget_deleted(connection: Connection, before_ns: int) -> None:
    """Remove records that were deleted before a time [ns since 1970], with their maps and revisions."""
    gone = select(_records.c.id).where(_records.c.deleted_ns < before_ns)
    connection.execute(delete(_maps).where(_maps.c.record.in_(gone)))
    connection.execute(delete(_revisions).where(_revisions.c.record.in_(gone)))
    connection.execute(delete(_records).where(_records.c.deleted_ns < before_ns))


def _plain(row: Row[Any]) -> dict[str, Any]:
    """Return a row as a dict from column names to values."""
    return dict(row._mapping)


def _unknown(record: int) -> UnknownError:
    """Return the error of a record that does not exist."""
    return UnknownError("there is no such run", where=f"run {record}", remedy="Load the list again")


class Store:
    """Annotations of all runs; `book` holds the records of the runs.

    Args:
        folder: Folder of the database; None keeps it in memory.
        clock: Returns the time in nanoseconds since 1970.

    Raises:
        StemmapError: The database cannot be used; the file is not modified.
    """

    def __init__(self, folder: Path | None, clock: Callable[[], int] = time.time_ns) -> None:
        self._engine = open_engine(folder)
        self._clock = clock
        self.book = RunRecords(self._engine, clock)

    @property
    def sets(self) -> Sets:
        """The saved parameter sets."""
        return Sets(self._engine, self._clock)

    def close(self) -> None:
        """Close the database."""
        self._engine.dispose()

    def open_run(self, source: str, uri: str, name: str) -> int:
        """Return the number of a source, which is stored if it is new; URI, name and time of a known one are
        updated. The number does not depend on the path of the recording.

        Args:
            source: Digest of the recording, or its URI if it has no digest.
            uri, name: Current URI and name.
        """
        now = {"uri": uri, "name": name, "opened_ns": self._clock()}
        source = _key(source)
        with self._engine.begin() as connection:
            known = connection.execute(select(_runs.c.id).where(_runs.c.source == source)).scalar()
            if known is None:
                return _inserted(connection, insert(_runs).values(source=source, **now))
            connection.execute(update(_runs).where(_runs.c.id == known).values(**now))
            return int(known)

    def annotations(self, run: int) -> list[Annotation]:
        """Return the annotations of the source with this number that are not deleted, in the order of their
        creation; [] for an unknown number."""
        query = (
            select(_annotations, _steps.c.who.label("by"))
            .outerjoin(_changes, _changes.c.id == _annotations.c.made_by)
            .outerjoin(_steps, _steps.c.id == _changes.c.step)
            .where(_annotations.c.run == run, _annotations.c.deleted.is_(False))
        )
        with self._engine.begin() as connection:
            rows = connection.execute(query.order_by(_annotations.c.id)).all()
        return [_annotation(row, row.by) for row in rows]

    def contents(self, source: str, kind: str = "") -> list[Content]:
        """Return the contents of the annotations of a source that are not deleted, in the order of their
        creation; [] for an unknown source.

        Args:
            source: Digest of the recording, or its URI if it has no digest.
            kind: Class of the annotations; "" for all.
        """
        query = (
            select(_annotations)
            .join(_runs, _runs.c.id == _annotations.c.run)
            .where(_runs.c.source == _key(source), _annotations.c.deleted.is_(False))
            .where(_annotations.c.kind == kind if kind else true())
        )
        with self._engine.begin() as connection:
            return [_content(row) for row in connection.execute(query.order_by(_annotations.c.id))]

    def was_reviewed(self, source: str) -> bool:
        """Return whether a tree of a source was ever reviewed: whether it has an annotation of KINDS or
        SKIPPED, also one that is deleted now.

        Args:
            source: Digest of the recording, or its URI if it has no digest.
        """
        query = (
            select(_annotations.c.id)
            .join(_runs, _runs.c.id == _annotations.c.run)
            .where(_runs.c.source == _key(source), _annotations.c.kind.in_((*KINDS, SKIPPED)))
        )
        with self._engine.begin() as connection:
            return connection.execute(query.limit(1)).scalar() is not None

    def annotation_counts(self) -> dict[int, int]:
        """Return a dict from the number of each source with annotations of KINDS to their number."""
        a = _annotations.c
        query = select(a.run, func.count()).where(a.deleted.is_(False), a.kind.in_(KINDS)).group_by(a.run)
        with self._engine.begin() as connection:
            return {row.run: row[1] for row in connection.execute(query)}

    def annotation_versions(self) -> dict[int, int]:
        """Return a dict from the number of each source that ever had annotations to the sum of their
        versions, which grows with each edit."""
        query = select(_annotations.c.run, func.sum(_annotations.c.version)).group_by(_annotations.c.run)
        with self._engine.begin() as connection:
            return {row.run: int(row[1]) for row in connection.execute(query)}

    def annotated_sources(self) -> list[AnnotatedSource]:
        """Return all sources with annotations of KINDS, in the order of their first opening, and how each was
        mapped last."""
        a = _annotations.c
        query = select(a.run, a.x, a.y, a.kind, a.dbh).where(a.deleted.is_(False), a.kind.in_(KINDS))
        with self._engine.begin() as connection:
            contents: dict[int, list[Content]] = {}
            for row in connection.execute(query.order_by(a.id)):
                contents.setdefault(row.run, []).append(Content(row.x, row.y, row.kind, row.dbh))
            runs = select(_runs).where(_runs.c.id.in_(contents)).order_by(_runs.c.id)
            return [
                AnnotatedSource(run.source, run.name, _request_of(connection, run), tuple(contents[run.id]))
                for run in connection.execute(runs)
            ]

    def add(self, run: int, author: Author, contents: Sequence[Content]) -> list[int]:
        """Add annotations in one step and return their ids, in the order of `contents`.

        Args:
            run: Number of the source, see `open_run`.
            author: Author of the edit.
            contents: Contents of the annotations.

        Raises:
            StemmapError: There would be more than MOST_ANNOTATIONS annotations; none is added.
            StaleError: The run has a reference system (FRAME) already, and the contents have one; none is
                added.
        """
        return self.edit(run, author, contents, ())

    def change(self, run: int, author: Author, id_: int, version: int, content: Content | None) -> None:
        """Change the content of an annotation, or delete it, in one step. The same content as before changes
        nothing and is no step.

        Args:
            run: Number of the source, see `open_run`.
            author: Author of the edit.
            id_: Identifier of the annotation.
            version: Version that the author has seen.
            content: New content; None deletes it.

        Raises:
            UnknownError: The run has no annotation with this id, or it has `values` and the new content has
                none, or the reverse.
            StaleError: The annotation has another version or is deleted; the message names author and time of
                the last change.
        """
        self.edit(run, author, (), [(id_, version, content)])

    def edit(
        self,
        run: int,
        author: Author,
        added: Sequence[Content],
        changed: Sequence[tuple[int, int, Content | None]],
    ) -> list[int]:
        """Add and change annotations in one step and return the ids of the added ones; errors as in `add` and
        `change`, then nothing changes.

        Args:
            run: Number of the source, see `open_run`.
            author: Author of the edit.
            added: Contents of new annotations.
            changed: Id, version and new content of each changed annotation, as in `change`; a content of an
                annotation that is deleted, at its present version, brings it back.
        """
        with self._engine.begin() as connection:
            counted = select(func.count()).where(_annotations.c.run == run, _annotations.c.deleted.is_(False))
            if added and connection.execute(counted).scalar_one() + len(added) > MOST_ANNOTATIONS:
                raise StemmapError(f"a run may have {MOST_ANNOTATIONS} annotations")
            frame = _frame(connection, run)
            if frame is not None and any(content.kind == FRAME for content in added):
                raise _stale(connection, frame)
            rows = [
                (_to_change(connection, run, id_, version, content), content)
                for id_, version, content in changed
            ]
            rows = [(row, content) for row, content in rows if row.deleted or content != _content(row)]
            if not added and not rows:
                return []
            kinds = [*(content.kind for content in added), *(row.kind for row, _ in rows)]
            step = self._step(connection, run, author, {_subject(kind) for kind in kinds})
            ids = [self._add(connection, run, step, author, content) for content in added]
            for row, content in rows:
                self._change(connection, step, author, row, content)
            return ids

    def change_with(
        self, run: int, author: Author, id_: int, changed: Sequence[tuple[int, int, Content | None]]
    ) -> None:
        """Change annotations in the step that added another one, so that both are undone together; nothing if
        that one was deleted since. Other arguments and errors as in `edit`.

        Args:
            run, author: As in `edit`.
            id_: Identifier of the annotation that was added.
            changed: As in `edit`.
        """
        added = select(_changes.c.step).where(_changes.c.annotation == id_).order_by(_changes.c.id)
        with self._engine.begin() as connection:
            if _row(connection, id_).deleted:
                return
            step = connection.execute(added.limit(1)).scalar_one()
            for each, version, content in changed:
                row = _to_change(connection, run, each, version, content)
                self._change(connection, step, author, row, content)

    def changed_with(self, id_: int) -> list[Changed]:
        """Return the changes of other annotations in the step that added an annotation. Those that were
        deleted are left out, unless this step has deleted them and they were not changed since.

        Args:
            id_: Identifier of the annotation.
        """
        added = select(_changes.c.step).where(_changes.c.annotation == id_).order_by(_changes.c.id)
        step = added.limit(1).scalar_subquery()
        query = select(_changes).where(_changes.c.step == step).order_by(_changes.c.id)
        found = list[Changed]()
        with self._engine.begin() as connection:
            for change in connection.execute(query).all():
                row = _row(connection, change.annotation)
                deleted_since = row.deleted and row.made_by != change.id
                if change.before is None or deleted_since or row.deleted != (change.after is None):
                    continue
                after = None if change.after is None else _as_content(change.after)
                found.append(
                    (_annotation(row, _author_of(connection, row.made_by)), _as_content(change.before), after)
                )
        return found

    def undo(self, run: int, author: Author, subjects: Sequence[str] = ()) -> None:
        """Undo the last step of a browser that is not undone, with all its annotations.

        Args:
            run: Number of the source, see `open_run`.
            author: Author, with the browser.
            subjects: Only steps of these subjects are considered, see `steps`; empty for all steps.

        Raises:
            StemmapError: There is no step to undo.
            StaleError: An annotation of the step was changed since, or the run would get a second reference
                system; nothing is undone, and the step is skipped from now on.
        """
        self._turn(run, author, "undone", subjects)

    def redo(self, run: int, author: Author, subjects: Sequence[str] = ()) -> None:
        """Redo the step that a browser undid last; arguments and errors as in `undo`."""
        self._turn(run, author, "done", subjects)

    def steps(self, run: int, browser: str) -> tuple[dict[str, int], dict[str, int]]:
        """Return the numbers of steps that a browser can undo and redo, as dicts from the subject of the
        steps, that of the first annotation of a step: "tree" for KINDS and SKIPPED, "repair", or "other" for
        the reference system and classes of extensions.

        Args:
            run: Number of the source, see `open_run`.
            browser: Identifier of the browser.
        """
        query = select(_steps.c.state, _subject_of_step().label("subject")).where(
            _steps.c.run == run, _steps.c.browser == browser
        )
        undo, redo = Counter[str](), Counter[str]()
        with self._engine.begin() as connection:
            for state, subject in connection.execute(query):
                {"done": undo, "undone": redo}.get(state, Counter())[subject] += 1
        return dict(undo), dict(redo)

    # --- one edit --------------------------------------------------------------------------------

    def _step(self, connection: Connection, run: int, author: Author, subjects: Collection[str]) -> int:
        """Store a new step of a browser and return its number; steps of the same subjects that this browser
        undid before can no longer be redone.

        Args:
            connection: Connection with an open transaction.
            run: Number of the source.
            author: Author of the edit, with the browser.
            subjects: Subjects of the annotations of the step, see `steps`.
        """
        undone = (_steps.c.run == run, _steps.c.browser == author.browser, _steps.c.state == "undone")
        same = _subject_of_step().in_(subjects)
        connection.execute(update(_steps).where(*undone, same).values(state="left"))
        values = {"browser": author.browser, "who": author.who, "at_ns": self._clock(), "state": "done"}
        return _inserted(connection, insert(_steps).values(run=run, **values))

    def _add(self, connection: Connection, run: int, step: int, author: Author, content: Content) -> int:
        """Insert an annotation with its change, and return its id.

        Args:
            connection: Connection with an open transaction.
            run: Number of the source.
            step: Number of the step.
            author: Author of the edit.
            content: Content of the annotation.
        """
        stored = _columns(content, *_authors(None, content, author))
        edit = {"at_ns": self._clock(), "version": 1, "deleted": False, "made_by": 0}
        id_ = _inserted(connection, insert(_annotations).values(run=run, **stored, **edit))
        values = {
            "step": step,
            "annotation": id_,
            "before": None,
            "after": stored,
            "made_before": 0,
        }
        change = _inserted(connection, insert(_changes).values(**values))
        connection.execute(update(_annotations).where(_annotations.c.id == id_).values(made_by=change))
        return id_

    def _change(
        self, connection: Connection, step: int, author: Author, row: Row[Any], content: Content | None
    ) -> None:
        """Store a change of an annotation and set its content.

        Args:
            connection: Connection with an open transaction.
            step: Number of the step.
            author: Author of the edit.
            row: Present row of the annotation.
            content: New content; None deletes the annotation.
        """
        values = {
            "step": step,
            "annotation": row.id,
            "before": None if row.deleted else _columns(_content(row), row.who, row.dbh_who),
            "after": None if content is None else _columns(content, *_authors(row, content, author)),
            "made_before": row.made_by,
        }
        change = _inserted(connection, insert(_changes).values(**values))
        self._put(connection, author.who, row, values["after"], change)

    def _put(
        self, connection: Connection, who: str, row: Row[Any], content: dict[str, Any] | None, by: int
    ) -> None:
        """Set the current content of an annotation.

        Args:
            connection: Connection with an open transaction.
            who: Name of the author, unless the content has it.
            row: Present row of the annotation.
            content: New content, see `_columns`; None deletes the annotation.
            by: Number of the change that led to the content.
        """
        edit = {"at_ns": self._clock(), "version": row.version + 1, "made_by": by}
        values = {"who": who, "dbh_who": None, **edit, "deleted": content is None, **(content or {})}
        connection.execute(update(_annotations).where(_annotations.c.id == row.id).values(**values))

    # --- back and forth --------------------------------------------------------------------------

    def _turn(self, run: int, author: Author, to: Literal["done", "undone"], subjects: Sequence[str]) -> None:
        """Undo or redo the next step of a browser. If an annotation of the step was changed since, or the run
        would get a second reference system, nothing is undone or redone, and the step can never be undone or
        redone again, unless a later edit of the same browser is the reason.

        Args:
            run: Number of the source.
            author: Author, with the browser.
            to: State of the step afterwards: "undone" or "done".
            subjects: Subjects of the steps, empty for all.

        Raises:
            StemmapError: There is no such step.
            StaleError: An annotation of the step was changed, or a reference system was added, since.
        """
        with self._engine.begin() as connection:
            step = _next_step(connection, run, author, to, subjects)
            query = select(_changes).where(_changes.c.step == step).order_by(_changes.c.id)
            pairs = [
                (change, _row(connection, change.annotation)) for change in connection.execute(query).all()
            ]
            back = to == "undone"
            stale = next((row for c, row in pairs if row.made_by != (c.id if back else c.made_before)), None)
            if stale is None and any(row.deleted and row.kind == FRAME for _, row in pairs):
                stale = _frame(connection, run)
            own = stale is not None and _is_of_a_later_step(connection, stale, author)
            state = to if stale is None else ("done" if back else "undone") if own else "left"
            connection.execute(update(_steps).where(_steps.c.id == step).values(state=state))
            for change, row in () if stale is not None else pairs:
                content, by = (change.before, change.made_before) if back else (change.after, change.id)
                who = None if content is None else _author_of(connection, by)
                self._put(connection, who or author.who, row, content, by)
            error = None if stale is None else _stale(connection, stale)
        if own:
            raise StaleError(
                "a later edit of yours changed the same annotation", remedy="Undo that edit first, in its tab"
            )
        if error is not None:  # not earlier: the skip of the step must persist
            raise error


def _request_of(connection: Connection, run: Row[Any]) -> SourceRequest:
    """Return the request of the newest record of a source that has a scan and is not deleted, with the path
    at which the source was opened last; the defaults without such a record."""
    newest = connection.execute(
        select(_records)
        .where(_records.c.run == run.id, _records.c.deleted_ns.is_(None), _records.c.scans > 0)
        .order_by(_records.c.changed_ns.desc(), _records.c.id.desc())
        .limit(1)
    ).one_or_none()
    if newest is None:
        return SourceRequest(run.uri)
    return request_of_kept(
        run.uri,
        odometry=newest.odometry,
        seed=newest.seed,
        choices=newest.chosen,
        preset=newest.preset,
        parameters=newest.parameters,
    )


def _next_step(connection: Connection, run: int, author: Author, to: str, subjects: Sequence[str]) -> int:
    """Return the number of the next step to undo or redo.

    Args:
        connection: Connection with an open transaction.
        run: Number of the source.
        author: Author, with the browser.
        to: State after the step: "undone" or "done".
        subjects: Subjects of the steps, empty for all.

    Raises:
        StemmapError: There is no such step.
    """
    # Undone steps follow the active ones and were undone from the end.
    newest, state = (func.max, "done") if to == "undone" else (func.min, "undone")
    query = select(newest(_steps.c.id)).where(
        _steps.c.run == run,
        _steps.c.browser == author.browser,
        _steps.c.state == state,
        _subject_of_step().in_(subjects) if subjects else true(),
    )
    step = connection.execute(query).scalar()
    if step is None:
        raise StemmapError(f"there is nothing to {'undo' if to == 'undone' else 'do again'}")
    return int(step)


def _subject(kind: str) -> str:
    """Return the subject of an annotation of a class, see `Store.steps`."""
    return "tree" if kind in (*KINDS, SKIPPED) else kind if kind == REPAIR else "other"


def _subject_of_step() -> ScalarSelect[str]:
    """Return the subject of a step, that of its first annotation, as an expression of the row of `steps`."""
    kind = _annotations.c.kind
    return (
        select(case((kind.in_((*KINDS, SKIPPED)), "tree"), (kind == REPAIR, REPAIR), else_="other"))
        .join(_changes, _changes.c.annotation == _annotations.c.id)
        .where(_changes.c.step == _steps.c.id)
        .order_by(_changes.c.id)
        .limit(1)
        .correlate(_steps)
        .scalar_subquery()
    )


def _to_change(connection: Connection, run: int, id_: int, version: int, content: Content | None) -> Row[Any]:
    """Return the row of an annotation that is changed; arguments and errors as in `Store.change`."""
    row = connection.execute(
        select(_annotations).where(_annotations.c.id == id_, _annotations.c.run == run)
    ).one_or_none()
    if row is None or (content is not None and (content.values is None) != (row.plot is None)):
        raise UnknownError("there is no such annotation", where=f"annotation {id_}")
    if row.version != version or (row.deleted and content is None):
        raise _stale(connection, row)
    return row


def _row(connection: Connection, id_: int) -> Row[Any]:
    """Return the row of an annotation, also of a deleted one. It must exist."""
    return connection.execute(select(_annotations).where(_annotations.c.id == id_)).one()


def _frame(connection: Connection, run: int) -> Row[Any] | None:
    """Return the row of the reference system of a run that is not deleted; None if there is none."""
    a = _annotations.c
    return connection.execute(
        select(_annotations).where(a.run == run, a.kind == FRAME, a.deleted.is_(False)).limit(1)
    ).one_or_none()


def _authors(row: Row[Any] | None, content: Content, author: Author) -> tuple[str, str | None]:
    """Return the authors of a new content and of its DBH: an edit of the DBH alone leaves the class its
    author, and an edit of the class leaves the DBH its own.

    Args:
        row: Present row of the annotation; None if it is added.
        content: The new content.
        author: Author of the edit.
    """
    who, dbh_who = content.who or author.who, content.dbh_who or content.who or author.who
    if row is not None and not row.deleted:
        if content.dbh is not None and row.dbh is not None and abs(row.dbh - content.dbh) <= _ROUNDED_M:
            dbh_who = row.dbh_who or row.who
        moved = max(abs(content.x - row.x), abs(content.y - row.y))
        if moved <= _ROUNDED_M and (content.kind, content.values) == (row.kind, row.plot):
            who = row.who
    return who, None if content.dbh is None else dbh_who


def _columns(content: Content, who: str, dbh_who: str | None) -> dict[str, Any]:
    """Return a content and its authors as values of the columns of annotations, as they are also stored in
    changes; older changes have no authors there, see `_author_of`."""
    return {
        "who": who,
        "dbh_who": dbh_who,
        "x": content.x,
        "y": content.y,
        "kind": content.kind,
        "dbh": content.dbh,
        "plot": content.values,
        "reach": content.reach,
    }


def _annotation(row: Row[Any], by: str | None) -> Annotation:
    """Return the annotation of a row, whose last edit was made by `by`; in older tables the author of the
    annotation is also that of the edit and of the DBH."""
    dbh_who = "" if row.dbh is None else row.dbh_who or row.who
    return Annotation(row.id, _content(row), row.who, dbh_who, by or row.who, row.at_ns, row.version)


def _content(row: Row[Any]) -> Content:
    """Return the content of the row of an annotation."""
    return Content(row.x, row.y, row.kind, row.dbh, row.plot, row.reach)


def _as_content(columns: dict[str, Any]) -> Content:
    """Return the content whose `_columns` these are, with its authors."""
    place, authors = (columns["x"], columns["y"]), (columns.get("who") or "", columns.get("dbh_who") or "")
    return Content(*place, columns["kind"], columns["dbh"], columns["plot"], columns.get("reach"), *authors)


def _key(source: str) -> str:
    """Return the lookup key of a source: itself, or the text "sha256" and its digest if it is longer than 600
    characters."""
    return source if len(source) <= _LONGEST_KEY else f"sha256 {sha256(source.encode()).hexdigest()}"


def _inserted(connection: Connection, statement: Insert) -> int:
    """Insert a row and return its id."""
    key = connection.execute(statement).inserted_primary_key
    assert key is not None  # noqa: S101 - one row was inserted
    return int(key[0])


def _author_of(connection: Connection, change: int) -> str | None:
    """Return the name of the author of the step of a change; None for the number of no change."""
    steps = select(_steps.c.who).join(_changes, _changes.c.step == _steps.c.id)
    return connection.execute(steps.where(_changes.c.id == change)).scalar()


def _is_of_a_later_step(connection: Connection, row: Row[Any], author: Author) -> bool:
    """Return whether the present content of an annotation is that of an edit of this browser that was not
    undone."""
    made_by = (
        select(_steps.c.browser, _steps.c.state)
        .join(_changes, _changes.c.step == _steps.c.id)
        .where(_changes.c.id == row.made_by)
    )
    step = connection.execute(made_by).one_or_none()
    return step is not None and step.browser == author.browser and step.state == "done"


def _stale(connection: Connection, row: Row[Any]) -> StaleError:
    """Return the error of an edit of an annotation that was changed or deleted meanwhile; `row` is its
    present row."""
    done = "deleted" if row.deleted else "changed"
    who = _author_of(connection, row.made_by) or row.who
    return StaleError(
        f"the annotation ({row.kind}) at {row.x:.2f}, {row.y:.2f} was {done} by {who} at {moment(row.at_ns)}",
        remedy="Your edit was not saved; check the current state and try again",
    )
