"""What people add to a run: reviews of its trees, its sample plots, also from GIS files (GeoPackage,
Shapefile and GeoJSON), and the reference system of its map.

A review decides whether a mapped tree is a tree in the figures and files that are handed in. The map is not
changed. An annotation of a class other than "tree" rejects the mapped tree at its place.
"""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from app.batch.georeference import LOCAL, LOCAL_NAME, MapFrame, gis_package, read_map_frame
from app.batch.run_folder import crs_unit, read_run
from app.store.records import FRAME, KINDS, PLOT, SKIPPED, Content
from pipeline.errors import SourceError, StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.atomic_files import write_texts
from pipeline.io.result_files import CONFIRMED, OPEN, REJECTED, TREE_COLUMNS, csv_in_units, csv_text
from pipeline.stand.plots import PLOTS_MAX, SamplePlot, checked, circle, plot_of

if TYPE_CHECKING:
    from app.store.store import Store

# Largest distance between an annotation and the same object in a map or a ground truth [m].
SAME_THING = 0.5
# What figures and exports of a run need, besides its trees.
_FILES = ("path.csv", "terrain.csv", "seen.csv", "run.json", "georeference.json")


def reviews_of(numbers: Sequence[int], position: Float, contents: Iterable[Content]) -> dict[int, str]:
    """Return a dict from the number of each reviewed tree to its review: CONFIRMED for the class "tree",
    REJECTED for another class, SKIPPED if no annotation of the tree states a class.

    An annotation belongs to the tree that is nearest to it, if it is nearer than SAME_THING. Of several
    annotations of a tree the nearest one that states a class counts, of equally near ones the last. The page
    has the same rule (`paired` in static/js/annotate/annotations.js).

    Args:
        numbers, position: Numbers of the trees, and their positions in the map, shape (T, 2) [m].
        contents: The annotations in the same frame; plots and frames are ignored.
    """
    from scipy.spatial import cKDTree

    states = {**dict.fromkeys(KINDS, REJECTED), "tree": CONFIRMED, SKIPPED: SKIPPED}
    reviews = [content for content in contents if content.kind in states]
    if not reviews or not len(numbers):
        return {}
    distance, row = cKDTree(position).query([(content.x, content.y) for content in reviews])
    states_class = np.array([content.kind != SKIPPED for content in reviews])
    found: dict[int, str] = {}
    for k in np.lexsort((-distance, states_class)):  # the one that counts comes last
        if distance[k] < SAME_THING:
            found[numbers[row[k]]] = states[reviews[k].kind]
    return found


def stored_reviews(store: Store, source: Mapping[str, Any]) -> list[Content] | None:
    """Return the annotations of a recording that review trees, in the frame of the map; None if it never had
    an annotation in this store, so that the reviews in the files of a run are those of another machine.

    Args:
        store: The store.
        source: Member `source` of run.json.
    """
    if not store.was_annotated(key := _key(source)):
        return None
    return [content for content in store.contents(key) if content.kind in (*KINDS, SKIPPED)]


@contextmanager
def reviewed_run(folder: FilePath, contents: Sequence[Content] | None) -> Iterator[FilePath]:
    """Yield a folder with the run of `folder` in which trees.csv has the reviews by annotations of its
    recording, and no others; the folder itself if there are neither annotations nor reviews. A temporary
    folder is removed afterwards; errors name `folder` instead.

    Args:
        folder: Folder that `stemmap map` wrote.
        contents: Annotations in the frame of the map; None yields `folder` unchecked.

    Raises:
        StemmapError: A file of the run is missing or damaged.
    """
    if contents is None:
        yield folder
        return
    run = read_run(folder)  # checks the files
    if not (contents or run.rejected or {*run.reviews.values()} - {OPEN}):
        yield folder
        return
    offset = run.record["source"].get("offset_m", (0.0, 0.0))
    placed = [replace(each, x=each.x + offset[0], y=each.y + offset[1]) for each in contents]
    text = (folder / "trees.csv").read_text(encoding="utf-8")
    if text.startswith("tree,x,"):
        text = csv_in_units(text, crs_unit(run.record), to_metres=True)
    rows = list(csv.DictReader(text.splitlines()))
    numbers = [int(float(row["tree"])) for row in rows]
    position = np.array([(float(row["x_m"]), float(row["y_m"])) for row in rows]).reshape(-1, 2)
    reviews = reviews_of(numbers, position, placed)
    texts = [
        [{**row, "review": reviews.get(number, OPEN)}.get(name, "") for name in TREE_COLUMNS]
        for number, row in zip(numbers, rows, strict=True)
    ]
    with TemporaryDirectory(prefix="stemmap-run-") as there:
        for name in _FILES:
            if (folder / name).is_file():
                shutil.copy2(folder / name, FilePath(there) / name)  # with its date, which the report states
        write_texts(FilePath(there), {"trees.csv": csv_text(TREE_COLUMNS, texts)})
        try:
            yield FilePath(there)
        except StemmapError as error:
            where = error.where.replace(there, str(folder))
            raise type(error)(error.what, where=where, remedy=error.remedy) from error


def _key(source: Mapping[str, Any]) -> str:
    """Return the key of a recording in the store, from the member `source` of run.json."""
    return str(source.get("sha256") or source.get("uri"))


# --- plots ------------------------------------------------------------------------------------------

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
        contents: Annotations; those that are no plots are left out.
        offset: Offset x, y of the frame of the map in these coordinates [m]; further values are ignored.
    """
    plots = [plot_of(**content.plot) for content in contents if content.plot]
    by = np.array(offset[:2], np.float64)
    return [SamplePlot(p.name, shapely.transform(p.shape, lambda xy: xy + by)) for p in plots]


def stored_plots(store: Store, source: Mapping[str, Any]) -> list[SamplePlot]:
    """Return the plots of a recording, in the coordinates of the files of its runs.

    Args:
        store: The store.
        source: Member `source` of run.json.
    """
    return placed(store.contents(_key(source), PLOT), source.get("offset_m", (0.0, 0.0)))


def stored_frame(store: Store, source: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the reference system that the store has for a recording, in the form of `MapFrame.record`; None
    if there is none. Arguments as in `stored_plots`."""
    contents = store.contents(_key(source), FRAME)
    return contents[0].plot["frame"] if contents and contents[0].plot else None


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
