"""The folder of a mapped run: reading it back, and checking it before it is overwritten.

`stemmap map` and `export` write to a folder whose name begins with a dot, and rename it at the end. When they
are killed, this partial output remains. It cannot be continued.
"""

from __future__ import annotations

import csv
import datetime
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.evaluation import MapScores, evaluate
from pipeline.geometry.columns import rows_of
from pipeline.geometry.poses import Float
from pipeline.io.atomic_files import UNFINISHED
from pipeline.io.result_files import (
    BY_PEOPLE,
    PATH_COLUMNS,
    READ_TREE_COLUMNS,
    REJECTED,
    REVIEWS,
    SEEN_COLUMNS,
    TERRAIN_COLUMNS,
    TREE_COLUMNS,
    csv_in_units,
    path_rows,
    tree_rows,
)
from pipeline.seen_area import CELL, SeenArea
from pipeline.types.records import Int, Path, Trees, TruthTrees

LARGEST_FILE = 256 << 20
#: Columns of BY_PEOPLE; `of_tree` is empty for a tree that the map lacks.
BY_PEOPLE_COLUMNS = ("of_tree", "x_m", "y_m", "dbh_tape_cm")
# Standard deviation of a diameter that a person measured [m]: 0.3 cm between four people on 319 trees, there
# with calipers (Luoma et al. 2017, Forests 8(2), 38).
TAPE_SIGMA = 0.003
_FILES = (
    "trees.csv",
    "path.csv",
    "trees.geojson",
    "detections.csv",
    "terrain.csv",
    "seen.csv",
    BY_PEOPLE,
    "slices.csv",
    "state.zip",
)
_REMEDY = "Name another folder with --out, or add --force to overwrite it"
_NEVER_EMPTY = frozenset({"t_s", "x_m", "y_m", "tree", "observations", "sigma_x_m", "sigma_y_m"})


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """The files of `stemmap map`.

    Attributes:
        record: run.json; only "source", "seed" and "parameters" are checked.
        uri: URI of the source.
        trees: The trees that no person rejected.
        reviews: Dict from the number of each tree to the state of its review, not "rejected", see
            `REVIEWS`.
        rejected: The trees that a person rejected.
        of_drive: Whether it is the map of a drive; another map has an empty path.
    """

    record: dict[str, Any]
    uri: str
    seed: int
    parameters: Parameters
    path: Path
    trees: Trees
    reviews: dict[int, str]
    rejected: Trees
    of_drive: bool


@dataclass(frozen=True, slots=True, eq=False)
class ByPeople:
    """What people measured of a run.

    Attributes:
        tape: Dict from the number of each tree of the map that was measured by tape to its diameter [m].
        added: Positions of the trees that people added because the map lacks them, shape (M, 2) [m].
        added_dbh: Their diameters by tape, shape (M,) [m]; NaN where unknown.
    """

    tape: dict[int, float]
    added: Float
    added_dbh: Float

    def tape_of(self, numbers: Sequence[int]) -> Float:
        """Return the diameter by tape of each tree by its number [m]; NaN where there is none."""
        return np.array([self.tape.get(number, math.nan) for number in numbers], np.float64)


def counted_dbh(tape: Float, of_map: Float, sigma: Float) -> tuple[Float, Float, NDArray[np.str_]]:
    """Return the diameter of each tree that counts, its standard deviation, TAPE_SIGMA by tape, and its
    source: "tape", else "map", "" where it is unknown.

    Args:
        tape: Diameters by tape, shape (T,) [m]; NaN where unknown.
        of_map, sigma: Those of the map and their standard deviations, likewise.
    """
    by_tape = np.isfinite(tape)
    source = np.where(by_tape, "tape", np.where(np.isfinite(of_map), "map", ""))
    return np.where(by_tape, tape, of_map), np.where(by_tape, TAPE_SIGMA, sigma), source


def read_run(folder: FilePath) -> FinishedRun:
    """Return the run in a folder that `stemmap map` wrote: its run.json, path.csv and trees.csv, without the
    trees that a person rejected. The trees have diagonal covariances and are all confirmed; times count from
    the first scan, unknown ones of trees are -1; other unknown values are NaN.

    Raises:
        SourceError: A file is missing, damaged or larger than 256 MB, or the parameters are not valid.
    """
    record = read_run_record(folder)
    try:
        parameters = validated(dict(record["parameters"]))
        uri, seed = str(record["source"]["uri"]), int(record["seed"])
    except (ValueError, KeyError, TypeError, OverflowError, ParameterError):
        raise damaged_record(folder) from None
    columns = _columns(folder / "trees.csv", READ_TREE_COLUMNS)
    states = [REVIEWS[k] for k in np.nan_to_num(columns["review"]).astype(np.int64)]
    every, kept = _trees(columns), np.array([state != REJECTED for state in states], np.bool_)
    trees = rows_of(every, kept)
    return FinishedRun(
        record,
        uri,
        seed,
        parameters,
        _path(_columns(folder / "path.csv", PATH_COLUMNS)),
        trees,
        dict(zip(trees.number.tolist(), (state for state in states if state != REJECTED), strict=True)),
        rows_of(every, ~kept),
        is_of_drive(record),
    )


def read_tree_places(folder: FilePath) -> dict[int, tuple[float, float]]:
    """Return a dict from the number of each tree in trees.csv to its position (x, y) [m] in the coordinates
    of the file, also of trees that a person rejected. run.json is not read.

    Raises:
        SourceError: The file is missing or damaged.
    """
    c = _columns(folder / "trees.csv", READ_TREE_COLUMNS)
    numbers = c["tree"].astype(np.int64).tolist()
    return dict(zip(numbers, zip(c["x_m"].tolist(), c["y_m"].tolist(), strict=True), strict=True))


def read_seen_area(folder: FilePath) -> SeenArea | None:
    """Return the area that a run observed, from seen.csv, with cells of CELL; None without this file. An
    unknown distance is NaN, an unknown number of views 0.

    Raises:
        SourceError: The file is damaged.
    """
    file = folder / "seen.csv"
    if not file.is_file():
        return None
    c = _columns(file, SEEN_COLUMNS)
    place = np.floor(np.stack([c["x_m"], c["y_m"]], axis=1) / CELL).astype(np.int64)
    views = np.nan_to_num(c["views"]).astype(np.int64)
    return SeenArea(CELL, place, c["nearest_m"], views, c["clear"] > 0.0)


def read_terrain(folder: FilePath) -> Float:
    """Return the terrain of a run, terrain.csv, as x, y, z of its cells, shape (K, 3) [m]; shape (0, 3)
    without cells.

    Raises:
        SourceError: The file is missing or damaged.
    """
    c = _columns(folder / "terrain.csv", TERRAIN_COLUMNS)
    return np.stack([c["x_m"], c["y_m"], c["z_m"]], axis=1)


def read_by_people(folder: FilePath) -> ByPeople:
    """Return what people measured of a run, from by_people.csv; nothing without this file.

    Raises:
        SourceError: The file is damaged.
    """
    if not (folder / BY_PEOPLE).is_file():
        return ByPeople({}, np.zeros((0, 2)), np.zeros(0))
    c = _columns(folder / BY_PEOPLE, BY_PEOPLE_COLUMNS)
    lacks, dbh = np.isnan(c["of_tree"]), 0.01 * c["dbh_tape_cm"]
    measured = ~lacks & np.isfinite(dbh)
    tape = dict(zip(c["of_tree"][measured].astype(int).tolist(), dbh[measured].tolist(), strict=True))
    return ByPeople(tape, np.stack([c["x_m"], c["y_m"]], axis=1)[lacks], dbh[lacks])


#: Earlier times count from the start of a sensor [ns since 1970].
_FIRST_DATE_NS = 1_000_000_000_000_000_000  # 2001-09-09


def recorded_time(kind: str, start_ns: int) -> dict[str, str]:
    """Return {"recorded": time of the first scan in UTC (ISO 8601, seconds)} for run.json; {} for a simulated
    run and for times before 2001-09-09.

    Args:
        kind: Name of the format of the source.
        start_ns: Time of the first scan [ns].
    """
    if kind.startswith("simulated") or start_ns < _FIRST_DATE_NS:
        return {}
    seconds = start_ns // 1_000_000_000
    return {"recorded": datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat()}


def is_of_drive(record: dict[str, Any]) -> bool:
    """Return whether a record (run.json) is that of the map of a drive, not of a source that was mapped in
    one step."""
    return not (isinstance(record.get("source"), dict) and "offset_m" in record["source"])


def crs_unit(record: dict[str, Any]) -> tuple[float, float]:
    """Return metres per unit of the reference system in which a record (run.json) says that the positions of
    the run are written, horizontal and vertical; 1, 1 without one."""
    try:
        flat, high = (float(value) for value in record["source"]["crs_unit_m"])
    except (KeyError, TypeError, ValueError):
        return 1.0, 1.0
    return (flat, high) if 0.0 < flat < math.inf and 0.0 < high < math.inf else (1.0, 1.0)


def truth_in_metres(
    truth: TruthTrees, unit: tuple[float, float], near: Float | Sequence[float]
) -> TruthTrees:
    """Return true trees in metres. Those of a file in feet may be in either unit: the one in which they lie
    nearer to its points.

    Args:
        truth: True trees in the coordinates of the file or in metres; unknown ones (NaN) are not compared.
        unit: Metres per unit of the reference system, see `crs_unit`.
        near: A position in the file, x, y [m].
    """
    known = np.isfinite(truth.x) & np.isfinite(truth.y)
    if unit == (1.0, 1.0) or not known.any():
        return truth
    scaled = replace(truth, x=truth.x * unit[0], y=truth.y * unit[0])
    return min(
        (truth, scaled),
        key=lambda each: math.hypot(np.median(each.x[known]) - near[0], np.median(each.y[known]) - near[1]),
    )


def read_run_record(folder: FilePath) -> dict[str, Any]:
    """Return run.json of a folder as a dict; the values of "source" and "parameters" are dicts, other values
    are not checked.

    Raises:
        SourceError: The file is missing, damaged or larger than 256 MB.
    """
    try:
        record = json.loads(_text(folder / "run.json"))
        if isinstance(record["source"], dict) and isinstance(record["parameters"], dict):
            return dict(record)
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    raise damaged_record(folder)


def damaged_record(folder: FilePath) -> SourceError:
    """Return the error of a folder with a damaged run.json."""
    return SourceError("run.json is damaged", where=str(folder), remedy="Map the run again")


def as_written(trees: Trees, path: Path, start_ns: int) -> tuple[Trees, Path]:
    """Return copies of the confirmed trees and of the path with the precision of their files, so that scores
    after mapping equal scores of the files. As from `read_run`, the trees have diagonal covariances, times
    count from `start_ns`, and unknown times of trees are -1.

    Args:
        trees, path: The map.
        start_ns: Time of the first scan [ns].
    """
    columns = (
        _table(path_rows(path, start_ns), PATH_COLUMNS),
        _table(tree_rows(trees, start_ns), TREE_COLUMNS),
    )
    return _trees(columns[1]), _path(columns[0])


_NOTHING = np.zeros(0)
#: Path of a map without a drive.
NO_PATH = Path(_NOTHING.astype(np.int64), _NOTHING, _NOTHING, _NOTHING, _NOTHING)


def score_map(trees: Trees, path: Path, truth: TruthTrees, parameters: Parameters) -> MapScores:
    """Return the scores of a map, see `evaluate`. With an empty path, as without a drive, all true
    trees count, else those within `evaluation.reach` of it.

    Args:
        trees, path: The map, see `as_written`.
        truth: True trees in the frame of the map.
        parameters: Parameters, of which those of the stage `evaluation` are used.
    """
    path_xy = np.stack([path.x, path.y], axis=1) if len(path.x) else None
    return evaluate(trees, truth, parameters.evaluation, path_xy)


def _text(file: FilePath) -> str:
    """Return the text of a file.

    Raises:
        SourceError: The file cannot be read, is larger than 256 MB, or is not UTF-8.
    """
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise SourceError("the file is larger than 256 MB", where=str(file))
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise SourceError(
            f"cannot read it: {error.strerror}",
            where=str(file),
            remedy="Name a folder that `stemmap map` wrote",
        ) from None
    except UnicodeDecodeError:
        raise SourceError("the file is not text", where=str(file)) from None


def _columns(file: FilePath, names: tuple[str, ...]) -> dict[str, Float]:
    """Return a dict from the name of each column of a CSV file to its numbers, shape (rows,), in the units of
    the file; positions in metres. An empty cell is NaN; a cell of "review" becomes its index in
    REVIEWS.

    Args:
        file: The file.
        names: Names that the header must have; further columns are not read.

    Raises:
        SourceError: The file cannot be read or is larger than 256 MB, has another header or a damaged row, or
            a cell of `_NEVER_EMPTY` is empty.
    """
    damaged = SourceError("a row is damaged", where=str(file), remedy="Map the run again")
    text = _text(file)
    try:
        if "x" in text.partition("\n")[0].split(","):  # of a cloud in feet
            text = csv_in_units(text, crs_unit(read_run_record(file.parent)), to_metres=True)
        rows = list(csv.reader(text.splitlines()))
    except (csv.Error, ValueError):
        raise damaged from None
    if not rows or not set(names) <= set(rows[0]):
        raise SourceError(
            f"the columns are not {', '.join(names)}", where=str(file), remedy="Map the run again"
        )
    order = [rows[0].index(name) for name in names]
    try:
        if any(len(row) != len(rows[0]) for row in rows):
            raise ValueError("a row is too short")
        columns = _table([[row[k] for k in order] for row in rows[1:]], names)
    except ValueError:
        raise damaged from None
    for name in _NEVER_EMPTY.intersection(names):
        if not np.all(np.isfinite(columns[name])):
            raise SourceError(f"a cell of {name} is empty", where=str(file), remedy="Map the run again")
    return columns


def _table(rows: Sequence[Sequence[str]], names: tuple[str, ...]) -> dict[str, Float]:
    """Return a dict from the name of each column of a CSV table to its numbers, shape (rows,). An empty cell
    is NaN, and a cell of "review" becomes its index in REVIEWS.

    Args:
        rows: Cells of the rows, without the header.
        names: Names of the columns.

    Raises:
        ValueError: A row does not fit the columns, or a cell is not a number.
    """
    table = np.array(
        [[_number(name, cell) for name, cell in zip(names, row, strict=True)] for row in rows], np.float64
    )
    return dict(zip(names, table.reshape(len(rows), len(names)).T, strict=True))


def _number(name: str, cell: str) -> float:
    """Return a cell of a column as a number, see `_table`; ValueError if it is neither empty nor a number,
    nor in REVIEWS for the column "review"."""
    if not cell:
        return math.nan
    return float(REVIEWS.index(cell)) if name == "review" else float(cell)


def _path(c: dict[str, Float]) -> Path:
    """Return the path from the columns of path.csv, a dict from their names to arrays of shape (N,).
    `stamp_ns` counts from the first scan of the run."""
    stamp = np.round(c["t_s"] * 1e9).astype(np.int64)
    return Path(stamp, c["x_m"], c["y_m"], c["yaw_rad"], c["sigma_xy_m"])


def _trees(c: dict[str, Float]) -> Trees:
    """Return the trees from the columns of trees.csv, a dict from their names to arrays of shape (T,). All
    are confirmed, covariances xy are 0, and an unknown time is -1."""
    n = len(c["tree"])
    covariance = np.zeros((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = c["sigma_x_m"] ** 2, c["sigma_y_m"] ** 2
    return Trees(
        number=c["tree"].astype(np.int64),
        position=np.stack([c["x_m"], c["y_m"]], axis=1),
        covariance=covariance,
        dbh=c["dbh_cm"] / 100.0,
        dbh_sigma=c["sigma_dbh_cm"] / 100.0,
        eccentricity=c["eccentricity"],
        observations=c["observations"].astype(np.int64),
        coverage=np.radians(c["coverage_deg"]),
        first_seen_ns=_stamps(c["first_seen_s"]),
        last_seen_ns=_stamps(c["last_seen_s"]),
        confirmed=np.ones(n, np.bool_),
        height=c["height_m"],
        height_sigma=c["sigma_height_m"],
        lean=np.radians(c["lean_deg"]),
    )


def _stamps(seconds: Float) -> Int:
    """Return times [s], shape (N,), in nanoseconds, int64; NaN or infinity becomes -1."""
    stamps: Int = np.where(np.isfinite(seconds), np.round(np.nan_to_num(seconds) * 1e9), -1.0).astype(
        np.int64
    )
    return stamps


def check_folder(folder: FilePath, digest: str, *, force: bool) -> bool:
    """Check whether the files of a run may be written to a folder. Nothing is changed.

    Args:
        folder: The folder for the files; it need not exist.
        digest: Digest of the run's first source. A run of the same source may be replaced.
        force: Whether anything may be overwritten.

    Returns:
        Whether files in the folder will be replaced.

    Raises:
        StemmapError: `force` is not set, and the folder contains the run of another source, a run.json that
            cannot be read, or no run.json but a file of the names in _FILES.
    """
    if not (folder / "run.json").exists():
        there = [name for name in _FILES if (folder / name).exists()]
        if there and not force:
            raise StemmapError(
                f"the folder has a file {there[0]} that is not from a run", where=str(folder), remedy=_REMEDY
            )
        return bool(there)
    if force:
        return True
    try:
        source = read_run_record(folder)["source"]
    except StemmapError:
        raise StemmapError(
            "the folder has a run.json that cannot be read", where=str(folder), remedy=_REMEDY
        ) from None
    if source.get("sha256") != digest:
        raise StemmapError(
            f"the folder has the map of another source, {source.get('uri')}",
            where=str(folder),
            remedy=_REMEDY,
        )
    return True


def partial_output_warnings(folder: FilePath) -> list[str]:
    """Return a warning for each partial output directly in a folder; [] if the folder does not exist."""
    return [
        f"{path} is the partial output of a run that was killed: delete it, unless another stemmap process "
        "writes to it"
        for path in sorted(folder.glob(f"{UNFINISHED}*"))
        if path.is_dir()
    ]
