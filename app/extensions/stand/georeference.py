"""Finds the coordinate reference system of the map of a finished run: control points, GNSS, or by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from app.batch.map_frame import WGS84, MapFrame, heights_at, reproject
from app.batch.run_folder import read_run, read_run_record, read_terrain, read_tree_places
from app.extensions.stand.control_points import fit_control_points, fit_rigid_pairs
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.csv_table import CsvTable

#: Largest error of distances in a reference system: 10 cm on a plot of 10 m. Web Mercator has 56 % at a
#: latitude of 50 degrees, 1 / cos(latitude) - 1.
SCALE_ERROR = 0.01
_LARGEST_FILE = 1 << 20


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


_EAST = ("easting", "easting_m", "east", "east_m", "utm_x")
_NORTH = ("northing", "northing_m", "north", "north_m", "utm_y")
_LON, _LAT = ("lon", "longitude", "lon_deg"), ("lat", "latitude", "lat_deg")
_HEIGHT = ("elevation_m", "elevation", "z_m", "z", "height_m")
POINTS_MAX = 1000
NAME_MAX = 60  # characters of the name of a control point


def read_control_points(file: FilePath, crs: str) -> list[ControlPoint]:
    """Return the control points of a table, see `read_point_rows`.

    Raises:
        SourceError: As there, or a row has a fault; that of the first such row.
    """
    points, faults = read_point_rows(file, crs)
    if faults:
        raise faults[min(faults)]
    return points


def read_point_rows(file: FilePath, crs: str) -> tuple[list[ControlPoint], dict[int, SourceError]]:
    """Return the control points of a table, in its order, and the faults of its rows by their index: a cell
    that is not a number, a tree that is not a whole number, neither a tree nor a place, or a name of more
    than NAME_MAX characters.

    A point with a tree has no x and y. A point without a name gets the number of its tree or of its row as
    name. Whether the map has the trees is not checked. In a row with a fault, what could not be read is NaN,
    or None where it may be, and the name is cut.

    Args:
        file: CSV with a header: lon and lat, or without a column lon easting and northing; tree, or x_m and
            y_m for rows without a tree; optionally name and elevation_m.
        crs: Reference system, see `projected`, to which longitudes and latitudes are converted.

    Raises:
        SourceError: The file cannot be read, is larger than 1 MB, has an incomplete header, no rows or more
            than POINTS_MAX.
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
    faults: dict[int, SourceError] = {}
    known = np.stack([table.numbers(name, faults=faults) for name in (east, north)], axis=1)
    if names[0] is _LON:
        known = reproject(known, WGS84, crs)
        for k in np.flatnonzero(~np.isfinite(known).all(axis=1)).tolist():
            known[k] = math.nan
            what = f"line {table.lines[k]}: the reference system has no place for its lon and lat"
            faults.setdefault(k, SourceError(what, where=str(file), remedy="Check both, and the EPSG code"))
    x, y, tree, z = (
        table.numbers(name, required=False, faults=faults)
        for name in ("x_m", "y_m", "tree", table.find(_HEIGHT) or "")
    )
    points = []
    for k, name in enumerate(table.text("name")):
        number = int(tree[k]) if tree[k] == np.floor(tree[k]) and tree[k] > 0.0 else None
        fault = ""
        if number is None and math.isfinite(tree[k]):
            fault = f"the map has no tree {tree[k]:g}"
        elif number is None and not (math.isfinite(x[k]) and math.isfinite(y[k])):
            fault = "it has no tree and no x_m and y_m"
        elif len(name) > NAME_MAX:
            fault = f"the name has more than {NAME_MAX} characters"
        if fault:
            faults.setdefault(k, SourceError(f"line {table.lines[k]}: {fault}", where=str(file)))
        points.append(
            ControlPoint(
                name=name[:NAME_MAX] or str(k + 1 if number is None else number),
                east=float(known[k, 0]),
                north=float(known[k, 1]),
                tree=number,
                x=_finite(x[k]) if number is None else None,
                y=_finite(y[k]) if number is None else None,
                z=_finite(z[k]),
            )
        )
    return points, faults


def _finite(value: float) -> float | None:
    """Return a number; None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


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
            that of a live run), or they are not in the area of the reference system or do
            not fit the path.
    """
    from app.batch.saved_run import read_saved_run
    from app.sources.live_address import is_live
    from app.sources.opening import open_source
    from pipeline.io.readers.measured_poses import fit_rigid
    from pipeline.io.readers.ros import RosSource

    run = read_run(folder)
    fixes = []
    if run.of_drive and not is_live(run.uri):
        with closing(open_source(run.uri)) as source:
            fixes = source.readings("gnss") if isinstance(source, RosSource) else []
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
