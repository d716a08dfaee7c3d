"""Maps many runs: one task for each run, which is a process of `stemmap map`, and their table.

A task is a pure function of the words of the command line, and so of source, parameters and seed. Its result
has the files of the run, so that processes on other machines need no common folder for them.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from app.batch.run_folder import check_folder
from app.common.child_process import (
    BlockingChildProcess,
    ChildError,
    ParentConnection,
    exit_reason,
    python_module,
    run_child,
)
from app.common.task_pool import TaskPool
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import UNFINISHED, write_texts
from pipeline.io.result_files import OF_EARLIER_MAP

TABLE = "runs.csv"
_COLUMNS = ("run", "exit_code", "trees", "scans", "distance_m", "message")
#: First words of the messages about a run. Other lines, such as the progress of a compilation, depend on the
#: machine and are left out.
_ABOUT_RUN = ("warning: ", "left out: ", "stemmap: ")
_CANNOT_RUN = 1  # exit code of a run whose process was lost


class MappedFiles(msgspec.Struct, frozen=True):
    """Result of a task.

    Attributes:
        code: Exit code of `stemmap map`.
        messages: Lines that it printed to standard error about the run.
        files: Dict from the names of its files, relative to the folder of the run, to their bytes.
    """

    code: int
    messages: list[str]
    files: dict[str, bytes]


class _Outcome(msgspec.Struct, frozen=True):
    """What the process of a run sends."""

    code: int
    messages: str


_running: set[BlockingChildProcess] = set()  # the processes of the tasks of this process
_lock = threading.Lock()


def map_files(task: bytes) -> bytes:
    """Map a run in a process of its own and return `MappedFiles` in MessagePack.

    Args:
        task: JSON array of the words of `stemmap map` without `--out`.

    Raises:
        StemmapError: The process cannot be started, or was lost.
    """
    words = msgspec.json.decode(task, type=list[str])
    with TemporaryDirectory(prefix="stemmap-") as parent:
        folder = Path(parent) / "run"
        child = BlockingChildProcess(python_module(__name__), one_thread=True)
        with _lock:
            _running.add(child)
        try:
            child.send([*words, f"--out={folder}"])
            outcome = child.receive(_Outcome)
            if outcome is None:
                raise StemmapError(f"the process of the run was lost: {exit_reason(child.end(1.0))}")
        except ChildError as error:
            outcome = _Outcome(_CANNOT_RUN, str(error))
        finally:
            with _lock:
                _running.discard(child)
            child.end()
        found = sorted(path for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else []
        return msgspec.msgpack.encode(
            MappedFiles(
                outcome.code,
                [line for line in outcome.messages.splitlines() if line.startswith(_ABOUT_RUN)],
                {path.relative_to(folder).as_posix(): path.read_bytes() for path in found},
            )
        )


def end_processes() -> None:
    """End the processes of the tasks of this process; their results are lost."""
    with _lock:
        for child in _running:
            child.end()


class LocalPool:
    """A pool of processes on this machine, one for each task in progress.

    Args:
        count: Number of tasks that are computed at the same time.
    """

    def __init__(self, count: int) -> None:
        self.count = count

    def call(self, function: Callable[[bytes], bytes], task: bytes, place: int = 0) -> bytes:
        """Return the result of the function, which starts a process."""
        del place
        return function(task)

    def warnings(self) -> list[str]:
        """Return no warnings."""
        return []

    def close(self, function: Callable[[], None]) -> None:
        """Call the function."""
        function()


def map_runs(
    tasks: dict[str, list[str]],
    out: Path,
    pool: TaskPool,
    done: Callable[[str, MappedFiles], None],
    *,
    force: bool,
) -> list[int]:
    """Map runs, write the files of each to a folder of its name and a table of all, and return the exit codes
    in the order of the tasks. The table is written again after each run.

    Args:
        tasks: Dict from the name of a run to the words of `stemmap map` without `--out`.
        out: Folder of the folders; it is created.
        pool: Where the tasks are computed.
        done: Called with the name and the result of each run that ended, also of one that failed.
        force: Whether the map of another source in a folder is replaced.

    Raises:
        OSError, StemmapError: A file cannot be written.
    """
    rows: dict[str, tuple[object, ...]] = {}  # without the files, which would fill the memory

    def mapped(place: int, words: Sequence[str]) -> MappedFiles:
        try:
            answer = pool.call(map_files, msgspec.json.encode(words), place)
        except StemmapError as error:
            return MappedFiles(_CANNOT_RUN, [f"stemmap: {error}"], {})
        return msgspec.msgpack.decode(answer, type=MappedFiles)

    codes, places = dict[str, int](), pool.count
    out.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(places, "runs") as threads:
        futures = {
            threads.submit(mapped, k % places, words): name for k, (name, words) in enumerate(tasks.items())
        }
        try:
            for future in as_completed(futures):
                name = futures.pop(future)
                result = _written(out / name, future.result(), force=force)
                codes[name], rows[name] = result.code, _row(name, result)
                write_texts(out, {TABLE: _table(rows[each] for each in tasks if each in rows)})
                done(name, result)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            pool.close(end_processes)
            raise
    return [codes[name] for name in tasks]


def _written(folder: Path, result: MappedFiles, *, force: bool) -> MappedFiles:
    """Write the files of a run to its folder, run.json last, and remove those of an earlier map that are
    missing now; other files stay. Return the result, or that of a failure if the folder has the map of
    another source. Raises OSError."""
    if not result.files:
        return result
    try:
        check_folder(folder, json.loads(result.files["run.json"])["source"]["sha256"], force=force)
    except (StemmapError, KeyError, ValueError) as error:
        return MappedFiles(_CANNOT_RUN, [*result.messages, f"stemmap: {error}"], {})
    folder.mkdir(exist_ok=True)
    for name in (*OF_EARLIER_MAP, "state.zip"):
        if name not in result.files:
            (folder / name).unlink(missing_ok=True)
    with TemporaryDirectory(prefix=UNFINISHED, dir=folder) as parent:
        for name in sorted(result.files, key="run.json".__eq__):  # last: if it exists, so do the others
            partial, file = Path(parent) / "file", folder / name
            partial.write_bytes(result.files[name])
            file.parent.mkdir(parents=True, exist_ok=True)
            partial.replace(file)
    return result


def _row(name: str, result: MappedFiles) -> tuple[object, ...]:
    """Return the row of a run in the table; figures of a run without files are empty."""
    record = json.loads(result.files.get("run.json", b"{}"))
    figures = [record.get(key, "") for key in ("trees", "scans", "distance_m")]
    return (name, result.code, *figures, result.messages[0] if result.messages else "")


def _table(rows: Iterable[tuple[object, ...]]) -> str:
    """Return the table of the runs as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_COLUMNS, *rows])
    return text.getvalue()


def _map(parent: ParentConnection) -> None:
    """Run the program of the process of a run: receive the words, map, and send the outcome."""
    from app.cli import main

    words = parent.receive(list[str])
    printed = io.StringIO()
    with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(io.StringIO()):
        code = main(["map", *words])
    parent.send(_Outcome(code, printed.getvalue()))


if __name__ == "__main__":
    run_child(_map)
