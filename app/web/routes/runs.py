"""Runs that were mapped before: list, inspect, rename, delete with undo, replay."""

from __future__ import annotations

import asyncio
import io
import os
import zipfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from pydantic import Field
from starlette.responses import Response

from app.batch.map_frame import write_map_frame
from app.batch.run_edits import reviewed_run, stored_frame, stored_reviews
from app.batch.run_folder import read_run_record
from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.shown_run import ShownRun
from app.sources import opening
from app.sources.live_address import is_live
from app.sources.request import request_of_kept
from app.store.records import UnknownError
from app.store.store import RunRecords
from app.web.responses import (
    LARGEST_NUMBER,
    BadRequestError,
    Body,
    Number,
    error_reply,
    json_reply,
)
from app.web.routes.access import (
    Dash,
    Deployment,
    Permitted,
    ViewerTurn,
    in_thread,
    permitted_request,
)
from pipeline.config import PRESETS, preset
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api/runs")

_OPEN, _FOLDER = "open", "folder:"
_MOST_FOLDERS = 500
# The number of a record, or the name of a finished folder.
Key = Annotated[str, Path(min_length=1, max_length=300)]


class _Name(Body):
    name: Annotated[str, Field(max_length=200)]


@router.get("")
async def list_runs(dashboard: Dash, settings: Deployment) -> Response:
    """GET /api/runs: return an object with `runs`, at most 500, the last changed first, see
    `ReviewedRuns.listed`; `folders`, the finished folders, each with `key`, `name` and `changed_s`; and
    `open`, the number of the open run (null if it is not recorded)."""
    await dashboard.run_recorder.write_now()
    rows = await dashboard.reviewed_runs.listed()
    folders = await asyncio.to_thread(_folders, settings)
    return json_reply(
        {
            "runs": [_row(row) for row in rows],
            "folders": [
                {"key": f"{_FOLDER}{name}", "name": name, "changed_s": changed_s}
                for name, changed_s in folders.items()
            ],
            "open": dashboard.run_recorder.record,
        }
    )


@router.get("/{key}", dependencies=[ViewerTurn])
async def read_run(key: Key, dashboard: Dash, settings: Deployment) -> Response:
    """Return a run of the store or an output folder ("folder:NAME") with its map, its parameters and their
    history (empty for a folder); 404 if it does not exist, 409 if the folder cannot be read."""
    return json_reply(await whole_run(key, settings, dashboard))


@router.patch("/{number}")
async def rename(body: _Name, number: Number, dashboard: Dash) -> Response:
    """Rename a run; return its number (`id`). Spaces are merged. 422 for a name that is empty or not
    printable, 404 for an unknown run."""
    name = " ".join(body.name.split())
    if not name or not name.isprintable():
        raise BadRequestError("the name is empty or has characters that cannot be shown", where="name")
    return await _done(dashboard, number, lambda book: book.rename(number, name))


@router.delete("/{number}")
async def delete(request: Request, number: Number, dashboard: Dash) -> Response:
    """Delete a run that is not open, and return its number (`id`); `restore` undoes the deletion for a month.
    409 if it is open here or in another dashboard of this server, 404 for an unknown run."""
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
    """Undo the deletion of a run; return its number (`id`). 404 if it does not exist any more."""
    return await _done(dashboard, number, lambda book: book.bring_back(number))


@router.post("/{key}/replay")
async def replay(
    key: Key, dashboard: Dash, settings: Deployment, permitted: Permitted, check_only: bool = False
) -> Response:
    """Open the source of a run again, with its topics, mounting and final parameters; with `check_only`, only
    check whether it can be opened. The response is empty (202); the status reports the result. 403 if the
    file may not be opened by the caller, 404 for an unknown run, 409 if it was live or its source cannot be
    opened, 422 if its parameters are not valid in this version."""
    run = await whole_run(key, settings, dashboard)
    if run["live"]:  # its address would end the open run, and map what the robot sends now
        raise StemmapError(
            "a live run cannot be replayed", where=run["name"], remedy="Open its recording, if one was made"
        )
    request = request_of_kept(
        run["uri"],
        odometry=run.get("odometry") or "auto",
        seed=run["seed"],
        choices=run.get("chosen"),
        preset=run["preset"],
        parameters=run["parameters"],
    )
    request = permitted_request(request, permitted)
    await (dashboard.check_source(request) if check_only else dashboard.open(request))
    return json_reply({}, 202)


@asynccontextmanager
async def run_folder(key: str, settings: Settings, dashboard: Dashboard) -> AsyncIterator[FilePath]:
    """Yield the folder with the result files of a run; a temporary folder is removed afterwards. The files
    have the reviews of the trees, and the reference system of the map if there is one.

    Args:
        key: See `is_open_run` for the present state of the open run; number of another record; or "folder:"
            and the name of a finished folder.
        settings: Settings with the data folders.
        dashboard: The dashboard with its store.

    Raises:
        UnknownError: There is no such run.
        StemmapError: The run has no result files, they are damaged, or nothing is mapped yet.
    """
    if is_open_run(key, dashboard):
        async with in_thread(ShownRun.of(dashboard).folder()) as folder:
            yield folder
    elif key.startswith(_FOLDER):
        folder = await asyncio.to_thread(_finished_folder, key.removeprefix(_FOLDER), settings)
        async with _with_reviews(folder, dashboard) as found:
            yield found
    else:
        number = _number(key)
        packed = await dashboard.store.ask(lambda store: store.book.files(number))
        changed_ns = (await dashboard.store.ask(lambda store: store.book.whole(number)))["changed_ns"]
        with TemporaryDirectory(prefix="stemmap-run-") as there:
            folder = FilePath(there)
            await asyncio.to_thread(zipfile.ZipFile(io.BytesIO(packed)).extractall, folder)
            os.utime(folder / "run.json", ns=(changed_ns, changed_ns))  # the date of the map
            source = read_run_record(folder)["source"]
            frame = await dashboard.store.ask(lambda store: stored_frame(store, source))
            if frame is not None:
                await asyncio.to_thread(write_map_frame, folder, frame)
            async with _with_reviews(folder, dashboard) as found:
                yield found


def is_open_run(key: str, dashboard: Dashboard) -> bool:
    """Return whether a key names the open run: "open", or the number of its record."""
    return key in (_OPEN, str(dashboard.run_recorder.record))


@asynccontextmanager
async def _with_reviews(folder: FilePath, dashboard: Dashboard) -> AsyncIterator[FilePath]:
    """Yield a run with the reviews of its recording, see `reviewed_run`. Raises StemmapError if run.json is
    damaged or the store cannot be used."""
    source = (await asyncio.to_thread(read_run_record, folder))["source"]
    contents = await dashboard.store.ask(lambda store: stored_reviews(store, source))
    async with in_thread(reviewed_run(folder, contents)) as reviewed:
        yield reviewed


def _number(key: str) -> int:
    """Return the number of a record from its key; UnknownError unless the key is a number up to
    LARGEST_NUMBER."""
    if not key.isdecimal() or int(key) > LARGEST_NUMBER:
        raise UnknownError("there is no such run", where=key[:100])
    return int(key)


async def _done(dashboard: Dashboard, number: int, work: Callable[[RunRecords], None]) -> Response:
    """Run an action on the records, and return the number of the run (`id`); errors of the action and of the
    store pass through."""
    await dashboard.store.ask(lambda store: work(store.book))
    return json_reply({"id": number})


async def whole_run(key: str, settings: Settings, dashboard: Dashboard) -> dict[str, Any]:
    """Return a run as a dict of JSON values: the keys of `_row` for a record, or of
    `app.dashboard.inspection_process.finished` for a folder, with `key`, `map`, `revisions` (list of
    `_revision`; [] for a folder), `differences`, see `_differences`, and `live`, whether it was a live run,
    which cannot be replayed.

    Args:
        key: Number of a record, or "folder:" and the name of a finished folder.
        settings: Settings with the data folders.
        dashboard: The dashboard with its store.

    Raises:
        UnknownError: There is no such run.
        StemmapError: The folder of the run cannot be read.
    """
    if key.startswith(_FOLDER):
        name = key.removeprefix(_FOLDER)
        folder = await asyncio.to_thread(_finished_folder, name, settings)
        async with _with_reviews(folder, dashboard) as reviewed:
            found = await opening.ask({"ask": "finished", "path": str(reviewed)})
        run = {"key": key, "name": name, "revisions": [], **found}
    else:
        number = _number(key)
        row = await dashboard.reviewed_runs.whole(number)
        run = {**_row(row), "map": row["map"], "revisions": [_revision(each) for each in row["revisions"]]}
    differences = _differences(run["preset"], run["parameters"])
    return {**run, "differences": differences, "live": is_live(run["uri"])}


def _differences(name: str, parameters: dict[str, Any]) -> dict[str, Any]:
    """Return a dict from dotted names to the values that differ from those of the preset `name`, without
    parameters that the preset does not have; empty for an unknown preset."""
    if name not in PRESETS:
        return {}
    usual = dict(preset(name).flat())
    return {key: value for key, value in parameters.items() if key in usual and usual[key] != value}


def _row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a record as a dict for the dashboard: the entries of `row` (see `RunRecords.listed`) except
    `map`, `revisions`, `run` and `deleted_ns`, and `key`, the number of the record as text. `begun_ns` and
    `changed_ns` become `begun_s` and `changed_s`, integers [s since 1970]."""
    kept = {
        name: value for name, value in row.items() if name not in ("map", "revisions", "run", "deleted_ns")
    }
    begun, changed = kept.pop("begun_ns"), kept.pop("changed_ns")
    return {**kept, "key": str(row["id"]), "begun_s": begun // 10**9, "changed_s": changed // 10**9}


def _revision(row: dict[str, Any]) -> dict[str, Any]:
    """Return a change of parameters as a dict for the dashboard: `revision`, `time_s` [s since the first
    scan], `who`, `preset`, `changes` and `at_s`, the time of the change as an integer [s since 1970]."""
    names = ("revision", "time_s", "who", "preset", "changes")
    return {**{name: row[name] for name in names}, "at_s": row["at_ns"] // 10**9}


def _changed_s(folder: FilePath) -> int | None:
    """Return the time of the last change of run.json in a finished folder as an integer [s since 1970]; None
    if it does not exist."""
    try:
        return int((folder / "run.json").stat().st_mtime)
    except OSError:  # it was removed a moment ago
        return None


def _folders(settings: Settings) -> dict[str, int | None]:
    """Return a dict from the name of each finished folder to the result of `_changed_s`."""
    return {name: _changed_s(path) for name, path in _finished_folders(settings).items()}


def _finished_folders(settings: Settings) -> dict[str, FilePath]:
    """Return a dict from names to paths of at most 500 folders of finished runs in the data folders; of two
    with the same name the first one counts. Links that point outside of their data folder, and data folders
    that cannot be read, are left out."""
    found: dict[str, FilePath] = {}
    for folder in settings.data_folders:
        try:
            paths = sorted(path for path in folder.iterdir() if _is_finished(path, folder))
        except OSError:
            continue
        for path in paths:
            found.setdefault(path.name, path)
    return dict(list(found.items())[:_MOST_FOLDERS])


def _finished_folder(name: str, settings: Settings) -> FilePath:
    """Return the folder of a finished run by its name in `_finished_folders`; raises UnknownError if it is
    not among them."""
    path = _finished_folders(settings).get(name)
    if path is None:
        raise UnknownError("there is no such run in the data folders", where=name[:200])
    return path


def _is_finished(path: FilePath, folder: FilePath) -> bool:
    """Return whether a path is the folder of a finished run: not hidden, with run.json and trees.csv, and
    inside of a data folder, also where it is a link. False if it cannot be read.

    Args:
        path: The path.
        folder: The data folder.
    """
    try:
        if path.name.startswith(".") or not path.resolve().is_relative_to(folder.resolve()):
            return False
        return (path / "run.json").is_file() and (path / "trees.csv").is_file()
    except OSError:
        return False
