"""Who may talk to the server: the holder of the token, by a name that we know, from our own page.

The link that is printed at the start carries the token once; the answer sets a cookie that scripts
cannot read, that other sites do not send with what they ask for, and that ends with the browser. Host
is checked against names rebound to this machine, Origin against pages of other servers (another port
is another origin, but not another site).
"""

from __future__ import annotations

import base64
import hmac
import html
import ipaddress
import secrets
import socket
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from typing import Literal
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from app.dashboard.user import hand, name_in
from app.web.responses import error_reply
from pipeline.errors import StemmapError

# Where bodies may be as long as a recording.
UPLOADS = "/api/uploads"
Role = Literal["owner", "viewer"]
_SAFE_METHODS = frozenset({"GET", "HEAD"})
_CHANGES_NOTHING = frozenset({("POST", "/api/compare")})  # asks with a body, and the run stays as it is
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_ANY_ADDRESS = ("0.0.0.0", "::")  # noqa: S104 - compared with, not bound to

_LOGIN_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>stemmap</title>
<style>body{font:1.1rem/1.6 system-ui,sans-serif;max-width:36rem;margin:15vh auto;padding:0 1.5rem}</style>
<h1>Open the link that stemmap printed</h1>
<p>This dashboard belongs to whoever started it. In the terminal where <code>stemmap</code> runs stands a
link that ends in <code>?token=</code> and some letters: open that one.
It changes at every start.</p></html>"""


_LEAD_ON = """<!doctype html><html lang="en"><meta charset="utf-8"><title>stemmap</title>
<meta http-equiv="refresh" content="0;url={target}"><p><a href="{target}">Open the dashboard</a></p></html>"""


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(24)


def viewer_token(token: str) -> str:
    """The token of the link for those who may look and not touch. It comes of the other one, so that it
    outlives a restart as that does, and nobody can go the way back."""
    made = hmac.new(token.encode(), b"stemmap viewer", "sha256").digest()
    return base64.urlsafe_b64encode(made[:24]).decode()


def role_of(scope: Scope) -> Role:
    """What the guard found out about who asks."""
    role: Role = scope.get("state", {}).get("role", "viewer")
    return role


def session_value(token: str, port: int) -> str:
    """What the cookie holds: of its own, so that whoever reads it (browsers send it to every port of this
    machine) has not got the token. It is the same after a restart with the same token, so that an open
    page finds its server again."""
    return hmac.new(token.encode(), f"stemmap cookie {port}".encode(), "sha256").hexdigest()


def allowed_hosts(host: str, port: int, further: Iterable[str] = ()) -> frozenset[str]:
    """The values of the Host header by which the server may be called."""
    names = {*_LOOPBACK_NAMES, f"[{host}]" if ":" in host else host.lower(), *further}
    if host in _ANY_ADDRESS:
        names.add(socket.gethostname().lower())
    return frozenset(f"{name}:{port}" for name in names) | (frozenset(names) if port == 80 else frozenset())


class Guard:
    """ASGI middleware: lets through only who may, for requests and websockets alike.

    Args:
        app: What is guarded.
        token: That must be shown.
        host, port: Where the server listens.
        further_hosts: Other names of it.
        body_limit: Largest body of a request [bytes]; upload_limit: of an upload.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        token: str,
        host: str,
        port: int,
        further_hosts: Iterable[str] = (),
        body_limit: int,
        upload_limit: int = 0,
    ) -> None:
        self._app = app
        tokens: tuple[tuple[Role, str], ...] = (("owner", token), ("viewer", viewer_token(token)))
        self._tokens = tokens
        self._sessions = tuple((role, session_value(given, port)) for role, given in tokens)
        self._port = port
        self._hosts = allowed_hosts(host, port, further_hosts)
        self._any_address = host in _ANY_ADDRESS
        self._body_limit, self._upload_limit = body_limit, upload_limit
        self.cookie = f"stemmap_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with an error, or hand on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = (
            self._refusal(scope, headers) or self._login(scope, headers) or self._restraint(scope, headers)
        )
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        hand.set(name_in(headers.getlist("cookie")))
        if scope["type"] == "http":
            await self._app(scope, _limited(receive, self._limit_of(scope)), send)
        else:
            await self._app(scope, receive, send)

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """The answer to a request that comes by a wrong name, from a wrong page, or is too large."""
        if not self._knows_host(headers):
            return error_reply(
                403, "this server is not known by that name", remedy="Open the link that stemmap printed"
            )
        unsafe = scope["type"] == "websocket" or scope["method"] not in _SAFE_METHODS
        if unsafe and not self._fits_origin(scope, headers):
            return error_reply(403, "the request comes from the page of another server")
        length = headers.get("content-length", "0")
        limit = self._limit_of(scope)
        if not length.isdecimal() or int(length) > limit:
            return error_reply(413, f"a body may have {limit} bytes")
        return None

    def _restraint(self, scope: Scope, headers: Headers) -> Response | None:
        """The answer to who may look and wants to touch; the role of all others is kept in the scope."""
        role = self._role(headers)
        scope.setdefault("state", {})["role"] = role
        if role == "owner" or scope["type"] == "websocket" or scope["method"] in _SAFE_METHODS:
            return None
        if (scope["method"], scope["path"]) in _CHANGES_NOTHING:
            return None
        return error_reply(
            403,
            "this link is for looking only",
            remedy="Ask who runs stemmap for the link that may change things",
        )

    def _limit_of(self, scope: Scope) -> int:
        """Largest body of a request [bytes]."""
        is_upload = scope.get("path") == UPLOADS and scope.get("method") == "POST"
        return max(self._body_limit, self._upload_limit) if is_upload else self._body_limit

    def _login(self, scope: Scope, headers: Headers) -> Response | None:
        """The answer to who brings the token in the link, or brings none."""
        if scope["type"] == "http" and scope["path"] == "/" and scope["method"] in _SAFE_METHODS:
            query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
            given = [value for name, value in query if name == "token"]
            role = self._role_by_token(given[-1]) if given else None
            if role is not None:
                rest = [(name, value) for name, value in query if name != "token"]
                from_elsewhere = headers.get("sec-fetch-site") == "cross-site"
                return self._welcome(role, rest, from_elsewhere=from_elsewhere)
        if self._role(headers) is not None:
            return None
        if scope["type"] == "http" and "text/html" in headers.get("accept", ""):
            return HTMLResponse(_LOGIN_PAGE, 401, {"Cache-Control": "no-store"})
        return error_reply(401, "the token is missing or wrong", remedy="Open the link that stemmap printed")

    def _welcome(self, role: Role, query: list[tuple[str, str]], *, from_elsewhere: bool) -> Response:
        """Give the cookie and lead on to the page without the token.

        A strict cookie is not sent along a redirect that began in a file or on another site; from a
        page of our own it is, so whoever comes from there is led on by such a page.
        """
        target = "/" + (f"?{urlencode(query)}" if query else "")
        reply: Response = RedirectResponse(target, 303)
        if from_elsewhere:
            reply = HTMLResponse(_LEAD_ON.format(target=html.escape(target)))
        reply.headers["Cache-Control"] = "no-store"
        reply.headers["Referrer-Policy"] = "no-referrer"
        reply.set_cookie(self.cookie, dict(self._sessions)[role], path="/", httponly=True, samesite="strict")
        return reply

    def _knows_host(self, headers: Headers) -> bool:
        given = headers.getlist("host")
        if len(given) != 1:
            return False
        host = given[0].lower()
        return host in self._hosts or (self._any_address and self._is_own_address(host))

    def _is_own_address(self, host: str) -> bool:
        """Whether it is a bare address with our port: only names can be rebound to this machine."""
        try:
            parts = urlsplit(f"//{host}")
            ipaddress.ip_address(parts.hostname or "")
            return (parts.port or 80) == self._port
        except ValueError:
            return False

    def _fits_origin(self, scope: Scope, headers: Headers) -> bool:
        origins = headers.getlist("origin")
        if not origins:
            return scope["type"] == "http" or self._role_by_bearer(headers) is not None
        host = headers["host"].lower()
        return len(origins) == 1 and origins[0].lower() in (f"http://{host}", f"https://{host}")

    def _role(self, headers: Headers) -> Role | None:
        return self._role_by_cookie(headers) or self._role_by_bearer(headers)

    def _role_by_cookie(self, headers: Headers) -> Role | None:
        # Several cookies of one name can be sent; one of another path must not hide ours.
        given = [
            value
            for line in headers.getlist("cookie")
            for part in line.split(";")
            if (value := _cookie_value(part, self.cookie)) is not None
        ]
        return next(
            (role for role, session in self._sessions for value in given if _same(value, session)), None
        )

    def _role_by_bearer(self, headers: Headers) -> Role | None:
        scheme, _, given = headers.get("authorization", "").partition(" ")
        return self._role_by_token(given.strip()) if scheme.lower() == "bearer" else None

    def _role_by_token(self, given: str) -> Role | None:
        return next((role for role, token in self._tokens if _same(given, token)), None)


def _same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode())


def _cookie_value(part: str, name: str) -> str | None:
    try:
        morsel = SimpleCookie(part.strip()).get(name)
    except CookieError:
        return None
    return None if morsel is None else morsel.value


class BodyTooLargeError(StemmapError):
    """A body that goes on beyond the limit."""


def _limited(receive: Receive, limit: int) -> Receive:
    """`receive` that counts: a body without a length in its head may not go on for ever."""
    seen = 0

    async def counted() -> dict[str, object]:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > limit:
            raise BodyTooLargeError(f"a body may have {limit} bytes")
        return dict(message)

    return counted
