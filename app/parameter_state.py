"""The parameters in force, as the browsers see and change them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pipeline.errors import ParameterError
from pipeline.parameters import PRESETS, Parameters, field_specs, preset
from pipeline.parameters.model import Value

Begin = Callable[[str], tuple[str, Parameters]]

DEFAULT_PRESET = "forest"
_SPECS = field_specs()


def preset_alone(name: str) -> tuple[str, Parameters]:
    """A preset as it is."""
    return name, preset(name)


class ParameterState:
    """A set of parameters with the preset it came from, and a revision that counts the changes.

    Args:
        begin: Preset name and parameters to begin with, from the preset that suits a source. It is asked
            again for each source until a person changes something.
    """

    def __init__(self, begin: Begin = preset_alone) -> None:
        self._begin = begin
        self.preset, self.parameters = begin(DEFAULT_PRESET)
        self.revision = 0
        self._chosen = False

    def change(self, changes: dict[str, Value]) -> None:
        """Change values by their dotted names.

        Raises:
            ParameterError: A name is unknown, a value is out of bounds, or two values contradict;
                then nothing is changed.
        """
        self._become(self.parameters.replace(changes))

    def use_preset(self, name: str) -> None:
        """Take all values of a preset.

        Raises:
            ParameterError: There is none of this name.
        """
        parameters = preset(name)
        self.preset = name
        self._become(parameters)

    def reset(self, names: list[str]) -> None:
        """Give parameters (none named: all) the preset's values again.

        Raises:
            ParameterError: A name is unknown.
        """
        wanted = preset(self.preset).flat()
        unknown = [name for name in names if name not in wanted]
        if unknown:
            raise ParameterError(f"there is no parameter {unknown[0]!r}")
        self._become(self.parameters.replace({name: wanted[name] for name in names or wanted}))

    def suit(self, name: str) -> bool:
        """Take the preset that suits a source, unless a person has chosen. Returns whether anything
        changed."""
        if self._chosen:
            return False
        try:
            preset_name, parameters = self._begin(name)
        except ParameterError:  # flags that fitted the default need not fit this one
            return False
        if (preset_name, parameters) == (self.preset, self.parameters):
            return False
        self.preset, self.parameters = preset_name, parameters
        self.revision += 1
        return True

    def as_plain(self) -> dict[str, Any]:
        """What changes: preset, revision, values, and the names that differ from the preset."""
        return {
            "preset": self.preset,
            "revision": self.revision,
            "values": self.parameters.flat(),
            "changed": list(self.parameters.changes_from(preset(self.preset))),
        }

    def as_plain_with_specs(self) -> dict[str, Any]:
        """The same with what never changes: how each parameter is declared, and the presets."""
        presets = [{"name": name, "doc": doc} for name, (doc, _) in PRESETS.items()]
        return {**self.as_plain(), "specs": _SPECS, "presets": presets}

    def _become(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.revision += 1
        self._chosen = True
