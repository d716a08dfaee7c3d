"""Messages arrive, limits hold, and a child ends with its parent."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from app.common.child_process import (
    BlockingChildProcess,
    ChildError,
    ChildProcess,
    ProtocolError,
    exit_reason,
    python_module,
)
from pipeline.errors import StemmapError

PROGRAM = (sys.executable, "-m", "tests.app.common.child_program")


async def test_messages_go_to_and_fro_and_prints_do_not_disturb_them():
    child = await ChildProcess.start(PROGRAM)
    for number in (3, 4):
        await child.send(str(number))
        assert await child.receive(int) == 2 * number
    assert await child.end(5.0) == 1


async def test_limits_of_time_length_and_type_hold():
    child = await ChildProcess.start(PROGRAM, line_limit=1000)
    await child.send("1")
    with pytest.raises(ProtocolError, match="protocol error"):
        await child.receive(str)
    await child.send("long")
    with pytest.raises(ProtocolError, match="too long"):
        await child.receive(str)
    await child.end()
    child = await ChildProcess.start(PROGRAM)
    await child.send("sleep")
    with pytest.raises(TimeoutError):
        await child.receive(int, timeout_s=0.2)
    await child.end()
    blocking = BlockingChildProcess(PROGRAM, line_limit=1000)
    blocking.send("long")
    with pytest.raises(ProtocolError, match="too long"):
        blocking.receive(str)
    blocking.end()


async def test_a_child_that_dies_gives_no_message():
    child = await ChildProcess.start(PROGRAM)
    await child.send("die")
    assert await child.receive(int) is None
    await child.send("1")
    assert exit_reason(await child.end()) == "signal 9, SIGKILL"
    blocking = BlockingChildProcess(PROGRAM)
    blocking.send("unknown")
    assert blocking.receive(int) is None
    assert exit_reason(blocking.end(5.0)) == "exit code 1"


def test_a_blocking_child_answers_and_is_killed_when_it_takes_too_long():
    child = BlockingChildProcess(PROGRAM)
    child.send("5")
    assert child.receive(int) == 10
    assert child.returncode is None
    child.send("sleep")
    assert child.receive(int, timeout_s=0.2) is None
    assert child.end() == -signal.SIGKILL


@pytest.mark.skipif(sys.platform != "linux", reason="the limit of the memory is that of Linux")
def test_memory_beyond_the_limit_is_refused():
    child = BlockingChildProcess(PROGRAM)
    child.send("allocate")
    with pytest.raises(ChildError, match="more memory than this machine has"):
        child.receive(str)
    assert child.end(5.0) == 1


def test_the_error_of_a_program_reaches_its_parent():
    child = BlockingChildProcess(PROGRAM)
    child.send("refuse")
    with pytest.raises(ChildError, match=r"it is empty \(a\.mcap\)\. Take another"):
        child.receive(str)
    assert child.end(5.0) == 1


def test_a_child_ends_when_its_parent_is_killed():
    code = (
        "from app.common.child_process import BlockingChildProcess\n"
        f"child = BlockingChildProcess({PROGRAM!r})\n"
        "child.send('pid')\nprint(child.receive(int), flush=True)\nchild.send('sleep')\nchild.receive(int)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert parent.stdout is not None
    assert int(parent.stdout.readline()) > 0
    parent.kill()
    parent.communicate(timeout=20.0)  # the child holds the pipe of errors until it ends


async def test_a_program_that_does_not_exist_is_an_error_for_people():
    with pytest.raises(StemmapError, match="no process can be started"):
        await ChildProcess.start(("/no/such/program",))
    with pytest.raises(StemmapError, match="no process can be started"):
        BlockingChildProcess(("/no/such/program",))


def test_a_file_in_the_working_directory_does_not_replace_the_program(tmp_path: Path):
    (tmp_path / "app.py").write_text("print('replaced')")
    done = subprocess.run(python_module("app.common.text"), cwd=tmp_path, capture_output=True, check=True)
    assert done.stdout == b""
