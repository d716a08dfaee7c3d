"""Uploads of recordings."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Query, Request
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from app.web.auth import UPLOADS
from app.web.responses import failure_reply, json_reply
from app.web.uploads import UploadError, Uploads

router = APIRouter()


@router.get(UPLOADS)
async def room(request: Request) -> Response:
    """Return how large an upload may be now [bytes], so that a browser does not send one that is refused."""
    uploads: Uploads = request.app.state.uploads
    try:
        return json_reply({"room": await asyncio.to_thread(uploads.room), "limit": uploads.limit})
    except UploadError as error:
        return failure_reply(error.status, error)


@router.post(UPLOADS)
async def upload(request: Request, name: Annotated[str, Query(min_length=1, max_length=1000)]) -> Response:
    """Store a recording; the body is the file."""
    uploads: Uploads = request.app.state.uploads
    kind = request.headers.get("content-type", "")
    try:
        if kind != "application/octet-stream":  # what a form of another page cannot send
            raise UploadError(
                422, "the body must be the file", where="Content-Type", remedy="Send application/octet-stream"
            )
        size = request.headers.get("content-length", "")
        if not size.isdecimal():
            raise UploadError(411, "the length of the file is missing", where="Content-Length")
        return json_reply(await uploads.take(name, int(size), _pieces(request)), 201)
    except UploadError as error:
        return failure_reply(error.status, error)


async def _pieces(request: Request) -> AsyncIterator[bytes]:
    try:
        async for piece in request.stream():
            yield piece
    except ClientDisconnect:
        raise UploadError(422, "the connection ended before the file was complete") from None
