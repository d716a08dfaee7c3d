"""Process of one benchmark: `python -m tests.benchmarks.child NAME` prints its tables as JSON."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import sys
from typing import TextIO


def answers() -> TextIO:
    """Return the pipe to the parent. From now on, output of libraries to stdout goes to stderr."""
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
