"""Sample plots of GIS files (GeoPackage, Shapefile and GeoJSON), and those that were drawn on the page."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from app.batch.map_frame import LOCAL, LOCAL_NAME, MapFrame, gis_package, read_map_frame
from app.batch.run_edits import recording_key
from app.extensions.stand.plots import PLOTS_MAX, SamplePlot, checked, circle, plot_of
from app.store.records import Content
from pipeline.errors import SourceError, StemmapError

if TYPE_CHECKING:
    from app.dashboard.shown_run import ShownRun
    from app.store.store import Store

#: Class of the annotations that are plots, see `plot_of` for their values.
PLOT = "plot"
LARGEST_FILE = 64 << 20
SUFFIXES = (".gpkg", ".shp", ".zip", ".geojson", ".json")
_NAMES = ("name", "plot", "plot_id", "plotid", "id", "nr", "number")
_RADII = ("radius_m", "radius", "r_m")


def read_plots(file: FilePath, run: FilePath, *, crs: str | None) -> list[SamplePlot]:
    """Return the plots of a file in the frame of the map of a run.

    Of several layers one is read, see `_layer_of`. Polygons are plots; points are circles if a column
    `radius_m` (or `radius`, `r_m`) gives their radius. Names are those of the first of the columns `name`,
    `plot`, `plot_id`, `plotid`, `id`, `nr` and `number` (upper or lower case), else the numbers of the rows
    from 1 on; equal names are not refused.

    Args:
        file: A GeoPackage, Shapefile (also in a zip archive) or GeoJSON of at most 64 MB and PLOTS_MAX rows.
        run: Folder of the run.
        crs: Reference system of a file without one: an EPSG code, or "local" for the frame of the map. It
            also states that a GeoJSON, which is WGS84 by its standard, is in that system. It is ignored for
            other files with a reference system.

    Raises:
        StemmapError: geopandas is not installed; the file cannot be read, has another suffix or no plots; a
            shape is not a valid area, as a point without a radius; or its reference system does not fit the
            run.
    """
    geopandas = gis_package("geopandas", "plots from files")
    if file.suffix.lower() not in SUFFIXES:
        raise SourceError("plots are .gpkg, .shp (also in a .zip) or .geojson files", where=str(file))
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise SourceError("the file of plots is larger than 64 MB", where=str(file))
        layer = _layer_of(file)
        table = geopandas.read_file(file, engine="pyogrio", rows=PLOTS_MAX + 1, layer=layer)
    except OSError as error:
        raise SourceError(f"cannot read the plots: {error.strerror}", where=str(file)) from None
    except (RuntimeError, ValueError) as error:
        text = str(error).splitlines()[0]
        raise SourceError(f"cannot read the plots: {text}", where=str(file)) from None
    if not 0 < len(table) <= PLOTS_MAX:
        raise SourceError(f"the file has {'no' if not len(table) else 'too many'} plots", where=str(file))
    shapes = _in_map(table, _crs_of(file, table, crs), read_map_frame(run), file)
    columns = {str(name).lower(): name for name in table.columns}
    named = next((columns[name] for name in _NAMES if name in columns), None)
    radius = next((columns[name] for name in _RADII if name in columns), None)
    plots = []
    for k, shape in enumerate(shapes):
        name = str(k + 1) if named is None else str(table[named].iloc[k])
        is_centre = shape is not None and shape.geom_type == "Point" and not shape.is_empty
        if is_centre and radius is not None:
            plots.append(circle(name, shape.x, shape.y, _radius(table[radius].iloc[k], name, file)))
        else:
            plots.append(checked(SamplePlot(name, shape)))
    return plots


def placed(contents: Sequence[Content], offset: Sequence[float]) -> list[SamplePlot]:
    """Return plots of the store in the coordinates of the files of a run.

    Args:
        contents: Annotations; those that are not of the class PLOT are left out.
        offset: Offset x, y of the frame of the map in these coordinates [m]; further values are ignored.
    """
    plots = [plot_of(**content.values) for content in contents if content.kind == PLOT and content.values]
    by = np.array(offset[:2], np.float64)
    return [SamplePlot(p.name, shapely.transform(p.shape, lambda xy: xy + by)) for p in plots]


def plots_of_run(run: ShownRun) -> list[SamplePlot]:
    """Return the plots of the open run, in the coordinates of its files."""
    return placed([row.content for row in run.edits], run.offset)


def stored_plots(store: Store, source: Mapping[str, Any]) -> list[SamplePlot]:
    """Return the plots of a recording, in the coordinates of the files of its runs.

    Args:
        store: The store.
        source: Member `source` of run.json.
    """
    return placed(store.contents(recording_key(source), PLOT), source.get("offset_m", (0.0, 0.0)))


def _radius(value: object, name: str, file: FilePath) -> float:
    """Return the radius in a cell [m]; raises SourceError for anything but a finite number.

    Args:
        value: The cell.
        name, file: Name of the plot and its file, for errors.
    """
    try:
        radius = float(str(value))
    except ValueError:
        radius = math.nan
    if not math.isfinite(radius):
        raise SourceError(f"plot {name}: the radius {str(value)!r} is not a number", where=str(file))
    return radius


def _layer_of(file: FilePath) -> str:
    """Return the name of the layer with the plots: `plots`, or one that ends in `_plots`, as in the files of
    `stemmap export`; else the first. ValueError without a layer."""
    import pyogrio

    names = [str(name) for name in pyogrio.list_layers(file)[:, 0]]
    if not names:
        raise ValueError("it has no layer")
    return next((name for name in names if name == "plots" or name.endswith("_plots")), names[0])


def _crs_of(file: FilePath, table: Any, given: str | None) -> Any:  # noqa: ANN401 - a pyproj.CRS
    """Return the reference system of a file; None for the frame of the map. A GeoJSON with the member
    `coordinateFrame` is in the frame of the map unless `given`.

    Args:
        file: The file, for messages and for the members of a GeoJSON.
        table: GeoDataFrame of the file.
        given: The system that the user gives, or None; LOCAL for the frame of the map. It is used if the file
            states none, or is a GeoJSON without the member `crs`.

    Raises:
        StemmapError: `given` is unknown, there is no reference system, or a GeoJSON is not JSON in UTF-8.
    """
    import pyproj

    declared = table.crs
    if file.suffix.lower() in (".geojson", ".json"):
        try:
            record = json.loads(file.read_text(encoding="utf-8-sig"))
        except ValueError:
            raise SourceError("the file of plots is not JSON in UTF-8", where=str(file)) from None
        if "coordinateFrame" in record:  # a file of this program without georeference
            declared = None
            given = given or LOCAL
        elif given is not None and "crs" not in record:
            declared = None
    if declared is None and given is None:
        raise StemmapError(
            "the file of plots has no coordinate reference system",
            where=str(file),
            remedy="Name it (--plots-crs): EPSG:CODE, or local for the coordinates of the map",
        )
    if declared is not None:
        return None if declared.name == LOCAL_NAME else declared
    if given == LOCAL:
        return None
    try:
        return pyproj.CRS.from_user_input(given)
    except pyproj.exceptions.CRSError:
        raise StemmapError(f"{given!r} (--plots-crs) is not a coordinate reference system") from None


def _in_map(table: Any, crs: Any, frame: MapFrame, file: FilePath) -> list[Any]:  # noqa: ANN401
    """Return the shapes of a table in the frame of the map; None for a row without a shape.

    Args:
        table: GeoDataFrame.
        crs: Reference system of its shapes; None for the frame of the map.
        frame: The frame of the map.
        file: The file, for messages.

    Raises:
        StemmapError: The shapes have a reference system, but the map has none.
    """
    if crs is None:
        return list(table.geometry)
    if not frame.crs:
        raise StemmapError(
            f"the plots are in {crs.name}, but the map is local",
            where=str(file),
            remedy="Run stemmap georeference for the map, or name local (--plots-crs) if they are in it",
        )
    moved = table.set_crs(crs, allow_override=True).to_crs(frame.crs)
    return [None if shape is None else shapely.transform(shape, frame.to_map) for shape in moved.geometry]
