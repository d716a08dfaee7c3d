"""Request bodies and responses of the API: validated models, JSON, and errors with their remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import msgspec
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.common.user import USER_NAME
from pipeline.errors import StemmapError

LARGEST_NUMBER = 2**31 - 1

#: A number in a path or a body, as of a run or of a tree.
Number = Annotated[int, Field(ge=0, le=LARGEST_NUMBER)]
#: A name that the server looks up, as of a parameter.
Word = Annotated[str, Field(max_length=100)]
#: A parameter's value. The bounds of each parameter are checked by its declaration.
Value = (
    bool | Annotated[int, Field(ge=-(2**53), le=2**53)] | Annotated[float, Field(ge=-1e12, le=1e12)] | Word
)
#: The name that a person entered in the page.
UserName = Annotated[str, Field(pattern=USER_NAME.replace(r"\Z", r"$"), max_length=40)]


class Body(BaseModel):
    """The JSON body of a request: types are not converted, and unknown fields and NaN are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


# Letters of any script: readable everywhere, and without characters that steer a terminal or a path.
SetName = Annotated[str, Field(pattern=r"^\w[\w .+-]{0,39}$", max_length=40)]


class SaveSet(Body):
    """Name of a saved parameter set, and the person who saves it."""

    name: SetName
    who: UserName = "somebody"


class BadRequestError(StemmapError):
    """A request that does not fit the route."""


@contextmanager
def as_bad_request(where: str | None = None) -> Iterator[None]:
    """Convert a StemmapError inside the context to a BadRequestError with the same text. Its `where` is
    replaced by the argument unless that is None."""
    try:
        yield
    except StemmapError as error:
        place = error.where if where is None else where
        raise BadRequestError(error.what, where=place, remedy=error.remedy) from None


def json_reply(content: object, status: int = 200) -> Response:
    """Return records, dicts and lists as JSON that is not cached; NaN and infinity become null.

    Args:
        content: What `msgspec` can encode.
        status: HTTP status.
    """
    return Response(
        msgspec.json.encode(content), status, {"Cache-Control": "no-store"}, media_type="application/json"
    )


def error_reply(
    status: int, what: str, *, where: str = "", remedy: str = "", retry_after_s: int | None = None
) -> Response:
    """Return an error as JSON: {"error": {"what": ..., "where": ..., "remedy": ...}}.

    Args:
        status: HTTP status.
        what, where, remedy: Text of the error, see `StemmapError`.
        retry_after_s: Time after which the same request may succeed [s], as header Retry-After; None for no
            header.
    """
    reply = json_reply({"error": {"what": what, "where": where, "remedy": remedy}}, status)
    if retry_after_s is not None:
        reply.headers["Retry-After"] = str(retry_after_s)
    return reply


def failure_reply(status: int, error: StemmapError, retry_after_s: int | None = None) -> Response:
    """Return an exception as JSON for the page; arguments as in `error_reply`."""
    return error_reply(
        status, error.what, where=error.where, remedy=error.remedy, retry_after_s=retry_after_s
    )


#: Bounds of numbers by the type of the error of pydantic: words, and the key of the limit.
_BOUNDS = {
    "greater_than": ("above", "gt"),
    "greater_than_equal": ("at least", "ge"),
    "less_than": ("below", "lt"),
    "less_than_equal": ("at most", "le"),
}


def invalid_reply(errors: Sequence[Any]) -> Response:
    """Return 422 with the first error of a validation: which field does not fit, and why. A number out of
    its bounds is stated for people, with the entry of a list ("plot 1") that has it.

    Args:
        errors: Errors of pydantic.
    """
    first = errors[0] if errors else {}
    parts = [part for part in first.get("loc", ()) if part != "body"]
    if parts and first.get("type") in _BOUNDS:
        words, key = _BOUNDS[first["type"]]
        name = str(parts[-1])[:100]
        entry = next((k for k, part in enumerate(parts) if k and isinstance(part, int)), None)
        return error_reply(
            422,
            f"{name} is {str(first.get('input'))[:50]}, but must be {words} {first['ctx'][key]:,.10g}",
            where="" if entry is None else f"{str(parts[entry - 1]).removesuffix('s')} {parts[entry] + 1}",
            remedy="Correct this value",
        )
    place = [str(part)[:100] for part in parts]
    given = first.get("ctx", {}).get("tag", "")  # an unknown kind of command
    words = f"{first.get('msg', '')} {str(given)[:100]}".strip()
    return error_reply(422, f"the request does not fit: {'.'.join(place)}: {words}".replace(": :", ":"))


def text_reply(text: str, filename: str, media_type: str = "text/csv") -> Response:
    """Return a text, in UTF-8, that the browser saves as a file; arguments as in `bytes_reply`, the type
    without the character set."""
    return bytes_reply(text.encode(), f"{media_type}; charset=utf-8", filename)


def bytes_reply(content: bytes, media_type: str = "application/octet-stream", filename: str = "") -> Response:
    """Return bytes that are not cached.

    Args:
        content: The body.
        media_type: Media type of the body.
        filename: Name under which the browser saves the body, without quotes or characters beyond ASCII;
            empty to show it.
    """
    reply = Response(content, 200, {"Cache-Control": "no-store"}, media_type=media_type)
    if filename:
        reply.headers["Content-Disposition"] = f'attachment; filename="{filename}"'
    return reply
