"""Files of a finished run for GIS, CAD and spreadsheets: GeoPackage, Shapefile, GeoJSON, DXF, XLSX, GeoTIFF.

The same run gives the same bytes: time stamps in the files are fixed.
"""

from __future__ import annotations

import datetime
import io
import math
import os
import sqlite3
import threading
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import shapely

from app.batch.georeference import (
    LOCAL_NAME,
    WGS84,
    MapFrame,
    gis_package,
    heights_at,
    read_map_frame,
    reproject,
)
from app.batch.run_folder import read_run, read_terrain
from app.batch.stand import StandResult
from app.common.text import version
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.result_files import geojson
from pipeline.stand.figures import FIGURES
from pipeline.types.records import Trees

_DATE = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
# The libraries have settings of the process, which must not change while another thread writes.
_WRITING = threading.Lock()
_CELLS_MAX = 25_000_000
TERRAIN_CELL = 0.5  # m
CONTOUR_STEP = 0.5  # m
LOCAL_WKT = (
    f'ENGCRS["{LOCAL_NAME}",EDATUM["origin of the map"],CS[Cartesian,2],'
    'AXIS["x",unspecified,ORDER[1]],AXIS["y",unspecified,ORDER[2]],LENGTHUNIT["metre",1]]'
)


@dataclass(frozen=True, slots=True)
class Field:
    """A column of an exported layer: name, name in a Shapefile (at most 10 characters), unit, meaning."""

    name: str
    short: str
    unit: str
    meaning: str


TREE_FIELDS = (
    Field("tree", "tree", "", "number of the tree in the map"),
    Field("dbh_cm", "dbh_cm", "cm", "diameter at breast height"),
    Field("sigma_dbh_cm", "sdbh_cm", "cm", "standard deviation of the diameter"),
    Field("g_m2", "g_m2", "m2", "basal area"),
    Field("sigma_x_m", "sx_m", "m", "standard deviation of the position along x of the map"),
    Field("sigma_y_m", "sy_m", "m", "standard deviation of the position along y of the map"),
    Field("z_m", "z_m", "m", "height of the ground at the tree"),
    Field("map_x_m", "mapx_m", "m", "x in the frame of the map"),
    Field("map_y_m", "mapy_m", "m", "y in the frame of the map"),
    Field(
        "observations",
        "obs",
        "",
        "number of scans, or of sections of a whole cloud, with a detection of the tree",
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
)
#: Beginnings of the names of the figures of a plot in a Shapefile, which may end in `_se`.
_FIGURES_SHORT = {
    "n_ha": "n_ha",
    "n_ha_plain": "n_ha_plain",
    "n_ha_corrected": "n_ha_c",
    "g_ha": "g_ha",
    "g_ha_plain": "g_ha_plain",
    "g_ha_corrected": "g_ha_c",
    "v_ha": "v_ha",
    "v_ha_corrected": "v_ha_c",
    "dg_cm": "dg_cm",
    "mean_dbh_cm": "dm_cm",
    "dominant_dbh_cm": "ddom_cm",
    "sdi": "sdi",
    "nearest_neighbour_m": "nn_m",
    "clark_evans": "ce",
}


def _figure_fields() -> Iterator[Field]:
    """Yield a field for each stand parameter in FIGURES and, unless its name ends with "_plain", one for its
    standard error with "_se" appended to the name."""
    for name, (title, unit) in FIGURES.items():
        short = _FIGURES_SHORT[name]
        yield Field(name, short, unit, title)
        if not name.endswith("_plain"):
            yield Field(f"{name}_se", f"{short}_se", unit, f"standard error of {name}")


PLOT_FIELDS = (
    Field("plot", "plot", "", "name of the plot"),
    Field("area_m2", "area_m2", "m2", "area of the plot"),
    Field("seen_m2", "seen_m2", "m2", "observed part of the area"),
    Field("trees", "trees", "", "number of trees of at least the minimum diameter in the observed part"),
    *_figure_fields(),
)
#: Fields of each layer.
LAYER_FIELDS = {
    "trees": TREE_FIELDS,
    "path": (
        Field("scans", "scans", "", "number of scans"),
        Field("length_m", "length_m", "m", "length of the path"),
    ),
    "plots": PLOT_FIELDS,
    "contours": (Field("z_m", "z_m", "m", "height of the contour"),),
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
            unknown values. `review` has texts.
        path: The path in the coordinates of `place`, shape (N, 2) [m].
        plots: Tuples, one per plot, of name, shape in the coordinates of `place`, and a dict from the names
            of PLOT_FIELDS except "plot" to values.
        terrain: x, y, z of the terrain cells in the frame of the map, shape (K, 3) [m].
    """

    uri: str
    trees: Trees
    frame: MapFrame
    place: Float
    columns: dict[str, Any]
    path: Float
    plots: tuple[tuple[str, Any, dict[str, float]], ...]
    terrain: Float

    @property
    def crs(self) -> str:
        """Reference system as text for libraries; LOCAL_WKT without one."""
        return self.frame.crs or LOCAL_WKT


def read_for_export(folder: FilePath, of_plots: StandResult | None) -> ExportedRun:
    """Return a run with its values for export; rejected trees are left out.

    Args:
        folder: Folder of the run.
        of_plots: Stand figures of the run on plots, which are exported with them; None for no plots.

    Raises:
        StemmapError: A file of the run is missing or damaged.
    """
    run, frame = read_run(folder), read_map_frame(folder)
    shapes: list[tuple[str, Any, dict[str, float]]] = []
    if of_plots is not None:
        for plot in of_plots.plots:
            f = of_plots.figures[plot.name]
            figures = {"area_m2": f.area, "seen_m2": f.seen, "trees": f.trees}
            for name, estimate in f.values.items():
                figures.update({name: estimate.value, f"{name}_se": estimate.se})
            shapes.append((plot.name, shapely.transform(plot.shape, frame.to_crs), figures))
    trees, path, terrain = run.trees, run.path, read_terrain(folder)
    ground = heights_at(terrain, trees.position) + frame.z
    unknown = np.full(len(trees.number), np.nan)
    values = (
        trees.number,
        100.0 * trees.dbh,
        100.0 * trees.dbh_sigma,
        0.25 * math.pi * np.square(trees.dbh),
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
    )
    digits = (0, 1, 1, 4, 3, 3, 2, 3, 3, 0, 0, 3, 2, 2, 2, 0)
    columns = {
        field.name: np.round(v, d) if v.dtype.kind == "f" else v
        for field, v, d in zip(TREE_FIELDS, values, digits, strict=True)
    }
    path_xy = frame.to_crs(np.stack([path.x, path.y], axis=1))
    place = frame.to_crs(trees.position)
    return ExportedRun(run.uri, trees, frame, place, columns, path_xy, tuple(shapes), terrain)


def export_run(run: ExportedRun, file: FilePath) -> list[FilePath]:
    """Write a run to a file whose suffix gives the format; return all files that were written, ordered by
    name. Existing files are replaced.

    Files are complete or absent: they are written elsewhere first. Threads write one after the other.

    Args:
        run: The run.
        file: File with a suffix of WRITERS; its folder must exist. A Shapefile has further files in that
            folder.

    Raises:
        StemmapError: The suffix is unknown, a package is missing, the terrain covers too large an area, or
            the run lacks what the format shows: a GeoTIFF needs terrain and, unless the map is local, an EPSG
            code.
        OSError: The file cannot be written.
    """
    writer = WRITERS.get(file.suffix.lower())
    if writer is None:
        raise StemmapError(
            f"{file.name!r} has an unknown format",
            remedy=f"Formats: {', '.join([*WRITERS, '.laz'])}, or tree-manager. "
            "Tables (.csv) are in the folder of the run.",
        )
    with _WRITING, TemporaryDirectory(prefix=".export-", dir=file.parent) as folder:
        writer(run, FilePath(folder) / file.name)
        written = []
        for part in sorted(FilePath(folder).iterdir()):
            os.replace(part, file.parent / part.name)  # noqa: PTH105 - over an existing file, everywhere
            written.append(file.parent / part.name)
    return written


def export_bytes(run: ExportedRun, suffix: str) -> tuple[bytes, str]:
    """Return the bytes of an exported file and its name, such as trees.gpkg. Several files, as of a
    Shapefile, are one zip archive (trees_shp.zip) of the files of `export_run`.

    Args:
        run: The run.
        suffix: One of WRITERS.

    Raises:
        StemmapError, OSError: See `export_run`.
    """
    with TemporaryDirectory(prefix="stemmap-export-") as folder:
        written = export_run(run, FilePath(folder) / f"trees{suffix}")
        if len(written) == 1:
            return written[0].read_bytes(), written[0].name
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in written:
                archive.writestr(zipfile.ZipInfo(file.name, _DATE.timetuple()[:6]), file.read_bytes())
        return packed.getvalue(), f"trees_{suffix.lstrip('.')}.zip"


def _layers(run: ExportedRun) -> dict[str, Any]:
    """Return a dict from the name of each layer to its GeoDataFrame in the coordinates of the files: `trees`,
    also without trees; `path` if it has at least two positions; `plots` and `contours` if there are any. The
    columns are LAYER_FIELDS and the geometry. Raises StemmapError if a package is not installed or the
    terrain covers too large an area."""
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
    if run.plots:
        layers["plots"] = geopandas.GeoDataFrame(
            _plot_table(run),
            geometry=[shape for _, shape, _ in run.plots],
            crs=run.crs,
        )
    lines = contours(run)
    if lines:
        layers["contours"] = geopandas.GeoDataFrame(
            {"z_m": [z for z, _ in lines]},
            geometry=[shapely.LineString(line) for _, line in lines],
            crs=run.crs,
        )
    return layers


def _plot_table(run: ExportedRun) -> dict[str, Any]:
    """Return a dict from each name of PLOT_FIELDS to the values of the plots, rounded to four decimals; NaN
    if unknown."""
    table: dict[str, Any] = {"plot": [name for name, _, _ in run.plots]}
    for field in PLOT_FIELDS[1:]:
        table[field.name] = np.array([round(figures[field.name], 4) for _, _, figures in run.plots])
    return table


def _write_layers(run: ExportedRun, file: FilePath) -> None:
    """Write a GeoPackage with the layers of `_layers`, which also raises, and their styles."""
    pyogrio = gis_package("pyogrio", "GIS files")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _DATE.strftime("%Y-%m-%dT%H:%M:%S.000Z")})
    try:
        for name, layer in _layers(run).items():
            pyogrio.write_dataframe(layer, file, layer=name, driver="GPKG", append=file.exists())
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
    _write_styles(file)


def _write_styles(file: FilePath) -> None:
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
        date = _DATE.strftime("%Y-%m-%dT%H:%M:%S.000Z")
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
                (table, table, _STYLES[table], date),
            )
        database.commit()
    finally:
        database.close()


def _qml(kind: str, symbol: str, layer: str, properties: dict[str, str]) -> str:
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
    '<Option name="expression" type="QString" value="coalesce(&quot;dbh_cm&quot; / 100, 0.1)"/>'
    '<Option name="type" type="int" value="3"/></Option></Option>'
    '<Option name="type" type="QString" value="collection"/></Option></data_defined_properties>'
)
#: Styles of the layers: trees are circles with their diameter in metres on the map.
_STYLES = {
    "trees": _qml(
        "marker",
        "SimpleMarker",
        _BY_DBH,
        {"color": "47,125,50,255", "outline_color": "20,60,25,255", "size": "0.3", "size_unit": "MapUnit"},
    ),
    "path": _qml("line", "SimpleLine", "", {"line_color": "31,90,180,255", "line_width": "0.4"}),
    "plots": _qml(
        "fill",
        "SimpleFill",
        "",
        {"color": "230,140,20,40", "outline_color": "200,110,0,255", "style": "solid"},
    ),
    "contours": _qml("line", "SimpleLine", "", {"line_color": "150,110,70,255", "line_width": "0.15"}),
}


def _write_shapefiles(run: ExportedRun, file: FilePath) -> None:
    """Write a Shapefile per layer: the trees to `file`, the others to `file` with `_` and the name of the
    layer. Columns have their short names; a local map has no .prj. Layers and errors as in `_layers`."""
    pyogrio = gis_package("pyogrio", "GIS files")
    short = {field.name: field.short for fields in LAYER_FIELDS.values() for field in fields}
    for name, layer in _layers(run).items():
        part = file if name == "trees" else file.with_name(f"{file.stem}_{name}{file.suffix}")
        table = layer.rename(columns=short).set_crs(run.frame.crs or None, allow_override=True)
        options = {"DBF_DATE_LAST_UPDATE": _DATE.strftime("%Y-%m-%d"), "ENCODING": "UTF-8"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a file without a reference system
            pyogrio.write_dataframe(table, part, driver="ESRI Shapefile", layer_options=options)
        if not run.frame.crs:
            part.with_suffix(".prj").unlink(missing_ok=True)


def _write_geojson(run: ExportedRun, file: FilePath) -> None:
    """Write the trees as GeoJSON: in longitude and latitude (WGS84), or in the frame of a local map."""
    lon_lat = None
    if run.frame.crs:
        lon_lat = reproject(run.place, run.frame.crs, WGS84)
    reviews = dict(zip(run.columns["tree"].tolist(), run.columns["review"].tolist(), strict=True))
    text = geojson(run.trees, 0, lon_lat=lon_lat, reviews=reviews)
    file.write_text(text, encoding="utf-8", newline="")


def _write_dxf(run: ExportedRun, file: FilePath) -> None:
    """Write a DXF drawing in metres with the layers TREES, LABELS, PATH, PLOTS and CONTOURS. A tree without a
    diameter is a point without a circle, one without a ground height has z 0. StemmapError if ezdxf or
    contourpy is not installed, or the terrain covers too large an area."""
    ezdxf = gis_package("ezdxf", "DXF files")
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        drawing = ezdxf.new("R2010", units=ezdxf.units.M)
        drawing.header.custom_vars.append("CRS", run.frame.name)
        drawing.header.custom_vars.append("Program", f"stemmap {version()}")
        for layer, colour in (("TREES", 3), ("LABELS", 7), ("PATH", 5), ("PLOTS", 30), ("CONTOURS", 33)):
            drawing.layers.add(layer, color=colour)
        space = drawing.modelspace()
        columns = run.columns
        for k, (x, y) in enumerate(run.place.tolist()):
            z = float(np.nan_to_num(columns["z_m"][k]))
            dbh = float(columns["dbh_cm"][k])
            space.add_point((x, y, z), dxfattribs={"layer": "TREES"})
            if math.isfinite(dbh):
                space.add_circle((x, y, z), 0.005 * dbh, dxfattribs={"layer": "TREES"})
            text = f"{columns['tree'][k]}" + (f" {dbh:.0f}" if math.isfinite(dbh) else "")
            label = space.add_text(text, height=0.25, dxfattribs={"layer": "LABELS"})
            label.set_placement((x + 0.2, y + 0.2, z))
        if len(run.path) > 1:
            space.add_lwpolyline(run.path.tolist(), dxfattribs={"layer": "PATH"})
        for name, shape, _ in run.plots:
            for part in getattr(shape, "geoms", [shape]):
                for ring in (part.exterior, *part.interiors):
                    space.add_lwpolyline(list(ring.coords), close=True, dxfattribs={"layer": "PLOTS"})
            label = space.add_text(name, height=0.5, dxfattribs={"layer": "PLOTS"})
            label.set_placement(tuple(shape.centroid.coords[0]))
        for z, line in contours(run):
            space.add_lwpolyline(line.tolist(), dxfattribs={"layer": "CONTOURS", "elevation": z})
        drawing.saveas(file)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def _write_xlsx(run: ExportedRun, file: FilePath) -> None:
    """Write a workbook with the sheets trees, plots (if there are any), fields and about. StemmapError if
    xlsxwriter is not installed."""
    xlsxwriter = gis_package("xlsxwriter", "XLSX files")
    book = xlsxwriter.Workbook(str(file), {"nan_inf_to_errors": False, "strings_to_formulas": False})
    book.set_properties({"created": _DATE.replace(tzinfo=None), "comments": f"stemmap {version()}"})
    bold = book.add_format({"bold": True})
    first, second = ("east_m", "north_m") if run.frame.crs else ("x_m", "y_m")
    place = {first: np.round(run.place[:, 0], 3), second: np.round(run.place[:, 1], 3)}
    number = run.columns["tree"]
    _sheet(book, "trees", {"tree": number, **place, **run.columns}, bold)
    if run.plots:
        _sheet(book, "plots", _plot_table(run), bold)
    axes = tuple(Field(name, "", "m", f"coordinate in {run.frame.name}") for name in (first, second))
    rows = [
        (field, layer)
        for layer, fields in LAYER_FIELDS.items()
        for field in ((*fields, *axes) if layer == "trees" else fields)
    ]
    units = {
        "field": [field.name for field, _ in rows],
        "unit": [field.unit for field, _ in rows],
        "meaning": [field.meaning for field, _ in rows],
        "layer": [layer for _, layer in rows],
    }
    _sheet(book, "fields", units, bold)
    about = {
        "program": f"stemmap {version()}",
        "source": run.uri,
        "coordinates": run.frame.name,
        "georeference": run.frame.method_words if run.frame.crs else "none",
    }
    _sheet(book, "about", {"what": list(about), "value": list(about.values())}, bold)
    book.close()


def _sheet(book: Any, name: str, table: dict[str, Any], bold: Any) -> None:  # noqa: ANN401
    """Add a sheet with a column per entry of a table; values that are not finite are empty cells.

    Args:
        book: Workbook of xlsxwriter.
        name: Name of the sheet.
        table: Dict from the title of each column to its values, strings or numbers; columns may differ in
            length.
        bold: Format of the titles.
    """
    sheet = book.add_worksheet(name)
    sheet.freeze_panes(1, 0)
    for column, (title, values) in enumerate(table.items()):
        sheet.write_string(0, column, title, bold)
        longest = len(title)
        for row, value in enumerate(values, start=1):
            if isinstance(value, str):
                sheet.write_string(row, column, value)
                longest = max(longest, len(value))
            elif math.isfinite(value):  # a field without a value is empty
                sheet.write_number(row, column, float(value))
        sheet.set_column(column, column, min(longest + 2, 60))


def terrain_raster(run: ExportedRun) -> tuple[Float, float, float] | None:
    """Return the heights of the terrain as a north-up raster in the coordinates of the files, shape (rows
    from north to south, columns from west to east) [m], NaN where unknown, with west and north of its corner
    [m]; None if there is no terrain. Cells have TERRAIN_CELL metres. A map that is rotated or whose cells are
    not those of the raster is resampled linearly between the centres of its cells, beyond them from the
    nearest one, and only within 0.75 cells of one.

    Raises:
        SourceError: The raster would have more than 25 million cells.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import cKDTree

    if not len(run.terrain):
        return None
    place, z = run.frame.to_crs(run.terrain[:, :2]), run.terrain[:, 2] + run.frame.z
    cell = TERRAIN_CELL
    low = np.floor(place.min(axis=0) / cell) * cell
    high = np.floor(place.max(axis=0) / cell) * cell + cell
    width, height = np.round((high - low) / cell).astype(int)
    if width * height > _CELLS_MAX:
        raise SourceError("the terrain covers too large an area", where=run.uri)
    raster = np.full((height, width), np.nan)
    aligned = abs(math.remainder(run.frame.pose.yaw, math.tau)) < 1e-12 and len(
        np.unique(place, axis=0)
    ) == len(z)
    on_grid = np.abs((place - low) / cell - np.floor((place - low) / cell) - 0.5) < 1e-3
    if aligned and on_grid.all():
        column, row = np.floor((place - low) / cell).astype(int).T
        raster[height - 1 - row, column] = z
    else:
        x, y = low[0] + (np.arange(width) + 0.5) * cell, high[1] - (np.arange(height) + 0.5) * cell
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        distance, nearest = cKDTree(place).query(nodes)
        values = z[nearest]
        if len(z) > 3 and np.linalg.matrix_rank(place - place.mean(axis=0)) == 2:
            linear = LinearNDInterpolator(place - low, z)(nodes - low)
            values = np.where(np.isfinite(linear), linear, values)
        raster = np.where(distance <= 0.75 * cell, values, np.nan).reshape(height, width)
    return raster, float(low[0]), float(high[1])


def contours(run: ExportedRun) -> list[tuple[float, Float]]:
    """Return (height [m], line, shape (N, 2) [m]) of each contour line, at multiples of CONTOUR_STEP, in the
    coordinates of the files; [] if there is no terrain or with a single row or column of cells. Lines of
    fewer than three points are omitted.

    Raises:
        StemmapError: contourpy is not installed, or the raster would be too large.
    """
    found = terrain_raster(run)
    if found is None or min(found[0].shape) < 2:
        return []
    contourpy = gis_package("contourpy", "contours")
    raster, west, north = found
    x = west + (np.arange(raster.shape[1]) + 0.5) * TERRAIN_CELL
    y = north - (np.arange(raster.shape[0]) + 0.5) * TERRAIN_CELL
    generator = contourpy.contour_generator(x - west, y - north, np.ma.masked_invalid(raster))
    low, high = np.nanmin(raster), np.nanmax(raster)
    levels = np.arange(math.ceil(low / CONTOUR_STEP), math.floor(high / CONTOUR_STEP) + 1) * CONTOUR_STEP
    return [
        (float(level), line + np.array([west, north]))
        for level in levels
        for line in generator.lines(level)
        if len(line) > 2
    ]


def _write_geotiff(run: ExportedRun, file: FilePath) -> None:
    """Write the terrain as a GeoTIFF of float32 with NaN as no-data.

    Raises:
        StemmapError: The run has no terrain, or one that covers too large an area; its reference system has
            no EPSG code up to 32766; or tifffile is not installed. A local map needs no code.
    """
    tifffile = gis_package("tifffile", "GeoTIFF files")
    found = terrain_raster(run)
    if found is None:
        raise StemmapError("the run has no terrain", where=run.uri)
    raster, west, north = found
    tags: list[tuple[Any, ...]] = [
        (33550, "d", 3, (TERRAIN_CELL, TERRAIN_CELL, 0.0), True),  # ModelPixelScale
        (33922, "d", 6, (0.0, 0.0, 0.0, west, north, 0.0), True),  # ModelTiepoint
        (42113, "s", 0, "nan", True),  # GDAL_NODATA
    ]
    authority, _, code = run.frame.crs.partition(":")
    if run.frame.crs and (authority != "EPSG" or not code.isdecimal() or int(code) > 32766):
        raise StemmapError(
            f"a GeoTIFF needs a reference system with an EPSG code, not {run.frame.crs[:60]}",
            remedy="Run stemmap georeference with --crs EPSG:CODE",
        )
    keys: tuple[int, ...]
    if run.frame.crs:  # version 1.1.0; projected, pixels are areas, code of the system, metres
        keys = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, int(code), 3076, 0, 1, 9001)
    else:  # user-defined
        text = "local|"
        keys = (1, 1, 0, 3, 1024, 0, 1, 32767, 1025, 0, 1, 1, 1026, 34737, len(text), 0)
        tags.append((34737, "s", 0, text, True))
    tags.append((34735, "H", len(keys), keys, True))
    tifffile.imwrite(
        file, raster.astype(np.float32), compression="zlib", metadata=None, extratags=tags, datetime=False,
        software="stemmap",
    )  # fmt: skip


WRITERS: dict[str, Callable[[ExportedRun, FilePath], None]] = {
    ".gpkg": _write_layers,
    ".shp": _write_shapefiles,
    ".geojson": _write_geojson,
    ".dxf": _write_dxf,
    ".xlsx": _write_xlsx,
    ".tif": _write_geotiff,
}
