"""Folders of finished runs, written without mapping."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path as FilePath

import numpy as np

from app.batch.run_folder import read_run
from app.store.records import Author, Content
from app.store.store import Store
from pipeline.config import Parameters
from pipeline.io.result_files import RunFiles, csv_text, seen_text
from pipeline.seen_area import CELL, SeenArea
from pipeline.types.records import Path, Trees

TERRAIN = ("x_m", "y_m", "z_m", "sigma_m", "views")


def write_run(folder, position, dbh, *, dbh_sigma=0.01, side=20.0, seen=True, numbers=None, cloud_crs=None):
    """Write the files of a run with trees in a square from 0 to `side`, all of it observed, and a path along
    its diagonal; return the folder.

    Args:
        folder: Where.
        position: Trees, shape (T, 2) [m].
        dbh, dbh_sigma: [m]; NaN for unknown.
        side: Of the square [m].
        seen: Whether seen.csv is written.
        numbers: Numbers of the trees; by default from 1.
        cloud_crs: Reference system of a whole cloud, "" for a cloud without one; None for a drive.
    """
    folder = FilePath(folder)
    position, dbh = np.reshape(position, (-1, 2)).astype(float), np.array(dbh, float)
    n = len(dbh)
    trees = Trees(
        np.arange(1, n + 1) if numbers is None else np.array(numbers),
        position,
        np.tile(np.diag([0.02**2, 0.02**2]), (n, 1, 1)),
        dbh,
        np.where(np.isfinite(dbh), dbh_sigma, np.nan),
        np.full(n, 5.0),
        np.full(n, 20),
        np.full(n, 4.0),
        np.zeros(n, np.int64),
        np.full(n, 10**10),
        np.ones(n, np.bool_),
    )
    steps = np.linspace(0.0, side, 41)
    path = Path(np.arange(41) * 10**9, steps, steps, np.full(41, np.pi / 4), np.full(41, 0.01))
    cells = np.argwhere(np.ones((round(side / CELL),) * 2, np.bool_))
    nearest = np.abs((cells[:, 0] - cells[:, 1]) * CELL) / np.sqrt(2.0)
    area = SeenArea(CELL, cells, nearest, np.full(len(cells), 5), np.ones(len(cells), np.bool_))
    rows = [[f"{x:.3f}", f"{y:.3f}", f"{0.1 * x:.3f}", "", ""] for x, y in area.centres]
    source: dict[str, object] = {"uri": "sim:stand", "kind": "simulated", "sha256": "00"}
    if cloud_crs is not None:
        source.update(offset_m=[0.0, 0.0, 0.0], crs=cloud_crs or None)
        path = Path(np.zeros(0, np.int64), *(np.zeros(0) for _ in range(4)))
    run = {
        "stemmap": "0.1.0",
        "source": source,
        "seed": 0,
        "preset": "forest",
        "changed": {},
        "parameters": Parameters().model_dump(),
        "scans": 41,
        "duration_s": 40.0,
        "distance_m": 28.3,
        "trees": n,
        "points": {},
        "health": {"scans": {"good": 40, "weak": 1, "lost": 0}, "worst": {"sigma_xy_m": 0.05}},
        "verdicts": {"tree": n, "pole": 2},
        "evaluation": None,
        "path_error": None,
        "warnings": [],
        "losses": {},
    }
    more = {"terrain.csv": csv_text(TERRAIN, rows)}
    if seen:
        more["seen.csv"] = seen_text(area)
    RunFiles(folder).finish(trees, path, 0, run, None, more)
    return folder


def reject_on_page(folder, data_folder):
    """Reject the first tree of a run as a person does on the page, in the database of the data folder."""
    run = read_run(folder)
    x, y = run.trees.position[0].tolist()
    with closing(Store(data_folder)) as store:
        number = store.open_run(run.record["source"].get("sha256") or run.uri, run.uri, "grid")
        store.add(number, Author("a" * 16, "Ann"), [Content(x, y, "pole")])


def grid_run(folder, *, seen=True, cloud_crs=None):
    """A run with 100 trees of 20 cm, one every 2 m, on 20 m x 20 m."""
    axis = np.arange(1.0, 20.0, 2.0)
    position = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return write_run(folder, position, np.full(100, 0.2), seen=seen, cloud_crs=cloud_crs)
