"""Another process that makes trials of a search: `python -m app.tuning.worker N PARENT`, the plan as JSON on
stdin.

What it makes stands in the storage that all processes of the search share. It ends when no trial is left, or
when the process that started it is gone.
"""

from __future__ import annotations

import os
import sys

import msgspec

from app.common.parent_watch import is_gone
from app.tuning.plan import Plan
from app.tuning.search import Search, StoppedError
from pipeline.errors import StemmapError

FAILED = 1


def main() -> None:
    """Make trials until none is left."""
    parent = int(sys.argv[2])
    plan = msgspec.json.decode(sys.stdin.buffer.read(), type=Plan)
    code = 0
    try:
        search = Search(plan, worker=int(sys.argv[1]), stop=lambda: is_gone(parent))
        search.begin()
        while search.step() is not None:
            pass
    except StoppedError:
        pass
    except StemmapError as error:
        print(f"stemmap: {error}", file=sys.stderr)  # noqa: T201 - it is what the terminal is told
        code = FAILED
    sys.stderr.flush()
    os._exit(code)  # what it made is kept


if __name__ == "__main__":
    main()
