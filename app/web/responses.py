"""How the server answers: JSON, and errors that say what, where, and what to do."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from pipeline.errors import StemmapError

T = TypeVar("T")


def json_reply(content: object, status: int = 200) -> Response:
    """Records, dicts and lists as JSON; NaN becomes null."""
    return Response(
        msgspec.json.encode(content), status, {"Cache-Control": "no-store"}, media_type="application/json"
    )


def error_reply(status: int, what: str, *, where: str = "", remedy: str = "") -> Response:
    """An error as the page shows it."""
    return json_reply({"error": {"what": what, "where": where, "remedy": remedy}}, status)


def failure_reply(status: int, error: StemmapError) -> Response:
    """An error for people, as the page shows it."""
    return error_reply(status, error.what, where=error.where, remedy=error.remedy)


def table_reply(text: str, filename: str, media_type: str = "text/csv") -> Response:
    """A text to be saved as a file."""
    headers = {"Content-Disposition": f'attachment; filename="{filename}"', "Cache-Control": "no-store"}
    return Response(text, 200, headers, media_type=f"{media_type}; charset=utf-8")


class BadRequestError(StemmapError):
    """A body that is not what the route takes."""


async def body_of(request: Request, expected: type[T] | Any) -> T:  # noqa: ANN401 - a union is no `type`
    """The JSON body of a request as one of the expected types.

    Raises:
        BadRequestError: It is not JSON, or not of these types.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise BadRequestError("the body must be JSON", where="Content-Type", remedy="Send application/json")
    try:
        body: T = msgspec.json.decode(await request.body(), type=expected)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequestError(f"the body does not fit: {error}") from None
    return body
