"""Two runs compared as two visits of a stand."""

from __future__ import annotations

import math
from contextlib import AsyncExitStack
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query
from starlette.responses import Response

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.extensions.stand.questions import VISITS
from app.sources import opening
from app.store.records import NoFilesError
from app.web.responses import json_reply
from app.web.routes.access import Dash, Deployment, ViewerTurn
from app.web.routes.runs import run_folder, whole_run
from pipeline.geometry.poses import Pose2
from pipeline.io.atomic_files import write_texts
from pipeline.io.result_files import REJECTED, csv_text

router = APIRouter(prefix="/api/runs")

_KeyInQuery = Annotated[str, Query(min_length=1, max_length=300)]


@router.get("/compare", dependencies=[ViewerTurn])
async def compare_runs(dashboard: Dash, settings: Deployment, a: _KeyInQuery, b: _KeyInQuery) -> Response:
    """Compare two runs as `stemmap compare` does, in a child process. The keys name runs of the store or
    output folders ("folder:NAME"). Maps of the same recording share a frame; others are aligned by the
    distances between their stems or, if that fails, compared without alignment, and `how` has the reason.

    Return an object with both runs, `a` (the earlier visit) and `b`, see `whole_run`; the keys of
    `app.extensions.stand.questions.visits`; `b_path`, the path of b in the frame of a as a list of [x, y]
    [m]; and `parameters`, see `_changed_parameters`. 404 if a run does not exist, 409 if its files cannot be
    read.
    """
    first, second = await whole_run(a, settings, dashboard), await whole_run(b, settings, dashboard)
    async with AsyncExitStack() as stack:
        paths = (
            await _visit_path(a, first, stack, settings, dashboard),
            await _visit_path(b, second, stack, settings, dashboard),
        )
        question = {
            "ask": VISITS,
            "paths": [str(path) for path in paths],
            "names": [first["name"], second["name"]],
            "same_frame": bool(first["source"]) and first["source"] == second["source"],
        }
        found = await opening.ask(question)
    path = np.array(second["map"]["path"], np.float64).reshape(-1, 2)
    return json_reply(
        {
            "a": first,
            "b": second,
            **found,
            "b_path": np.round(Pose2(*found["pose"]).apply(path), 3).tolist(),
            "parameters": _changed_parameters(first["parameters"], second["parameters"]),
        }
    )


async def _visit_path(
    key: str, run: dict[str, Any], stack: AsyncExitStack, settings: Settings, dashboard: Dashboard
) -> FilePath:
    """Return the folder of a run; if it has no result files, a table (trees.csv) of its trees without those
    that were rejected in the review. Errors as in `run_folder`, except NoFilesError.

    Args:
        key, settings, dashboard: See `run_folder`.
        run: The run with its map.
        stack: Removes temporary files.
    """
    try:
        return await stack.enter_async_context(run_folder(key, settings, dashboard))
    except NoFilesError:
        folder = FilePath(stack.enter_context(TemporaryDirectory(prefix="stemmap-run-")))
        names = ("number", "x", "y", "dbh_cm")
        trees = [tree for tree in run["map"]["trees"] if tree.get("review") != REJECTED]
        cells = [[str(tree[n]) if tree[n] is not None else "" for n in names] for tree in trees]
        write_texts(folder, {"trees.csv": csv_text(("tree", "x_m", "y_m", "dbh_cm"), cells)})
        return folder / "trees.csv"


def _changed_parameters(a: dict[str, Any], b: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a list of a dict for each parameter that differs, with `name` and the values `a` and `b`; None
    in place of a value that a run does not have and of NaN and infinity.

    Args:
        a, b: Dicts from dotted names to values.
    """
    names = dict.fromkeys([*a, *b])
    return [
        {"name": name, "a": _plain(a.get(name)), "b": _plain(b.get(name))}
        for name in names
        if a.get(name) != b.get(name)
    ]


def _plain(value: Any) -> Any:  # noqa: ANN401 - whatever a parameter is
    """Return a value for JSON: None for NaN and infinity, all else unchanged."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
