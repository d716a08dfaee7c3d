"""`stemmap stand`: stand figures of a finished run, for plots or the whole observed area."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from app.cli.flags import numbers, positive_number, print_warnings
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.store.store import Store
    from pipeline.config.stages import Stand
    from pipeline.stand.plots import SamplePlot

T = TypeVar("T")

NO_PLOTS = "none"
CIRCLE, RECTANGLE = "X,Y,R", "X,Y,LENGTH,WIDTH[,TURN]"
HELP = "stems and basal area per hectare, diameters and density of a mapped run"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    add_plot_flags(parser)
    add_stand_flags(parser)
    parser.add_argument("--out", metavar="DIR", type=Path, help="write stand.csv, classes.csv and stand.json")
    parser.epilog = (
        "Without plots, the whole observed area is one plot. A tree belongs to a plot if its centre does.\n"
        "Figures refer to the part of a plot that was observed; `plain` figures to the whole plot, and\n"
        "`corrected` figures take the probability of detection over distance into account.\n"
        "Exit code 3: there are warnings, such as fewer than ten trees."
    )


def add_plot_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that define plots."""
    group = parser.add_argument_group("plots", "in metres, in the coordinates of the map")
    group.add_argument(
        "--plots",
        metavar="FILE",
        type=Path,
        help="polygons: .gpkg, .shp or .geojson; by default those drawn on the page, if no plot is given; "
        "none: without them",
    )
    group.add_argument(
        "--plots-crs",
        metavar="CRS",
        help="reference system of --plots if the file has none: EPSG:CODE, or local for that of the map",
    )
    group.add_argument(
        "--circle",
        metavar=CIRCLE,
        type=numbers(CIRCLE),
        action="append",
        default=[],
        help="a circle; repeatable",
    )
    group.add_argument(
        "--rectangle",
        metavar=RECTANGLE,
        type=numbers(RECTANGLE),
        action="append",
        default=[],
        help="a rectangle by its centre; TURN of its length from x to y in degrees; repeatable",
    )
    group.add_argument(
        "--along",
        metavar="M",
        type=positive_number(1e4, "distance in metres"),
        help="circles along the path, one every M metres",
    )
    group.add_argument(
        "--radius",
        metavar="M",
        type=positive_number(500.0, "radius in metres"),
        default=5.64,
        help="radius of the circles of --along (default: 5.64, 100 m2)",
    )


def add_stand_flags(parser: argparse.ArgumentParser, without: tuple[str, ...] = ()) -> None:
    """Add a flag for each parameter of the stand figures but those in `without`; values stay texts, see
    `stand_parameters`."""
    from pipeline.config.stages import Stand

    group = parser.add_argument_group("figures")
    for name, declared in Stand.model_fields.items():
        if name in without:
            continue
        extra = declared.json_schema_extra
        unit = str(extra["unit"]) if isinstance(extra, dict) else ""
        group.add_argument(
            f"--{name.replace('_', '-')}",
            dest=f"stand_{name}",
            metavar=unit or name.upper(),
            help=f"{declared.description} (default: {declared.default or 'none'})".replace("%", "%%"),
        )


def stand_parameters(arguments: argparse.Namespace) -> Stand:
    """Return the parameters that the flags give; declared defaults for the others.

    Raises:
        ParameterError: A value is not a number or out of bounds.
    """
    from pydantic import ValidationError

    from pipeline.config.stages import Stand

    texts = {name: getattr(arguments, f"stand_{name}", None) for name in Stand.model_fields}
    given = {name: text for name, text in texts.items() if text is not None}
    try:
        return Stand.model_validate(given, strict=False)  # the values are texts
    except ValidationError as error:
        first = error.errors()[0]
        flag = f"--{first['loc'][0]}".replace("_", "-")
        reason = first["msg"].removeprefix("Value error, ")
        raise ParameterError(f"{flag} {first['input']}: {reason[0].lower()}{reason[1:]}") from None


def chosen_plots(arguments: argparse.Namespace) -> list[SamplePlot]:
    """Return the plots that the flags define, in the frame of the map: those of --plots, then circles and
    rectangles, named by their place in the result from 1 on, then those along the path. Without such flags,
    those that were drawn on the page for the recording, which is reported; [] with only --plots none.

    Raises:
        StemmapError: A plot, a file or the database is not valid.
    """
    import numpy as np

    from app.batch.run_folder import read_run
    from pipeline.stand.plots import along, circle, rectangle

    plots: list[SamplePlot] = []
    given = (arguments.plots, arguments.along, *arguments.circle, *arguments.rectangle)
    if all(each is None for each in given):
        return _drawn_plots(arguments.run)
    if arguments.plots is not None and str(arguments.plots) != NO_PLOTS:
        from app.batch.run_edits import read_plots

        plots += read_plots(arguments.plots, arguments.run, crs=arguments.plots_crs)
    for sizes in (*(c[2:] for c in arguments.circle), *(r[2:4] for r in arguments.rectangle)):
        if min(sizes) <= 0.0:
            raise StemmapError("a plot has an area of 0", remedy="Give sizes above 0, in metres")
    for x, y, radius in arguments.circle:
        plots.append(circle(str(len(plots) + 1), x, y, radius))
    for x, y, length, width, turn in arguments.rectangle:
        plots.append(rectangle(str(len(plots) + 1), x, y, length, width, math.radians(turn)))
    if arguments.along is not None:
        path = read_run(arguments.run).path
        plots += along(np.stack([path.x, path.y], axis=1), arguments.along, arguments.radius)
    return plots


def stored_on_page(run: Path, read: Callable[[Store, dict[str, Any]], T]) -> T | None:
    """Return what a function reads of the database for the recording of a run; None without a database.

    Args:
        run: Folder of the run.
        read: The function; its arguments are the store and the member `source` of run.json.

    Raises:
        StemmapError: The run or the database cannot be read.
    """
    import os

    from app.batch.run_folder import read_run_record
    from app.common.settings import data_folder
    from app.store.database import FILE_NAME

    folder = data_folder(os.environ)
    if folder is None or not (folder / FILE_NAME).is_file():
        return None
    from app.store.store import Store

    store = Store(folder)
    try:
        return read(store, read_run_record(run)["source"])
    finally:
        store.close()


@contextmanager
def reviewed(run: Path) -> Iterator[Path]:
    """Yield the folder of a run, or a temporary one in which trees.csv has the reviews that people made on
    the page (see `reviewed_run`); the number of rejected trees is then printed to standard error. A path that
    is not a folder is yielded unchecked.

    Raises:
        StemmapError: The run or the database cannot be read.
    """
    import sys

    from app.batch.run_edits import reviewed_run, stored_reviews
    from app.batch.run_folder import read_run
    from app.common.text import count

    contents = stored_on_page(run, stored_reviews) if run.is_dir() else None
    with reviewed_run(run, contents) as folder:
        if folder != run and (rejected := read_run(folder).rejected):
            print(f"review: {count(rejected, 'tree')} rejected on the page left out", file=sys.stderr)
        yield folder


def _drawn_plots(run: Path) -> list[SamplePlot]:
    """Return the plots that were drawn on the page for the recording of a run, in the coordinates of the map,
    and print their number to standard error; [] without a database.

    Raises:
        StemmapError: The run or the database cannot be read.
    """
    import sys

    from app.batch.run_edits import stored_plots
    from app.common.text import count

    plots = stored_on_page(run, stored_plots) or []
    if plots:
        words = f"{count(len(plots), 'plot')} of the page (--plots {NO_PLOTS}: without)"
        print(f"plots: {words}", file=sys.stderr)
    return plots


def run(arguments: argparse.Namespace) -> int:
    """Print the figures, print warnings to standard error, and with --out write the files.

    Returns:
        Exit code: 3 with warnings, else 0.

    Raises:
        StemmapError: A flag or plot is not valid, the run cannot be read, `stand_of` refuses it, or a file
            cannot be written.
        OSError: The folder --out cannot be created.
    """
    from app.batch.stand import stand_files, stand_of, stand_summary
    from pipeline.io.atomic_files import write_texts

    plots, parameters = chosen_plots(arguments), stand_parameters(arguments)
    with reviewed(arguments.run) as folder:
        result = stand_of(folder, parameters, plots)
    print("\n".join(stand_summary(result)))
    print_warnings(result.warnings)
    if arguments.out is not None:
        write_texts(arguments.out, stand_files(result))
        print(f"files in {arguments.out}")
    return 3 if result.warnings else 0
