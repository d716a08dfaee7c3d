"""Files of a finished run for geographic information systems: GeoPackage and GeoJSON. Extensions write
further formats, and further layers.

The same run gives the same bytes: time stamps in the files are fixed.
"""

from __future__ import annotations

import datetime
import json
import math
import os
import sqlite3
import threading
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import shapely
import shapely.geometry

from app.batch.map_frame import (
    LOCAL_NAME,
    WGS84,
    MapFrame,
    gis_package,
    heights_at,
    read_map_frame,
    reproject,
)
from app.batch.run_folder import counted_dbh, read_by_people, read_run, read_terrain
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.result_files import ROBOTS_FRAME, features_text, point_feature, tree_features
from pipeline.types.records import Trees

#: Date of all files.
DATE = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
# The libraries have settings of the process, which must not change while another thread writes.
_WRITING = threading.Lock()
LOCAL_WKT = (
    f'ENGCRS["{LOCAL_NAME}",EDATUM["origin of the map"],CS[Cartesian,2],'
    'AXIS["x",unspecified,ORDER[1]],AXIS["y",unspecified,ORDER[2]],LENGTHUNIT["metre",1]]'
)


@dataclass(frozen=True, slots=True)
class Field:
    """A column of an exported layer: name, short name for formats with at most 10
    characters, unit, meaning."""

    name: str
    short: str
    unit: str
    meaning: str


_COUNTED = (
    Field("dbh_counted_cm", "dbh_count", "cm", "diameter that counts: by tape, else of the map"),
    Field("sigma_dbh_counted_cm", "sdbh_count", "cm", "standard deviation of the diameter that counts"),
    Field(
        "dbh_source", "dbh_source", "", "source of the diameter that counts: tape or map; empty without one"
    ),
)
_BASAL_AREA = Field("g_m2", "g_m2", "m2", "basal area by the diameter that counts")
TREE_FIELDS = (
    Field("tree", "tree", "", "number of the tree in the map"),
    Field("dbh_cm", "dbh_cm", "cm", "diameter at breast height"),
    Field("sigma_dbh_cm", "sdbh_cm", "cm", "standard deviation of the diameter"),
    _BASAL_AREA,
    Field("sigma_x_m", "sx_m", "m", "standard deviation of the position along x of the map"),
    Field("sigma_y_m", "sy_m", "m", "standard deviation of the position along y of the map"),
    Field("z_m", "z_m", "m", "height of the ground at the tree"),
    Field("map_x_m", "mapx_m", "m", "x in the frame of the map"),
    Field("map_y_m", "mapy_m", "m", "y in the frame of the map"),
    Field(
        "observations",
        "obs",
        "",
        "number of scans, or of sections of a whole cloud, with a detection of the tree; 0: the position is "
        "that of the accumulated scans or of a person, and its standard deviation assumed",
    ),
    Field("coverage_deg", "cover_deg", "deg", "part of the circumference that was observed"),
    Field(
        "eccentricity",
        "eccentr",
        "",
        "ratio of the eigenvalues of the points of a scan; empty for a whole cloud",
    ),
    Field("height_m", "height_m", "m", "height of the tree; empty where its top is not seen"),
    Field("sigma_height_m", "sh_m", "m", "standard deviation of the height"),
    Field("lean_deg", "lean_deg", "deg", "angle of the stem from the vertical"),
    Field("review", "review", "", "state of the review: open, or confirmed or skipped by a person"),
    Field("dbh_tape_cm", "dbh_tape", "cm", "diameter that a person measured by tape; empty without one"),
    *_COUNTED,
)
#: Fields of each layer.
LAYER_FIELDS = {
    "trees": TREE_FIELDS,
    "path": (
        Field("scans", "scans", "", "number of scans"),
        Field("length_m", "length_m", "m", "length of the path"),
    ),
    "added": (
        Field("name", "name", "", "A1, A2, ... in the order in which people added the trees"),
        _BASAL_AREA,
        Field("dbh_tape_cm", "dbh_tape", "cm", "diameter by tape of a tree that a person added"),
        *_COUNTED,
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class ExportedRun:
    """A run in the coordinates of its files.

    Attributes:
        uri: URI of the source.
        trees: Confirmed trees of the run.
        frame: Reference system of the run.
        place: Positions of the trees: east, north, or x, y for a local map, shape (T, 2) [m].
        columns: Dict from each name of TREE_FIELDS to the rounded values of the trees, shape (T,); NaN for
            unknown values. `review` and `dbh_source` have texts.
        path: The path in the coordinates of `place`, shape (N, 2) [m].
        terrain: x, y, z of the terrain cells in the frame of the map, shape (K, 3) [m].
        added: Trees that a person added because the map lacks them, in the coordinates of `place`, shape
            (M, 2) [m]. They are not in `trees`.
        added_dbh: Their diameters by tape [cm], shape (M,); NaN where unknown.
    """

    uri: str
    trees: Trees
    frame: MapFrame
    place: Float
    columns: dict[str, Any]
    path: Float
    terrain: Float
    added: Float
    added_dbh: Float

    @property
    def added_columns(self) -> dict[str, Any]:
        """Dict from each name of the fields of the layer `added` to the values of these trees."""
        names = np.array([f"A{k + 1}" for k in range(len(self.added))], np.str_)
        dbh, unknown = 0.01 * self.added_dbh, np.full(len(self.added), np.nan)
        counted, sigma, source = counted_dbh(dbh, unknown, unknown)
        in_cm = ((100.0 * value).round(1) for value in (dbh, counted, sigma))
        values = (names, _basal_area(counted).round(4), *in_cm, source)
        return dict(zip((f.name for f in LAYER_FIELDS["added"]), values, strict=True))

    @property
    def crs(self) -> str:
        """Reference system as text for libraries; LOCAL_WKT without one."""
        return self.frame.crs or LOCAL_WKT


def _basal_area(dbh: Float) -> Float:
    return 0.25 * math.pi * np.square(dbh)


R = TypeVar("R", bound=ExportedRun)
#: Writes a run to a file.
Writer = Callable[[R, FilePath], None]


def read_for_export(folder: FilePath) -> ExportedRun:
    """Return a run with its values for export; rejected trees are left out.

    Args:
        folder: Folder of the run.

    Raises:
        StemmapError: A file of the run is missing or damaged.
    """
    run, frame = read_run(folder), read_map_frame(folder)
    trees, path, terrain = run.trees, run.path, read_terrain(folder)
    ground = heights_at(terrain, trees.position) + frame.z
    unknown = np.full(len(trees.number), np.nan)
    people = read_by_people(folder)
    tape = people.tape_of(trees.number.tolist())
    counted, counted_sigma, source = counted_dbh(tape, trees.dbh, trees.dbh_sigma)
    values = (
        trees.number,
        100.0 * trees.dbh,
        100.0 * trees.dbh_sigma,
        _basal_area(counted),
        np.sqrt(trees.covariance[:, 0, 0]),
        np.sqrt(trees.covariance[:, 1, 1]),
        ground,
        trees.position[:, 0],
        trees.position[:, 1],
        trees.observations,
        np.where(trees.coverage > 0.0, np.degrees(trees.coverage), np.nan),
        trees.eccentricity,
        unknown if trees.height is None else trees.height,
        unknown if trees.height_sigma is None else trees.height_sigma,
        unknown if trees.lean is None else np.degrees(trees.lean),
        np.array(list(run.reviews.values()), np.str_),
        100.0 * tape,
        100.0 * counted,
        100.0 * counted_sigma,
        source,
    )
    digits = (0, 1, 1, 4, 3, 3, 2, 3, 3, 0, 0, 3, 2, 2, 2, 0, 1, 1, 1, 0)
    columns = {
        field.name: np.round(v, d) if v.dtype.kind == "f" else v
        for field, v, d in zip(TREE_FIELDS, values, digits, strict=True)
    }
    path_xy = frame.to_crs(np.stack([path.x, path.y], axis=1))
    place = frame.to_crs(trees.position)
    added_dbh = np.round(100.0 * people.added_dbh, 1)
    return ExportedRun(
        run.uri, trees, frame, place, columns, path_xy, terrain, frame.to_crs(people.added), added_dbh
    )


def export_run(run: R, file: FilePath, writers: Mapping[str, Writer[R]]) -> list[FilePath]:
    """Write a run to a file whose suffix gives the format; return all files that were written, ordered by
    name. Existing files are replaced.

    Files are complete or absent: they are written elsewhere first. Threads write one after the other.

    Args:
        run: The run.
        file: File with a suffix of `writers`; its folder must exist. Some formats have further files in that
            folder.
        writers: Dict from suffixes to what writes these files, such as WRITERS.

    Raises:
        StemmapError: The suffix is unknown, a package is missing, or the run lacks what the format shows.
        OSError: The file cannot be written.
    """
    writer = writers.get(file.suffix.lower())
    if writer is None:
        raise StemmapError(
            f"{file.name!r} has an unknown format",
            remedy=f"Formats: {', '.join(writers)}. Tables (.csv) are in the folder of the run.",
        )
    with _WRITING, TemporaryDirectory(prefix=".export-", dir=file.parent) as folder:
        writer(run, FilePath(folder) / file.name)
        written = []
        for part in sorted(FilePath(folder).iterdir()):
            os.replace(part, file.parent / part.name)  # noqa: PTH105 - over an existing file, everywhere
            written.append(file.parent / part.name)
    return written


def export_one_file(run: R, suffix: str, writers: Mapping[str, Writer[R]], folder: FilePath) -> FilePath:
    """Export a run to one file in a folder and return it, such as trees.gpkg. Several files become one zip
    archive of the files of `export_run`, such as trees_shp.zip.

    Args:
        run: The run.
        suffix: One of `writers`.
        writers: As for `export_run`.
        folder: An empty folder.

    Raises:
        StemmapError, OSError: See `export_run`.
    """
    written = export_run(run, folder / f"trees{suffix}", writers)
    if len(written) == 1:
        return written[0]
    packed = folder / f"trees_{suffix.lstrip('.')}.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in written:
            archive.writestr(zipfile.ZipInfo(file.name, DATE.timetuple()[:6]), file.read_bytes())
    return packed


def layers_of(run: ExportedRun) -> dict[str, Any]:
    """Return a dict from the name of each layer to its GeoDataFrame in the coordinates of the files: `trees`,
    also without trees, `path` if it has at least two positions, and `added` if there are any. The columns are
    LAYER_FIELDS and the geometry. Raises StemmapError if a package is not installed."""
    geopandas = gis_package("geopandas", "GIS files")
    layers = {
        "trees": geopandas.GeoDataFrame(
            run.columns, geometry=shapely.points(run.place.reshape(-1, 2)), crs=run.crs
        )
    }
    if len(run.path) > 1:
        length = float(np.hypot(*np.diff(run.path, axis=0).T).sum())
        layers["path"] = geopandas.GeoDataFrame(
            {"scans": [len(run.path)], "length_m": [round(length, 2)]},
            geometry=[shapely.LineString(run.path)],
            crs=run.crs,
        )
    if len(run.added):
        layers["added"] = geopandas.GeoDataFrame(
            run.added_columns, geometry=shapely.points(run.added), crs=run.crs
        )
    return layers


def write_geopackage(layers: Mapping[str, Any], file: FilePath, styles: Mapping[str, str]) -> None:
    """Write layers (GeoDataFrames by name) as GeoPackage, with a QGIS style for each, see `qml`; StemmapError
    if a package is not installed."""
    pyogrio = gis_package("pyogrio", "GIS files")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": DATE.strftime("%Y-%m-%dT%H:%M:%S.000Z")})
    try:
        for name, layer in layers.items():
            pyogrio.write_dataframe(layer, file, layer=name, driver="GPKG", append=file.exists())
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
    _write_styles(file, styles)


def _write_layers(run: ExportedRun, file: FilePath) -> None:
    """Write a GeoPackage with the layers of `layers_of`, which also raises, and their styles."""
    write_geopackage(layers_of(run), file, STYLES)


def _write_styles(file: FilePath, styles: Mapping[str, str]) -> None:
    """Add the styles that QGIS reads from a GeoPackage by default, as a table layer_styles with a row per
    layer."""
    database = sqlite3.connect(file)
    try:
        tables = [row[0] for row in database.execute("SELECT table_name FROM gpkg_contents")]
        database.execute(
            "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT, f_table_catalog TEXT(256), "
            "f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256), "
            "styleName TEXT(30), styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, "
            "owner TEXT(30), ui TEXT(30), update_time DATETIME)"
        )
        date = DATE.strftime("%Y-%m-%dT%H:%M:%S.000Z")
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change, srs_id) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles', '', ?, 0)",
            (date,),
        )
        for table in tables:
            database.execute(
                "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, "
                "styleName, styleQML, styleSLD, useAsDefault, description, owner, update_time) "
                "VALUES ('', '', ?, 'geom', ?, ?, '', 1, 'stemmap', 'stemmap', ?)",
                (table, table, styles[table], date),
            )
        database.commit()
    finally:
        database.close()


def qml(kind: str, symbol: str, layer: str, properties: dict[str, str]) -> str:
    """Return a QGIS style with one symbol as XML.

    Args:
        kind: Type of the symbol: "marker", "line" or "fill".
        symbol: Class of its symbol layer.
        layer: Further XML in the symbol layer.
        properties: Options of the symbol layer.
    """
    options = "".join(f'<Option name="{k}" type="QString" value="{v}"/>' for k, v in properties.items())
    return (
        f'<!DOCTYPE qgis PUBLIC "http://mrcc.com/qgis.dtd" "SYSTEM"><qgis version="3.28" '
        f'styleCategories="Symbology"><renderer-v2 type="singleSymbol"><symbols>'
        f'<symbol type="{kind}" name="0">'
        f'<layer class="{symbol}"><Option type="Map">{options}</Option>{layer}</layer></symbol></symbols>'
        f"</renderer-v2></qgis>"
    )


_BY_DBH = (
    '<data_defined_properties><Option type="Map"><Option name="properties" type="Map">'
    '<Option name="size" type="Map"><Option name="active" type="bool" value="true"/>'
    '<Option name="expression" type="QString" value="coalesce(&quot;dbh_counted_cm&quot; / 100, 0.1)"/>'
    '<Option name="type" type="int" value="3"/></Option></Option>'
    '<Option name="type" type="QString" value="collection"/></Option></data_defined_properties>'
)
#: Styles of the layers: trees are circles with the diameter that counts, in metres on the map.
STYLES = {
    "trees": qml(
        "marker",
        "SimpleMarker",
        _BY_DBH,
        {"color": "47,125,50,255", "outline_color": "20,60,25,255", "size": "0.3", "size_unit": "MapUnit"},
    ),
    "path": qml("line", "SimpleLine", "", {"line_color": "31,90,180,255", "line_width": "0.4"}),
    "added": qml(
        "marker",
        "SimpleMarker",
        "",
        {"color": "255,255,255,255", "outline_color": "20,60,25,255", "size": "2"},
    ),
}


def trees_geojson(run: ExportedRun) -> str:
    """Return the trees as GeoJSON: in longitude and latitude (WGS84), or in the frame of a local map. Where
    people measured any, the trees have `dbh_tape_cm` and the diameter that counts with its sigma and source,
    and those that they added follow, with the review "added" and a name, but without a number."""
    lon_lat = reproject(run.place, run.frame.crs, WGS84) if run.frame.crs else None
    reviews = dict(zip(run.columns["tree"].tolist(), run.columns["review"].tolist(), strict=True))
    features = tree_features(run.trees, 0, lon_lat=lon_lat, reviews=reviews)
    places = reproject(run.added, run.frame.crs, WGS84).round(8) if run.frame.crs else run.added.round(3)
    added = run.added_columns
    features += [
        point_feature(x, y, {"tree": None, "name": name, "review": "added"})
        for (x, y), name in zip(places.tolist(), added["name"].tolist(), strict=True)
    ]
    if len(run.added) or np.isfinite(run.columns["dbh_tape_cm"]).any():
        for name in ("dbh_tape_cm", *(field.name for field in _COUNTED)):
            for feature, value in zip(
                features, [*run.columns[name].tolist(), *added[name].tolist()], strict=True
            ):
                is_known = value if isinstance(value, str) else math.isfinite(value)
                feature["properties"][name] = value if is_known else None
    return features_text(features, None if run.frame.crs else ROBOTS_FRAME)


def path_geojson(run: ExportedRun) -> str:
    """Return the path as GeoJSON, see `shapes_geojson`; no feature for a path of one position."""
    path = shapely.LineString(run.path) if len(run.path) > 1 else None
    return shapes_geojson([] if path is None else [("path", path)], run.frame)


def shapes_geojson(shapes: Sequence[tuple[str, Any]], frame: MapFrame) -> str:
    """Return named shapes as a GeoJSON FeatureCollection with the property `name`: in longitude and latitude
    (WGS84), or with the member `coordinateFrame` in the frame of a local map [m].

    Args:
        shapes: Names with shapely geometries in the reference system of the frame.
        frame: Reference system of the run.
    """
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if not frame.crs:
        collection["coordinateFrame"] = dict(ROBOTS_FRAME)
    collection["features"] = [
        {
            "type": "Feature",
            "geometry": shapely.geometry.mapping(
                shapely.transform(shape, lambda xy: reproject(xy, frame.crs, WGS84)) if frame.crs else shape
            ),
            "properties": {"name": name},
        }
        for name, shape in shapes
    ]
    return json.dumps(collection) + "\n"


def write_geojson(run: ExportedRun, file: FilePath) -> None:
    """Write the trees as GeoJSON, see `trees_geojson`."""
    file.write_text(trees_geojson(run), encoding="utf-8", newline="")


WRITERS: dict[str, Writer[ExportedRun]] = {".gpkg": _write_layers, ".geojson": write_geojson}
