"""`stemmap bench`: measures speed and memory of the pipeline and of a comparable one, from the source
tree."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pipeline.errors import StemmapError

HELP = "measure speed and memory, and write docs/benchmarks.md (needs the source tree)"

_ROOT = Path(__file__).resolve().parents[2]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments, which the benchmarks declare (`tests/benchmarks/command.py`).

    Raises:
        StemmapError: This is not the source tree.
    """
    if not (_ROOT / "tests" / "benchmarks" / "command.py").is_file():
        raise StemmapError(
            "the benchmarks are not part of the installed package",
            remedy="Run `uv run stemmap bench` in a clone of the source tree",
        )
    if str(_ROOT) not in sys.path:
        sys.path.insert(0, str(_ROOT))
    from tests.benchmarks import command

    command.configure(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmarks, see `tests.benchmarks.command.run`."""
    from tests.benchmarks import command

    return command.run(arguments)
