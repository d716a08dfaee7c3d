"""`stemmap report`: a page for the file about a mapped run."""

from __future__ import annotations

import argparse
from pathlib import Path

from app.cli.stored import reviewed
from app.extensions.stand.commands.flags import (
    add_plot_flags,
    add_stand_flags,
    chosen_plots,
    stand_parameters,
)

HELP = "write a report of a mapped run as one HTML page or PDF"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help=".html, or .pdf by Chromium")
    parser.add_argument("--language", metavar="en|de", default="en", help="language (default: en)")
    add_plot_flags(parser)
    add_stand_flags(parser)
    parser.epilog = (
        "The page has a map, stand tables, the distribution of diameters, the list of trees, the method and\n"
        "what was left out. It needs no other file and no network."
    )


def run(arguments: argparse.Namespace) -> int:
    """Write the report to --out, in place of an existing file; return 0.

    Raises:
        StemmapError: A flag is wrong, the run cannot be read, there is no Chromium for a PDF, or the file
            cannot be written.
    """
    from app.extensions.stand.report import report_page, write_report

    plots, parameters = chosen_plots(arguments), stand_parameters(arguments)
    with reviewed(arguments.run) as folder:
        page = report_page(folder, language=arguments.language, plots=plots, parameters=parameters)
    write_report(page, arguments.out)
    print(f"report in {arguments.out}")
    return 0
