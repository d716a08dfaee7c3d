"""All runs that have annotations, with how each was mapped last: what decision trees learn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Engine, select

from app.store import tables
from app.store.records import Content

_runs, _annotations, _records = tables.runs, tables.annotated, tables.records


@dataclass(frozen=True, slots=True)
class AnnotatedSource:
    """A source with its annotations.

    Attributes:
        source: Digest of what was recorded, else the URI; uri, name: As it was opened last.
        seed, odometry, preset, parameters: Of its newest record; of one that was never mapped, those with
            which every run begins.
        annotations: That stand.
    """

    source: str
    uri: str
    name: str
    seed: int
    odometry: str
    preset: str
    parameters: Mapping[str, Any]
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
                    run.uri,
                    run.name,
                    seed=0 if newest is None else newest.seed,
                    odometry="auto" if newest is None else newest.odometry,
                    preset="" if newest is None else newest.preset,
                    parameters={} if newest is None else newest.parameters,
                    annotations=tuple(contents[run.id]),
                )
            )
    return found
