"""The parameters in force, as the browsers see and change them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from pipeline.config import PRESETS, Parameters, field_specs, preset
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
                takes. Empty where nobody knows; then those that follow one another fast are one.

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
