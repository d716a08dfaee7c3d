"""The search that a dashboard asked for, in a process of its own: `python -m app.tuning.served`.

The plan comes as a line of JSON on stdin; a second line ends the search, and so does the end of stdin, at
once. What is known goes as lines of JSON to stdout: `Said` records. The journal lies in a folder of its own,
which belongs to who asked: it stays when the search was stopped, and goes when who asked is gone.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from pathlib import Path

import msgspec

from app.tuning.plan import Plan
from app.tuning.result import result_of
from app.tuning.said import FOLDER, Said
from app.tuning.search import Search, StoppedError
from app.tuning.storage import OtherSearchError
from app.tuning.trial import Trial
from pipeline.errors import StemmapError

NICE = 10  # the mapping of the standing run comes first
_TELL_EVERY_S = 0.25


class _Child:
    def __init__(self) -> None:
        self._out = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)  # a library may print
        self._stop = threading.Event()
        self._folder = Path()

    def run(self) -> None:
        """Search and tell."""
        if hasattr(os, "nice"):
            os.nice(NICE)
        plan = msgspec.json.decode(sys.stdin.buffer.readline(), type=Plan)
        self._folder = Path(plan.storage).parent
        threading.Thread(target=self._listen, daemon=True).start()
        try:
            self._search(plan)
        except StoppedError:  # before there was a score to begin with
            self._say(Said())
        except OtherSearchError as error:
            self._say(Said(error=(f"this is another search now: {error.differs}", "", "Search again")))
        except StemmapError as error:
            self._say(Said(error=(error.what, error.where, error.remedy)))
        except MemoryError:
            self._say(Said(error=("the search does not fit into the memory of this machine", "", "")))

    def _search(self, plan: Plan) -> None:
        search = Search(plan, stop=self._stop.is_set)
        try:
            start = search.begin()
            self._say(Said(start=start, trials=tuple(search.trials())))
            until = time.monotonic() + plan.seconds if plan.seconds else float("inf")
            self._make(search, until)
            search.stop = lambda: False
            self._say(Said(result=result_of(search)))
        finally:
            search.close()

    def _make(self, search: Search, until: float) -> None:
        news: list[Trial] = []
        told_s = 0.0
        try:
            while time.monotonic() < until and (trial := search.step()) is not None:
                news.append(trial)
                if time.monotonic() - told_s > _TELL_EVERY_S:
                    told_s = time.monotonic()
                    self._say(Said(trials=tuple(news)))
                    news = []
        except StoppedError:
            pass
        self._say(Said(trials=tuple(news)))

    def _listen(self) -> None:
        if sys.stdin.buffer.readline():
            self._stop.set()
            sys.stdin.buffer.readline()
        if self._folder.name.startswith(FOLDER):
            shutil.rmtree(self._folder, ignore_errors=True)
        os._exit(1)  # who asked is gone

    def _say(self, said: Said) -> None:
        self._out.write(msgspec.json.encode(said) + b"\n")
        self._out.flush()


def main() -> None:
    """Search."""
    _Child().run()
    sys.stderr.flush()
    os._exit(0)  # the thread that listens need not be asked


if __name__ == "__main__":
    main()
