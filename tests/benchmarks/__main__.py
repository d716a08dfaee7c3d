"""`python -m tests.benchmarks NAME`: runs benchmarks, from the root of a clone.

`golden`, `honest`, `results` and `size` are programs of their own with their own flags.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from datetime import date
from pathlib import Path

from app.cli import FAILED, WRONG_USAGE, flags
from pipeline.errors import StemmapError, UsageError
from tests.benchmarks import runner
from tests.benchmarks.plots import draw_all
from tests.benchmarks.seeds import VARIABLE

ROOT = Path(__file__).resolve().parents[2]
#: Modules of this package that are called by name like a benchmark, but write no table.
PROGRAMS = ("golden", "honest", "results", "size")


def main(words: list[str] | None = None) -> int:
    """Run the command line; errors are printed to standard error.

    Args:
        words: Words after the program's name; None takes those of this process.

    Returns:
        0 done, 1 failed with a message, 2 wrong usage.
    """
    words = sys.argv[1:] if words is None else words
    try:
        if words and words[0] in PROGRAMS:
            return int(importlib.import_module(f"tests.benchmarks.{words[0]}").main(words[1:]) or 0)
        return run(_parser().parse_args(words))
    except SystemExit as stop:  # argparse has printed its message
        return int(stop.code or 0)
    except StemmapError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return WRONG_USAGE if isinstance(error, UsageError) else FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m tests.benchmarks",
        description="Measures speed, memory and quality, and writes docs/benchmarks.md.",
        epilog="Sections of benchmarks that are not run stay unchanged. "
        f"Programs with flags of their own: {', '.join(PROGRAMS)}.",
    )
    parser.add_argument("names", metavar="NAME", nargs="*", help="benchmarks to run (default: all)")
    parser.add_argument("--list", action="store_true", help="only list the benchmarks")
    parser.add_argument(
        "--seeds",
        metavar="A-B",
        type=_seeds,
        help="seeds of benchmarks that map a recording several times, such as 1-20 (default: their own)",
    )
    parser.add_argument(
        "--hours", metavar="N", type=flags.positive_number(1000.0, "hours"), help="duration of `campaign`"
    )
    parser.add_argument(
        "--scans", metavar="N", type=flags.whole_number(1000, 10**8), help="length of `soak` and `rerun`"
    )
    parser.add_argument(
        "--starts", metavar="N", type=flags.whole_number(1, 10**5), help="starts of each pair of `localise`"
    )
    parser.add_argument(
        "--openings", metavar="N", type=flags.whole_number(1, 10**5), help="sources of `many_sources`"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write the figures as JSON")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="Markdown file (default: docs/benchmarks.md of the tree)"
    )
    parser.add_argument(
        "--pictures",
        metavar="DIR",
        type=Path,
        help="only draw path, ground truth and map of the named benchmarks into a folder",
    )
    parser.add_argument(
        "--date",
        metavar="YYYY-MM-DD",
        type=_date,
        help="date of the figures (default: today)",
    )
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmarks and write docs/benchmarks.md or --out; with --list or --pictures only list them or
    draw pictures. --seeds, --hours, --scans, --starts and --openings are passed on by environment variables.

    Returns:
        Exit code: 1 if a benchmark failed, else 0.

    Raises:
        StemmapError: A name is unknown, or a folder does not exist.
    """
    if arguments.list:
        known = runner.descriptions()
        for name, line in known.items():
            print(f"{name:{max(map(len, known))}}  {line}")
        return 0
    if arguments.pictures is not None:
        for file in draw_all(arguments.names, arguments.pictures):
            print(f"{file}: {file.stat().st_size / 1000:.0f} kB", flush=True)
        return 0
    out = arguments.out or ROOT / "docs" / "benchmarks.md"
    day = arguments.date or date.today()
    if arguments.seeds is not None:
        os.environ[VARIABLE] = arguments.seeds
    for name in ("hours", "scans", "starts", "openings"):
        if (value := getattr(arguments, name)) is not None:
            os.environ[f"STEMMAP_BENCH_{name.upper()}"] = str(value)
    failed = runner.run(arguments.names, out=out, json_file=arguments.json, day=day)
    return 1 if failed else 0


def _seeds(text: str) -> str:
    """Return the text if it is a number or a range A-B; raises argparse.ArgumentTypeError otherwise."""
    if not re.fullmatch(r"\d{1,9}(-\d{1,9})?", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of seeds like 1-20")
    return text


def _date(text: str) -> date:
    """Parse a date YYYY-MM-DD; raises argparse.ArgumentTypeError for other texts."""
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a date like 2026-01-31") from None


if __name__ == "__main__":
    sys.exit(main())
