"""The page and its files, the page of viser, the rights of the link, and the two websockets: the live states
of the page, and the bridge to viser."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import html
import mimetypes
from collections.abc import AsyncIterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Annotated
from urllib.parse import quote, urlsplit

import msgspec
from fastapi import APIRouter, Query, Request
from msgspec import Meta
from starlette.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.common.user import current_user
from app.dashboard.broadcast import Broadcast, Listener
from app.dashboard.dashboard import Dashboard
from app.extension import EXTENSION_PAGES, extensions_on, static_folder
from app.web.auth import HEALTH, AccessTokens, role_of, ticket
from app.web.responses import LARGEST_NUMBER, error_reply, json_reply
from app.web.routes.access import BROWSER, Bounds, CallerRole, Dash
from app.web.viser_proxy import bridge, client_page
from pipeline.errors import StemmapError

router = APIRouter()

# Where the machine's own table knows it wrong or not at all, a browser refuses a module script.
mimetypes.add_type("text/javascript", ".js")
mimetypes.add_type("text/javascript", ".mjs")

# Where a page names the extensions.
_EXTENSIONS = "<!-- extensions -->"

_CHECK_EACH_TIME = {"Cache-Control": "no-cache"}

# Plotly writes style attributes and takes pictures through blob: and data: addresses.
_PAGE_POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
# viser's page is one file that unpacks itself: its scripts stand in it and are evaluated.
_VISER_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; worker-src blob:; "
    "style-src 'unsafe-inline' blob:; img-src 'self' data: blob:; font-src data: blob:; "
    "connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


@router.get("/")
def page(request: Request) -> Response:
    """GET /: return the dashboard with the modules of its extensions, or 304 if the browser has it."""
    return _extended(request, "index.html", "main")


def _extended(request: Request, page: str, name: str) -> Response:
    """Return a page with the modules of extensions, see `page_with_extensions`, or 304."""
    content = page_with_extensions(page, name)
    headers = {
        **_CHECK_EACH_TIME,
        "Content-Security-Policy": _PAGE_POLICY,
        "ETag": f'"{hashlib.sha256(content.encode()).hexdigest()[:32]}"',
    }
    if headers["ETag"] in _known_tags(request):
        return Response(status_code=304, headers=headers)
    return HTMLResponse(content, headers=headers)


def page_with_extensions(page: str, name: str) -> str:
    """Return a page of this program with the JavaScript modules of the extensions that are switched on in
    front of its own, which starts what they register, and their style sheets.

    Args:
        page: Name of its file, such as index.html.
        name: Name of the modules and style sheets of extensions for it, without the suffix; those that an
            extension does not have are left out.
    """
    pages = {each: found.page for each, found in extensions_on().items() if found.page is not None}
    folders = {each: f"/static/{EXTENSION_PAGES}/{quote(each)}" for each in pages}
    styles = [
        f'<link rel="stylesheet" href="{folders[each]}/{name}.css">'
        for each, folder in pages.items()
        if (folder / f"{name}.css").is_file()
    ]
    modules = [
        f'<script type="module" data-extension="{html.escape(each)}" src="{folders[each]}/{name}.js">'
        "</script>"
        for each, folder in pages.items()
        if (folder / f"{name}.js").is_file()
    ]
    text = (static_folder() / page).read_text(encoding="utf-8")
    return text.replace(_EXTENSIONS, "\n  ".join([*styles, *modules]))


@router.get(HEALTH)
async def health(dashboard: Dash) -> Response:
    """Return 200 while this process answers and the mapping process runs, else 503, without a token and
    without further information."""
    return json_reply({}) if dashboard.worker.pid is not None else error_reply(503, "no mapping process runs")


@router.get("/runs")
def runs_page(request: Request) -> Response:
    """GET /runs: return the page of all runs with the modules of its extensions, or 304 if the browser has
    it."""
    return _extended(request, "runs.html", "runs")


@router.get("/api/access")
def access(request: Request) -> Response:
    """GET /api/access: return an object with `role`, "owner" or "viewer"; `viewer_link`, the address
    "/?token=..."; and `viewers`, the number of pages that are open with it (both null for a viewer)."""
    role, tokens = role_of(request.scope), _tokens(request)
    owns = role == "owner"
    return json_reply(
        {
            "role": role,
            "viewer_link": f"/?token={tokens.viewer}" if owns else None,
            "viewers": tokens.viewer_pages if owns else None,
        }
    )


@router.delete("/api/access/viewer-link")
async def end_viewer_link(request: Request) -> Response:
    """DELETE /api/access/viewer-link: end the view-only link, its sessions and its websockets, and return the
    access with the new link, as GET /api/access."""
    await _tokens(request).end_viewer_link()
    return access(request)


def _tokens(request: Request) -> AccessTokens:
    tokens: AccessTokens = request.app.state.tokens
    return tokens


@router.get("/static/plotly.min.js")
def plotly(request: Request) -> Response:
    """GET /static/plotly.min.js: return the plotting library of the installed package, or 304."""
    return _file(request, plotly_script(), _PAGE_POLICY)


@router.get("/static/{path:path}")
def page_file(request: Request, path: str) -> Response:
    """Return a file of the page, or 304 if the browser has it already; 404 for an unknown one."""
    found = _page_path(path)
    if found is None:
        return error_reply(404, "there is no such file", where=f"/static/{path[:200]}")
    return _file(request, found, _PAGE_POLICY)


@router.get("/viser/")
def viser_page(request: Request) -> Response:
    """GET /viser/: return the page of the 3D scene, of the installed viser, or 304."""
    return _file(request, client_page(), _VISER_POLICY)


def lead_on(request: Request, port: int) -> Response:
    """Return a redirect (303) to another port of this host, with a ticket that opens it once for the same
    role."""
    role = role_of(request.scope)
    # Redirects are kept in histories and logs, so they must not contain the token.
    once = ticket(_tokens(request).token(role), port, role)
    hostname = urlsplit(f"//{request.headers['host']}").hostname or "127.0.0.1"
    host = f"[{hostname}]" if ":" in hostname else hostname
    answer = RedirectResponse(f"{request.url.scheme}://{host}:{port}/?ticket={once}", 303)
    answer.headers["Cache-Control"] = "no-store"
    return answer


def page_answer(request: Request, path: Path) -> Response:
    """Return a page of this program with the content security policy of pages, or 304 if the browser has
    it."""
    return _file(request, path, _PAGE_POLICY)


def _file(request: Request, path: Path, policy: str) -> Response:
    """Return the file, or 304 without content if the browser has this version (ETag) already.

    Args:
        request: The request.
        path: The file, which exists.
        policy: Content security policy of the response.
    """
    headers = {**_CHECK_EACH_TIME, "Content-Security-Policy": policy}
    answer = FileResponse(path, headers=headers, stat_result=path.stat())
    if answer.headers["etag"] in _known_tags(request):
        return Response(status_code=304, headers={**headers, "ETag": answer.headers["etag"]})
    return answer


def _known_tags(request: Request) -> list[str]:
    """Return the ETags of the versions that the browser has."""
    return [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]


def _page_path(path: str) -> Path | None:
    """Return the file of a path below /static/; None if it does not exist, is hidden or is outside."""
    wanted = PurePosixPath(path)
    if "\0" in path or any(part.startswith(".") for part in wanted.parts):
        return None
    folder = static_folder()
    if wanted.is_relative_to(EXTENSION_PAGES) and len(wanted.parts) > 2:
        extension = extensions_on().get(wanted.parts[2])  # its files may be in another package
        if extension is None or extension.page is None:
            return None
        folder, wanted = extension.page, PurePosixPath(*wanted.parts[3:])
    try:
        folder = folder.resolve()
        found = (folder / wanted).resolve()
        return found if found.is_relative_to(folder) and found.is_file() else None
    except OSError:  # a name that no file system accepts
        return None


@cache
def plotly_script() -> Path:
    """Return the path of plotly.min.js without importing plotly, which is slow.

    Raises:
        StemmapError: plotly is not installed.
    """
    spec = find_spec("plotly")
    for folder in spec.submodule_search_locations or () if spec else ():
        script = Path(folder) / "package_data" / "plotly.min.js"
        if script.is_file():
            return script
    raise StemmapError("plotly is not installed", remedy="Install stemmap again")


_REFUSED = 1003

_Number = Annotated[int, Meta(ge=0, le=LARGEST_NUMBER)]


class _Select(msgspec.Struct, frozen=True, tag="select"):
    """Select a tree; null selects nothing."""

    tree: _Number | None


class _SelectCluster(msgspec.Struct, frozen=True, tag="select_cluster"):
    """Select a cluster of a scan, with the tree that it belongs to."""

    scan: _Number
    cluster: _Number


_decoder: msgspec.json.Decoder[_Select | _SelectCluster] = msgspec.json.Decoder(_Select | _SelectCluster)


@router.websocket("/api/live")
async def live(
    browser: WebSocket,
    dashboard: Dash,
    bounds: Bounds,
    role: CallerRole,
    page: Annotated[str | None, Query(pattern=BROWSER)] = None,
) -> None:
    """WebSocket /api/live: send states as they change, the newest of each kind, and receive selections, which
    are those of `page`, an identity that the page has chosen; those of viewers are ignored. The websocket is
    closed with 1013 before it is accepted if too many pages are open, and with 1003 after an invalid
    message."""
    with bounds.pages.place(role):
        await browser.accept()
        try:
            async with telling(browser, dashboard.live):
                await _receive(browser, dashboard, page, may_select=role == "owner")
        finally:
            dashboard.selector.close_page(page)


async def _receive(browser: WebSocket, dashboard: Dashboard, page: str | None, *, may_select: bool) -> None:
    """Process the selections of a browser until it disconnects; an invalid message closes the websocket
    (1003).

    Args:
        browser: Websocket of the browser.
        dashboard: The dashboard, whose selection changes.
        page: Identity of the page, see `Selection`.
        may_select: Whether valid selections are processed; otherwise they are ignored.
    """
    while (event := await browser.receive())["type"] != "websocket.disconnect":
        try:
            wanted = _decoder.decode(event.get("text") or b"")
        except (msgspec.MsgspecError, UnicodeDecodeError):
            await browser.close(_REFUSED, "not a message of the page")
            return
        if not may_select:  # other pages follow the selection
            continue
        if isinstance(wanted, _SelectCluster):
            dashboard.selector.cluster_soon(wanted.scan, wanted.cluster, page)
        else:
            dashboard.selector.tree(wanted.tree, page)


@router.websocket("/viser")
@router.websocket("/viser/")
async def viser(browser: WebSocket, dashboard: Dash, bounds: Bounds, role: CallerRole) -> None:
    """WebSocket /viser: connect the browser with the 3D scene; viewers cannot change it. The websocket is
    closed with 1013 before it is accepted if too many scenes are open."""
    with bounds.scenes.place(role):
        scene = dashboard.scene
        await bridge(
            browser,
            port=scene.port,
            secret=scene.secret,
            user=current_user.get(),
            looks_only=role != "owner",
        )


@contextlib.asynccontextmanager
async def telling(browser: WebSocket, live: Broadcast) -> AsyncIterator[None]:
    """Send all state changes to a browser while the context is active, first the newest message of each kind.

    Args:
        browser: Websocket of the browser, which is accepted.
        live: Broadcast of the dashboard.
    """
    with live.listener() as listener:
        sending = asyncio.create_task(_send(browser, listener))
        try:
            yield
        finally:
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sending


async def _send(browser: WebSocket, listener: Listener) -> None:
    """Send the messages of a listener to a browser until the task is cancelled; the errors of a browser that
    has disconnected pass through."""
    async for message in listener.messages():
        await browser.send_text(message.decode())
