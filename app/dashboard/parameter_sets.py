"""The sets of parameters that people saved, and their files."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from typing import Any

from app.dashboard.parameter_state import DEFAULT_PRESET
from app.store.async_store import Keeper
from app.store.records import SavedSet, UnknownError
from pipeline.config import PRESETS, Parameters, from_toml, preset, to_toml
from pipeline.errors import ParameterError, StemmapError

_PRESET = re.compile(r"# preset: ([a-z0-9-]{1,40})\s*\n")


def file_of(preset_name: str, parameters: Parameters) -> str:
    """All values as a file that `--config` takes, with the preset that they came from as a remark."""
    return f"# preset: {preset_name}\n{to_toml(parameters)}"


def read_file(text: str, where: str, otherwise: str = DEFAULT_PRESET) -> tuple[str, Parameters]:
    """The preset and the values of a file; what it does not say is as in the preset.

    Args:
        text: Of the file.
        where: Its name, for the error.
        otherwise: The preset where the file names none.

    Raises:
        ParameterError: It is no such file, or a value does not fit.
    """
    named = _PRESET.match(text.removeprefix("\ufeff"))
    name = named.group(1) if named and named.group(1) in PRESETS else otherwise
    return name, from_toml(text.removeprefix("\ufeff"), preset(name), where)


class ParameterSets:
    """The saved sets, as they stand in the store.

    Args:
        keeper: Of the store.
        changed: Called when others stand there.
    """

    def __init__(self, keeper: Keeper, changed: Callable[[], None]) -> None:
        self._keeper, self._changed = keeper, changed
        self._sets: dict[str, SavedSet] = {}
        self._values: dict[str, tuple[str, Parameters]] = {}

    async def load(self) -> None:
        """Read what was saved; a store that cannot be used has none, and says so when asked to save."""
        try:
            rows = await self._keeper.ask(lambda store: store.sets.all())
        except StemmapError:
            rows = []
        self._sets = {row.name: row for row in rows}
        self._values.clear()
        for row in rows:
            with contextlib.suppress(ParameterError):  # of another version; who asks for it is told why
                self._values[row.name] = read_file(row.toml, row.name)
        self._changed()

    async def save(
        self, name: str, preset_name: str, parameters: Parameters, who: str, text: str = ""
    ) -> None:
        """Keep parameters under a name, in place of those that have it.

        Args:
            text: A file of them that says more, to be kept in place of the plain one.

        Raises:
            ParameterError: A preset has this name.
            StemmapError: They cannot be kept.
        """
        if name in PRESETS:
            raise ParameterError("a preset has this name", where=name, remedy="Choose another")
        text = text or file_of(preset_name, parameters)
        await self._keeper.ask(lambda store: store.sets.save(name, text, who))
        await self.load()

    async def delete(self, name: str) -> None:
        """Forget a set.

        Raises:
            UnknownError: There is none of this name.
        """
        await self._keeper.ask(lambda store: store.sets.delete(name))
        await self.load()

    def text(self, name: str) -> str:
        """The file of a set.

        Raises:
            UnknownError: There is none of this name.
        """
        if name not in self._sets:
            raise UnknownError("there is no saved set of this name", where=name)
        return self._sets[name].toml

    def named(self, name: str) -> tuple[str, Parameters]:
        """The preset and the values of a preset or a saved set.

        Raises:
            UnknownError: There is none of this name.
            ParameterError: A saved value does not fit any more.
        """
        if name in PRESETS:
            return name, preset(name)
        return read_file(self.text(name), name)

    def name_of(self, preset_name: str, parameters: Parameters) -> str:
        """The saved set that is these values; empty when none is."""
        wanted = (preset_name, parameters)
        return next((name for name, values in self._values.items() if values == wanted), "")

    def as_plain(self) -> dict[str, Any]:
        """For the browsers."""
        rows = [
            {"name": row.name, "who": row.who, "at_s": row.at_ns // 1_000_000_000}
            for row in self._sets.values()
        ]
        return {"sets": rows}
