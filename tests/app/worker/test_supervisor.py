"""The worker as a process: it answers, it is started again when it dies, and it never outlives us."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from app.worker.protocol import (
    Advance,
    FromWorker,
    Open,
    Opened,
    Play,
    Report,
    SetParameters,
    SetSpeed,
    Shown,
    WorkerBusyError,
)
from app.worker.supervisor import WorkerProcess
from pipeline.config import Parameters

FAKE = (sys.executable, "-m", "tests.app.fake_worker")
FINE = Parameters().model_dump()


class Said:
    """What a worker said, and waiting for it."""

    def __init__(self) -> None:
        self.messages: list[FromWorker] = []
        self._more = asyncio.Condition()

    async def __call__(self, message: FromWorker) -> None:
        async with self._more:
            self.messages.append(message)
            self._more.notify_all()

    async def wait(self, wanted: Callable[[FromWorker], bool]) -> Any:
        """The first message that is wanted; those up to it are forgotten."""
        async with asyncio.timeout(40), self._more:
            while True:
                for k, message in enumerate(self.messages):
                    if wanted(message):
                        del self.messages[: k + 1]
                        return message
                await self._more.wait()

    async def state(self, state: str) -> Any:
        report = await self.wait(lambda m: isinstance(m, Report) and m.status.state == state)
        return report.status

    async def scan(self, index: int) -> Any:
        return await self.wait(lambda m: isinstance(m, Shown) and m.frame.index == index)

    async def opened(self) -> Any:
        return await self.wait(lambda m: isinstance(m, Opened))


@pytest_asyncio.fixture
async def both() -> AsyncIterator[tuple[WorkerProcess, Said]]:
    said = Said()
    worker = WorkerProcess(FAKE)
    await worker.start(said)
    yield worker, said
    await worker.close()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def started() -> AsyncIterator[tuple[WorkerProcess, Said]]:
    said = Said()
    worker = WorkerProcess(FAKE)
    await worker.start(said)
    await said.wait(lambda m: isinstance(m, Report))
    yield worker, said
    await worker.close()


@pytest.fixture
def shared(started: tuple[WorkerProcess, Said]) -> tuple[WorkerProcess, Said]:
    """A worker that other tests used before, and will use; the test leaves it running."""
    worker, said = started
    said.messages.clear()
    worker.restarts = 0
    return worker, said


in_one_loop = pytest.mark.asyncio(loop_scope="module")


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@in_one_loop
async def test_it_opens_and_maps(shared: tuple[WorkerProcess, Said]) -> None:
    worker, said = shared
    await worker.send(SetSpeed(0.0))
    await worker.send(Open("fake:30"))
    assert (await said.opened()).kind == "fake run"
    await worker.send(Advance(8))
    picture = await said.scan(7)
    assert picture.path_start + picture.path.x.size == 8
    await worker.send(Play())
    assert (await said.state("finished")).scan_index == 29


@in_one_loop
@pytest.mark.parametrize("number", [signal.SIGKILL])
async def test_killed_it_is_started_again_with_all_it_must_know(
    shared: tuple[WorkerProcess, Said], number: signal.Signals
) -> None:
    worker, said = shared
    await worker.send(SetParameters(FINE, 9))
    await worker.send(Open("fake:30"))
    await said.opened()
    first = worker.pid
    assert first is not None
    os.kill(first, number)
    assert f"signal {number.value}, {number.name}" in (await said.state("failed")).detail
    assert (await said.opened()).uri == "fake:30"
    assert worker.restarts == 1
    assert worker.pid != first
    assert (await said.state("paused")).revision == 9
    await worker.send(Advance(2))
    await said.scan(1)


@in_one_loop
async def test_a_print_of_a_library_disturbs_nothing(shared: tuple[WorkerProcess, Said]) -> None:
    worker, said = shared
    await worker.send(Open("prints:5"))
    await said.opened()
    await worker.send(Advance(1))
    await said.scan(0)
    assert worker.restarts == 0


@in_one_loop
async def test_a_failed_source_is_a_state_and_not_a_death(shared: tuple[WorkerProcess, Said]) -> None:
    worker, said = shared
    await worker.send(Open("missing:"))
    assert "no such file" in (await said.state("failed")).detail
    await worker.send(Open("fake:5"))
    await said.opened()
    assert worker.restarts == 0


async def test_dying_again_and_again_it_waits_for_a_person() -> None:
    said = Said()
    worker = WorkerProcess((sys.executable, "-c", "raise SystemExit(7)"), clock=lambda: 0.0)
    worker_pauses_shortened(worker)
    await worker.start(said)
    try:
        status = await said.wait(lambda m: isinstance(m, Report) and "5 times" in m.status.detail)
        assert "exit code 7" in status.status.detail
        assert "Press play" in status.status.detail
        stopped_at = worker.restarts
        assert worker.pid is None
        await worker.send(Play())
        await said.state("failed")
        assert worker.restarts == stopped_at + 1
    finally:
        await worker.close()


def worker_pauses_shortened(worker: WorkerProcess) -> None:
    worker._pauses_s = (0.0,) * 5


async def test_a_protocol_error_ends_it() -> None:
    said = Said()
    worker = WorkerProcess((sys.executable, "-c", "print('hello ' * 5, flush=True)"))
    await worker.start(said)
    try:
        assert "protocol error" in (await said.state("failed")).detail
    finally:
        await worker.close()


async def test_a_fault_of_the_listener_does_not_end_the_watch(caplog: pytest.LogCaptureFixture) -> None:
    said = Said()

    async def listener(message: FromWorker) -> None:
        await said(message)
        if isinstance(message, Opened):
            raise KeyError("a fault on purpose")

    worker = WorkerProcess(FAKE)
    await worker.start(listener)
    try:
        await worker.send(Open("fake:5"))
        await said.opened()
        status = await said.state("failed")
        assert "A result could not be shown: KeyError" in status.detail
        await worker.send(Advance(1))
        await said.scan(0)
        assert "a fault on purpose" in caplog.text
    finally:
        await worker.close()


async def test_closing_ends_it_even_when_it_hangs(both: tuple[WorkerProcess, Said]) -> None:
    worker, said = both
    await worker.send(Open("hangs:"))
    await said.state("starting")
    pid = worker.pid
    assert pid is not None
    await worker.close()
    assert not is_running(pid)
    assert worker.pid is None


async def test_a_live_run_has_time_to_finish_its_recording(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("app.worker.supervisor._GRACE_S", 0.1)
    slow = "import sys, time, pathlib; sys.stdin.read(); time.sleep(1); pathlib.Path(sys.argv[1]).touch()"
    worker = WorkerProcess((sys.executable, "-c", slow, str(tmp_path / "finished")))
    await worker.start(Said())
    await worker.send(Open("zenoh:tcp/127.0.0.1:1"))
    await worker.close()
    assert (tmp_path / "finished").exists()


async def test_a_source_that_never_finishes_opening_is_ended_and_reported(
    both: tuple[WorkerProcess, Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    worker, said = both
    await said.wait(lambda m: isinstance(m, Report))  # the process has started, which takes some seconds
    with monkeypatch.context() as short:
        short.setattr(worker, "_opening_limit_s", 0.5)
        await worker.send(Open("hangs:"))
        assert "took longer than 0.5 s" in (await said.state("failed")).detail
    await worker.send(Open("fake:5"))
    await said.opened()
    assert worker.restarts == 0


@in_one_loop
async def test_a_refused_source_is_no_longer_being_opened(
    shared: tuple[WorkerProcess, Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its refusal follows its first status at once, and neither may be lost on the way."""
    worker, said = shared
    pid = worker.pid
    monkeypatch.setattr(worker, "_opening_limit_s", 0.5)
    for _ in range(5):
        await worker.send(Open("missing:"))
        await said.state("failed")
    await asyncio.sleep(1.0)
    assert worker.pid == pid
    assert worker._opening == ""


@pytest.mark.slow
async def test_another_source_replaces_one_that_does_not_finish_opening(
    both: tuple[WorkerProcess, Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.worker.supervisor._REPLACE_AFTER_S", 0.1)
    worker, said = both
    await worker.send(Open("hangs:"))
    await said.wait(lambda m: isinstance(m, Report) and m.status.source == "hangs:")
    await asyncio.sleep(0.2)
    await worker.send(Open("fake:5"))
    assert (await said.opened()).uri == "fake:5"
    assert worker.restarts == 0


@pytest.mark.slow
@in_one_loop
async def test_a_command_while_the_worker_restarts_is_refused_and_not_lost(
    shared: tuple[WorkerProcess, Said],
) -> None:
    worker, said = shared
    await worker.send(Open("fake:5"))
    await said.opened()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    await said.state("failed")
    with pytest.raises(WorkerBusyError):
        await worker.send(Advance(1))
    await worker.send(SetSpeed(2.0))  # remembered
    await said.opened()
    await worker.send(Advance(1))
    await said.scan(0)


async def test_it_does_not_outlive_the_web_process() -> None:
    process = await asyncio.create_subprocess_exec(
        *FAKE, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    assert process.stdin is not None
    process.stdin.close()
    async with asyncio.timeout(20):
        assert await process.wait() == 0


async def test_a_run_that_stops_answering_is_reported_and_replaced() -> None:
    said = Said()
    worker = WorkerProcess(FAKE, silence_limit_s=2.0)
    await worker.start(said)
    try:
        await worker.send(Open("fake:100000"))
        await said.opened()
        await worker.send(Play())
        await said.state("playing")
        first = worker.pid
        assert first is not None
        os.kill(first, signal.SIGSTOP)
        assert "has not answered" in (await said.state("waiting")).detail
        assert "did not answer" in (await said.state("failed")).detail
        await said.opened()
        assert not is_running(first)
        assert worker.restarts == 1
    finally:
        await worker.close()


@pytest.mark.slow
async def test_the_time_without_an_answer_counts_from_the_command_of_an_idle_run() -> None:
    said = Said()
    worker = WorkerProcess(FAKE, silence_limit_s=9.0)  # a sixth of it is reported
    await worker.start(said)
    try:
        await worker.send(Open("fake:100000"))
        await said.opened()
        await said.state("paused")
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGSTOP)
        await worker.send(Play())
        assert (await said.state("waiting")).detail.endswith("has not answered for 2 s")
        os.kill(worker.pid, signal.SIGCONT)
    finally:
        await worker.close()


@pytest.mark.slow
async def test_a_worker_that_gets_no_processor_is_reported_and_not_replaced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said = Said()
    worker = WorkerProcess(FAKE, silence_limit_s=2.0)
    await worker.start(said)
    try:
        await worker.send(Open("fake:100000"))
        await said.opened()
        await worker.send(Play())
        await said.state("playing")
        assert worker.pid is not None
        monkeypatch.setattr("app.worker.supervisor.starved_s", lambda _pid: 0.9 * time.monotonic())
        os.kill(worker.pid, signal.SIGSTOP)
        assert "has not answered" in (await said.state("waiting")).detail
        await asyncio.sleep(3.0)
        assert worker.restarts == 0
        os.kill(worker.pid, signal.SIGCONT)
        await said.state("playing")
    finally:
        await worker.close()


@pytest.mark.slow
async def test_a_command_that_is_not_answered_while_paused_replaces_the_worker() -> None:
    said = Said()
    worker = WorkerProcess(FAKE, silence_limit_s=2.0)
    await worker.start(said)
    try:
        await worker.send(Open("fake:30"))
        await said.opened()
        await said.state("paused")
        first = worker.pid
        assert first is not None
        os.kill(first, signal.SIGSTOP)
        await asyncio.sleep(3.0)
        assert worker.restarts == 0  # no message is due
        await worker.send(Advance(1))
        assert "did not answer" in (await said.state("failed")).detail
        await said.opened()
    finally:
        await worker.close()


@pytest.mark.slow
async def test_a_run_that_is_paused_or_plays_slowly_is_not_replaced() -> None:
    said = Said()
    worker = WorkerProcess(FAKE, silence_limit_s=2.0)
    await worker.start(said)
    try:
        await worker.send(SetSpeed(0.01))
        await worker.send(Open("fake:30"))
        await said.opened()
        await worker.send(Play())
        await said.state("playing")
        await asyncio.sleep(3.0)
        assert worker.restarts == 0
    finally:
        await worker.close()
