"""The parameters in force with their undo steps, and the parameter sets that people saved."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from app.store.async_store import AsyncStore
from app.store.records import SavedSet, UnknownError
from pipeline.config import OF_ONE_SENSOR, PRESETS, Parameters, field_specs, from_toml, preset, to_toml
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError

Begin = Callable[[str], tuple[str, Parameters]]

DEFAULT_PRESET = "forest"
_SPECS = field_specs()
# A slider that moves sends many values; those that follow one another so fast are one step.
_ONE_GESTURE_S = 1.5
_MOST_STEPS = 200


def preset_alone(name: str) -> tuple[str, Parameters]:
    """Return `name` unchanged and the parameters of this preset, the default of `begin`. Raises
    ParameterError for an unknown preset."""
    return name, preset(name)


class _Standing(NamedTuple):
    """Preset and parameters at one time, for undo and redo."""

    preset: str
    parameters: Parameters


class _Gesture(NamedTuple):
    """The last change: names of the values, identifier of the slider drag, and time [s]."""

    names: frozenset[str]
    gesture: str
    at_s: float


_NO_GESTURE = _Gesture(frozenset(), "", 0.0)


class ParameterState:
    """The parameters in force with their preset, the undo history, and a revision that counts the changes.

    Args:
        begin: Returns preset name and initial parameters for the preset that suits a source. It is called for
            each source while no change of a person is in force.
        clock: Returns the time [s] from any origin; changes of the same values in quick succession are one
            step.

    Attributes:
        preset, parameters: Name of the preset and the values in force.
        revision: Number of actions so far, also of those that set the values that were in force.
        step: Number of new steps, undos and redos so far.
        whole: Whether a change applies to the whole run, which is then mapped again, or from the current scan
            onwards.
        suits: Name of the preset that suits the open source.
        check: Called with parameters before they are used; raises a StemmapError if they cannot be used.
    """

    def __init__(self, begin: Begin = preset_alone, clock: Callable[[], float] = time.monotonic) -> None:
        self._begin, self._clock = begin, clock
        self.preset, self.parameters = begin(DEFAULT_PRESET)
        self.revision = self.step = 0
        self.whole = True
        self.check: Callable[[Parameters], None] = lambda _: None
        self.suits = self.preset
        self._suited = _Standing(self.preset, self.parameters)
        self._source = ""
        self._undo: list[_Standing] = []
        self._redo: list[_Standing] = []
        self._gesture = _NO_GESTURE

    def change(self, changes: dict[str, Value], gesture: str = "") -> None:
        """Change values by dotted name.

        Args:
            changes: Dict from dotted names to new values.
            gesture: Identifier of a slider drag, whose values are one undo step however long it takes. Empty
                if unknown; then changes of the same names within 1.5 s are one step.

        Raises:
            StemmapError: A name is unknown, a value is out of bounds, two values contradict each other, or
                `check` refuses them; nothing changes.
        """
        parameters = self.parameters.replace(changes)
        names, now = frozenset(changes), self._clock()
        before = self._gesture
        soon = bool(gesture) or now - before.at_s < _ONE_GESTURE_S
        self._become(self.preset, parameters, (names, gesture) == before[:2] and soon)
        self._gesture = _Gesture(names, gesture, now)

    def use_preset(self, name: str) -> None:
        """Use all values of a preset, as one undo step.

        Raises:
            StemmapError: There is no preset of this name, or `check` refuses it; nothing changes.
        """
        self._become(name, preset(name))

    def use(self, preset_name: str, parameters: Parameters) -> None:
        """Use all values of a parameter set, as one undo step.

        Args:
            preset_name: Preset with which the set is compared.
            parameters: The values.

        Raises:
            StemmapError: There is no such preset, or `check` refuses the values; nothing changes.
        """
        preset(preset_name)
        self._become(preset_name, parameters)

    def undo(self) -> None:
        """Undo the last step, whoever made it.

        Raises:
            StemmapError: There is no step to undo, or `check` refuses its values; nothing changes.
        """
        self._go_back(self._undo, self._redo, "there is no change of a parameter to undo")

    def redo(self) -> None:
        """Repeat the step that was undone last.

        Raises:
            StemmapError: No step was undone, a parameter was changed since, or `check` refuses the values;
                nothing changes.
        """
        self._go_back(self._redo, self._undo, "there is no change of a parameter to do again")

    def reset(self, names: list[str]) -> None:
        """Reset the named parameters, or all if the list is empty, to the values of the preset, as one undo
        step.

        Raises:
            StemmapError: A name is unknown, or the values contradict others or are refused by `check`;
                nothing changes.
        """
        wanted = preset(self.preset).flat()
        unknown = [name for name in names if name not in wanted]
        if unknown:
            raise ParameterError(f"there is no parameter {unknown[0]!r}")
        self._become(self.preset, self.parameters.replace({name: wanted[name] for name in names or wanted}))

    def take(self, preset_name: str, values: dict[str, Value]) -> None:
        """Use the parameters of another run, as one undo step.

        Args:
            preset_name: Preset of the other run; an unknown or empty name means the preset in force.
            values: Dict from dotted names to the values that differ from the preset.

        Raises:
            StemmapError: A name is unknown, a value is not valid, or `check` refuses them; nothing changes.
        """
        name = preset_name if preset_name in PRESETS else self.preset
        self._become(name, preset(name).replace(values))

    def suit(self, name: str, source: str = "") -> bool:
        """Use the preset that suits a source, unless a person has chosen the values in force or the preset
        cannot be used. Return whether `as_plain` may differ now. It is no undo step; after an undo or a reset
        of all changes nothing counts as chosen. The steps are forgotten if a preset is put in force. For
        another source the undone steps are forgotten, and the steps to undo unless the values in force were
        chosen.

        Args:
            name: The preset.
            source: Identifies the source.
        """
        is_other, self.suits = name != self.suits or source != self._source, name
        is_chosen = self._suited != (self.preset, self.parameters)
        if source != self._source:
            self._source = source
            self._redo.clear()
            if not is_chosen:
                self._undo.clear()
        if is_chosen:
            return is_other
        try:
            preset_name, parameters = self._begin(name)
            self.check(parameters)
        except StemmapError:  # flags that fitted the default need not fit this one
            return is_other
        if (preset_name, parameters) == (self.preset, self.parameters):
            return is_other
        self._suited = _Standing(preset_name, parameters)
        self.preset, self.parameters = self._suited
        self._undo.clear()
        self._redo.clear()
        self.revision += 1
        return True

    def as_plain(self) -> dict[str, Any]:
        """Return the state as a dict: `whole`, `preset`, `unsuited` (the preset that suits the source
        if the one in force is made for another kind of sensor, else ""), `revision`, `undo` and `redo`
        (numbers of steps), `values`, a dict from dotted names to values, and `changed`, a list of the names
        whose values differ from the preset."""
        is_special = not OF_ONE_SENSOR.isdisjoint({self.suits, self.preset})
        return {
            "whole": self.whole,
            "preset": self.preset,
            "unsuited": self.suits if self.suits != self.preset and is_special else "",
            "revision": self.revision,
            "undo": len(self._undo),
            "redo": len(self._redo),
            "values": self.parameters.flat(),
            "changed": list(self.parameters.changes_from(preset(self.preset))),
        }

    def as_plain_with_specs(self) -> dict[str, Any]:
        """Return `as_plain` with two further keys that never change: `specs`, a list of `FieldSpec`, and
        `presets`, a list of dicts with `name` and `doc`."""
        presets = [{"name": name, "doc": doc} for name, (doc, _) in PRESETS.items()]
        return {**self.as_plain(), "specs": _SPECS, "presets": presets}

    def _become(self, preset_name: str, parameters: Parameters, goes_on: bool = False) -> None:
        """Put parameters in force as an undo step, and clear the redo steps. Equal parameters only increase
        the revision. At most 200 steps are kept.

        Args:
            preset_name: Name of their preset, which is not checked.
            parameters: The values.
            goes_on: Whether the change belongs to the step before; then no step is added.

        Raises:
            StemmapError: `check` refuses them; nothing changes.
        """
        before = _Standing(self.preset, self.parameters)
        self.check(parameters)
        self._gesture = _NO_GESTURE
        self.revision += 1
        if before == (preset_name, parameters):
            return
        if not (goes_on and self._undo):
            self._undo = [*self._undo, before][-_MOST_STEPS:]
            self.step += 1
        self._redo.clear()
        self.preset, self.parameters = preset_name, parameters

    def _go_back(self, steps: list[_Standing], others: list[_Standing], none: str) -> None:
        """Put the last of `steps` in force and remove it, and append the present state to `others`. Revision
        and step increase.

        Args:
            steps, others: The undo and redo steps, or the reverse.
            none: Message of the error if `steps` is empty.

        Raises:
            StemmapError: There is no step, or `check` refuses its values; nothing changes.
        """
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
    """Return the text of a TOML file for `--config` with all values. Its first line is the comment "# preset:
    NAME".

    Args:
        preset_name: Name of the preset.
        parameters: The values.
    """
    return f"# preset: {preset_name}\n{to_toml(parameters)}"


def read_file(text: str, where: str, otherwise: str = DEFAULT_PRESET) -> tuple[str, Parameters]:
    """Return the preset and the values of a parameter file; values that it does not contain are those of the
    preset.

    Args:
        text: Contents of the file.
        where: Name of the file in errors.
        otherwise: Preset if the file names none or an unknown one.

    Raises:
        ParameterError: The file or a value is not valid.
    """
    if _NESTED.search(text):
        raise ParameterError("the names in the file are nested too deeply", where=where)
    named = _PRESET.match(text.removeprefix("\ufeff"))
    name = named.group(1) if named and named.group(1) in PRESETS else otherwise
    return name, from_toml(text.removeprefix("\ufeff"), preset(name), where)


class ParameterSets:
    """The parameter sets that people saved.

    Args:
        store: Access to the store.
        changed: Called when the saved sets have changed.
    """

    def __init__(self, store: AsyncStore, changed: Callable[[], None]) -> None:
        self._store, self._changed = store, changed
        self._sets: dict[str, SavedSet] = {}
        self._values: dict[str, tuple[str, Parameters]] = {}

    async def load(self) -> None:
        """Read the saved sets and call `changed`. If the store cannot be used there are none; `save` then
        raises the error. Sets of another version are listed; `named` raises their error."""
        try:
            rows = await self._store.ask(lambda store: store.sets.all())
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
        """Save parameters under a name, replacing a set of that name, and `load` all sets.

        Args:
            name: Name of the set.
            preset_name: Name of their preset.
            parameters: The values.
            who: Name of the person.
            text: Text of the file with further comments, stored unchecked in place of `parameters`; empty for
                `file_of`.

        Raises:
            ParameterError: A preset has this name.
            StemmapError: The set cannot be stored, or there are too many.
        """
        if name in PRESETS:
            raise ParameterError("a preset has this name", where=name, remedy="Choose another")
        text = text or file_of(preset_name, parameters)
        await self._store.ask(lambda store: store.sets.save(name, text, who))
        await self.load()

    async def delete(self, name: str) -> None:
        """Delete the saved set of this name, and `load` the others.

        Raises:
            UnknownError: There is no set of this name.
            StemmapError: The store cannot be used.
        """
        await self._store.ask(lambda store: store.sets.delete(name))
        await self.load()

    def text(self, name: str) -> str:
        """Return the parameter file of a saved set.

        Raises:
            UnknownError: There is no set of this name.
        """
        if name not in self._sets:
            raise UnknownError("there is no saved set of this name", where=name)
        return self._sets[name].toml

    def named(self, name: str) -> tuple[str, Parameters]:
        """Return the preset name and the values of a preset or a saved set; a preset comes first.

        Raises:
            UnknownError: There is neither of this name.
            ParameterError: A saved value is not valid in this version.
        """
        if name in PRESETS:
            return name, preset(name)
        return read_file(self.text(name), name)

    def name_of(self, preset_name: str, parameters: Parameters) -> str:
        """Return the name of the saved set with these values and preset, the first by name of equal ones;
        empty if there is none, or if the values are those of the preset. Sets that are not valid in this
        version are not compared.

        Args:
            preset_name: Name of an existing preset.
            parameters: The values.
        """
        wanted = (preset_name, parameters)
        if parameters == preset(preset_name):
            return ""
        return next((name for name, values in self._values.items() if values == wanted), "")

    def as_plain(self) -> dict[str, Any]:
        """Return {"sets": [...]} for the page, sorted by name, each set with `name`, `who` and `at_s`, the
        time of its last change [s since 1970]."""
        rows = [
            {"name": row.name, "who": row.who, "at_s": row.at_ns // 1_000_000_000}
            for row in self._sets.values()
        ]
        return {"sets": rows}
