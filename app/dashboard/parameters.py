"""The parameters in force with their undo steps, and the parameter sets that people saved."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from app.store.async_store import AsyncStore
from app.store.records import SavedSet, UnknownError
from pipeline.config import PRESETS, Parameters, field_specs, from_toml, preset, to_toml
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError

Begin = Callable[[str], tuple[str, Parameters]]

DEFAULT_PRESET = "forest"
_SPECS = field_specs()
# A slider that moves sends many values; those that follow one another so fast are one step.
_ONE_GESTURE_S = 1.5
_MOST_STEPS = 200


def preset_alone(name: str) -> tuple[str, Parameters]:
    """A preset as it is."""
    return name, preset(name)


class _Standing(NamedTuple):
    """What holds at one time: it is undone to, and done again."""

    preset: str
    parameters: Parameters


class _Gesture(NamedTuple):
    """What was changed last: which values, by which movement of a hand, and when [s]."""

    names: frozenset[str]
    gesture: str
    at_s: float


_NO_GESTURE = _Gesture(frozenset(), "", 0.0)


class ParameterState:
    """A set of parameters with the preset it came from, and a revision that counts the changes.

    Args:
        begin: Preset name and parameters to begin with, from the preset that suits a source. It is asked
            again for each source until a person changes something.
        clock: Seconds from any start; changes of the same values in quick succession are one step.

    Attributes:
        step: Grows with each change that is a step of its own.
        whole: Whether a change acts on the whole run, which is mapped again then, or from the standing scan
            on.
        check: Called with parameters before they hold; raises a StemmapError for those that cannot.
    """

    def __init__(self, begin: Begin = preset_alone, clock: Callable[[], float] = time.monotonic) -> None:
        self._begin, self._clock = begin, clock
        self.preset, self.parameters = begin(DEFAULT_PRESET)
        self.revision = self.step = 0
        self.whole = True
        self.check: Callable[[Parameters], None] = lambda _: None
        self._chosen = False
        self._undo: list[_Standing] = []
        self._redo: list[_Standing] = []
        self._gesture = _NO_GESTURE

    def change(self, changes: dict[str, Value], gesture: str = "") -> None:
        """Change values by their dotted names.

        Args:
            gesture: Of a slider that is held: all values until it is let go are one step, however long that
                takes. Empty where unknown; then changes in quick succession are one step.

        Raises:
            ParameterError: A name is unknown, a value is out of bounds, or two values contradict;
                then nothing is changed.
        """
        parameters = self.parameters.replace(changes)
        names, now = frozenset(changes), self._clock()
        before = self._gesture
        soon = bool(gesture) or now - before.at_s < _ONE_GESTURE_S
        self._become(self.preset, parameters, (names, gesture) == before[:2] and soon)
        self._gesture = _Gesture(names, gesture, now)

    def use_preset(self, name: str) -> None:
        """Take all values of a preset.

        Raises:
            ParameterError: There is none of this name.
        """
        self._become(name, preset(name))

    def use(self, preset_name: str, parameters: Parameters) -> None:
        """Take all values of a set.

        Args:
            preset_name: That the set differs from.
            parameters: Its values.

        Raises:
            ParameterError: There is no such preset.
        """
        preset(preset_name)
        self._become(preset_name, parameters)

    def undo(self) -> None:
        """Take back the last step, of whoever made it.

        Raises:
            StemmapError: There is none.
        """
        self._go_back(self._undo, self._redo, "there is no change of a parameter to undo")

    def redo(self) -> None:
        """Do again what was undone last.

        Raises:
            StemmapError: Nothing was, or something else was changed since.
        """
        self._go_back(self._redo, self._undo, "there is no change of a parameter to do again")

    def reset(self, names: list[str]) -> None:
        """Give parameters (none named: all) the preset's values again.

        Raises:
            ParameterError: A name is unknown.
        """
        wanted = preset(self.preset).flat()
        unknown = [name for name in names if name not in wanted]
        if unknown:
            raise ParameterError(f"there is no parameter {unknown[0]!r}")
        self._become(self.preset, self.parameters.replace({name: wanted[name] for name in names or wanted}))

    def take(self, preset_name: str, values: dict[str, Value]) -> None:
        """Take all values, as another run had them.

        Raises:
            ParameterError: The preset or a name is unknown, or a value does not fit.
        """
        name = preset_name if preset_name in PRESETS else self.preset
        self._become(name, preset(name).replace(values))

    def suit(self, name: str) -> bool:
        """Take the preset that suits a source, unless a person has chosen. Returns whether anything
        changed."""
        if self._chosen:
            return False
        try:
            preset_name, parameters = self._begin(name)
            self.check(parameters)
        except StemmapError:  # flags that fitted the default need not fit this one
            return False
        if (preset_name, parameters) == (self.preset, self.parameters):
            return False
        self.preset, self.parameters = preset_name, parameters
        self.revision += 1
        return True

    def as_plain(self) -> dict[str, Any]:
        """What changes: what a change acts on, preset, revision, values, the names that differ from the
        preset, and how many steps can be undone and done again."""
        return {
            "whole": self.whole,
            "preset": self.preset,
            "revision": self.revision,
            "undo": len(self._undo),
            "redo": len(self._redo),
            "values": self.parameters.flat(),
            "changed": list(self.parameters.changes_from(preset(self.preset))),
        }

    def as_plain_with_specs(self) -> dict[str, Any]:
        """The same with what never changes: how each parameter is declared, and the presets."""
        presets = [{"name": name, "doc": doc} for name, (doc, _) in PRESETS.items()]
        return {**self.as_plain(), "specs": _SPECS, "presets": presets}

    def _become(self, preset_name: str, parameters: Parameters, goes_on: bool = False) -> None:
        """Let this hold from now on; `goes_on`: as part of the step before."""
        before = _Standing(self.preset, self.parameters)
        self.check(parameters)
        self._gesture = _NO_GESTURE
        self._chosen = True
        self.revision += 1
        if before == (preset_name, parameters):
            return
        if not (goes_on and self._undo):
            self._undo = [*self._undo, before][-_MOST_STEPS:]
            self.step += 1
        self._redo.clear()
        self.preset, self.parameters = preset_name, parameters

    def _go_back(self, steps: list[_Standing], others: list[_Standing], none: str) -> None:
        if not steps:
            raise StemmapError(none)
        self.check(steps[-1].parameters)
        others.append(_Standing(self.preset, self.parameters))
        self.preset, self.parameters = steps.pop()
        self._gesture = _NO_GESTURE
        self.revision += 1
        self.step += 1


# Names have two parts. The TOML reader needs memory that grows with the square of the depth.
_NESTED = re.compile(r"(?:[\w\"'-]{0,40}[ \t]*\.[ \t]*){8}")
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
    if _NESTED.search(text):
        raise ParameterError("the names in the file are nested too deeply", where=where)
    named = _PRESET.match(text.removeprefix("\ufeff"))
    name = named.group(1) if named and named.group(1) in PRESETS else otherwise
    return name, from_toml(text.removeprefix("\ufeff"), preset(name), where)


class ParameterSets:
    """The saved sets of the store.

    Args:
        keeper: Of the store.
        changed: Called when the saved sets have changed.
    """

    def __init__(self, keeper: AsyncStore, changed: Callable[[], None]) -> None:
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
            with contextlib.suppress(
                ParameterError
            ):  # of another version; the error is raised when the set is used
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
