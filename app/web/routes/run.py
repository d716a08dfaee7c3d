"""The open run: its status, commands, and the sources that can be opened."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from fastapi import APIRouter
from pydantic import Field, field_validator
from starlette.responses import Response

from app.common.settings import Settings, recordings_place
from app.sources.live_address import is_live
from app.sources.opening import ask
from app.sources.request import (
    LARGEST_SEED,
    LONGEST_URI,
    FormChoice,
    Role,
    SourceRequest,
    UnitChoice,
    UpChoice,
    mount_of_degrees,
)
from app.web.responses import BadRequestError, Body, Value, Word, json_reply
from app.web.routes.access import Dash, Deployment, Permitted, checked_uri, permitted_request
from app.worker.protocol import FASTEST, LONGEST_S, MOST_SCANS, Command, Open
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")

_MOST_RECORDINGS = 500
_LEVELS = 3  # of folders that are searched for recordings
_MOST_ENTRIES = 5000  # of them together
SHORTEST_LOOP_S = 0.5
SLOWEST = 0.01

_Uri = Annotated[str, Field(min_length=1, max_length=LONGEST_URI)]
_Seconds = Annotated[float, Field(ge=0.0, le=LONGEST_S)]
_Length = Annotated[float, Field(ge=-100.0, le=100.0)]
_Angle = Annotated[float, Field(ge=-360.0, le=360.0)]


class _Play(Body):
    type: Literal["play"]


class _Pause(Body):
    type: Literal["pause"]


class _BeginRecording(Body):
    type: Literal["record"]


class _EndRecording(Body):
    type: Literal["end_recording"]


class _EndRun(Body):
    type: Literal["end_run"]


class _Advance(Body):
    type: Literal["advance"]
    scans: Annotated[int, Field(ge=-MOST_SCANS, le=MOST_SCANS)] = 1


class _Seek(Body):
    type: Literal["seek"]
    time_s: _Seconds


class _SetSpeed(Body):
    """Factor of real time; 0 is as fast as possible."""

    type: Literal["set_speed"]
    factor: Annotated[float, Field(ge=0.0, le=FASTEST)]

    @field_validator("factor")
    @classmethod
    def _not_almost_zero(cls, factor: float) -> float:
        """Return the factor; ValueError if it is between 0 and SLOWEST."""
        if 0.0 < factor < SLOWEST:
            raise ValueError(f"should be 0 or at least {SLOWEST}")
        return factor


_AnyCommand = Annotated[
    _Play | _Pause | _BeginRecording | _EndRecording | _EndRun | _Advance | _Seek | _SetSpeed,
    Field(discriminator="type"),
]


class _LoopSpan(Body):
    """The part of the run that is repeated [s since the first scan]; null for both ends the repetition."""

    from_s: _Seconds | None
    to_s: _Seconds | None


class _Source(Body):
    """A source and how it is mapped, as `SourceRequest` describes it.

    Attributes:
        mount: x, y, z [m], roll, pitch, yaw [degrees] of the LiDAR on the robot.
        record: Whether a live run is recorded to a new file in the data folder.
    """

    uri: _Uri
    form: FormChoice = "auto"
    unit: UnitChoice = "auto"
    up: UpChoice = "auto"
    odometry: Annotated[str, Field(max_length=LONGEST_URI)] = "auto"
    seed: Annotated[int, Field(ge=0, le=LARGEST_SEED)] = 0
    topics: dict[Role, Annotated[str, Field(max_length=256)]] = Field(default_factory=dict)
    mount: Annotated[tuple[_Length, _Length, _Length, _Angle, _Angle, _Angle] | None, Field(strict=False)] = (
        None
    )
    preset: Word = ""
    parameters: dict[Word, Value] = Field(default_factory=dict, max_length=500)
    record: bool = False


class _Uninspected(Body):
    uri: _Uri


@router.get("/status")
async def status(dashboard: Dash) -> Response:
    """GET /api/status: return the status of the run, see `app.worker.protocol.Status`."""
    return json_reply(dashboard.status)


@router.post("/command")
async def command(body: _AnyCommand, dashboard: Dash, settings: Deployment) -> Response:
    """POST /api/command: play, pause, advance, seek, set the speed, end a live run, or begin or end its
    recording. The response is empty (202); the status reports the result. 422 for a recording of what is not
    live, 409 if there is no data folder for it, 503 if the worker is being restarted."""
    fields = body.model_dump()
    if isinstance(body, _BeginRecording):
        fields["path"] = _new_recording(dashboard.source.uri, settings)
    await dashboard.command(msgspec.convert(fields, Command))
    return json_reply({}, 202)


def _new_recording(uri: str, settings: Settings) -> str:
    """Return the path of a new recording of a run in the data folder. Raises BadRequestError if the run is
    not live, StemmapError if there is no data folder."""
    if not is_live(uri):
        raise BadRequestError("only a live run can be recorded", where="record", remedy="Leave it out")
    return str(recordings_place(settings, time.time()))


@router.post("/loop")
async def loop(body: _LoopSpan, dashboard: Dash) -> Response:
    """POST /api/loop: repeat a part of the run between two times [s], or end the repetition if a time is
    missing. The response is empty (202); 422 for a part shorter than SHORTEST_LOOP_S."""
    if body.from_s is None or body.to_s is None:
        dashboard.loop.choose(None)
    elif body.to_s - body.from_s < SHORTEST_LOOP_S:
        raise BadRequestError("the loop is too short", remedy=f"Make it {SHORTEST_LOOP_S} s or longer")
    else:
        dashboard.loop.choose((body.from_s, body.to_s))
    return json_reply({}, 202)


@router.post("/open")
async def open_source(
    body: _Source, dashboard: Dash, permitted: Permitted, settings: Deployment, check_only: bool = False
) -> Response:
    """POST /api/open: close the run and open another source, with its parameters if any are given; with
    `check_only`, only check whether the source can be opened, and keep the run. The response is empty (202);
    the status reports the result. 403 for a file that the caller may not open, 422 for an unknown odometry,
    invalid parameters or a recording of what is not live, 409 if the source cannot be opened or there is no
    data folder for a recording; the open run is kept then."""
    chosen = {**body.model_dump(exclude={"record"}), "mount": mount_of_degrees(body.mount)}
    request = permitted_request(SourceRequest(**chosen), permitted)
    if body.record:
        place = _new_recording(request.uri, settings)
        request = Open(**{name: getattr(request, name) for name in chosen}, record=place)
    await (dashboard.check_source(request) if check_only else dashboard.open(request))
    return json_reply({}, 202)


@router.post("/inside")
async def inside(body: _Uninspected, permitted: Permitted) -> Response:
    """POST /api/inside: return the topics of a recording or a robot and the mounting of its LiDAR, read by a
    child process (see `app.dashboard.inspection_process.inside`); 403 if the address is not permitted on this
    server, 409 if it cannot be read."""
    return json_reply(await ask({"ask": "inside", "path": checked_uri(body.uri, permitted)}))


@router.get("/sources")
async def sources(dashboard: Dash, settings: Deployment) -> Response:
    """GET /api/sources: return an object with `scenarios`, a list of objects with `uri` and `doc`, and
    `recordings`, a list of at most 500 results of `_listed`, without a file that is being written."""
    from pipeline.simulation.scenarios import scenarios

    try:
        uploaded = await dashboard.store.ask(lambda store: store.book.uploads())
    except StemmapError:  # they are listed under their file names then
        uploaded = {}
    found = await asyncio.to_thread(recordings, settings.data_folders)
    status = dashboard.status
    written = status.recorded_file if status.recording.startswith(("recording", "finishing")) else ""
    return json_reply(
        {
            "scenarios": [{"uri": uri, "doc": doc} for uri, doc in scenarios().items()],
            "recordings": [_listed(path, name, uploaded) for path, name in found if str(path) != written],
        }
    )


def _listed(path: Path, name: str, uploaded: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Return a dict with the path of a recording (`uri`), `name` and `doc`. For an uploaded recording, `name`
    is the original name and `doc` "FORMAT, uploaded"; otherwise `doc` is "".

    Args:
        path: The recording.
        name: Name of a recording that was not uploaded.
        uploaded: Result of `RunRecords.uploads`.
    """
    known = uploaded.get(path.name)
    if known is None:
        return {"uri": str(path), "name": name, "doc": ""}
    return {"uri": str(path), "name": known["name"], "doc": f"{known['kind']}, uploaded"}


def recordings(folders: Sequence[Path]) -> list[tuple[Path, str]]:
    """Return (path, path inside of the data folder) of at most 500 recordings, files or folders, in the data
    folders: in the order of the data folders and sorted in each.

    They are recognised by their names. A folder that is no recording is searched as well, at most three
    levels deep and not through links; the search ends after 5,000 entries. Hidden files, finished maps, and
    what cannot be read are left out.
    """
    entries = ((folder, *entry) for folder in folders for entry in _entries(folder))
    found = {
        path: str(path.relative_to(folder))
        for folder, path, kind in islice(entries, _MOST_ENTRIES)
        if kind == "recording"
    }
    return list(islice(found.items(), _MOST_RECORDINGS))


_Kind = Literal["recording", "folder", "other"]


def _entries(folder: Path, levels: int = _LEVELS) -> Iterator[tuple[Path, _Kind]]:
    """Yield (path, kind) of each entry of a folder, sorted, see `_kind_of`. Each entry of kind "folder" is
    followed by its own entries, down to `levels` levels. A folder that cannot be read has none."""
    inside: list[Path] = []
    with contextlib.suppress(OSError):
        inside = sorted(folder.iterdir())
    for path in inside:
        kind = _kind_of(path)
        yield path, kind
        if kind == "folder" and levels > 1:
            yield from _entries(path, levels - 1)


def _kind_of(path: Path) -> _Kind:
    """Return "recording" for a file or folder that is a recording by its name or the names in it; "folder"
    for another folder that is no link; "other" for hidden entries, finished runs, links to other folders,
    other and empty files, and entries that cannot be read."""
    from pipeline.io.readers import folder_opener, is_recording

    with contextlib.suppress(OSError):
        if path.name.startswith(".") or (path / "run.json").is_file():
            return "other"
        if path.is_file():
            return "recording" if path.stat().st_size and is_recording(path) else "other"
        if path.is_dir():
            return "recording" if folder_opener(path) else "other" if path.is_symlink() else "folder"
    return "other"
