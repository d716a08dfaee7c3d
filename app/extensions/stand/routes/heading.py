"""The heading of the report of the open run.

It is an annotation of the class `heading`: undo and redo are routes of `app.web.routes.annotations`.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.extensions.stand.heading import HEADING, LONGEST, heading_of
from app.store.records import Content
from app.store.store import Store
from app.web.responses import BadRequestError, Body
from app.web.routes.access import Dash, Edit, apply_edit, edited

router = APIRouter(prefix="/api")

_Name = Annotated[str, Field(max_length=LONGEST)]


class _Names(Body):
    """The fields of a `Heading` that change; None keeps a field."""

    stand: _Name | None = None
    client: _Name | None = None
    author: _Name | None = None


class _Heading(Edit):
    names: _Names


@router.put("/heading")
async def heading(body: _Heading, dashboard: Dash) -> Response:
    """Change fields of the heading of the report in one edit. Return the counts of edits, see `edited`. 409
    if another run was opened or the heading was changed meanwhile, 422 for characters that cannot be shown.
    """
    names = body.names.model_dump(exclude_none=True)
    for name, text in names.items():
        names[name] = " ".join(text.split())
        if not names[name].isprintable():
            raise BadRequestError("the text has characters that cannot be shown", where=name)
    before = [row for row in dashboard.annotation_editor.others if row.content.kind == HEADING]
    known = asdict(heading_of(row.content for row in before))
    values = {**known, **names}
    content = Content(0.0, 0.0, HEADING, None, values)
    if values != known and before:
        await apply_edit(dashboard, body, Store.change, before[-1].id, before[-1].version, content)
    elif values != known:
        await apply_edit(dashboard, body, Store.add, [content])
    return await edited(dashboard, body, {})
