"""Record of the open run: what the store refuses is written later."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from app.dashboard import run_recorder
from app.dashboard.run_recorder import RunRecorder
from pipeline.errors import StemmapError


class RefusingStore:
    """A store whose first requests fail."""

    def __init__(self, refusals: int) -> None:
        self.refusals = refusals
        self.written: list[Any] = []
        self.files: list[int] = []

    async def ask(self, function: Any) -> Any:
        if self.refusals:
            self.refusals -= 1
            raise StemmapError("the disk is full")
        return function(SimpleNamespace(book=self))

    def update(self, _record: int, _figures: Any) -> None:
        pass

    def put_files(self, record: int, _files: bytes) -> None:
        self.files.append(record)

    def revise_all(self, _record: int, changes: list[Any]) -> None:
        self.written += changes


def recorder_of(store: RefusingStore) -> RunRecorder:
    """A recorder of an open run that has a record and has shown a scan."""
    recorder = RunRecorder(cast(Any, store))
    page = run_recorder._Page(cast(Any, None), None, record=1)
    page.best = page.newest = cast(Any, SimpleNamespace(shown=SimpleNamespace(time_s=2.0), texts=dict))
    recorder._page = page
    return recorder


@pytest.mark.parametrize("refusals", [0, 1, 2])
def test_parameter_changes_that_the_store_refuses_are_written_later(refusals, monkeypatch):
    monkeypatch.setattr(run_recorder, "_PAUSE_S", 0.0)
    monkeypatch.setattr(run_recorder, "_figures_of", lambda *_: None)
    store = RefusingStore(refusals)

    async def drive() -> None:
        recorder = recorder_of(store)
        for revision in (1, 2):
            recorder.changed({"eps": 0.1}, {"eps": 0.1 + revision}, "forest", revision, "")
            await asyncio.gather(*recorder._tasks)
        await recorder.close()

    asyncio.run(drive())
    assert [change.revision for change in store.written] == [1, 2]


def test_the_result_files_of_a_live_run_are_written_when_it_ends(monkeypatch):
    monkeypatch.setattr(run_recorder, "_PAUSE_S", 0.0)
    store = RefusingStore(0)

    async def drive() -> None:
        recorder = recorder_of(store)
        recorder.finished()
        await asyncio.gather(*recorder._tasks)
        assert store.files == [1]
        await recorder.close()

    asyncio.run(drive())
    assert store.files == [1, 1]  # what people have added since is in the second ones
