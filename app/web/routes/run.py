"""The run: how it goes, and what is to be done with it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl, urlencode

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.common.settings import Settings
from app.sources.request import LONGEST_URI, Role, Seed, SourceRequest, TopicName, mount_of_degrees
from app.sources.sandbox import ask
from app.web.responses import BadRequestError, body_of, error_reply, json_reply
from app.web.routes.access import Dash
from app.worker.protocol import LONGEST_S, Advance, Pause, Play, Seek, SetSpeed
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")

_MOST_RECORDINGS = 500
SHORTEST_LOOP_S = 0.5
NOT_FROM_AFAR = "from another machine only scenarios and the recordings of the folder can be opened"

_Command = Play | Pause | Advance | Seek | SetSpeed


_Length = Annotated[float, Meta(ge=-100.0, le=100.0)]
_Angle = Annotated[float, Meta(ge=-360.0, le=360.0)]
_Word = Annotated[str, Meta(max_length=100)]


class OpenRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a browser may ask to have opened."""

    uri: Annotated[str, Meta(min_length=1, max_length=LONGEST_URI)]
    odometry: Literal["auto", "wheels", "kiss-icp", "static"] = "auto"
    seed: Seed = 0
    topics: dict[Role, TopicName] = {}
    preset: Annotated[str, Meta(max_length=100)] = ""
    parameters: Annotated[dict[_Word, bool | int | float | _Word], Meta(max_length=500)] = {}
    #: x, y, z [m], roll, pitch, yaw [degrees] of the LiDAR on the robot.
    mount: tuple[_Length, _Length, _Length, _Angle, _Angle, _Angle] | None = None


class _Look(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is to be looked into."""

    uri: Annotated[str, Meta(min_length=1, max_length=LONGEST_URI)]


@router.get("/status")
async def status(dashboard: Dash) -> Response:
    """How the run goes."""
    return json_reply(dashboard.status)


@router.post("/command")
async def command(request: Request, dashboard: Dash) -> Response:
    """Play, pause, advance, seek or set the speed."""
    wanted: _Command = await body_of(request, _Command)
    await dashboard.command(wanted)
    return json_reply({}, 202)


class _Loop(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """From where to where the run is played again and again [s since the first scan]; both null: not so."""

    from_s: Annotated[float, Meta(ge=0.0, le=LONGEST_S)] | None
    to_s: Annotated[float, Meta(ge=0.0, le=LONGEST_S)] | None


@router.post("/loop")
async def loop(request: Request, dashboard: Dash) -> Response:
    """Play a part of the run again and again, or no more."""
    wanted: _Loop = await body_of(request, _Loop)
    if wanted.from_s is None or wanted.to_s is None:
        dashboard.loop.choose(None)
    elif wanted.to_s - wanted.from_s < SHORTEST_LOOP_S:
        raise BadRequestError("the loop is too short", remedy=f"Make it {SHORTEST_LOOP_S} s or longer")
    else:
        dashboard.loop.choose((wanted.from_s, wanted.to_s))
    return json_reply({}, 202)


@router.post("/open")
async def open_source(request: Request, dashboard: Dash) -> Response:
    """Leave the run and open another source; how that went is told by the status."""
    wanted: OpenRequest = await body_of(request, OpenRequest)
    settings: Settings = request.app.state.settings
    uri = what_may_be_opened(wanted.uri, settings)
    if uri is None:
        return _not_from_afar(wanted.uri)
    topics = {str(role): name for role, name in wanted.topics.items()}
    mount = mount_of_degrees(wanted.mount)
    request_ = SourceRequest(
        uri, wanted.odometry, wanted.seed, topics, mount, wanted.preset, wanted.parameters
    )
    await dashboard.open(request_)
    return json_reply({}, 202)


@router.post("/inside")
async def inside(request: Request) -> Response:
    """The topics of a recording or of a robot, and where the LiDAR stands; read by a process of its own."""
    wanted: _Look = await body_of(request, _Look)
    uri = what_may_be_opened(wanted.uri, request.app.state.settings)
    if uri is None:
        return _not_from_afar(wanted.uri)
    return json_reply(await ask({"ask": "inside", "path": uri}))


def _not_from_afar(uri: str) -> Response:
    remedy = "Put it into the folder of recordings, or open it on the machine itself"
    return error_reply(403, NOT_FROM_AFAR, where=uri, remedy=remedy)


@router.get("/sources")
async def sources(request: Request, dashboard: Dash) -> Response:
    """What can be opened; uploaded recordings with the names that they had."""
    from pipeline.io.readers.simulated import scenarios

    settings: Settings = request.app.state.settings
    try:
        uploaded = await dashboard.keeper.ask(lambda store: store.book.uploads())
    except StemmapError:  # they are listed under their made-up names then
        uploaded = {}
    found = await asyncio.to_thread(recordings, settings.data_folders)
    return json_reply(
        {
            "scenarios": [{"uri": uri, "doc": doc} for uri, doc in scenarios().items()],
            "recordings": [_named(path, uploaded) for path in found],
        }
    )


def _named(path: Path, uploaded: dict[str, dict[str, Any]]) -> str | dict[str, str]:
    known = uploaded.get(path.name)
    if known is None:
        return str(path)
    return {"uri": str(path), "name": known["name"], "doc": f"{known['kind']}, uploaded"}


def recordings(folders: Sequence[Path]) -> list[Path]:
    """Files and folders in the folders of recordings; hidden ones and finished maps are left out."""
    found: list[Path] = []
    for folder in folders:
        with contextlib.suppress(OSError):
            found += sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return [path for path in found if not (path / "run.json").is_file()][:_MOST_RECORDINGS]


def what_may_be_opened(uri: str, settings: Settings) -> str | None:
    """What is to be opened for a URI; None when it may not be.

    Any file may be opened by who sits at the machine; others must not feel their way in its disk. For
    them it becomes a path from the root, without links, so that what was looked at is what is opened.
    """
    if settings.loopback:
        return uri
    try:
        if uri.startswith("sim:") and not Path(uri).exists():
            return _simulated_that_may_be_opened(uri, settings)
        return _path_that_may_be_opened(uri.removeprefix("file://"), settings)
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a home of nobody
        return None


def _path_that_may_be_opened(name: str, settings: Settings) -> str | None:
    path = Path(name).expanduser().resolve()
    inside = any(path.is_relative_to(folder.resolve()) for folder in settings.data_folders)
    return str(path) if inside else None


def _simulated_that_may_be_opened(uri: str, settings: Settings) -> str | None:
    """The files that a virtual scan reads must lie where other files must."""
    name, _, query = uri.removeprefix("sim:").partition("?")
    if name != "cloud":
        return uri
    values = dict(parse_qsl(query, keep_blank_values=True))
    for key in ("file", "truth"):
        if key in values:
            path = _path_that_may_be_opened(values[key], settings)
            if path is None:
                return None
            values[key] = path
    return f"sim:cloud?{urlencode(values)}"
