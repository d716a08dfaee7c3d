"""`stemmap stand`: stand figures of a finished run, for plots or the whole observed area."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.flags import print_warnings
from app.cli.stored import reviewed
from app.extensions.stand.commands.flags import (
    add_plot_flags,
    add_stand_flags,
    chosen_plots,
    stand_parameters,
)

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


def run(arguments: argparse.Namespace) -> int:
    """Print the figures, print warnings to standard error, and with --out write the files.

    Returns:
        Exit code: 3 with warnings, else 0.

    Raises:
        StemmapError: A flag or plot is not valid, the run cannot be read, `stand_of` refuses it, or a file
            cannot be written.
        OSError: The folder --out cannot be created.
    """
    from app.extensions.stand.run_figures import stand_files, stand_of, stand_summary
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
