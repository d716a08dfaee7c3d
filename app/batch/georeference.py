"""The coordinate reference system of a finished run: georeference.json in its folder."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from app.batch.run_folder import is_of_cloud, read_run, read_run_record, read_terrain
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_beside
from pipeline.stand.control_points import fit_control_points, fit_rigid_pairs

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
    """Return a projected reference system with metres in the normal form of its authority (EPSG:25832), or as
    WKT without one.

    Args:
        crs: A code such as "25832" or "EPSG:25832", or any text that pyproj reads.

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
    """Check that positions are in the area for which a reference system is defined, with a margin of 3
    degrees; for a system without an area only that they have a longitude and latitude.

    Args:
        crs: The reference system.
        points: East, north, shape (N, 2) [m].

    Raises:
        StemmapError: A position is outside; the message gives its longitude and latitude.
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
    reference system, else the local one. The reference system is not checked.

    Raises:
        SourceError: run.json is missing, or a file is damaged.
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
    """Write georeference.json, in place of an earlier one.

    Raises:
        StemmapError: The file cannot be written.
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


_EAST = ("easting", "easting_m", "east", "east_m", "utm_x")
_NORTH = ("northing", "northing_m", "north", "north_m", "utm_y")
_LON, _LAT = ("lon", "longitude", "lon_deg"), ("lat", "latitude", "lat_deg")
_HEIGHT = ("elevation_m", "elevation", "z_m", "z", "height_m")
_POINTS_MAX = 1000


def by_control_points(folder: FilePath, file: FilePath, crs: str, point_sigma: float | None) -> MapFrame:
    """Return the frame of a map by control points: trees by their numbers, or positions in the map. It is not
    written.

    Heights, if the file has them, give the height of the map's zero with the terrain of the run; it is 0
    without heights.

    Args:
        folder: Folder of the run.
        file: CSV with a header: easting and northing (or lon and lat), tree or x_m and y_m, optionally name
            and elevation_m.
        crs: Reference system, see `projected`.
        point_sigma: See `fit_control_points`; None for 0.125 m.

    Raises:
        StemmapError: The table is damaged or names unknown trees, the points are not in the area of the
            reference system or contradict one another, or the run has no terrain at a point with a height.
    """
    import pyproj

    rows = _control_rows(file)
    run = read_run(folder)
    place = {int(n): p for n, p in zip(run.trees.number, run.trees.position, strict=True)}
    local: list[Float] = []
    names: list[str] = []
    for line, row in rows:
        name = row.get("name") or row.get("tree") or str(len(names) + 1)
        if row.get("tree"):
            number = _cell(row, ("tree",), line, file)
            if number not in place:
                raise StemmapError(f"line {line}: the map has no tree {row['tree']}", where=str(file))
            local.append(place[int(number)])
        else:
            local.append(np.array([_cell(row, (axis,), line, file) for axis in ("x_m", "y_m")]))
        names.append(name)
    columns = rows[0][1]
    geographic = any(name in columns for name in _LON)
    axes = (_LON, _LAT) if geographic else (_EAST, _NORTH)
    known = np.array([[_cell(row, axis, line, file) for axis in axes] for line, row in rows])
    if geographic:
        transformer = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
        known = np.stack(transformer.transform(known[:, 0], known[:, 1]), axis=1)
    check_area(crs, known)
    fit = fit_control_points(np.array(local), known, names=names, point_sigma=point_sigma or 0.125)
    z = 0.0
    if any(name in columns for name in _HEIGHT):
        heights = np.array([_cell(row, _HEIGHT, line, file) for line, row in rows])
        z = float(np.mean(heights - ground_heights(folder, np.array(local))))
        if not math.isfinite(z):
            raise StemmapError(
                "the run has no terrain at a control point with a height",
                where=str(file),
                remedy="Leave the heights out",
            )
    residuals = [(n, float(e), float(m)) for n, (e, m) in zip(names, fit.residuals, strict=True)]
    how = (
        f"{len(names)} control points, {fit.rms:.3f} m (RMS), one coordinate of a point "
        f"+- {fit.sigma_point:.3f} m, turn +- {math.degrees(fit.sigma_turn):.3f} degrees"
    )
    return MapFrame(crs, fit.pose, z, how, fit.sigma, tuple(residuals))


def _control_rows(file: FilePath) -> list[tuple[int, dict[str, str]]]:
    """Return line number and cells by lower-case header of each row that is not empty, at least one and at
    most _POINTS_MAX.

    Raises:
        SourceError: The file cannot be read, is larger than 1 MB, or has an incomplete header or no rows.
    """
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise SourceError("the table of control points is larger than 1 MB", where=str(file))
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise SourceError(f"cannot read the control points: {error.strerror}", where=str(file)) from None
    except UnicodeDecodeError:
        raise SourceError("the table of control points is not text", where=str(file)) from None
    head = text.partition("\n")[0]
    reader = csv.reader(text.splitlines(), delimiter=max(",;\t", key=head.count))
    try:
        table = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise SourceError(f"the control points are damaged: {error}", where=str(file)) from None
    table = [(line, row) for line, row in table if any(row)]
    header = [name.lower() for name in table[0][1]] if table else []
    if len(table) > _POINTS_MAX:
        raise SourceError(f"there are more than {_POINTS_MAX} control points", where=str(file))
    known = any(n in header for n in (*_EAST, *_LON)) and any(n in header for n in (*_NORTH, *_LAT))
    if not known or not ("tree" in header or {"x_m", "y_m"} <= set(header)):
        raise SourceError(
            "the header of the control points is not complete",
            where=str(file),
            remedy="It needs easting and northing (or lon and lat), and tree or x_m and y_m",
        )
    rows = [(line, dict(zip(header, row, strict=False))) for line, row in table[1:]]
    if not rows:
        raise SourceError("the file has no control points", where=str(file))
    return rows


def _cell(row: dict[str, str], names: tuple[str, ...], line: int, file: FilePath) -> float:
    """Return the number in the first column of some names that a row has.

    Args:
        row: Cells by header.
        names: Names of the column; of several that exist the first.
        line, file: Line and file, for errors.

    Raises:
        SourceError: The cell is missing, not a number, or its magnitude is 1e8 or more.
    """
    name = next((name for name in names if name in row), names[0])
    try:
        value = float(row[name])
    except (KeyError, ValueError):
        value = math.nan
    if not abs(value) < _FARTHEST:
        raise SourceError(f"line {line}: {name} = {row.get(name, '')!r} is not a number", where=str(file))
    return value


def by_hand(folder: FilePath, crs: str, east: float, north: float, turn: float, z: float) -> MapFrame:
    """Return the frame of a map by the position of its origin. It is not written.

    Args:
        folder: Folder of the run.
        crs: Reference system, see `projected`.
        east, north: Position of the origin [m].
        turn: Angle of the x axis from east to north [rad].
        z: Height of the map's zero [m].

    Raises:
        StemmapError: The folder is not that of a run, or the position is not in the area of the reference
            system.
    """
    read_run_record(folder)
    check_area(crs, np.array([[east, north]]))
    return MapFrame(crs, Pose2(east, north, turn), z, "by hand")


def by_gnss(folder: FilePath, crs: str) -> MapFrame:
    """Return the frame of a map by the GNSS fixes of its recording, fitted to the whole path. Fixes that are
    far from the path, compared with the others, do not count. The height of the map's zero is 0. It is not
    written.

    Args:
        folder: Folder of the run, whose recording must still exist.
        crs: Reference system, see `projected`.

    Raises:
        StemmapError: The recording or the saved state cannot be read, the recording has no fixes, or they do
            not fit the path.
    """
    import pyproj

    from app.batch.continue_map import read_saved_run
    from app.sources.opening import open_source
    from pipeline.io.readers.measured_poses import fit_rigid
    from pipeline.io.readers.ros import RosSource

    run = read_run(folder)
    source = open_source(run.uri)
    try:
        fixes = source.fixes() if isinstance(source, RosSource) else []
    finally:
        source.close()
    if not fixes:
        raise StemmapError(
            "the recording has no GNSS fixes", where=run.uri, remedy="Use --control or --by-hand"
        )
    transformer = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
    positions = np.stack(
        transformer.transform([f.longitude for f in fixes], [f.latitude for f in fixes]), axis=1
    )
    check_area(crs, positions)
    origin = positions[0].copy()
    stamps = read_saved_run(folder).map.stamp_ns
    path = np.stack([run.path.x, run.path.y], axis=1)
    at_ns = np.array([fix.stamp_ns for fix in fixes], np.int64)
    sigma = np.array([fix.sigma for fix in fixes])
    keep = np.argsort(at_ns, kind="stable")
    keep = keep[(at_ns[keep] >= stamps[0]) & (at_ns[keep] <= stamps[-1])]
    on_path = np.stack([np.interp(at_ns, stamps, path[:, axis]) for axis in (0, 1)], axis=1)
    for _ in range(10):  # rounds of fitting and leaving out
        if len(keep) < 2:
            break
        rigid = fit_rigid_pairs(on_path[keep], positions[keep] - origin)
        off = np.hypot(*rigid.residuals.T)
        near = off <= max(3.0 * float(np.median(off)), 0.05)
        if near.all():
            break
        keep = keep[near]
    fit, why = fit_rigid(
        at_ns[keep], positions[keep] - origin, sigma[keep], stamps.tolist(), path,
        shortest=5.0, what="fixes", unknown="the direction of north",
    )  # fmt: skip
    if fit is None:
        raise StemmapError(f"the GNSS fixes cannot be used: {why}", where=run.uri, remedy="Use --control")
    pose = fit.T_map_other.inverse()
    how = (
        f"{len(keep)} of {len(fixes)} GNSS fixes, {fit.residual:.2f} m (RMS) from the path, "
        f"turn +- {math.degrees(fit.yaw_sigma):.2f} degrees"
    )
    return MapFrame(crs, Pose2(pose.x + origin[0], pose.y + origin[1], pose.yaw), 0.0, how, fit.sigma)


def ground_heights(folder: FilePath, points: Float) -> Float:
    """Return the height of the terrain of a run at positions in the map, shape (N, 2), as shape (N,) [m]:
    that of the nearest cell within 2 m; NaN without one.

    Raises:
        SourceError: terrain.csv is missing or damaged.
    """
    return heights_at(read_terrain(folder), points)


def heights_at(terrain: Float, points: Float, reach: float = 2.0) -> Float:
    """Return the height of the nearest cell of the terrain at positions in the map, shape (N,) [m]; NaN if it
    is farther than `reach`.

    Args:
        terrain: x, y, z of its cells, shape (K, 3) [m].
        points: Positions, shape (N, 2) [m].
        reach: Largest distance of the cell [m].
    """
    from scipy.spatial import cKDTree

    if not len(terrain):
        return np.full(len(points), np.nan)
    distance, row = cKDTree(terrain[:, :2]).query(np.reshape(points, (-1, 2)))
    return np.where(distance <= reach, terrain[row, 2], np.nan)


def frame_lines(frame: MapFrame) -> list[str]:
    """Return a frame as lines for people: position, and where known its standard deviation and the residuals
    of the control points."""
    if not frame.crs:
        return ["local coordinates: the map has no reference system"]
    lines = [
        f"{frame.name}: origin at {frame.pose.x:.3f}, {frame.pose.y:.3f} m, x axis "
        f"{math.degrees(frame.pose.yaw):.3f} degrees from east to north, by {frame.how or 'the source'}"
    ]
    if math.isfinite(frame.sigma):
        lines.append(f"a coordinate in the middle of the points +- {frame.sigma:.3f} m")
    lines += [f"point {name}: residual {e:+.3f} m east, {n:+.3f} m north" for name, e, n in frame.residuals]
    return lines
