"""The coordinate reference system of a finished run: georeference.json in its folder."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.batch.run_folder import is_of_cloud, read_run, read_run_record, read_terrain, read_tree_places
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_beside
from pipeline.io.csv_table import CsvTable
from pipeline.io.readers.base import COORDINATE_LIMIT
from pipeline.stand.control_points import fit_control_points, fit_rigid_pairs

FILE = "georeference.json"
LOCAL = "local"
#: Name of the reference system of local files.
LOCAL_NAME = "local frame of the map"
#: Longitude and latitude [deg].
WGS84 = "EPSG:4326"
#: Largest error of distances in a reference system: 10 cm on a plot of 10 m. Web Mercator has 56 % at a
#: latitude of 50 degrees, 1 / cos(latitude) - 1.
SCALE_ERROR = 0.01
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
        sigma: Standard deviation of a position by this georeference, at the centre of its points [m]; NaN if
            unknown.
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


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A point that is known in the map and in a reference system.

    Attributes:
        name: Name of the point, for messages.
        east, north: Position in the reference system [m].
        tree: Number of the tree at the point; None for another mark.
        x, y: Position in the map [m]; None for a tree.
        z: Height in the reference system [m]; None if unknown.
    """

    name: str
    east: float
    north: float
    tree: int | None = None
    x: float | None = None
    y: float | None = None
    z: float | None = None


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


def projected(crs: str) -> str:
    """Return a projected reference system in metres as "AUTHORITY:CODE", for example EPSG:25832, or as WKT if
    no authority has a code for it.

    Args:
        crs: A code such as "25832" or "EPSG:25832", or any text that pyproj reads.

    Raises:
        StemmapError: The reference system is unknown, not projected (geographic, geocentric, vertical, local)
            or has another unit than metres. The message states which.
    """
    import pyproj

    try:
        system = pyproj.CRS.from_user_input(f"EPSG:{crs}" if crs.isdigit() else crs)
    except pyproj.exceptions.CRSError:
        raise StemmapError(
            f"{crs!r} is not a coordinate reference system", remedy="Give a code such as EPSG:25832"
        ) from None
    units = ", ".join(sorted({axis.unit_name for axis in system.axis_info[:2]}))
    problem = ""
    if not system.is_projected and system.is_geocentric:
        problem = "is geocentric: its coordinates count from the centre of the earth, not east and north"
    elif not system.is_projected and not system.is_geographic:
        problem = (
            "has only heights, no east and north"
            if system.is_vertical
            else f"is not a map projection but of the kind {system.type_name}"
        )
    elif units != "metre":
        problem = f"has {'degrees' if units == 'degree' else f'the unit {units}'}, not metres"
    if problem:
        raise StemmapError(
            f"{system.name} {problem}",
            remedy="Give a projected system in metres, such as the UTM zone EPSG:32632",
        )
    authority = system.to_authority()
    return ":".join(authority) if authority else system.to_wkt()


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


def check_area(crs: str, points: Float) -> None:
    """Check that positions have a longitude and latitude, that these are in the area for which a reference
    system is defined, if it states one, with a margin of 3 degrees, and that its metres are those of the
    ground within SCALE_ERROR.

    Args:
        crs: The reference system.
        points: East, north, shape (N, 2) [m].

    Raises:
        StemmapError: A position is outside; the message gives its longitude and latitude if it has them. Or
            distances in the system, such as Web Mercator, are not those on the ground.
    """
    import pyproj

    system = pyproj.CRS.from_user_input(crs)
    lon, lat = reproject(points, crs, WGS84).T
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
    scale = np.array(pyproj.Proj(system).get_factors(lon, lat).parallel_scale) if len(lon) else np.ones(1)
    if np.any(np.abs(scale - 1.0) > SCALE_ERROR):
        raise StemmapError(
            f"a metre on the ground is {np.max(scale):.2f} m in {system.name}, and a map is never scaled",
            remedy="Choose a system for this area, such as a zone of UTM",
        )


def map_centre(folder: FilePath) -> Float:
    """Return the mean position of the trees of a run in the map, also of rejected ones, shape (1, 2) [m]; the
    origin without trees.

    Raises:
        SourceError: trees.csv is missing or damaged.
    """
    places = read_tree_places(folder)
    centre: Float = np.array(list(places.values()) or [(0.0, 0.0)]).mean(axis=0, keepdims=True)
    return centre


def place_words(crs: str, point: Float) -> str:
    """Return a reference system and a position in it for people, so that a wrong code is noticed: code, name,
    longitude and latitude, and the area for which the system is defined.

    Args:
        crs: The reference system.
        point: East, north, shape (1, 2) [m].
    """
    import pyproj

    system = pyproj.CRS.from_user_input(crs)
    authority = system.to_authority()
    code = f"{':'.join(authority)}, " if authority else ""
    lon, lat = reproject(point, crs, WGS84)[0]
    where = f"{abs(lon):.2f}° {'W' if lon < 0 else 'E'}, {abs(lat):.2f}° {'S' if lat < 0 else 'N'}"
    area = f" (area of use: {system.area_of_use.name.rstrip('.')})" if system.area_of_use else ""
    return f"{code}{system.name}: {where}{area}"


def read_map_frame(folder: FilePath) -> MapFrame:
    """Return the frame of the map of a run: that of georeference.json, else that of a whole cloud with a
    known reference system, else the local one.

    Raises:
        SourceError: run.json is missing, a file is damaged, or the reference system of georeference.json is
            unknown to PROJ.
    """
    import pyproj

    record = read_run_record(folder)
    file = folder / FILE
    if not file.is_file():
        crs = str(record["source"].get("crs") or "") if is_of_cloud(record) else ""
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
            remedy="Update the package pyproj, or run stemmap georeference again",
        ) from None
    except (ValueError, KeyError, TypeError, RecursionError, OSError):
        raise SourceError(
            f"{FILE} is damaged", where=str(folder), remedy="Run stemmap georeference again"
        ) from None


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


_EAST = ("easting", "easting_m", "east", "east_m", "utm_x")
_NORTH = ("northing", "northing_m", "north", "north_m", "utm_y")
_LON, _LAT = ("lon", "longitude", "lon_deg"), ("lat", "latitude", "lat_deg")
_HEIGHT = ("elevation_m", "elevation", "z_m", "z", "height_m")
POINTS_MAX = 1000
NAME_MAX = 60  # characters of the name of a control point


def read_control_points(file: FilePath, crs: str) -> list[ControlPoint]:
    """Return the control points of a table, in its order. A point with a tree has no x and y. A point without
    a name gets the number of its tree or of its row as name. Whether the map has the trees is not checked.

    Args:
        file: CSV with a header: lon and lat, or without a column lon easting and northing; tree, or x_m and
            y_m for rows without a tree; optionally name and elevation_m.
        crs: Reference system, see `projected`, to which longitudes and latitudes are converted.

    Raises:
        SourceError: The file cannot be read, is larger than 1 MB, has an incomplete header or row, a cell
            that is not a number, a tree that is not a whole number, a name of more than NAME_MAX characters,
            no rows or more than POINTS_MAX.
    """
    table = CsvTable.read(file, "table of control points", _LARGEST_FILE)
    if len(table.rows) > POINTS_MAX:
        raise SourceError(f"there are more than {POINTS_MAX} control points", where=str(file))
    names = (_LON, _LAT) if table.find(_LON) else (_EAST, _NORTH)
    east, north = (table.find(each) for each in names)
    if not (east and north) or not ("tree" in table.column or {"x_m", "y_m"} <= table.column.keys()):
        raise SourceError(
            "the header of the control points is not complete",
            where=str(file),
            remedy="It needs easting and northing (or lon and lat), and tree or x_m and y_m; it has "
            f"{', '.join(table.column) or 'no header'}",
        )
    if not table.rows:
        raise SourceError("the file has no control points", where=str(file))
    known = np.stack([table.numbers(east), table.numbers(north)], axis=1)
    if names[0] is _LON:
        known = reproject(known, WGS84, crs)
    x, y, tree = (table.numbers(name, required=False) for name in ("x_m", "y_m", "tree"))
    z = table.numbers(table.find(_HEIGHT) or "", required=False)
    points = []
    for k, name in enumerate(table.text("name")):
        number = None if math.isnan(tree[k]) else int(tree[k])
        if number is not None and number != tree[k]:
            raise SourceError(f"line {table.lines[k]}: the map has no tree {tree[k]}", where=str(file))
        if number is None and not (math.isfinite(x[k]) and math.isfinite(y[k])):
            raise SourceError(f"line {table.lines[k]}: it has no tree and no x_m and y_m", where=str(file))
        if len(name) > NAME_MAX:
            raise SourceError(
                f"line {table.lines[k]}: the name has more than {NAME_MAX} characters", where=str(file)
            )
        points.append(
            ControlPoint(
                name=name or str(k + 1 if number is None else number),
                east=float(known[k, 0]),
                north=float(known[k, 1]),
                tree=number,
                x=float(x[k]) if number is None else None,
                y=float(y[k]) if number is None else None,
                z=float(z[k]) if math.isfinite(z[k]) else None,
            )
        )
    return points


def by_control_points(
    folder: FilePath, points: Sequence[ControlPoint], crs: str, point_sigma: float
) -> MapFrame:
    """Return the frame of a map by control points. It is not written.

    The height of the origin of the map is the mean over the points with a height of this height minus the
    terrain of the run there; 0 if no point has a height.

    Args:
        folder: Folder of the run.
        points: Trees, also rejected ones, or positions in the map.
        crs: Reference system, see `projected`.
        point_sigma: See `fit_control_points`.

    Raises:
        StemmapError: The folder is not that of a run, a tree is unknown, the points are not in the area of
            the reference system, are fewer than two, at one place or contradict one another, or the run has
            no terrain at a point with a height.
    """
    read_run_record(folder)
    trees = read_tree_places(folder)
    for point in points:
        if point.tree is not None and point.tree not in trees:
            raise StemmapError(f"point {point.name}: the map has no tree {point.tree}")
    local = np.array([(p.x, p.y) if p.tree is None else trees[p.tree] for p in points]).reshape(-1, 2)
    known = np.array([(p.east, p.north) for p in points]).reshape(-1, 2)
    names = [point.name for point in points]
    check_area(crs, known)
    fit = fit_control_points(local, known, names=names, point_sigma=point_sigma)
    z, heights = 0.0, np.array([math.nan if point.z is None else point.z for point in points])
    if (high := np.isfinite(heights)).any():
        z = float(np.mean(heights[high] - heights_at(read_terrain(folder), local[high])))
        if not math.isfinite(z):
            raise StemmapError(
                "the run has no terrain at a control point with a height", remedy="Leave the heights out"
            )
    residuals = [(n, float(e), float(m)) for n, (e, m) in zip(names, fit.residuals, strict=True)]
    numbers = {
        "points": len(names),
        "rms_m": fit.rms,
        "sigma_point_m": fit.sigma_point,
        "sigma_turn_deg": math.degrees(fit.sigma_turn),
    }
    return MapFrame(
        crs,
        fit.pose,
        z,
        "control",
        numbers,
        sigma=fit.sigma,
        residuals=tuple(residuals),
        place=place_words(crs, fit.pose.apply(map_centre(folder))),
    )


def by_hand(folder: FilePath, crs: str, east: float, north: float, turn: float, z: float) -> MapFrame:
    """Return the frame of a map with a given position of its origin; `sigma` is NaN. Nothing is written. The
    method is "hand", or "file" if `east`, `north`, `turn` and `z` are all 0.

    Args:
        folder: Folder of the run.
        crs: Reference system, see `projected`.
        east, north: Position of the origin [m].
        turn: Angle from east to the x axis of the map, counter-clockwise [rad].
        z: Height of the origin of the map [m].

    Raises:
        StemmapError: The folder is not that of a run, or the centre of the map is not in the area of the
            reference system.
    """
    read_run_record(folder)
    pose = Pose2(east, north, turn)
    centre = pose.apply(map_centre(folder))
    check_area(crs, centre)
    method = "hand" if any((east, north, turn, z)) else "file"
    return MapFrame(crs, pose, z, method, place=place_words(crs, centre))


def by_gnss(folder: FilePath, crs: str, start_ns: int | None = None) -> MapFrame:
    """Return the frame of a map by the GNSS fixes of its recording, fitted to the whole path. Fixes before or
    after the path, and those far from it compared with the others, do not count. The height of the map's
    zero is 0. It is not written.

    Args:
        folder: Folder of the run, whose recording must still exist.
        crs: Reference system, see `projected`.
        start_ns: Time of the first scan [ns]; None for that of the saved state of the run.

    Raises:
        StemmapError: The run, its recording or its saved state cannot be read, the recording has no fixes (as
            that of a live run or a whole cloud), or they are not in the area of the reference system or do
            not fit the path.
    """
    from app.batch.continue_map import read_saved_run
    from app.robot.address import is_live
    from app.sources.opening import open_source
    from pipeline.io.readers.measured_poses import fit_rigid
    from pipeline.io.readers.ros import RosSource

    run = read_run(folder)
    fixes = []
    if not (run.of_cloud or is_live(run.uri)):
        with closing(open_source(run.uri)) as source:
            fixes = source.fixes() if isinstance(source, RosSource) else []
    if not fixes:
        raise StemmapError(
            "the recording has no GNSS fixes", where=run.uri, remedy="Use control points, or place it by hand"
        )
    positions = reproject(np.array([(f.longitude, f.latitude) for f in fixes]), WGS84, crs)
    check_area(crs, positions)
    origin = positions[0].copy()
    stamps = run.path.stamp_ns + (read_saved_run(folder).start_ns if start_ns is None else start_ns)
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
        raise StemmapError(
            f"the GNSS fixes cannot be used: {why}", where=run.uri, remedy="Use control points"
        )
    pose = fit.T_map_other.inverse()
    numbers = {
        "points": len(keep),
        "fixes": len(fixes),
        "rms_m": fit.residual,
        "sigma_turn_deg": math.degrees(fit.yaw_sigma),
    }
    pose = Pose2(pose.x + origin[0], pose.y + origin[1], pose.yaw)
    place = place_words(crs, pose.apply(map_centre(folder)))
    return MapFrame(crs, pose, 0.0, "gnss", numbers, sigma=fit.sigma, place=place)


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


def frame_lines(frame: MapFrame) -> list[str]:
    """Return a frame as lines for people: the place of the map if it is known; the pose and the method; the
    standard deviation if it is known; and the residuals of the control points. A local frame is one line."""
    if not frame.crs:
        return ["local coordinates: the map has no reference system"]
    lines = [f"the map is at {frame.place}"] if frame.place else []
    lines.append(
        f"{frame.title}: origin at {frame.pose.x:.3f}, {frame.pose.y:.3f} m, x axis "
        f"{math.degrees(frame.pose.yaw):.3f} degrees from east to north, by {frame.method_words}"
    )
    if math.isfinite(frame.sigma):
        lines.append(f"a coordinate in the middle of the points +- {frame.sigma:.3f} m")
    lines += [f"point {name}: residual {e:+.3f} m east, {n:+.3f} m north" for name, e, n in frame.residuals]
    return lines
