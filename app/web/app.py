"""The web application: one port for the page, the API, the live messages and the 3D scene."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import TYPE_CHECKING

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.common.settings import Settings
from app.common.timers import TooManyRequestsError, ended
from app.dashboard.broadcast import Broadcast
from app.dashboard.dashboard import Dashboard
from app.dashboard.parameters import ParameterState
from app.dashboard.selection import NoStoryError, NothingMappedError
from app.extension import extensions_on
from app.store.async_store import AsyncStore, StoreBusyError
from app.store.forests import Forests
from app.store.records import UnknownError
from app.web import uploads
from app.web.auth import AccessTokens, Guard
from app.web.responses import BadRequestError, error_reply, failure_reply, invalid_reply
from app.web.routes import annotations as annotation_routes
from app.web.routes import page, parameters, repairs, results, run, runs
from app.web.routes.access import Limits, NotPermittedError
from app.worker.protocol import Open, WorkerBusyError
from app.worker.supervisor import WorkerProcess
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.scene import Scene

_log = logging.getLogger(__name__)

_ROUTES = (page, run, runs, parameters, results, annotation_routes, repairs, uploads)
ROUTERS = tuple(module.router for module in _ROUTES)

MakeScene = Callable[[Dashboard, asyncio.AbstractEventLoop], "Scene"]
MakeWorker = Callable[[], WorkerProcess]


Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]

_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"SAMEORIGIN"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
_RETRY_AFTER_S = 3
_POLICY = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'self'")


def build(
    settings: Settings,
    *,
    port: int,
    tokens: AccessTokens,
    source: Open,
    parameter_state: ParameterState,
    make_scene: MakeScene | None = None,
    make_worker: MakeWorker = WorkerProcess,
    open_records: Callable[[], set[int | None]] | None = None,
) -> FastAPI:
    """Return the application of one dashboard. Worker, scene and source are started when the application
    starts, and ended with it; abandoned uploads are removed then.

    Args:
        settings: Settings of the deployment.
        port: Port on which it is served, to check Host and Origin.
        tokens: Tokens of the links.
        source: Source that is opened at the start.
        parameter_state: Parameters at the start; its `check` is set.
        make_scene: Replaces viser in tests.
        make_worker: Returns the worker, which may run already; tests replace it.
        open_records: Returns the numbers of the records that are open; None for that of this dashboard.
    """
    parameter_state.check = Forests(settings.folder).check
    dashboard = Dashboard(parameter_state, Broadcast(), AsyncStore(settings.folder))

    kept_uploads = uploads.Uploads(settings.uploads, settings.upload_limit, dashboard.store)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(kept_uploads.clear)
        dashboard.worker = make_worker()
        loop = asyncio.get_running_loop()
        await dashboard.start(source, lambda: (make_scene or _scene)(dashboard, loop))
        try:
            yield
        finally:
            await ended(app.state.closing)
            await dashboard.close()

    app = guarded(settings, port=port, tokens=tokens, lifespan=lifespan)
    app.state.dashboard, app.state.settings = dashboard, settings
    app.state.open_records = open_records or (lambda: {dashboard.run_recorder.record})
    app.state.uploads, app.state.limits = kept_uploads, Limits()
    app.state.closing = []  # what extensions end before the dashboard
    for name, extension in extensions_on().items():
        if extension.web is not None:
            try:
                extension.web(app)
            except Exception:  # the dashboard works without it
                _log.exception("the extension %s is left out of the dashboard", name)
    for router in ROUTERS:  # after those of extensions, which may answer in their place
        app.include_router(router)
    return app


def guarded(settings: Settings, *, port: int, tokens: AccessTokens, lifespan: Lifespan) -> FastAPI:
    """Return an application without routes that checks access and answers errors as JSON.

    Args:
        settings: Hosts and size limits.
        port: Port on which the server listens.
        tokens: Tokens of the links.
        lifespan: Context in which the application runs.
    """
    guard = Middleware(Guard, tokens=tokens, settings=settings, port=port)
    app = FastAPI(
        title="stemmap",
        lifespan=lifespan,
        middleware=[Middleware(SafeHeaders), guard],
        docs_url=None,  # its page loads scripts from another server
        redoc_url=None,
        openapi_url="/api/openapi.json",
        redirect_slashes=False,
    )
    app.state.tokens = tokens
    _answer_errors(app)
    return app


class SafeHeaders:
    """ASGI middleware that adds security headers to every response, refusals included."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Call the application; add to its response those security headers that it does not set itself."""

        async def careful(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                given = list(message.get("headers", ()))
                names = {name.lower() for name, _ in given}
                message["headers"] = given + [h for h in (*_HEADERS, _POLICY) if h[0] not in names]
            await send(message)

        await self._app(scope, receive, careful)


def _answer_errors(app: FastAPI) -> None:
    """Register handlers that return errors as JSON: StemmapError with the status of its class (409 by
    default, UploadError with its own; 429 and 503 with Retry-After), failed validation 422, HTTPException
    with its status, and every other exception as 500, which is logged."""
    statuses = {
        BadRequestError: 422,
        NotPermittedError: 403,
        TooManyRequestsError: 429,
        WorkerBusyError: 503,
        StoreBusyError: 503,
        ParameterError: 422,
        UnknownError: 404,
        NothingMappedError: 409,
        NoStoryError: 404,
        StemmapError: 409,
    }

    @app.exception_handler(StemmapError)
    async def for_people(_: Request, error: Exception) -> Response:
        assert isinstance(error, StemmapError)  # noqa: S101 - the handler is registered for it
        status = next(statuses[t] for t in type(error).__mro__ if t in statuses)
        if isinstance(error, uploads.UploadError):
            status = error.status
        return failure_reply(status, error, _RETRY_AFTER_S if status in (429, 503) else None)

    @app.exception_handler(RequestValidationError)
    async def of_validation(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)  # noqa: S101 - the handler is registered for it
        return invalid_reply(error.errors())

    @app.exception_handler(HTTPException)
    async def of_the_framework(_: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)  # noqa: S101 - the handler is registered for it
        return error_reply(error.status_code, str(error.detail).lower())

    @app.exception_handler(Exception)
    async def unexpected(_: Request, error: Exception) -> Response:
        _log.error("a request failed", exc_info=error)
        return error_reply(500, "this is a fault in stemmap", remedy="The terminal shows where it happened")


def _scene(dashboard: Dashboard, loop: asyncio.AbstractEventLoop) -> Scene:
    """Return the 3D scene of a dashboard; viser is imported only here."""
    from app.scene import Scene

    return Scene(dashboard, loop)
