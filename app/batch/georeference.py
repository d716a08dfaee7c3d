"""The coordinate reference system of a finished run: georeference.json in its folder."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from app.batch.run_folder import is_of_cloud, read_run_record
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_beside

FILE = "georeference.json"
LOCAL = "local"
_LARGEST_FILE = 1 << 20
_FARTHEST = 1e8  # m


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Position of the frame of a map in a coordinate reference system.

    Attributes:
        crs: Reference system as text for pyproj, such as EPSG:25832; "" for the local frame of the map.
        pose: Pose of the map in it: east, north [m], angle of the map's x axis from east to north [rad].
        z: Height of the map's zero [m].
        how: How it was found, for people.
        sigma: Standard deviation of a position by this georeference, at the centre of its points [m]; NaN if
            unknown.
        residuals: Name and residual east, north [m] of each control point.
    """

    crs: str = ""
    pose: Pose2 = field(default_factory=Pose2)
    z: float = 0.0
    how: str = ""
    sigma: float = math.nan
    residuals: tuple[tuple[str, float, float], ...] = ()

    @property
    def name(self) -> str:
        """The reference system for people."""
        return self.crs or LOCAL

    def to_crs(self, points: Float) -> Float:
        """Return positions of the map, shape (N, 2), in the reference system: east, north [m]."""
        return self.pose.apply(np.reshape(points, (-1, 2)))

    def to_map(self, points: Float) -> Float:
        """Return positions in the reference system, shape (N, 2), in the frame of the map [m]."""
        return self.pose.inverse().apply(np.reshape(points, (-1, 2)))


def projected(crs: str) -> str:
    """Return a projected reference system with metres, east and north, in the normal form of its authority
    (EPSG:25832).

    Raises:
        StemmapError: It is unknown, has degrees (geographic) or another unit than metres.
    """
    import pyproj

    try:
        system = pyproj.CRS.from_user_input(int(crs) if crs.isdigit() else crs)
    except pyproj.exceptions.CRSError:
        raise StemmapError(
            f"{crs!r} is not a coordinate reference system", remedy="Give a code such as EPSG:25832"
        ) from None
    units = {axis.unit_name for axis in system.axis_info[:2]}
    if system.is_geographic or not system.is_projected:
        raise StemmapError(
            f"{system.name} has degrees, not metres",
            remedy="Give a projected system, such as the UTM zone EPSG:32632",
        )
    if units != {"metre"}:
        raise StemmapError(f"{system.name} has the unit {', '.join(sorted(units))}, not metres")
    authority = system.to_authority()
    return ":".join(authority) if authority else system.to_wkt()


def check_area(crs: str, points: Float) -> None:
    """Check that positions lie in the area for which a reference system is defined.

    Args:
        crs: The reference system.
        points: East, north, shape (N, 2) [m].

    Raises:
        StemmapError: A position is far outside; the message gives its longitude and latitude.
    """
    import pyproj

    system = pyproj.CRS.from_user_input(crs)
    lon, lat = pyproj.Transformer.from_crs(system, 4326, always_xy=True).transform(
        *np.reshape(points, (-1, 2)).T
    )
    area = system.area_of_use
    margin = 3.0  # degrees; systems are used somewhat beyond their area
    fits = np.isfinite(lon) & np.isfinite(lat)
    if area is not None:
        fits &= np.abs(lat - 0.5 * (area.south + area.north)) <= 0.5 * (area.north - area.south) + margin
        width = (area.east - area.west) % 360.0 or 360.0
        turn = (lon - area.west + margin) % 360.0
        fits &= turn <= width + 2.0 * margin
    if not fits.all():
        k = int(np.argmin(fits))
        east, north = np.reshape(points, (-1, 2))[k]
        where = (
            f"longitude {lon[k]:.3f}, latitude {lat[k]:.3f}" if np.isfinite(lon[k]) else "no place on earth"
        )
        raise StemmapError(
            f"the coordinates do not fit {system.name}: {east:.1f}, {north:.1f} is {where}",
            remedy="Check the EPSG code, the order of the axes (east, north) and the unit",
        )


def read_map_frame(folder: FilePath) -> MapFrame:
    """Return the frame of the map of a run: that of georeference.json, else that of a whole cloud with a
    reference system, else the local one.

    Raises:
        SourceError: A file is damaged.
    """
    record = read_run_record(folder)
    file = folder / FILE
    if not file.is_file():
        crs = str(record["source"].get("crs") or "") if is_of_cloud(record) else ""
        return MapFrame(crs, how="the cloud's own" if crs else "")
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise ValueError("too large")
        given: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        x, y, yaw, z = (float(given[key]) for key in ("east_m", "north_m", "turn_rad", "z_m"))
        sigma = math.nan if given["sigma_m"] is None else float(given["sigma_m"])
        residuals = tuple((str(n), float(e), float(m)) for n, e, m in given["residuals_m"])
        if not all(abs(v) < _FARTHEST for v in (x, y, yaw, z)):
            raise ValueError("out of range")
        return MapFrame(str(given["crs"]), Pose2(x, y, yaw), z, str(given["how"]), sigma, residuals)
    except (ValueError, KeyError, TypeError, RecursionError, OSError):
        raise SourceError(
            f"{FILE} is damaged", where=str(folder), remedy="Run stemmap georeference again"
        ) from None


def write_map_frame(folder: FilePath, frame: MapFrame) -> None:
    """Write georeference.json.

    Raises:
        OSError: The folder cannot be written.
    """
    record = {
        "crs": frame.crs,
        "east_m": frame.pose.x,
        "north_m": frame.pose.y,
        "turn_rad": frame.pose.yaw,
        "z_m": frame.z,
        "sigma_m": None if math.isnan(frame.sigma) else frame.sigma,
        "how": frame.how,
        "residuals_m": [list(row) for row in frame.residuals],
    }
    with write_beside(folder / FILE) as partial:
        partial.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")
