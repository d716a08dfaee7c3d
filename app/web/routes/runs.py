"""Runs that were mapped before: list, look, compare, rename, delete with an undo, play again."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Annotated, Any

import msgspec
from fastapi import APIRouter, Path, Query, Request
from msgspec import Meta
from starlette.responses import Response

from app.batch.compare import compare
from app.batch.data_folders import delete_partial_output, finished_folders, partial_outputs, read_folder
from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.sources.request import request_of_kept
from app.store.book import RunBook
from app.store.records import UnknownError
from app.web.responses import BadRequestError, body_of, error_reply, failure_reply, json_reply
from app.web.routes.access import Dash
from app.web.routes.run import NOT_FROM_AFAR, what_may_be_opened

router = APIRouter(prefix="/api/runs")

_FOLDER = "folder:"
# A record by its number, a finished folder by its name.
_Key = Annotated[str, Path(min_length=1, max_length=300)]
_Asked = Annotated[str, Query(min_length=1, max_length=300)]
_Number = Annotated[int, Path(ge=0, le=2**31 - 1)]


@router.get("")
async def listed(request: Request, dashboard: Dash) -> Response:
    """All runs, the newest first, the finished folders and what is left of killed runs; maps are left out."""
    settings: Settings = request.app.state.settings
    rows = await dashboard.keeper.ask(lambda store: store.book.listed())
    folders = await asyncio.to_thread(finished_folders, settings)
    changed = await asyncio.to_thread(lambda: {name: _changed_s(path) for name, path in folders.items()})
    return json_reply(
        {
            "runs": [_row(row) for row in rows],
            "folders": [
                {"key": f"{_FOLDER}{name}", "name": name, "changed_s": changed[name]} for name in folders
            ],
            "unfinished": await asyncio.to_thread(partial_outputs, settings),
            "open": dashboard.logbook.record,
        }
    )


@router.get("/compare")
async def compared(request: Request, dashboard: Dash, a: _Asked, b: _Asked) -> Response:
    """Two runs, with the map of the second in the frame of the first."""
    try:
        first, second = await _whole(a, request, dashboard), await _whole(b, request, dashboard)
    except UnknownError as error:
        return failure_reply(404, error)
    same = first["source"] == second["source"] and bool(first["source"])
    return json_reply({"a": first, "b": second, **await compare(first, second, same_source=same)})


@router.get("/{key}")
async def whole(key: _Key, request: Request, dashboard: Dash) -> Response:
    """A run with its map, its parameters and who changed them when."""
    try:
        return json_reply(await _whole(key, request, dashboard))
    except UnknownError as error:
        return failure_reply(404, error)


class _Name(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, Meta(max_length=200)]


@router.patch("/{number}")
async def rename(request: Request, number: _Number, dashboard: Dash) -> Response:
    """Give it another name."""
    wanted: _Name = await body_of(request, _Name)
    name = " ".join(wanted.name.split())
    if not name or not name.isprintable():
        raise BadRequestError("the name is empty or has odd characters", remedy="Give it some letters")
    return await _done(dashboard, number, lambda book: book.rename(number, name))


@router.delete("/unfinished")
async def take_away(request: Request, name: _Asked) -> Response:
    """Delete what a killed run left in the data folder; nothing brings it back, and nothing is lost by it."""
    try:
        await asyncio.to_thread(delete_partial_output, name, request.app.state.settings)
    except UnknownError as error:
        return failure_reply(404, error)
    return json_reply({"name": name})


@router.delete("/{number}")
async def delete(request: Request, number: _Number, dashboard: Dash) -> Response:
    """Take it away; `restore` brings it back."""
    if number in request.app.state.open_records():
        own = number == dashboard.logbook.record
        what = "this run is open" if own else "this run is open in the dashboard of another robot"
        remedy = "Open another one first, then delete it" if own else "Open another one there, then delete it"
        return error_reply(409, what, where=f"run {number}", remedy=remedy)
    return await _done(dashboard, number, lambda book: book.delete(number))


@router.post("/{number}/restore")
async def restore(number: _Number, dashboard: Dash) -> Response:
    """Undo a deletion."""
    return await _done(dashboard, number, lambda book: book.bring_back(number))


@router.post("/{key}/replay")
async def replay(key: _Key, request: Request, dashboard: Dash) -> Response:
    """Open its source again, with its topics and mounting and the parameters that it ended with."""
    settings: Settings = request.app.state.settings
    try:
        run = await _whole(key, request, dashboard)
    except UnknownError as error:
        return failure_reply(404, error)
    uri = what_may_be_opened(run["uri"], settings)
    if uri is None:
        return error_reply(403, NOT_FROM_AFAR, where=run["uri"])
    await dashboard.open(
        request_of_kept(
            uri,
            odometry=run.get("odometry") or "auto",
            seed=run["seed"],
            choices=run.get("chosen"),
            preset=run["preset"],
            parameters=run["parameters"],
        )
    )
    return json_reply({}, 202)


async def _done(dashboard: Dashboard, number: int, work: Callable[[RunBook], None]) -> Response:
    try:
        await dashboard.keeper.ask(lambda store: work(store.book))
    except UnknownError as error:
        return failure_reply(404, error)
    return json_reply({"id": number})


async def _whole(key: str, request: Request, dashboard: Dashboard) -> dict[str, Any]:
    if key.startswith(_FOLDER):
        name = key.removeprefix(_FOLDER)
        return {"key": key, "revisions": [], **await read_folder(name, request.app.state.settings)}
    if not key.isdecimal() or int(key) >= 2**31:
        raise UnknownError("there is no such run", where=key[:100])
    row = await dashboard.keeper.ask(lambda store: store.book.whole(int(key)))
    return {**_row(row), "map": row["map"], "revisions": [_revision(each) for each in row["revisions"]]}


def _row(row: dict[str, Any]) -> dict[str, Any]:
    kept = {
        name: value for name, value in row.items() if name not in ("map", "revisions", "run", "deleted_ns")
    }
    begun, changed = kept.pop("begun_ns"), kept.pop("changed_ns")
    return {**kept, "key": str(row["id"]), "begun_s": begun // 10**9, "changed_s": changed // 10**9}


def _revision(row: dict[str, Any]) -> dict[str, Any]:
    names = ("revision", "time_s", "who", "preset", "changes")
    return {**{name: row[name] for name in names}, "at_s": row["at_ns"] // 10**9}


def _changed_s(folder: FilePath) -> int | None:
    try:
        return int((folder / "run.json").stat().st_mtime)
    except OSError:  # it went just now
        return None
