"""A pool of tasks on the workers of a Dask cluster.

The scheduler, its queue and the repetition of tasks whose worker died are those of `distributed`. Tasks and
results are bytes that this program decodes as JSON or MessagePack.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from app.common.text import code_digest, count
from pipeline.errors import StemmapError

#: How long a scheduler may take to answer, and its first worker to arrive, also after all were lost [s]: the
#: default of Dask for a connection.
_PATIENCE_S = 30.0
#: How often a task that takes long asks whether the cluster still has workers [s].
_POLL_S = 5.0
#: How often a task is repeated after an exception; after the death of a worker the scheduler decides (3).
_RETRIES = 2


class DaskPool:
    """A pool on the workers of a scheduler. It connects when it is used for the first time.

    Args:
        address: Address of the scheduler, such as tcp://host:8786.

    Raises:
        StemmapError: The extra `dask` is not installed.
    """

    def __init__(self, address: str) -> None:
        if find_spec("distributed") is None:
            raise StemmapError(
                "--dask needs the package distributed", remedy="Install it with: uv sync --extra dask"
            )
        self._address = address
        self._client: Any = None
        self._is_closed = False
        self._futures: set[Any] = set()
        self._places: list[str] = []  # address of a worker for each of its threads

    @property
    def count(self) -> int:
        """Number of threads of all workers, when the pool connected."""
        self._connect()
        return len(self._places)

    def call(self, function: Callable[[bytes], bytes], task: bytes, place: int = 0) -> bytes:
        """Return the result of a function for a task, see `app.common.task_pool.TaskPool.call`."""
        client = self._connect()
        try:
            return self._result(client, function, task, self._places[place % len(self._places)])
        except Exception as error:
            raise StemmapError(
                f"a task was lost: {type(error).__name__}: {error}",
                where=self._address,
                remedy="Look at the log of the workers",
            ) from error

    def _result(
        self,
        client: Any,  # noqa: ANN401 - distributed has no types
        function: Callable[[bytes], bytes],
        task: bytes,
        preferred: str,
    ) -> bytes:
        """Return the result of a function for a task, from the preferred worker while it lives.

        Raises:
            TimeoutError: All workers are gone. The scheduler itself would wait without end.
        """

        def submit(**where: Any) -> Any:  # noqa: ANN401
            future = client.submit(function, task, retries=_RETRIES, pure=False, **where)
            self._futures.add(future)
            return future

        is_free = preferred not in client.nthreads()  # of a preference
        future = submit() if is_free else submit(workers=[preferred], allow_other_workers=True)
        seen_s = time.monotonic()  # when the cluster last had a worker
        while True:
            try:
                result: bytes = future.result(_POLL_S)
                self._futures.discard(future)
                return result
            except TimeoutError:
                if future.status == "error":  # the exception of the task itself
                    raise
                if future.done():
                    continue
            workers = client.nthreads()
            if workers:
                seen_s = time.monotonic()
            elif time.monotonic() - seen_s > _PATIENCE_S:
                raise TimeoutError("all workers of the cluster are gone")
            is_assigned = any(future.key in keys for keys in client.processing().values())
            if not is_free and preferred not in workers and not is_assigned:
                # If no other worker was there at that moment, the scheduler never assigns the task again:
                # it looks for tasks that a new worker may take by their preference alone.
                client.cancel([future], reason="the worker is gone")
                self._futures.discard(future)
                future, is_free = submit(), True

    def warnings(self) -> list[str]:
        """Return a warning if workers were lost since the pool connected."""
        if self._client is None:
            return []
        lost = set(self._places) - set(self._client.nthreads())
        return [f"{count(len(lost), 'worker')} of the cluster lost; its tasks were repeated"] if lost else []

    def close(self, function: Callable[[], None]) -> None:
        """Cancel the tasks, call a function once in each worker that can be reached, and leave the
        cluster."""
        client, self._client, self._is_closed = self._client, None, True
        if client is None:
            return
        try:
            client.cancel(list(self._futures), reason="the command ended")
            client.run(function, on_error="ignore")
        except OSError:  # the scheduler is gone
            pass
        finally:
            client.close()

    def _connect(self) -> Any:  # noqa: ANN401 - distributed has no types
        """Return the client, connected.

        Raises:
            StemmapError: No scheduler answers, it has no workers, one of them has another version, or the
                pool is closed.
        """
        if self._client is not None:
            return self._client
        if self._is_closed:
            raise StemmapError("the cluster was left", where=self._address)
        from distributed import Client

        try:
            client = Client(self._address, timeout=_PATIENCE_S, set_as_default=False, name="stemmap")
        except (OSError, ValueError, TypeError) as error:
            raise StemmapError(
                f"no Dask scheduler answers: {error}",
                where=self._address,
                remedy="Start it, with dask scheduler",
            ) from error
        try:
            client.wait_for_workers(1, timeout=_PATIENCE_S)
            self._check_versions(client)
        except BaseException as error:
            client.close()
            if isinstance(error, TimeoutError):
                raise StemmapError(
                    "the scheduler has no workers",
                    where=self._address,
                    remedy="Start some: dask worker ADDRESS",
                ) from error
            raise
        self._places = [place for place, threads in sorted(client.nthreads().items()) for _ in range(threads)]
        self._client = client
        return client

    def _check_versions(self, client: Any) -> None:  # noqa: ANN401
        """Raise StemmapError if a worker has another version of this program, or none: its results would
        differ."""
        for place, answer in sorted(client.run(code_digest, on_error="return").items()):
            if answer != code_digest():
                what = f"has {answer}" if isinstance(answer, str) else f"cannot load it: {answer}"
                raise StemmapError(
                    f"this is stemmap {code_digest()}, and a worker {what}",
                    where=place,
                    remedy="Install the same version there",
                )
