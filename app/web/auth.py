"""Access control: a request needs the token or a session cookie, a known Host and, if it has one, our Origin.

The link that is printed at the start carries the token once. The response sets a session cookie that scripts
cannot read, that other sites do not send, and that expires after SESSION_S. The Host check defeats names that
are rebound to this machine; the Origin check refuses pages of other servers (another port is another origin,
but not another site).
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import hmac
import html
import ipaddress
import secrets
import socket
import time
from collections.abc import Iterable, Iterator
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Literal, Self
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.common.settings import BODY_LIMIT, Settings, is_loopback
from app.common.user import current_user, user_of_cookies
from app.web.responses import error_reply
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside

# The only route whose bodies may be as large as a recording.
UPLOADS = "/api/uploads"
#: Error and remedy for a request of a viewer that only an owner may make.
VIEW_ONLY, ASK_OWNER = "this is a view-only link", "Ask the person who runs stemmap for the owner's link"
# The only route without a token: for the supervisor of a service.
HEALTH = "/health"
Role = Literal["owner", "viewer"]
_ROLES: tuple[Role, ...] = ("owner", "viewer")
#: A session lasts so long; each page load in its second half starts a new one.
SESSION_S = 7 * 86_400
TICKET_S = 60
_SAFE_METHODS = frozenset({"GET", "HEAD"})
_CHANGES_NOTHING = frozenset({("POST", "/api/compare")})  # a query with a body
_FORWARDING = (
    "forwarded",
    "via",
    "x-forwarded-for",
    "x-forwarded-host",
    "x-forwarded-proto",
    "x-real-ip",
    "cf-connecting-ip",
)
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_ANY_ADDRESS = ("0.0.0.0", "::")  # noqa: S104 - compared with, not bound to
_SCENES = frozenset({"/viser", "/viser/"})
_POLICY_VIOLATION = 1008
_CLOSE_S = 1.0

_LOGIN_STYLE = "body{font:1.1rem/1.6 system-ui,sans-serif;max-width:36rem;margin:15vh auto;padding:0 1.5rem}"
_LOGIN_PAGE = f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>stemmap</title>
<style>{_LOGIN_STYLE}</style>
<h1>Open the link that stemmap printed</h1>
<p>This dashboard needs the link that <code>stemmap</code> printed in the terminal when it was started.
The link ends in <code>?token=</code> and some letters. It changes at every start, and a session ends after a
week.</p>
<p>If you had a view-only link, the owner of the dashboard may have ended it: ask the owner for a new one.</p>
</html>"""
_LOGIN_STYLE_HASH = base64.b64encode(hashlib.sha256(_LOGIN_STYLE.encode()).digest()).decode()
#: The hash permits the style of this page and no other one.
_LOGIN_POLICY = f"default-src 'none'; style-src 'sha256-{_LOGIN_STYLE_HASH}'; frame-ancestors 'self'"

_LEAD_ON = """<!doctype html><html lang="en"><meta charset="utf-8"><title>stemmap</title>
<meta http-equiv="refresh" content="0;url={target}"><p><a href="{target}">Open the dashboard</a></p></html>"""


def new_token() -> str:
    """Return a random token of 192 bits."""
    return secrets.token_urlsafe(24)


def viewer_token(token: str, salt: bytes = b"") -> str:
    """Return the token of the view-only link, 32 characters. It is derived from the owner's token, so that it
    stays valid after a restart with the same token, and does not reveal that one.

    Args:
        token: Token of the owner.
        salt: Changes with each view-only link that was ended; empty for the first link.
    """
    made = hmac.new(token.encode(), b"stemmap viewer" + salt, "sha256").digest()
    return base64.urlsafe_b64encode(made[:24]).decode()


class AccessTokens:
    """The tokens of the owner's link and of the view-only link, and the open websockets of viewers.
    Several dashboards may share them.

    Args:
        owner: Token of the owner's link.
        salt_file: File of the salt of the view-only link, so that an ended link stays invalid after a restart
            with the same owner's token; None if the owner's token changes at each start.

    Attributes:
        owner, viewer: The tokens.

    Raises:
        StemmapError: The file exists and cannot be read.
    """

    def __init__(self, owner: str, salt_file: Path | None = None) -> None:
        self.owner, self._salt_file = owner, salt_file
        self._salt, self._saving = _read_salt(salt_file), asyncio.Lock()
        self.viewer = viewer_token(owner, self._salt)
        self._websockets: dict[asyncio.Timeout, str] = {}  # of viewers, with their path

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return the tokens of a deployment. Without a token in the settings, that of the owner is new, and
        the end of a view-only link is not saved, as without a data folder. Raises StemmapError as the
        class."""
        if not settings.token:
            return cls(new_token())
        return cls(settings.token, settings.folder and settings.folder / "view-only-link")

    def token(self, role: Role) -> str:
        """Return the token of a role."""
        return self.owner if role == "owner" else self.viewer

    @property
    def viewer_pages(self) -> int:
        """Number of open pages of viewers."""
        return sum(path not in _SCENES for path in self._websockets.values())

    @contextlib.contextmanager
    def viewer_websocket(self, timeout: asyncio.Timeout, path: str) -> Iterator[None]:
        """Count a websocket of a viewer inside the context. Its timeout expires when the view-only link is
        ended.

        Args:
            timeout: Timeout around the websocket, which is entered and has no deadline.
            path: Path of the websocket.
        """
        self._websockets[timeout] = path
        try:
            yield
        finally:
            self._websockets.pop(timeout, None)

    async def end_viewer_link(self) -> None:
        """Replace the token of the view-only link. The old link, its sessions and tickets become invalid, and
        open websockets of viewers are closed.

        Raises:
            StemmapError: The link has ended, but this could not be saved for the next start.
        """
        self._salt = secrets.token_hex(16).encode()
        self.viewer = viewer_token(self.owner, self._salt)
        websockets, self._websockets = self._websockets, {}
        for timeout in websockets:
            timeout.reschedule(asyncio.get_running_loop().time())
        if self._salt_file is not None:
            async with self._saving:
                await asyncio.to_thread(_write_salt, self._salt_file, self._salt)


def _read_salt(file: Path | None) -> bytes:
    """Return the content of the file of a salt, empty without a file; see `AccessTokens`."""
    try:
        return b"" if file is None else file.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise StemmapError(
            f"the state of the view-only link cannot be read: {error.strerror}", where=str(file)
        ) from None


def _write_salt(file: Path, salt: bytes) -> None:
    """Write the file of a salt; StemmapError if this fails."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with write_beside(file) as partial:
            partial.write_bytes(salt)
    except (OSError, StemmapError) as error:
        raise StemmapError(
            "the view-only link has ended, but this cannot be saved; a restart would make the old link valid",
            where=str(file),
            remedy="Make the folder writable and end the link again",
        ) from error


def role_of(scope: Scope) -> Role:
    """Return the role that the guard determined for a request: None for a health check without a session,
    "viewer" for a request that did not pass the guard."""
    role: Role = scope.get("state", {}).get("role", "viewer")
    return role


def session_value(token: str, port: int, expires_s: int) -> str:
    """Return the value of a session cookie.

    It is signed with the token and does not reveal it, because browsers send cookies to every port of this
    machine. It stays valid after a restart with the same token, so that an open page finds its server again.

    Args:
        token: Token of the link.
        port: Port of the dashboard.
        expires_s: Time at which it expires [s since 1970].
    """
    return f"{expires_s}.{_signature(token, f'stemmap cookie {port} {expires_s}')}"


def ticket(token: str, port: int, role: Role) -> str:
    """Return a code that opens a dashboard once, within TICKET_S seconds, as `/?ticket=CODE`.

    Args:
        token: Token of the role.
        port: Port of the dashboard.
        role: Role that the code gives.
    """
    expires_s = int(time.time()) + TICKET_S
    nonce = secrets.token_urlsafe(12)
    signed = f"{role}.{expires_s}.{nonce}"
    return f"{signed}.{_signature(token, f'stemmap ticket {port} {signed}')}"


def _signature(token: str, text: str) -> str:
    """Return the HMAC-SHA-256 (hex) of a text with the token as key."""
    return hmac.new(token.encode(), text.encode(), "sha256").hexdigest()


def is_local(headers: Headers) -> bool:
    """Return whether a request was sent to a loopback name, and no header shows that a proxy has forwarded
    it.

    A proxy that adds no header cannot be detected: behind one, set STEMMAP_FILES=folders.
    """
    if any(name in headers for name in _FORWARDING):
        return False
    try:
        name = urlsplit(f"//{headers.get('host', '')}").hostname or ""
    except ValueError:
        return False
    return is_loopback(name)


def allowed_hosts(host: str, port: int, further: Iterable[str] = ()) -> frozenset[str]:
    """Return the accepted values of the Host header, in lower case: loopback names, `host` and the further
    names, each with the port (and without it for port 80). If the server listens on any address, the name of
    this machine is accepted too.

    Args:
        host, port: Address on which the server listens.
        further: Further host names in lower case.
    """
    names = {*_LOOPBACK_NAMES, f"[{host}]" if ":" in host else host.lower(), *further}
    if host in _ANY_ADDRESS:
        names.add(socket.gethostname().lower())
    return frozenset(f"{name}:{port}" for name in names) | (frozenset(names) if port == 80 else frozenset())


class Guard:
    """ASGI middleware that refuses requests and websockets without permission: 401 without a session or
    token, 403 for a wrong Host or Origin or a viewer who would change something, 413 for a body that is too
    large.

    Args:
        app: The guarded application.
        tokens: Tokens of the owner and of viewers.
        settings: Settings with the host on which the server listens, further accepted names of it, and the
            largest size of an upload.
        port: Port on which the server listens.
    """

    def __init__(self, app: ASGIApp, *, tokens: AccessTokens, settings: Settings, port: int) -> None:
        self._app = app
        self._tokens = tokens
        self._used_tickets: dict[str, int] = {}  # with the time at which they expire
        self._port = port
        self._hosts = allowed_hosts(settings.host, port, settings.hosts)
        self._any_address = settings.host in _ANY_ADDRESS
        self._upload_limit = settings.upload_limit
        self.cookie = f"stemmap_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request; answer a link with a valid token or ticket by a redirect that sets the session
        cookie, which uses the ticket up; or call the application with the role of the caller in
        `scope["state"]["role"]` (None for a health check without a session) and the user in `current_user`, a
        limited body, and a renewed session where it is due. Events other than requests and websockets are
        passed on unchecked."""
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
        current_user.set(user_of_cookies(headers.getlist("cookie")))
        if scope["type"] == "http":
            await self._app(
                scope, _limited(receive, self._limit_of(scope)), self._renewing(scope, headers, send)
            )
        elif role_of(scope) == "owner":
            await self._app(scope, receive, send)
        else:
            await self._serve_viewer(scope, receive, send)

    async def _serve_viewer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Call the application for a websocket of a viewer. The websocket is closed (1008) when the view-only
        link is ended."""
        timeout = asyncio.timeout(None)
        try:
            async with timeout:
                with self._tokens.viewer_websocket(timeout, scope["path"]):
                    await self._app(scope, receive, send)
        except TimeoutError:
            if not timeout.expired():
                raise
            # Without the time limit, a browser that does not read would delay the end of the connection.
            with contextlib.suppress(TimeoutError, OSError, RuntimeError):
                async with asyncio.timeout(_CLOSE_S):
                    await send({"type": "websocket.close", "code": _POLICY_VIOLATION})

    def _renewing(self, scope: Scope, headers: Headers, send: Send) -> Send:
        """Return `send` with the cookie of a new session of the same role in the response, if the path is
        "/", the request has a session cookie, valid or not, and none has half of SESSION_S left; else `send`
        itself. The request has passed the guard.

        Args:
            scope: The request.
            headers: Headers of the request.
            send: Function that sends the response.
        """
        if scope["path"] != "/" or not self._is_half_over(headers):
            return send
        reply = Response()
        self._set_session(reply, role_of(scope))
        cookie = next(each for each in reply.raw_headers if each[0] == b"set-cookie")

        async def renewing(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), cookie]
            await send(message)

        return renewing

    def _is_half_over(self, headers: Headers) -> bool:
        """Return whether the request has a session cookie and the one that expires last has less than half of
        SESSION_S left. Signatures are not checked."""
        ends = [_seconds(value.partition(".")[0]) for value in self._cookies(headers)]
        return bool(ends) and max(end or 0 for end in ends) < time.time() + SESSION_S / 2

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the response to a wrong Host or Origin (403), or to an announced body that is too large or a
        length that is not a number (413); None if all are valid. The Origin of GET and HEAD requests is not
        checked."""
        if not self._knows_host(headers):
            return error_reply(
                403, "this server has another host name", remedy="Open the link that stemmap printed"
            )
        unsafe = scope["type"] == "websocket" or scope["method"] not in _SAFE_METHODS
        if unsafe and not self._fits_origin(scope, headers):
            return error_reply(403, "the request comes from the page of another server")
        length = headers.get("content-length", "0")
        limit = self._limit_of(scope)
        if not length.isdecimal() or int(length) > limit:
            return error_reply(413, f"the body is larger than {limit} bytes")
        return None

    def _restraint(self, scope: Scope, headers: Headers) -> Response | None:
        """Return 403 for a viewer who tries to change something; None otherwise, also for all websockets and
        for a comparison of parameter sets. Stores the role of the request in `scope`."""
        role = self._role(headers)
        scope.setdefault("state", {})["role"] = role
        if role == "owner" or scope["type"] == "websocket":
            return None
        if scope["method"] in _SAFE_METHODS:
            return None
        if (scope["method"], scope["path"]) in _CHANGES_NOTHING:
            return None
        return error_reply(
            403,
            VIEW_ONLY,
            remedy=ASK_OWNER,
        )

    def _limit_of(self, scope: Scope) -> int:
        """Return the maximum size of the body of a request [bytes]: BODY_LIMIT, or for an upload of a
        recording the maximum of it and the limit in the settings."""
        is_upload = scope.get("path") == UPLOADS and scope.get("method") == "POST"
        return max(BODY_LIMIT, self._upload_limit) if is_upload else BODY_LIMIT

    def _login(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the response to a link with a valid token or ticket (see `_welcome`), 401 for a request
        without a session or a valid header Authorization, except one about the health of the server, else
        None. A token in the query counts only for GET and HEAD of "/", a ticket only for GET of "/"; a ticket
        is used up. A client that accepts HTML gets the 401 as a page."""
        if scope["type"] == "http" and scope["path"] == "/" and scope["method"] in _SAFE_METHODS:
            query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
            given = dict(query)
            role = self._role_by_token(given["token"]) if "token" in given else None
            if role is None and "ticket" in given and scope["method"] == "GET":
                role = self._role_by_ticket(given["ticket"])
            if role is not None:
                rest = [(name, value) for name, value in query if name not in ("token", "ticket")]
                from_elsewhere = headers.get("sec-fetch-site") == "cross-site"
                return self._welcome(role, rest, from_elsewhere=from_elsewhere)
        is_health = scope["type"] == "http" and scope["path"] == HEALTH and scope["method"] in _SAFE_METHODS
        if is_health or self._role(headers) is not None:
            return None
        if scope["type"] == "http" and "text/html" in headers.get("accept", ""):
            headers_of_page = {"Cache-Control": "no-store", "Content-Security-Policy": _LOGIN_POLICY}
            return HTMLResponse(_LOGIN_PAGE, 401, headers_of_page)
        return error_reply(401, "the token is missing or wrong", remedy="Open the link that stemmap printed")

    def _welcome(self, role: Role, query: list[tuple[str, str]], *, from_elsewhere: bool) -> Response:
        """Return a redirect to the page without the token, which sets the session cookie.

        A browser does not send a strict cookie along a redirect that began in a file or on another site; in
        that case the response is a page of this server that loads the dashboard.

        Args:
            role: Role of the session.
            query: Parameters of the link.
            from_elsewhere: Whether the request began in a file or on another site.
        """
        target = "/" + (f"?{urlencode(query)}" if query else "")
        reply: Response = RedirectResponse(target, 303)
        if from_elsewhere:
            reply = HTMLResponse(_LEAD_ON.format(target=html.escape(target)))
        reply.headers["Cache-Control"] = "no-store"
        reply.headers["Referrer-Policy"] = "no-referrer"
        self._set_session(reply, role)
        return reply

    def _set_session(self, reply: Response, role: Role) -> None:
        """Add the cookie of a new session for a role to a response."""
        value = session_value(self._tokens.token(role), self._port, int(time.time()) + SESSION_S)
        reply.set_cookie(self.cookie, value, max_age=SESSION_S, path="/", httponly=True, samesite="strict")

    def _knows_host(self, headers: Headers) -> bool:
        """Return whether the request has exactly one Host header with an accepted value."""
        given = headers.getlist("host")
        if len(given) != 1:
            return False
        host = given[0].lower()
        return host in self._hosts or (self._any_address and self._is_own_address(host))

    def _is_own_address(self, host: str) -> bool:
        """Return whether a Host is a bare IP address with our port, 80 without a port. Only names can be
        rebound to this machine."""
        try:
            parts = urlsplit(f"//{host}")
            ipaddress.ip_address(parts.hostname or "")
            return (parts.port or 80) == self._port
        except ValueError:
            return False

    def _fits_origin(self, scope: Scope, headers: Headers) -> bool:
        """Return whether the Origin of a request is this server, by http or https. Without an Origin,
        requests fit, and websockets only with the token in the header Authorization."""
        origins = headers.getlist("origin")
        if not origins:
            return scope["type"] == "http" or self._role_by_bearer(headers) is not None
        host = headers["host"].lower()
        return len(origins) == 1 and origins[0].lower() in (f"http://{host}", f"https://{host}")

    def _role(self, headers: Headers) -> Role | None:
        """Return the role of a request by its session cookie, else by its header Authorization; None if there
        is no valid one."""
        return self._role_by_cookie(headers) or self._role_by_bearer(headers)

    def _role_by_cookie(self, headers: Headers) -> Role | None:
        """Return the highest role of all valid session cookies; None if there is none."""
        roles = {self._role_by_session(value) for value in self._cookies(headers)}
        return "owner" if "owner" in roles else "viewer" if "viewer" in roles else None

    def _cookies(self, headers: Headers) -> list[str]:
        """Return the values of all session cookies of the request, valid or not, because a cookie of another
        path could hide ours."""
        return [
            value
            for line in headers.getlist("cookie")
            for part in line.split(";")
            if (value := _cookie_value(part, self.cookie)) is not None
        ]

    def _role_by_session(self, value: str) -> Role | None:
        """Return the role of the value of a session cookie; None if it is expired or its signature is
        wrong."""
        expires_s = _seconds(value.partition(".")[0])
        if expires_s is None or expires_s < time.time():
            return None
        sessions = ((role, session_value(self._tokens.token(role), self._port, expires_s)) for role in _ROLES)
        return next((role for role, session in sessions if _same(value, session)), None)

    def _role_by_ticket(self, value: str) -> Role | None:
        """Return the role of a ticket that is valid and was not used before, and mark it as used; else
        None."""
        signed, _, signature = value.rpartition(".")
        parts = signed.split(".")
        expires_s = _seconds(parts[1]) if len(parts) == 3 else None
        now = time.time()
        if expires_s is None or expires_s < now or signed in self._used_tickets:
            return None
        role: Role = "owner" if parts[0] == "owner" else "viewer"
        if not _same(
            signature, _signature(self._tokens.token(role), f"stemmap ticket {self._port} {signed}")
        ):
            return None
        self._used_tickets = {k: end for k, end in self._used_tickets.items() if end >= now}
        self._used_tickets[signed] = expires_s
        return role

    def _role_by_bearer(self, headers: Headers) -> Role | None:
        """Return the role of the header `Authorization: Bearer TOKEN`; None if there is no valid one."""
        scheme, _, given = headers.get("authorization", "").partition(" ")
        return self._role_by_token(given.strip()) if scheme.lower() == "bearer" else None

    def _role_by_token(self, given: str) -> Role | None:
        """Return the role of a token; None for a wrong one."""
        return next((role for role in _ROLES if _same(given, self._tokens.token(role))), None)


def _same(given: str, secret: str) -> bool:
    """Return whether two texts are equal, in a time that does not depend on their contents."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode())


def _cookie_value(part: str, name: str) -> str | None:
    """Return the value of a cookie in a part of a Cookie header; None if it has another name or is
    malformed."""
    try:
        morsel = SimpleCookie(part.strip()).get(name)
    except CookieError:
        return None
    return None if morsel is None else morsel.value


def _seconds(text: str) -> int | None:
    """Return the integer in a text; None unless the text consists of 1 to 12 digits."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 12 else None


def _limited(receive: Receive, limit: int) -> Receive:
    """Return a `receive` that passes on messages and raises HTTPException 413 once the body exceeds `limit`
    [bytes], whether or not the request announces its length."""
    seen = 0

    async def counted() -> dict[str, object]:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > limit:
            raise HTTPException(413, f"the body is larger than {limit} bytes")
        return dict(message)

    return counted
