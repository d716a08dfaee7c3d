"""All runs that have annotations, with how each was mapped last: what decision trees learn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Engine, Row, select

from app.sources.request import SourceRequest, request_of_kept
from app.store import tables
from app.store.records import Content

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
