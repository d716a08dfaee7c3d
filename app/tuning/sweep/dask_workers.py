"""Workers of a Dask cluster. A job's JSON goes there; the function that does it is named, not sent."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from app.tuning.sweep.scoring import score_text
from app.tuning.sweep.workers import Done, Lost, Told
from pipeline.errors import ParameterError, StemmapError

SCHEMES = ("tcp://", "tls://")
CONNECT_S = 20.0
_LOOK_S = 0.5  # between two looks at who is there


class DaskWorkers:
    """The workers of a cluster, each with one job at a time; those that join are used from then on.

    Args:
        address: Of the scheduler, tcp://host:port or tls://host:port.
        score: What a worker does with a job, `score_text` by default; every worker must be able to import it.
        connect_s: So long a scheduler may take to answer.

    Raises:
        ParameterError: The address is none, or the extra is not installed.
        StemmapError: Nothing answers there.
    """

    def __init__(
        self, address: str, score: Callable[[bytes], bytes] | None = None, connect_s: float = CONNECT_S
    ) -> None:
        if not address.startswith(SCHEMES):
            raise ParameterError(
                f"{address!r} is no address of a Dask scheduler",
                remedy="Give tcp://host:port or tls://host:port",
            )
        try:
            from distributed import Client
        except ImportError:
            raise ParameterError(
                "--dask needs the package distributed, which is not installed",
                remedy="Install the extra: pip install 'stemmap[dask]', or in a clone `uv sync --extra dask`",
            ) from None
        try:
            self._client: Any = Client(address, timeout=connect_s, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError
            raise StemmapError(
                f"no Dask scheduler answers: {type(error).__name__}",
                where=address,
                remedy="Start it with `dask scheduler`, and workers with `dask worker`",
            ) from None
        self._score = score or score_text
        self._doing: dict[str, Any] = {}

    def free(self) -> list[str]:
        """The workers that have no job of ours."""
        return sorted(self._present() - set(self._doing))

    def give(self, worker: str, job: bytes) -> None:
        """Give it a job, which no other worker may take: what it keeps of a run is kept there."""
        self._doing[worker] = self._client.submit(
            self._score, job, workers=[worker], allow_other_workers=False, pure=False, retries=0
        )

    def told(self, patience_s: float) -> list[Told]:
        """What came meanwhile."""
        until = time.monotonic() + patience_s
        while True:
            events = self._events()
            left = until - time.monotonic()
            if events or left <= 0.0:
                return events
            self._wait(min(left, _LOOK_S))

    def close(self) -> None:
        """Leave the cluster; what our jobs there are doing is given up."""
        for future in self._doing.values():
            future.cancel()
        self._doing.clear()
        self._client.close()

    def _present(self) -> set[str]:
        try:
            return set(self._client.scheduler_info(n_workers=-1)["workers"])
        except (OSError, ValueError) as error:
            raise StemmapError(
                f"the Dask scheduler is gone: {error}", remedy="Start it again, and this too"
            ) from None

    def _wait(self, seconds: float) -> None:
        """Until a job is done, or so long."""
        from distributed import TimeoutError as TooLong
        from distributed import wait

        if not self._doing:
            time.sleep(seconds)
            return
        with contextlib.suppress(TooLong, TimeoutError), self._client.as_current():
            wait(list(self._doing.values()), timeout=seconds, return_when="FIRST_COMPLETED")

    def _events(self) -> list[Told]:
        if self._client.status not in ("running", "connecting"):
            raise StemmapError("the Dask scheduler is gone", remedy="Start it again, and this too")
        present, events = self._present(), []
        for worker, future in list(self._doing.items()):
            event: Told | None = None
            if future.status == "finished":
                event = Done(worker, bytes(future.result()))
            elif future.status in ("error", "cancelled", "lost"):
                event = Lost(worker, _why(future))
            elif worker not in present:
                future.cancel()
                event = Lost(worker, "it left the cluster")
            if event is not None:
                del self._doing[worker]
                future.release()
                events.append(event)
        return events


def _why(future: Any) -> str:  # noqa: ANN401 - a future of the library
    if future.status != "error":
        return str(future.status)
    error = future.exception()
    return f"{type(error).__name__}: {error}"[:300]
