"""Flags of the commands that compute stand figures: the plots, and the parameters of the figures."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.flags import numbers, positive_number
from app.cli.stored import stored_on_page
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.extensions.stand.parameters import Stand
    from app.extensions.stand.plots import SamplePlot

NO_PLOTS = "none"
CIRCLE, RECTANGLE = "X,Y,R", "X,Y,LENGTH,WIDTH[,TURN]"


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
    from app.extensions.stand.parameters import Stand

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

    from app.extensions.stand.parameters import Stand

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
    from app.extensions.stand.plots import along, circle, rectangle

    plots: list[SamplePlot] = []
    given = (arguments.plots, arguments.along, *arguments.circle, *arguments.rectangle)
    if all(each is None for each in given):
        return _drawn_plots(arguments.run)
    if arguments.plots is not None and str(arguments.plots) != NO_PLOTS:
        from app.extensions.stand.plot_files import read_plots

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


def _drawn_plots(run: Path) -> list[SamplePlot]:
    """Return the plots that were drawn on the page for the recording of a run, in the coordinates of the map,
    and print their number to standard error; [] without a database.

    Raises:
        StemmapError: The run or the database cannot be read.
    """
    from app.common.text import count
    from app.extensions.stand.plot_files import stored_plots

    plots = stored_on_page(run, stored_plots) or []
    if plots:
        words = f"{count(len(plots), 'plot')} of the page (--plots {NO_PLOTS}: without)"
        print(f"plots: {words}", file=sys.stderr)
    return plots
