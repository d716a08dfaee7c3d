"""Files of a finished run with its plots and terrain: GeoPackage, Shapefile, DXF, XLSX and GeoTIFF.

The same run gives the same bytes: time stamps in the files are fixed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import shapely

from app.batch import export
from app.batch.export import DATE, ExportedRun, Field, Writer, qml, write_geojson, write_geopackage
from app.batch.map_frame import gis_package
from app.common.text import version
from app.extensions.stand.figures import FIGURES
from app.extensions.stand.run_figures import StandResult
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float

_CELLS_MAX = 25_000_000
TERRAIN_CELL = 0.5  # m
CONTOUR_STEP = 0.5  # m
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
    "mean_height_m": "hm_m",
    "lorey_height_m": "hl_m",
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
    Field("trees_with_dbh", "trees_dbh", "", "number of these trees with a diameter"),
    Field("trees_with_height", "trees_h", "", "number of these trees with a height"),
    Field("trees_with_volume", "trees_v", "", "number of these trees with a volume; empty without a formula"),
    Field("dbh_by_tape", "tape", "", "number of these trees with a diameter by tape"),
    Field("trees_added", "trees_add", "", "number of these trees that people added"),
    Field("trees_removed", "trees_rem", "", "number of trees of the map there that people rejected"),
    *_figure_fields(),
)
#: Fields of each layer.
LAYER_FIELDS = {
    **export.LAYER_FIELDS,
    "plots": PLOT_FIELDS,
    "contours": (Field("z_m", "z_m", "m", "height of the contour"),),
}


@dataclass(frozen=True, slots=True, eq=False)
class PlottedRun(ExportedRun):
    """A run with its plots in the coordinates of its files.

    Attributes:
        plots: Tuples, one per plot, of name, shape in the coordinates of `place`, and a dict from the names
            of PLOT_FIELDS except "plot" to values.
    """

    plots: tuple[tuple[str, Any, dict[str, float]], ...]


def read_with_plots(folder: FilePath, of_plots: StandResult | None) -> PlottedRun:
    """Return a run with its values for export; rejected trees are left out.

    Args:
        folder: Folder of the run.
        of_plots: Stand figures of the run on plots, which are exported with them; None for no plots.

    Raises:
        StemmapError: A file of the run is missing or damaged.
    """
    run = export.read_for_export(folder)
    shapes: list[tuple[str, Any, dict[str, float]]] = []
    if of_plots is not None:
        for plot in of_plots.plots:
            f = of_plots.figures[plot.name]
            figures = {
                "area_m2": f.area,
                "seen_m2": f.seen,
                "trees": f.trees,
                "trees_with_dbh": f.trees - f.without_dbh,
                "trees_with_height": f.with_height,
                "trees_with_volume": math.nan if f.with_volume is None else f.with_volume,
                **of_plots.by_people[plot.name]._asdict(),
            }
            for name, estimate in f.values.items():
                figures.update({name: estimate.value, f"{name}_se": estimate.se})
            shapes.append((plot.name, shapely.transform(plot.shape, run.frame.to_crs), figures))
    values = {field.name: getattr(run, field.name) for field in fields(run)}
    return PlottedRun(**values, plots=tuple(shapes))


def layers_of(run: PlottedRun) -> dict[str, Any]:
    """Return a dict from the name of each layer to its GeoDataFrame in the coordinates of the files: those of
    `app.batch.export.layers_of`, and `plots` and `contours` if there are any. The columns are LAYER_FIELDS
    and the geometry. Raises StemmapError if a package is not installed or the terrain covers too large an
    area."""
    geopandas = gis_package("geopandas", "GIS files")
    layers = export.layers_of(run)
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


def _plot_table(run: PlottedRun) -> dict[str, Any]:
    """Return a dict from each name of PLOT_FIELDS to the values of the plots, rounded to four decimals; NaN
    if unknown."""
    table: dict[str, Any] = {"plot": [name for name, _, _ in run.plots]}
    for field in PLOT_FIELDS[1:]:
        table[field.name] = np.array([round(figures[field.name], 4) for _, _, figures in run.plots])
    return table


def _write_layers(run: PlottedRun, file: FilePath) -> None:
    """Write a GeoPackage with the layers of `layers_of`, which also raises, and their styles."""
    write_geopackage(layers_of(run), file, _STYLES)


_STYLES = {
    **export.STYLES,
    "plots": qml(
        "fill",
        "SimpleFill",
        "",
        {"color": "230,140,20,40", "outline_color": "200,110,0,255", "style": "solid"},
    ),
    "contours": qml("line", "SimpleLine", "", {"line_color": "150,110,70,255", "line_width": "0.15"}),
}


def _write_shapefiles(run: PlottedRun, file: FilePath) -> None:
    """Write a Shapefile per layer: the trees to `file`, the others to `file` with `_` and the name of the
    layer. Columns have their short names; a local map has no .prj. Layers and errors as in `layers_of`."""
    pyogrio = gis_package("pyogrio", "GIS files")
    short = {field.name: field.short for fields in LAYER_FIELDS.values() for field in fields}
    for name, layer in layers_of(run).items():
        part = file if name == "trees" else file.with_name(f"{file.stem}_{name}{file.suffix}")
        table = layer.rename(columns=short).set_crs(run.frame.crs or None, allow_override=True)
        options = {"DBF_DATE_LAST_UPDATE": DATE.strftime("%Y-%m-%d"), "ENCODING": "UTF-8"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a file without a reference system
            pyogrio.write_dataframe(table, part, driver="ESRI Shapefile", layer_options=options)
        if not run.frame.crs:
            part.with_suffix(".prj").unlink(missing_ok=True)


def _write_dxf(run: PlottedRun, file: FilePath) -> None:
    """Write a DXF drawing in metres; without a diameter, a tree has no circle."""
    ezdxf = gis_package("ezdxf", "DXF files")
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        drawing = ezdxf.new("R2010", units=ezdxf.units.M)
        drawing.header.custom_vars.append("CRS", run.frame.name)
        drawing.header.custom_vars.append("Program", f"stemmap {version()}")
        colours = {"TREES": 3, "LABELS": 7, "PATH": 5, "PLOTS": 30, "CONTOURS": 33}
        if len(run.added):
            colours["ADDED"] = 1
        for layer, colour in colours.items():
            drawing.layers.add(layer, color=colour)
        space = drawing.modelspace()
        columns = run.columns
        for k, (x, y) in enumerate(run.place.tolist()):
            z = float(np.nan_to_num(columns["z_m"][k]))
            dbh = float(columns["dbh_counted_cm"][k])
            space.add_point((x, y, z), dxfattribs={"layer": "TREES"})
            if math.isfinite(dbh):
                space.add_circle((x, y, z), 0.005 * dbh, dxfattribs={"layer": "TREES"})
            _label_tree(space, str(columns["tree"][k]), dbh, (x, y, z))
        names = run.added_columns["name"].tolist()
        for name, (x, y), dbh in zip(names, run.added.tolist(), run.added_dbh.tolist(), strict=True):
            space.add_point((x, y), dxfattribs={"layer": "ADDED"})
            if math.isfinite(dbh):
                space.add_circle((x, y), 0.005 * dbh, dxfattribs={"layer": "ADDED"})
            _label_tree(space, name, dbh, (x, y, 0.0))
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
        # Without this, ezdxf writes the classes of objects in the order of a set of strings.
        for kind in sorted(drawing.entitydb.dxf_types_in_use()):
            drawing.classes.add_class(kind)
        drawing.saveas(file)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def _label_tree(space: Any, name: str, dbh: float, place: tuple[float, float, float]) -> None:  # noqa: ANN401
    """Add the name of a tree and its diameter [cm], if it is known, to a space of ezdxf."""
    text = f"{name} {dbh:.0f}" if math.isfinite(dbh) else name
    label = space.add_text(text, height=0.25, dxfattribs={"layer": "LABELS"})
    label.set_placement((place[0] + 0.2, place[1] + 0.2, place[2]))


def _write_xlsx(run: PlottedRun, file: FilePath) -> None:
    """Write a workbook with the sheets trees, added and plots (if there are any), fields and about.
    StemmapError if xlsxwriter is not installed."""
    xlsxwriter = gis_package("xlsxwriter", "XLSX files")
    book = xlsxwriter.Workbook(str(file), {"nan_inf_to_errors": False, "strings_to_formulas": False})
    book.set_properties({"created": DATE.replace(tzinfo=None), "comments": f"stemmap {version()}"})
    bold = book.add_format({"bold": True})
    first, second = ("east_m", "north_m") if run.frame.crs else ("x_m", "y_m")
    place = {first: np.round(run.place[:, 0], 3), second: np.round(run.place[:, 1], 3)}
    number = run.columns["tree"]
    _sheet(book, "trees", {"tree": number, **place, **run.columns}, bold)
    if len(run.added):
        added = {name: np.round(run.added[:, axis], 3) for axis, name in enumerate((first, second))}
        columns = run.added_columns
        _sheet(book, "added", {"name": columns["name"], **added, **columns}, bold)
    if run.plots:
        _sheet(book, "plots", _plot_table(run), bold)
    axes = tuple(Field(name, "", "m", f"coordinate in {run.frame.name}") for name in (first, second))
    rows = [
        (field, layer)
        for layer, fields in LAYER_FIELDS.items()
        for field in ((*fields, *axes) if layer in ("trees", "added") else fields)
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


def _write_geotiff(run: PlottedRun, file: FilePath) -> None:
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


WRITERS: dict[str, Writer[PlottedRun]] = {
    ".gpkg": _write_layers,
    ".shp": _write_shapefiles,
    ".geojson": write_geojson,
    ".dxf": _write_dxf,
    ".xlsx": _write_xlsx,
    ".tif": _write_geotiff,
}
