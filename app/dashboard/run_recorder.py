"""Records the open run in the store: figures, map, parameters and their changes; and reads the recorded runs
with the reviews of their trees by the present annotations."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import msgspec
import numpy as np

from app.batch.run_edits import reviews_of
from app.batch.summary import lost_share
from app.dashboard.payload import trees_payload, truth_payload
from app.dashboard.shown_run import ShownRun, in_file, truth_in_file
from app.sources.live_address import is_live
from app.sources.request import SourceRequest
from app.store.async_store import AsyncStore
from app.store.records import Change, Content, NewRun, RunFigures
from app.store.store import Store
from app.worker.protocol import Opened
from pipeline.config.model import Value
from pipeline.errors import StemmapError
from pipeline.io.result_files import OPEN, REJECTED
from pipeline.types.records import Path

_log = logging.getLogger(__name__)

# Pause between two writes of a record, so that a slider or a fast replay costs few transactions.
_PAUSE_S = 5.0
MOST_PATH_POINTS = 3000


@dataclass(slots=True, eq=False)
class _Page:
    """Record of one run.

    Attributes:
        beginning, all_scans: The opened run, and the number of its scans; None if unknown.
        record: Number of the record; None before it is written.
        best: State at the farthest scan that was reached; newest: state that was shown last.
        scores: Scores of `best`; None if there are none.
        dirty: Whether `best` is not written.
        changes: Changes of parameters that are not written.
        recordings: Absolute paths of the files to which the run was recorded.
        logs: Events of a live run, see `RunRecorder.logged`, from the first start of the worker and from each
            restart; the last one grows unless `has_restarted`.
        writer: Task that writes the record.
        ended: Set when the run is left.
        complete: Whether the run came to its end and its result files are not written.
    """

    beginning: NewRun
    all_scans: int | None
    record: int | None = None
    best: ShownRun | None = None
    newest: ShownRun | None = None
    scores: dict[str, Any] | None = None
    dirty: bool = False
    changes: list[Change] = field(default_factory=list)
    recordings: list[str] = field(default_factory=list)
    logs: list[dict[str, Any]] = field(default_factory=list)
    has_restarted: bool = False
    writer: asyncio.Task[None] | None = None
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    complete: bool = False

    @property
    def state(self) -> ShownRun | None:
        """The best state with all recordings; None before the first scan."""
        if self.best is None or not self.recordings:
            return self.best
        return replace(self.best, recordings=tuple(self.recordings))


class RunRecorder:
    """Writes the results of runs to the store, with a delay of some seconds and at their end. Errors of the
    store are logged once. What an error prevents stays pending.

    Args:
        store: Asynchronous access to the store.
    """

    def __init__(self, store: AsyncStore) -> None:
        self._store = store
        self._page: _Page | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._problem = ""

    @property
    def record(self) -> int | None:
        """Number of the record of the open run; None before it is written."""
        return self._page.record if self._page else None

    @property
    def recordings(self) -> tuple[str, ...]:
        """Absolute paths of the files to which the open run was recorded."""
        return tuple(self._page.recordings) if self._page else ()

    def begin(self, run: int | None, source: SourceRequest, opened: Opened, *, again: bool) -> None:
        """Begin the record of an opened run; the one before is written and ended. It appears in the store
        with the first scan.

        Args:
            run: Number of its source in the store; None if the store cannot be used, then nothing is
                recorded.
            source, opened: Requested source and the opened run, whose URI is recorded.
            again: The worker was restarted and opened the same run again; its record continues.
        """
        if again and self._page is not None and self._page.beginning.request.uri == opened.uri:
            self._page.has_restarted = True
            return
        self.leave()
        if run is None:
            return
        name = FilePath(opened.uri.rstrip("/")).name or opened.uri
        if is_live(opened.uri):  # an address names every run of a robot
            name = f"{name}, {time.strftime('%Y-%m-%d %H:%M')}"
        beginning = NewRun(run, name, opened.kind, msgspec.structs.replace(source, uri=opened.uri))
        self._page = _Page(beginning, opened.scans)

    def leave(self) -> None:
        """Write pending changes and the result files in the background and end the record, because the run is
        closed."""
        page, self._page = self._page, None
        if page is not None:
            page.ended.set()
            self._soon(page)

    def shown(self, state: ShownRun, scores: dict[str, Any] | None) -> None:
        """Record a shown scan with the newest scores. The scan with the largest index counts, so that
        stepping back keeps the map; of results of the same scan, the last. Nothing without a record."""
        page = self._page
        if page is None:
            return
        page.newest = state
        if page.best is None or state.shown.frame.index >= page.best.shown.frame.index:
            page.best, page.scores, page.dirty = state, scores, True
            self._soon(page)

    def recorded(self, file: str) -> None:
        """Add the absolute path of a file to which the run is recorded; nothing without a record."""
        page = self._page
        if page is not None and file not in page.recordings:
            page.recordings.append(file)
            page.dirty = True
            self._soon(page)

    def logged(self, log: dict[str, Any]) -> None:
        """Record the events of a live run; nothing without a record or without events.

        Args:
            log: `events` (see `Events.as_plain`), and `start_s`, the time of the first scan [s since 1970].
        """
        page = self._page
        if page is None or not log["events"]:
            return
        if not page.has_restarted:
            del page.logs[-1:]
        page.logs.append(log)
        page.has_restarted, page.dirty = False, True
        self._soon(page)

    def scored(self, scores: dict[str, Any] | None) -> None:
        """Record the score of the scan that was displayed last; ignored for None, and if that scan is not the
        farthest one."""
        page = self._page
        if page is None or page.best is None or page.best is not page.newest or scores is None:
            return
        page.scores, page.dirty = scores, True
        self._soon(page)

    def changed(
        self, before: dict[str, Value], after: dict[str, Value], preset: str, revision: int, who: str
    ) -> None:
        """Record a change of parameters. Ignored before the first scan, or if no value differs.

        Args:
            before, after: Dicts from the dotted name of each parameter to its value.
            preset: Name of the preset.
            revision: Revision after the change.
            who: Name of the person.
        """
        changes = {name: [before[name], value] for name, value in after.items() if before[name] != value}
        page = self._page
        if page is None or page.newest is None or not changes:
            return
        page.changes.append(Change(revision, page.newest.shown.time_s, who, preset, changes))
        self._soon(page)

    def finished(self) -> None:
        """Write what is pending and the result files in the background, because nothing more is mapped; the
        record stays open. Nothing without a record."""
        if self._page is not None:
            self._page.complete = True
            self._soon(self._page)

    async def write_now(self) -> None:
        """Write what is pending of the open run, without its result files; an error of the store is only
        logged. Nothing without a run."""
        if self._page is not None:
            with contextlib.suppress(StemmapError):
                await self._write(self._page)

    async def close(self) -> None:
        """End the record, write pending changes and the result files, and wait until they are stored; what
        the store refuses is lost."""
        self.leave()
        while self._tasks:
            await asyncio.gather(*self._tasks)

    def _soon(self, page: _Page) -> None:
        """Ensure that a background task writes the pending changes of the record: start one unless one is
        running, which also writes the changes that are made meanwhile."""
        if page.writer is None or page.writer.done():
            page.writer = asyncio.create_task(self._write_on(page), name="run_recorder")
            self._tasks.add(page.writer)
            page.writer.add_done_callback(self._tasks.discard)

    async def _write_on(self, page: _Page) -> None:
        """Write the record every 5 s as long as it changes, with the result files when the run is complete,
        and once more, with them, when it is left. What the store refuses is written with the next attempt;
        after the last one it is lost."""
        while page.dirty or page.changes or page.complete or page.ended.is_set():
            is_last, is_complete, page.complete = page.ended.is_set(), page.complete, False
            with contextlib.suppress(StemmapError):  # the error was logged
                await self._write(page)
                if is_last or is_complete:
                    await self._write_files(page)
            if is_last:
                return
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(page.ended.wait(), _PAUSE_S)

    async def _write(self, page: _Page) -> None:
        """Write the best state of a record and the changes of parameters if they are not written, creating
        the record if necessary; raises StemmapError if the store refuses, then they stay pending."""
        state, scores, changes = page.state, page.scores, page.changes
        if state is None or not (page.dirty or changes):
            page.dirty, page.changes = False, []
            return
        page.dirty, page.changes = False, []

        def work(store: Store) -> None:
            figures = _figures_of(state, scores, page.all_scans, page.logs)
            if page.record is None:
                page.record = store.book.begin(page.beginning, figures)
            else:
                store.book.update(page.record, figures)
            if changes:
                store.book.revise_all(page.record, changes)

        try:
            await self._ask(work)
        except StemmapError:
            page.dirty, page.changes = True, changes + page.changes
            raise

    async def _write_files(self, page: _Page) -> None:
        """Write the result files of the best state; nothing without a record. Raises StemmapError if the
        store refuses."""
        state, record = page.state, page.record
        if state is not None and record is not None:
            files = zip_of(await asyncio.to_thread(state.texts))
            await self._ask(lambda store: store.book.put_files(record, files))

    async def _ask(self, work: Callable[[Store], None]) -> None:
        """Run a function of the store; an error is logged, unless it equals the one before, and raised."""
        try:
            await self._store.ask(work)
        except StemmapError as error:
            if str(error) != self._problem:  # log once, not every five seconds
                _log.warning("the run is not recorded: %s", error)
            self._problem = str(error)
            raise
        self._problem = ""


def zip_of(texts: Mapping[str, str]) -> bytes:
    """Return a zip archive of files; equal texts give equal bytes.

    Args:
        texts: Dict from the name of each file to its text.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)
    return content.getvalue()


def _figures_of(
    state: ShownRun, scores: dict[str, Any] | None, all_scans: int | None, logs: list[dict[str, Any]]
) -> RunFigures:
    """Return the results of a state for the store. `map` is a dict with `trees` (see `trees_payload`), `path`
    (see `thinned`) and `truth` (the list of `truth_payload`; None if there is no ground truth), in the
    coordinates of the files, which are those of the map plus `offset`; `recordings` and `warnings`, see
    `ShownRun`; and `logs`.

    Args:
        state, scores: The state, and its scores; None if there are none.
        all_scans: Number of scans of the source; None if unknown.
        logs: See `_Page`.
    """
    shown = state.shown
    trees = trees_payload(in_file(shown.frame.trees, state.one_step), start_ns=state.start_ns)
    truth = truth_payload(truth_in_file(state.truth, state.one_step))
    return RunFigures(
        scans=shown.frame.index + 1,
        all_scans=all_scans,
        time_s=round(shown.time_s, 3),
        distance_m=state.distance_m,
        lost=None if shown.counts is None else lost_share(shown.counts.health),
        trees=len(trees),
        preset=state.preset,
        parameters=state.parameters.flat(),
        scores=scores,
        map={
            "trees": trees,
            "path": thinned(state.path, state.offset),
            "truth": None if truth is None else truth["trees"],
            "offset": list(state.offset[:2]),
            "recordings": list(state.recordings),
            "logs": list(logs),
            "warnings": state.warnings(),
        },
    )


def thinned(path: Path, offset: Sequence[float] = (0.0, 0.0)) -> list[list[float]]:
    """Return at most MOST_PATH_POINTS evenly spaced positions of a path, with both ends, plus an offset [m]
    as a list of [x, y] rounded to 1 mm; [] for an empty path."""
    n = len(path.x)
    rows = np.unique(np.linspace(0, n - 1, min(n, MOST_PATH_POINTS)).round().astype(np.int64))
    place = np.column_stack([path.x[rows], path.y[rows]]) + offset[:2]
    points: list[list[float]] = np.round(place, 3).tolist()
    return points


class ReviewedRuns:
    """Reads the runs of the store. Numbers of rejected trees are kept until the run or the annotations of its
    recording change.

    Args:
        store: Asynchronous access to the store.
    """

    def __init__(self, store: AsyncStore) -> None:
        self._store = store
        self._rejected: dict[int, tuple[tuple[int, int], int]] = {}

    async def listed(self) -> list[dict[str, Any]]:
        """Return the runs as `RunRecords.listed`, each with `annotated`, the number of annotations of its
        recording. `trees` does not count the trees that a person rejected."""
        rows, annotated, versions = await self._store.ask(
            lambda store: (store.book.listed(), store.annotation_counts(), store.annotation_versions())
        )
        contents: dict[str, list[Content]] = {}
        for row in rows:
            row["annotated"] = annotated.get(row["run"], 0)
            if row["annotated"]:
                row["trees"] -= await self._rejected_trees(row, versions[row["run"]], contents)
        self._rejected = {row["id"]: self._rejected[row["id"]] for row in rows if row["id"] in self._rejected}
        return rows

    async def whole(self, number: int) -> dict[str, Any]:
        """Return a run as `RunRecords.whole`. Each tree of its map has its `review`; `trees` does not count
        those that a person rejected, and `rejected` is their number. Raises UnknownError for an unknown
        number."""
        return await self._store.ask(lambda store: _reviewed(store, number))

    async def _rejected_trees(
        self, row: dict[str, Any], version: int, contents: dict[str, list[Content]]
    ) -> int:
        """Return the number of rejected trees of a run.

        Args:
            row: The run.
            version: Version of the annotations of its recording, see `Store.annotation_versions`.
            contents: Dict from recordings to their annotations, which is completed.
        """
        number, state = row["id"], (row["changed_ns"], version)
        if number not in self._rejected or self._rejected[number][0] != state:

            def count(store: Store) -> int:
                source = row["source"]
                if source not in contents:
                    contents[source] = store.contents(source)
                return rejected(_reviews(store.book.map(number), contents[source]))

            self._rejected[number] = state, await self._store.ask(count)
        return self._rejected[number][1]


def rejected(reviews: dict[int, str]) -> int:
    """Return the number of rejected trees in a result of `reviews_of`."""
    return sum(review == REJECTED for review in reviews.values())


def _reviews(stored: dict[str, Any], contents: list[Content]) -> dict[int, str]:
    """Return the result of `reviews_of` for the trees of a stored map, by annotations in its frame."""
    trees = stored["trees"]
    position = np.array([(tree["x"], tree["y"]) for tree in trees], np.float64).reshape(-1, 2)
    offset = stored.get("offset", (0.0, 0.0))  # of the coordinates of the file
    return reviews_of([tree["number"] for tree in trees], position - offset, contents)


def _reviewed(store: Store, number: int) -> dict[str, Any]:
    """Return a run, see `ReviewedRuns.whole`."""
    row = store.book.whole(number)
    trees = row["map"]["trees"]
    reviews = _reviews(row["map"], store.contents(row["source"]))
    for tree in trees:
        tree["review"] = reviews.get(tree["number"], OPEN)
    return {**row, "trees": len(trees) - rejected(reviews), "rejected": rejected(reviews)}
