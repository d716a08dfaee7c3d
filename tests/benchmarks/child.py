"""A benchmark's own process: `python -m tests.benchmarks.child NAME` prints its tables as JSON."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import sys
from typing import TextIO


def answers() -> TextIO:
    """The pipe to the parent. Libraries that print to stdout reach stderr from now on."""
    pipe = os.fdopen(os.dup(1), "w", encoding="utf-8")
    sys.stdout.flush()
    os.dup2(2, 1)
    return pipe


def main(name: str) -> None:
    """Run the benchmark of this name."""
    with answers() as pipe:
        case = importlib.import_module(f"tests.benchmarks.cases.{name}")
        json.dump([dataclasses.asdict(table) for table in case.run()], pipe)


if __name__ == "__main__":
    main(sys.argv[1])
