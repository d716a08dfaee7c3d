"""Runs the store in its own thread, so that the disk never blocks the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pipeline.errors import StemmapError

if TYPE_CHECKING:
    from app.store.store import Store

T = TypeVar("T")

# More than all pages of a dashboard request at once; while the database does not answer, requests must not
# accumulate.
LARGEST_QUEUE = 200


class StoreBusyError(StemmapError):
    """Too many requests wait for the database. The same request may succeed later."""


class AsyncStore:
    """Opens the store with the first request, and runs one request after the other.

    Args:
        folder: Folder of the database; None keeps it in memory.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self._store: Store | None = None
        # One thread runs the requests in their order and never two at once.
        self._thread = ThreadPoolExecutor(1, "store")
        self._waiting = 0

    async def ask(self, function: Callable[[Store], T]) -> T:
        """Return the result of a function, which is called with the store in the thread of the store. Its
        exceptions are raised here, those of the database as StemmapError. If the store cannot be opened, the
        next request tries again.

        Raises:
            StoreBusyError: LARGEST_QUEUE requests wait.
            StemmapError: The store cannot be opened or used.
        """
        if self._waiting >= LARGEST_QUEUE:
            raise StoreBusyError("the database is busy", remedy="Try again in some seconds")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, self._work, function)
        finally:
            self._waiting -= 1

    async def close(self) -> None:
        """Finish the requests that wait, however many they are, and close the database. No request may
        follow.

        Raises:
            StemmapError: The database cannot be closed.
        """
        try:
            await asyncio.shield(asyncio.get_running_loop().run_in_executor(self._thread, self._close))
        finally:
            self._thread.shutdown(wait=False)

    def _close(self) -> None:
        """Close the database if it is open; errors as `_work`."""
        if self._store is not None:
            self._work(lambda store: store.close())

    def _work(self, function: Callable[[Store], T]) -> T:
        """Call a function with the store, which is opened if necessary; errors of the database become
        StemmapErrors."""
        from sqlalchemy.exc import SQLAlchemyError

        from app.store.database import reason_of
        from app.store.store import Store

        if self._store is None:
            self._store = Store(self.folder)
        try:
            return function(self._store)
        except SQLAlchemyError as error:  # a full disk
            raise StemmapError(
                f"the database refused: {reason_of(error)}", remedy="Nothing was changed; try again"
            ) from None
