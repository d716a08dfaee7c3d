"""The processes of a search: further workers for the command line, and the search of the page.

`python -m app.tuning.search_processes worker N` receives a plan and makes trials of it; the storage shares
them. `python -m app.tuning.search_processes page` receives a plan, sends `SearchMessage` records, and stops
at the next message of its parent.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from pathlib import Path

from app.common.child_process import BlockingChildProcess, ParentConnection, python_module, run_child
from app.tuning.plan import JOURNAL_FOLDER, Plan, Trial
from app.tuning.result import SearchMessage, result_of
from app.tuning.search import Search, StoppedError
from app.tuning.storage import OtherSearchError
from pipeline.errors import StemmapError

MODULE = "app.tuning.search_processes"
_STARTS_LIMIT = 4
_GRACE_S = 2.0
_MESSAGE_INTERVAL_S = 0.25


class SearchWorkers:
    """Processes that make trials of the same search.

    Args:
        plan: The search; the processes share its storage.
        number: How many.

    Attributes:
        lost: How many ended too early.
    """

    def __init__(self, plan: Plan, number: int) -> None:
        self._plan = plan
        self.lost = 0
        self._starts = [1] * number
        self._processes = [self._start(k) for k in range(number)]

    @property
    def pids(self) -> list[int]:
        """Process numbers of those that run."""
        return [process.pid for process in self._processes if process.returncode is None]

    def watch(self) -> None:
        """Restart processes that ended too early, a few times at most."""
        for k, process in enumerate(self._processes):
            if process.returncode in (None, 0) or self._starts[k] >= _STARTS_LIMIT:
                continue
            process.end()
            self.lost += 1
            self._starts[k] += 1
            self._processes[k] = self._start(k)

    def close(self) -> None:
        """End them."""
        for process in self._processes:
            process.end(_GRACE_S)

    def _start(self, k: int) -> BlockingChildProcess:
        process = BlockingChildProcess(python_module(MODULE, "worker", str(k + 1)))
        process.send(self._plan)
        return process


def make_trials(parent: ParentConnection, worker: int, stopped: threading.Event) -> None:
    """Make trials until none is left or the parent ends."""
    try:
        search = Search(parent.receive(Plan), worker=worker, stop=stopped.is_set)
        search.begin()
        while search.step() is not None:
            pass
    except StoppedError:
        pass
    except StemmapError as error:
        print(f"stemmap: {error}", file=sys.stderr)  # noqa: T201 - the terminal of the command shows it
        sys.exit(1)


class PageSearch:
    """The search of the page, in a process of its own. Its journal is in a folder that belongs to the parent:
    it stays when the search is stopped, and is deleted when the parent ends."""

    def __init__(self) -> None:
        self._folder = Path()

    def run(self, parent: ParentConnection) -> None:
        """Search and report."""
        plan = parent.receive(Plan)
        self._folder = Path(plan.storage).parent
        try:
            self._search(plan, parent)
        except StoppedError:
            parent.send(SearchMessage())
        except OtherSearchError as error:
            parent.send(
                SearchMessage(error=(f"this search has changed: {error.differs}", "", "Search again"))
            )
        except StemmapError as error:
            parent.send(SearchMessage(error=(error.what, error.where, error.remedy)))
        except MemoryError:
            parent.send(SearchMessage(error=("the search needs more memory than this machine has", "", "")))

    def parent_ended(self) -> None:
        """Delete the journal and end."""
        if self._folder.name.startswith(JOURNAL_FOLDER):
            shutil.rmtree(self._folder, ignore_errors=True)
        os._exit(1)

    def _search(self, plan: Plan, parent: ParentConnection) -> None:
        search = Search(plan, stop=lambda: parent.has_message)
        try:
            parent.send(SearchMessage(start=search.begin(), trials=tuple(search.trials())))
            until = time.monotonic() + plan.seconds if plan.seconds else float("inf")
            self._make_trials(search, parent, until)
            search.stop = lambda: False
            parent.send(SearchMessage(result=result_of(search)))
        finally:
            search.close()

    def _make_trials(self, search: Search, parent: ParentConnection, until: float) -> None:
        news: list[Trial] = []
        sent_s = 0.0
        try:
            while time.monotonic() < until and (trial := search.step()) is not None:
                news.append(trial)
                if time.monotonic() - sent_s > _MESSAGE_INTERVAL_S:
                    sent_s = time.monotonic()
                    parent.send(SearchMessage(trials=tuple(news)))
                    news = []
        except StoppedError:
            pass
        parent.send(SearchMessage(trials=tuple(news)))


def main(arguments: list[str]) -> None:
    """Run one of the two programs."""
    if arguments[0] == "page":
        page = PageSearch()
        run_child(page.run, low_priority=True, on_close=page.parent_ended)
    stopped = threading.Event()
    worker = int(arguments[1])
    run_child(lambda parent: make_trials(parent, worker, stopped), on_close=stopped.set)


if __name__ == "__main__":
    main(sys.argv[1:])
