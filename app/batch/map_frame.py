"""The coordinate reference system of the map of a finished run: georeference.json in its folder."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.batch.run_folder import is_of_drive, read_run_record
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_beside
from pipeline.io.readers.base import COORDINATE_LIMIT

FILE = "georeference.json"
LOCAL = "local"
#: Name of the reference system of local files.
LOCAL_NAME = "local frame of the map"
#: Longitude and latitude [deg].
WGS84 = "EPSG:4326"
_LARGEST_FILE = 1 << 20
#: Numbers of the methods, by name: control points or used fixes, and all fixes; root mean square residual
#: [m]; standard deviation of a coordinate of a point [m], and of the rotation [deg].
METHOD_NUMBERS = {
    "control": ("points", "rms_m", "sigma_point_m", "sigma_turn_deg"),
    "gnss": ("points", "fixes", "rms_m", "sigma_turn_deg"),
}
METHODS = ("cloud", "file", "hand", *METHOD_NUMBERS)
_METHOD_WORDS = {
    "": "the source",
    "cloud": "the cloud itself",
    "file": "the coordinates of the file",
    "hand": "hand",
    "control": "{points:.0f} control points, {rms_m:.3f} m (RMS), one coordinate of a point "
    "+- {sigma_point_m:.3f} m, turn +- {sigma_turn_deg:.3f} degrees",
    "gnss": "{points:.0f} of {fixes:.0f} GNSS fixes, {rms_m:.2f} m (RMS) from the path, "
    "turn +- {sigma_turn_deg:.2f} degrees",
}


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Position of the frame of a map in a coordinate reference system.

    Attributes:
        crs: Reference system as text for pyproj, such as EPSG:25832; "" for the local frame of the map.
        pose: Pose of the map frame in the reference system: east, north [m], angle from east to the x axis of
            the map, counter-clockwise [rad].
        z: Height of the origin of the map in the reference system [m].
        method: How it was found: "cloud" (the cloud states it), "file" (the coordinates of the file are
            already in it), "hand", "control" (points) or "gnss" (fixes); "" if unknown.
        numbers: Dict from the names in METHOD_NUMBERS to the numbers of the method; empty for "cloud", "file"
            and "hand".
        sigma: Standard deviation of a position in the reference system, at the centre of its points [m]; NaN
            if unknown.
        residuals: Name and residual east, north [m] of each control point.
        place: The reference system and the place of the map in it, see `place_words`; "" if unknown.
    """

    crs: str = ""
    pose: Pose2 = field(default_factory=Pose2)
    z: float = 0.0
    method: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    sigma: float = math.nan
    residuals: tuple[tuple[str, float, float], ...] = ()
    place: str = ""

    @property
    def name(self) -> str:
        """The reference system; LOCAL for the local frame."""
        return self.crs or LOCAL

    @property
    def title(self) -> str:
        """The reference system for people: the name of one in WKT, else as `name`."""
        return self.crs.split('"')[1] if '["' in self.crs else self.name

    @property
    def method_words(self) -> str:
        """How the frame was found, in English and to follow the word "by": the note if there is one; "the
        source" if the method is unknown."""
        return _METHOD_WORDS[self.method].format(**self.numbers)

    def to_crs(self, points: Float) -> Float:
        """Return positions x, y in the map, shape (N, 2) [m], as east, north in the reference system, shape
        (N, 2) [m]."""
        return self.pose.apply(np.reshape(points, (-1, 2)))

    def to_map(self, points: Float) -> Float:
        """Return positions east, north in the reference system, shape (N, 2) [m], as x, y in the map, shape
        (N, 2) [m]."""
        return self.pose.inverse().apply(np.reshape(points, (-1, 2)))

    def record(self) -> dict[str, Any]:
        """Return the frame as a dict of JSON values, the content of georeference.json: `crs`, `east_m`,
        `north_m`, `turn_rad`, `z_m`, `sigma_m` (None if unknown), `method`, `numbers`, `residuals_m`, `place`
        and, if there is one, the note as `how`."""
        return {
            "crs": self.crs,
            "east_m": self.pose.x,
            "north_m": self.pose.y,
            "turn_rad": self.pose.yaw,
            "z_m": self.z,
            "sigma_m": None if math.isnan(self.sigma) else self.sigma,
            "method": self.method,
            "numbers": dict(self.numbers),
            "residuals_m": [list(row) for row in self.residuals],
            "place": self.place,
        }


def gis_package(module: str, purpose: str) -> Any:  # noqa: ANN401 - a module
    """Import a package of the extra `gis` and return it.

    Args:
        module: Name of the package.
        purpose: What needs it, a plural for the message, such as "GIS files".

    Raises:
        StemmapError: The package, or a module that it needs, is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise StemmapError(
            f"{purpose} need the package {module}", remedy="Install it with: pip install 'stemmap[gis]'"
        ) from None


def reproject(points: Float, source: str, target: str) -> Float:
    """Return positions of one reference system in another as a new array, shape (N, 2): east, north [m] or
    longitude, latitude [deg], in this order in both systems; inf where the transformation has no value.

    Args:
        points: Positions in `source`, shape (N, 2).
        source, target: Reference systems as text for pyproj, such as WGS84.

    Raises:
        pyproj.exceptions.ProjError: A reference system is unknown.
    """
    import pyproj

    transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
    return np.stack(transformer.transform(*np.reshape(points, (-1, 2)).T), axis=1)


def read_map_frame(folder: FilePath) -> MapFrame:
    """Return the frame of the map of a run: that of georeference.json, else that of a source of one step with
    a known reference system, else the local one.

    Raises:
        SourceError: run.json is missing, a file is damaged, or the reference system of georeference.json is
            unknown to PROJ.
    """
    import pyproj

    record = read_run_record(folder)
    file = folder / FILE
    if not file.is_file():
        crs = "" if is_of_drive(record) else str(record["source"].get("crs") or "")
        try:
            return MapFrame(_known(crs), method="cloud" if crs else "")
        except pyproj.exceptions.ProjError:  # `stemmap map` warned of it
            return MapFrame()
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise ValueError("too large")
        given: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        x, y, yaw, z = (float(given[key]) for key in ("east_m", "north_m", "turn_rad", "z_m"))
        sigma = math.nan if given["sigma_m"] is None else float(given["sigma_m"])
        residuals = tuple((str(n), float(e), float(m)) for n, e, m in given["residuals_m"])
        if not all(abs(v) < COORDINATE_LIMIT for v in (x, y, yaw, z)):
            raise ValueError("out of range")
        method, numbers = _method_of(given)
        crs, place = _known(str(given["crs"])), str(given.get("place", ""))
        return MapFrame(crs, Pose2(x, y, yaw), z, method, numbers, sigma, residuals, place)
    except pyproj.exceptions.ProjError:
        raise SourceError(
            f"this version of PROJ does not know the reference system of {FILE}",
            where=str(folder),
            remedy="Update the package pyproj, or remove this file",
        ) from None
    except (ValueError, KeyError, TypeError, RecursionError, OSError):
        raise SourceError(f"{FILE} is damaged", where=str(folder), remedy="Remove or restore it") from None


def _known(crs: str) -> str:
    """Return a reference system as it is; "" for none.

    Raises:
        pyproj.exceptions.ProjError: It is unknown or has no transformation to WGS84.
    """
    if crs:
        reproject(np.zeros((0, 2)), crs, WGS84)
    return crs


def _method_of(given: dict[str, Any]) -> tuple[str, dict[str, float]]:
    """Return `method` and `numbers` of `MapFrame` from a record.

    Raises:
        ValueError, KeyError, TypeError: The method is unknown, or a number is missing.
    """
    method = str(given["method"])
    if method and method not in METHODS:
        raise ValueError("an unknown method")
    return method, {name: float(given["numbers"][name]) for name in METHOD_NUMBERS.get(method, ())}


def write_map_frame(folder: FilePath, record: dict[str, Any]) -> None:
    """Write georeference.json, in place of an earlier one.

    Args:
        folder: Folder of the run.
        record: The frame, see `MapFrame.record`.

    Raises:
        StemmapError: The file cannot be written.
    """
    with write_beside(folder / FILE) as partial:
        partial.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def heights_at(terrain: Float, points: Float, reach: float = 2.0) -> Float:
    """Return the height of the terrain cell nearest to each position, shape (N,) [m]; NaN if that cell is
    farther than `reach` or there are no cells.

    Args:
        terrain: x, y, z of the terrain cells in the map, shape (K, 3) [m].
        points: Positions x, y in the map, shape (N, 2) [m].
        reach: Maximum distance of the cell [m].
    """
    from scipy.spatial import cKDTree

    if not len(terrain):
        return np.full(len(points), np.nan)
    points = np.reshape(points, (-1, 2))
    row = _cells_of(terrain[:, :2], points)
    far = np.flatnonzero(row < 0)
    if len(far):
        _, row[far] = cKDTree(terrain[:, :2]).query(points[far])
    distance = np.hypot(*(points - terrain[row, :2]).T)
    return np.where(distance <= reach, terrain[row, 2], np.nan)


_MOST_CELLS = 1 << 24  # of the grid around all cells, 128 MB


def _cells_of(centres: Float, points: Float) -> NDArray[np.int64]:
    """Return the row of the cell in which each position lies, shape (N,); -1 for a position in no cell, and
    for all positions if the cells are no square grid.

    Args:
        centres: Centres of the cells, rounded to 1 mm, shape (K, 2) [m].
        points: Positions, finite, shape (N, 2) [m].
    """
    nowhere = np.full(len(points), -1)
    sides = [np.diff(np.unique(column)) for column in centres.T]
    side = min((float(np.median(steps)) for steps in sides if len(steps)), default=0.0)
    if side < 0.01:
        return nowhere
    low = centres.min(axis=0)
    place = (centres - low) / side
    key = np.rint(place).astype(np.int64)
    wide, long = (key.max(axis=0) + 1).tolist()
    if np.abs(place - key).max() > 0.01 or wide * long > _MOST_CELLS:
        return nowhere
    grid = np.full((wide, long), -1)
    grid[key[:, 0], key[:, 1]] = np.arange(len(centres))
    at = np.rint(np.clip((points - low) / side, -1.0, [wide, long])).astype(np.int64)
    inside = ((at >= 0) & (at < [wide, long])).all(axis=1)
    nowhere[inside] = grid[at[inside, 0], at[inside, 1]]
    return nowhere
