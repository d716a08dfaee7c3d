"""`stemmap export` with plots and terrain: layers of the GeoPackage, and files for CAD and spreadsheets."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.export import print_written
from app.cli.stored import reviewed
from app.extensions.stand.commands.flags import (
    add_plot_flags,
    add_stand_flags,
    chosen_plots,
    stand_parameters,
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the flags of plots and figures."""
    parser.add_argument_group(
        "further files of --to",
        ".shp, .dxf, .xlsx and .tif (terrain). The GeoPackage has the layers plots and contours, too.",
    )
    add_plot_flags(parser)
    add_stand_flags(parser, without=("reach",))


def run(arguments: argparse.Namespace) -> int | None:
    """Write the run with the figures of the chosen plots, if there are any, to the file that --to names, and
    print its files; existing ones are replaced.

    Returns:
        0; None if no file is named.

    Raises:
        StemmapError: A flag is wrong, the run cannot be read or lacks what the format shows, or a package is
            not installed.
        OSError: The file cannot be written, for example because its folder does not exist.
    """
    from app.batch.export import export_run
    from app.extensions.stand.gis_files import WRITERS, read_with_plots
    from app.extensions.stand.run_figures import stand_of

    if arguments.to is None:
        return None
    file = Path(arguments.to)
    with reviewed(arguments.run) as folder:
        plots, parameters = chosen_plots(arguments), stand_parameters(arguments)
        exported = read_with_plots(folder, stand_of(folder, parameters, plots) if plots else None)
        print_written(exported, export_run(exported, file, WRITERS))
    return 0
