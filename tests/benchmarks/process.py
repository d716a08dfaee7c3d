"""Processes of benchmarks, seen from their parent: one thread each, and the source tree on the path."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import StemmapError
from tests.benchmarks.table import Table

Task = TypeVar("Task")
Result = TypeVar("Result")

ROOT = Path(__file__).resolve().parents[2]
LONGEST_S = 172_800.0  # a campaign or a soak of a day on a busy machine
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "LOKY_MAX_CPU_COUNT",
)


#: Name of the variable with the root of another clone that is measured instead of this one, or in comparison
#: with it.
CLONE = "STEMMAP_BENCH_CLONE"


def environment(root: Path = ROOT) -> dict[str, str]:
    """The environment of a child: one thread per library, and the packages of a clone."""
    path = os.pathsep.join(p for p in (str(root), os.environ.get("PYTHONPATH", "")) if p)
    return {**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "PYTHONPATH": path}


def tables_of(name: str) -> list[Table]:
    """Run a benchmark in a process of its own.

    Raises:
        StemmapError: The benchmark failed; its messages are already on stderr.
    """
    words = [sys.executable, "-m", "tests.benchmarks.child", name]
    try:
        done = subprocess.run(
            words, env=environment(), cwd=ROOT, stdout=subprocess.PIPE, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise StemmapError(f"the benchmark took longer than {LONGEST_S:g} s", where=name) from None
    if done.returncode != 0:
        raise StemmapError(f"the benchmark ended with code {done.returncode}", where=name)
    return [Table.from_json(value) for value in json.loads(done.stdout)]


def on_cores(function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[tuple[Task, Result]]:
    """Yield each task with its result in the order in which they end, as many at a time as there are cores
    for this process. The function is one of a module. For benchmarks that do not measure wall time."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=context) as pool:
        running = {pool.submit(function, task): task for task in tasks}
        try:
            for done in as_completed(running):
                yield running[done], done.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)  # those that have not begun
            raise


class Side:
    """One of two processes that are measured in turns; each line of JSON on stdin is answered by one on
    stdout.

    Args:
        module: Name of the program of the process; of another clone, the file of this one.
        words: Words of its command line.
        clone: Clone whose packages it uses.
    """

    def __init__(self, module: str, *words: str, clone: Path = ROOT) -> None:
        self.name = module
        file = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        program = ("-m", module) if clone == ROOT else ("-P", str(file))
        self._process = subprocess.Popen(
            [sys.executable, *program, *words],
            env=environment(clone),
            cwd=clone,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request and wait for the answer.

        Raises:
            StemmapError: The process ended instead.
        """
        sending, receiving = self._process.stdin, self._process.stdout
        if sending is None or receiving is None:
            raise StemmapError("the process has no pipes", where=self.name)
        with contextlib.suppress(BrokenPipeError):
            sending.write(json.dumps(question) + "\n")
            sending.flush()
        line = receiving.readline()
        if not line:
            raise StemmapError(f"the process ended with code {self._process.wait()}", where=self.name)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def end(self) -> None:
        """Close the pipes of the process, and terminate it if it does not end."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def sides(modules: Mapping[str, str], *words: str) -> Iterator[dict[str, Side]]:
    """Start a process for each side, and end all of them also after an exception."""
    started: dict[str, Side] = {}
    try:
        for name, module in modules.items():
            started[name] = Side(module, *words)
        yield started
    finally:
        for side in started.values():
            side.end()
