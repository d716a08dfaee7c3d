"""The store in a thread of its own, so that no disk ever holds up the event loop."""

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


class Keeper:
    """Opens the store when it is first asked, and asks it one thing after the other.

    Args:
        folder: Where the database is kept; None keeps it in memory.
        database: Address of a PostgreSQL database in place of the folder.
    """

    def __init__(self, folder: Path | None, database: str = "") -> None:
        self._folder, self._database = folder, database
        self._store: Store | None = None
        # One thread: what is asked for first is done first, and the store is never used twice at once.
        self._thread = ThreadPoolExecutor(1, "store")

    async def ask(self, function: Callable[[Store], T]) -> T:
        """Let something be done to the store in its thread.

        Raises:
            StemmapError: The store cannot be used.
        """
        return await asyncio.get_running_loop().run_in_executor(self._thread, self._work, function)

    async def close(self) -> None:
        """Finish what is under way, and let go of the database."""
        if self._store is not None:
            await self.ask(lambda store: store.close())
        self._thread.shutdown()

    def _work(self, function: Callable[[Store], T]) -> T:
        from sqlalchemy.exc import SQLAlchemyError

        from app.store.database import reason_of
        from app.store.store import Store

        if self._store is None:
            self._store = Store(self._folder, database=self._database)
        try:
            return function(self._store)
        except SQLAlchemyError as error:  # a full disk, a server that went
            raise StemmapError(
                f"the database refused: {reason_of(error)}", remedy="Nothing was changed; try again"
            ) from None
