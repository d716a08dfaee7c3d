"""Runs that were mapped before: list, inspect, compare, rename, delete with undo, replay."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from pydantic import Field
from starlette.responses import Response

from app.batch.compare import compare
from app.batch.run_folder import delete_partial_output, finished_folders, partial_outputs, read_folder
from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.sources.request import request_of_kept
from app.store.records import UnknownError
from app.store.store import RunRecords
from app.web.responses import LARGEST_NUMBER, BadRequestError, Body, Number, error_reply, json_reply
from app.web.routes.access import AnyFile, Dash, Deployment, ViewerTurn
from app.web.routes.run import permitted_request

router = APIRouter(prefix="/api/runs")

_FOLDER = "folder:"
# The number of a record, or the name of a finished folder.
_Key = Annotated[str, Path(min_length=1, max_length=300)]
_KeyInQuery = Annotated[str, Query(min_length=1, max_length=300)]


class _Name(Body):
    name: Annotated[str, Field(max_length=200)]


@router.get("")
async def list_runs(dashboard: Dash, settings: Deployment) -> Response:
    """GET /api/runs: return at most 500 runs without their maps (`runs`), the newest first, finished folders
    (`folders`), partial outputs (`unfinished`), and the number of the open run (`open`)."""
    rows = await dashboard.store.ask(lambda store: store.book.listed())
    folders, changed, remains = await asyncio.to_thread(_folders, settings)
    return json_reply(
        {
            "runs": [_row(row) for row in rows],
            "folders": [
                {"key": f"{_FOLDER}{name}", "name": name, "changed_s": changed[name]} for name in folders
            ],
            "unfinished": remains,
            "open": dashboard.run_recorder.record,
        }
    )


@router.get("/compare", dependencies=[ViewerTurn])
async def compare_runs(dashboard: Dash, settings: Deployment, a: _KeyInQuery, b: _KeyInQuery) -> Response:
    """Return two runs as JSON, "a" and "b", with the map of b in the frame of a and the tables of
    `app.batch.compare.compare`; 404 if one does not exist, 409 if a folder cannot be read. The keys name runs
    of the store or output folders ("folder:NAME")."""
    first, second = await _whole(a, settings, dashboard), await _whole(b, settings, dashboard)
    same = first["source"] == second["source"] and bool(first["source"])
    return json_reply({"a": first, "b": second, **await compare(first, second, same_source=same)})


@router.get("/{key}", dependencies=[ViewerTurn])
async def read_run(key: _Key, dashboard: Dash, settings: Deployment) -> Response:
    """Return a run of the store or an output folder ("folder:NAME") with its map, its parameters and their
    history (empty for a folder); 404 if it does not exist, 409 if the folder cannot be read."""
    return json_reply(await _whole(key, settings, dashboard))


@router.patch("/{number}")
async def rename(body: _Name, number: Number, dashboard: Dash) -> Response:
    """Rename a run; return its number. Spaces are merged. 422 for a name that is empty or not printable, 404
    for an unknown run."""
    name = " ".join(body.name.split())
    if not name or not name.isprintable():
        raise BadRequestError("the name is empty or has characters that cannot be shown", where="name")
    return await _done(dashboard, number, lambda book: book.rename(number, name))


@router.delete("/unfinished")
async def delete_remains(name: _KeyInQuery, settings: Deployment) -> Response:
    """Delete the partial output of an ended run in the data folder, which cannot be undone; return its name.
    404 for an unknown one, 409 if a process may still write to it."""
    await asyncio.to_thread(delete_partial_output, name, settings)
    return json_reply({"name": name})


@router.delete("/{number}")
async def delete(request: Request, number: Number, dashboard: Dash) -> Response:
    """Delete a run that is not open, and return its number; `restore` undoes the deletion for a month. 409 if
    it is open here or in another dashboard of the fleet, 404 for an unknown run."""
    if number in request.app.state.open_records():
        here = number == dashboard.run_recorder.record
        what = "this run is open" if here else "this run is open in the dashboard of another robot"
        remedy = (
            "Open another one first, then delete it" if here else "Open another one there, then delete it"
        )
        return error_reply(409, what, where=f"run {number}", remedy=remedy)
    return await _done(dashboard, number, lambda book: book.delete(number))


@router.post("/{number}/restore")
async def restore(number: Number, dashboard: Dash) -> Response:
    """Undo the deletion of a run; return its number. 404 if it does not exist any more."""
    return await _done(dashboard, number, lambda book: book.bring_back(number))


@router.post("/{key}/replay")
async def replay(key: _Key, dashboard: Dash, settings: Deployment, any_file: AnyFile) -> Response:
    """Open the source of a run again, with its topics, mounting and final parameters. The response is empty
    (202); the status reports the result. 403 if the file may not be opened by the caller, 404 for an unknown
    run."""
    run = await _whole(key, settings, dashboard)
    request = request_of_kept(
        run["uri"],
        odometry=run.get("odometry") or "auto",
        seed=run["seed"],
        choices=run.get("chosen"),
        preset=run["preset"],
        parameters=run["parameters"],
    )
    await dashboard.open(permitted_request(request, settings, any_file))
    return json_reply({}, 202)


async def _done(dashboard: Dashboard, number: int, work: Callable[[RunRecords], None]) -> Response:
    """Run an action on the records, and return the number of the run."""
    await dashboard.store.ask(lambda store: work(store.book))
    return json_reply({"id": number})


async def _whole(key: str, settings: Settings, dashboard: Dashboard) -> dict[str, Any]:
    """Return a run with its map and parameter history as the page receives it.

    Args:
        key: Number of a record, or "folder:" and the name of a finished folder.
        settings: Settings with the data folders.
        dashboard: The dashboard with its store.

    Raises:
        UnknownError: There is no such run.
        StemmapError: It cannot be read.
    """
    if key.startswith(_FOLDER):
        name = key.removeprefix(_FOLDER)
        return {"key": key, "revisions": [], **await read_folder(name, settings)}
    if not key.isdecimal() or int(key) > LARGEST_NUMBER:
        raise UnknownError("there is no such run", where=key[:100])
    row = await dashboard.store.ask(lambda store: store.book.whole(int(key)))
    return {**_row(row), "map": row["map"], "revisions": [_revision(each) for each in row["revisions"]]}


def _row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a record without its map for the page, with times in seconds since 1970."""
    kept = {
        name: value for name, value in row.items() if name not in ("map", "revisions", "run", "deleted_ns")
    }
    begun, changed = kept.pop("begun_ns"), kept.pop("changed_ns")
    return {**kept, "key": str(row["id"]), "begun_s": begun // 10**9, "changed_s": changed // 10**9}


def _revision(row: dict[str, Any]) -> dict[str, Any]:
    """Return a change of parameters for the page, with its time in seconds since 1970."""
    names = ("revision", "time_s", "who", "preset", "changes")
    return {**{name: row[name] for name in names}, "at_s": row["at_ns"] // 10**9}


def _changed_s(folder: FilePath) -> int | None:
    """Return the time of the last change of a finished folder [s since 1970]; None if it was removed."""
    try:
        return int((folder / "run.json").stat().st_mtime)
    except OSError:  # it was removed a moment ago
        return None


def _folders(settings: Settings) -> tuple[dict[str, FilePath], dict[str, int | None], list[Any]]:
    """Return the finished folders and the times of their last change by name, and the partial outputs."""
    folders = finished_folders(settings)
    return (
        folders,
        {name: _changed_s(path) for name, path in folders.items()},
        list(partial_outputs(settings)),
    )
