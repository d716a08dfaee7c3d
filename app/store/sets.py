"""Sets of parameters that were saved under a name, for all runs."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Engine, delete, func, insert, select

from app.store.records import MOST_SETS, SavedSet, UnknownError
from app.store.tables import parameter_sets as table
from pipeline.errors import StemmapError


class Sets:
    """Reads and writes the saved sets.

    Args:
        engine: On the database.
        clock: Nanoseconds since 1970.
    """

    def __init__(self, engine: Engine, clock: Callable[[], int]) -> None:
        self._engine, self._clock = engine, clock

    def all(self) -> list[SavedSet]:
        """Every set, by name."""
        with self._engine.begin() as connection:
            rows = connection.execute(select(table).order_by(table.c.name)).all()
        return [SavedSet(row.name, row.toml, row.who, row.at_ns) for row in rows]

    def save(self, name: str, toml: str, who: str) -> None:
        """Keep a set under a name; one that has the name already makes room for it.

        Raises:
            StemmapError: There would be too many.
        """
        with self._engine.begin() as connection:
            connection.execute(delete(table).where(table.c.name == name))
            if connection.execute(select(func.count()).select_from(table)).scalar_one() >= MOST_SETS:
                raise StemmapError(f"there are {MOST_SETS} saved sets already", remedy="Delete some first")
            values = {"name": name, "toml": toml, "who": who, "at_ns": self._clock()}
            connection.execute(insert(table).values(**values))

    def delete(self, name: str) -> None:
        """Forget a set.

        Raises:
            UnknownError: There is none of this name.
        """
        with self._engine.begin() as connection:
            if connection.execute(delete(table).where(table.c.name == name)).rowcount == 0:
                raise UnknownError("there is no saved set of this name", where=name)
