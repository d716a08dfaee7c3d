"""`stemmap report`: a page for the file about a mapped run."""

from __future__ import annotations

import argparse
import datetime
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.stored import reviewed, stored_on_page
from app.extensions.stand.commands.flags import (
    add_plot_flags,
    add_stand_flags,
    chosen_plots,
    stand_parameters,
)

if TYPE_CHECKING:
    from app.extensions.stand.heading import Heading

HELP = "write a report of a mapped run as one HTML page or PDF"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("run", metavar="DIR", type=Path, help="folder that `stemmap map` wrote")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help=".html, or .pdf by Chromium")
    parser.add_argument("--language", metavar="en|de", default="en", help="language (default: en)")
    group = parser.add_argument_group(
        "heading", "by default, the names are those that were typed on the page"
    )
    group.add_argument("--stand", metavar="NAME", help="name of the stand")
    group.add_argument("--client", metavar="NAME", help="who ordered the report")
    group.add_argument("--author", metavar="NAME", help="who made it")
    group.add_argument("--date", metavar="YYYY-MM-DD", type=_date, help="date of the report (default: today)")
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
        page = report_page(
            folder,
            language=arguments.language,
            plots=plots,
            parameters=parameters,
            heading=_heading(arguments),
            date=arguments.date,
        )
    write_report(page, arguments.out)
    print(f"report in {arguments.out}")
    return 0


def _date(text: str) -> datetime.date:
    """Return a date; argparse.ArgumentTypeError for another text."""
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a date as 2026-05-31") from None


def _heading(arguments: argparse.Namespace) -> Heading:
    """Return the names that the flags give; of the others, those that the recording got on the page, which is
    reported. StemmapError if the run or the database cannot be read."""
    from app.extensions.stand.heading import Heading, stored_heading

    given = {name: getattr(arguments, name) for name in ("stand", "client", "author")}
    given = {name: " ".join(text.split()) for name, text in given.items() if text is not None}
    heading = stored_on_page(arguments.run, stored_heading) or Heading()
    used = [text for name, text in asdict(heading).items() if text and name not in given]
    if used:
        print(f"heading of the page: {', '.join(used)}", file=sys.stderr)
    return replace(heading, **given)
