"""The heading of the report of the open run.

It is an annotation of the class `heading`: undo and redo are routes of `app.web.routes.annotations`.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.extensions.stand.heading import HEADING, LONGEST
from app.store.records import Content
from app.store.store import Store
from app.web.responses import BadRequestError, Body
from app.web.routes.access import Dash, Edit, apply_edit, edited

router = APIRouter(prefix="/api")

_Name = Annotated[str, Field(max_length=LONGEST)]


class _Names(Body):
    """The fields of a `Heading`."""

    stand: _Name = ""
    client: _Name = ""
    author: _Name = ""


class _Heading(Edit):
    names: _Names


@router.put("/heading")
async def heading(body: _Heading, dashboard: Dash) -> Response:
    """Store the heading of the report in one edit, in place of the one before. Return the counts of edits,
    see `edited`. 409 if another run was opened or the heading was changed meanwhile, 422 for characters that
    cannot be shown."""
    values = {name: " ".join(text.split()) for name, text in body.names.model_dump().items()}
    for name, text in values.items():
        if not text.isprintable():
            raise BadRequestError("the text has characters that cannot be shown", where=name)
    content = Content(0.0, 0.0, HEADING, None, values)
    before = [row for row in dashboard.annotation_editor.others if row.content.kind == HEADING]
    if not before:
        await apply_edit(dashboard, body, Store.add, [content])
    elif before[-1].content.values != values:
        await apply_edit(dashboard, body, Store.change, before[-1].id, before[-1].version, content)
    return await edited(dashboard, body, {})
