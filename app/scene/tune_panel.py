"""The Tune panel: a slider for every parameter, made from the one declaration of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from app.scene.widgets import set_value
from pipeline.config import PRESETS, FieldSpec, Parameters, field_specs, preset

Value = float | int | bool | str
CHANGED = "● "

OnChange = Callable[[str, Value, viser.ClientHandle], None]
OnPreset = Callable[[str, viser.ClientHandle], None]
OnReset = Callable[[list[str], viser.ClientHandle], None]


class TunePanel:
    """Sliders, a preset list and reset buttons. All callbacks run in viser's thread.

    Args:
        gui: viser's panel, standing where the widgets are to be added.
        parameters, preset_name: What holds at first.
        on_change, on_preset, on_reset: Told what a person did; nothing that was set from code.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        parameters: Parameters,
        preset_name: str,
        on_change: OnChange,
        on_preset: OnPreset,
        on_reset: OnReset,
    ) -> None:
        self._on_change, self._on_reset = on_change, on_reset
        self._widgets: dict[str, viser.GuiInputHandle[Any]] = {}
        self._folders: dict[str, viser.GuiFolderHandle] = {}
        self._preset = gui.add_dropdown(
            "Preset", tuple(PRESETS), initial_value=preset_name, hint=_preset_hint()
        )
        self._summary = gui.add_markdown("")
        self._add_reset(gui, "Reset all", [])

        @self._preset.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                on_preset(event.target.value, event.client)

        values = parameters.flat()
        stages: dict[str, list[FieldSpec]] = {}
        for spec in field_specs():
            stages.setdefault(spec.stage, []).append(spec)
        for stage, specs in stages.items():
            self._add_stage(gui, stage, specs, values)
        self.show(parameters, preset_name, frozenset())

    def show(self, parameters: Parameters, preset_name: str, moving: frozenset[str]) -> None:
        """Set the sliders from code, and mark what differs from the preset.

        Args:
            parameters, preset_name: What holds now.
            moving: Parameters a person is moving right now; their sliders are left alone.
        """
        changed = parameters.changes_from(preset(preset_name))
        values = parameters.flat()
        for spec in field_specs():
            widget = self._widgets[spec.name]
            if spec.name not in moving:
                set_value(widget, _shown(spec, values[spec.name]))
            widget.label = _label(spec, spec.name in changed)
        for stage, folder in self._folders.items():
            count = sum(spec.stage == stage and spec.name in changed for spec in field_specs())
            folder.label = f"{CHANGED}{stage} ({count} changed)" if count else stage
        set_value(self._preset, preset_name)
        self._summary.content = _summary(len(changed), preset_name)

    def widget(self, name: str) -> viser.GuiInputHandle[Any]:
        """The widget of a parameter, by its dotted name."""
        return self._widgets[name]

    def _add_stage(
        self, gui: viser.GuiApi, stage: str, specs: list[FieldSpec], values: dict[str, Value]
    ) -> None:
        self._folders[stage] = gui.add_folder(stage, expand_by_default=stage in ("Clustering", "Detection"))
        with self._folders[stage]:
            for spec in specs:
                self._widgets[spec.name] = self._add_widget(gui, spec, values[spec.name])
            self._add_reset(gui, f"Reset {stage.lower()}", [spec.name for spec in specs])

    def _add_widget(self, gui: viser.GuiApi, spec: FieldSpec, value: Value) -> viser.GuiInputHandle[Any]:
        widget = make_widget(gui, spec, value)

        @widget.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:  # None: it was set by us
                self._on_change(spec.name, _meant(spec, event.target.value), event.client)

        return widget

    def _add_reset(self, gui: viser.GuiApi, title: str, names: list[str]) -> None:
        button = gui.add_button(title, color="gray", hint="Back to the values of the preset.")

        @button.on_click
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._on_reset(names, event.client)


def make_widget(gui: viser.GuiApi, spec: FieldSpec, value: Value) -> viser.GuiInputHandle[Any]:
    """A slider with a number box, a list or a switch, as the parameter's kind asks."""
    label = _label(spec, changed=False)
    if spec.kind == "bool":
        return gui.add_checkbox(label, bool(value), hint=spec.doc)
    if spec.kind == "choice":
        return gui.add_dropdown(label, spec.choices, initial_value=str(value), hint=spec.doc)
    if spec.kind == "name":
        # Chosen on the page: here each letter that is typed would be a change.
        return gui.add_text(label, str(value), disabled=True, hint=spec.doc)
    kind = int if spec.kind == "int" else float
    low, high, step = (kind(bound or 0) for bound in (spec.minimum, spec.maximum, spec.step))
    return gui.add_slider(label, low, high, step, kind(value), hint=f"{spec.doc} ({spec.name})")


def _label(spec: FieldSpec, changed: bool) -> str:
    unit = f" [{spec.unit}]" if spec.unit else ""
    return f"{CHANGED if changed else ''}{spec.title}{unit}"


def _shown(spec: FieldSpec, value: Value) -> Value:
    return float(value) if spec.kind == "float" else value


def _meant(spec: FieldSpec, value: Value) -> Value:
    # A slider of step 0.01 gives 0.15000000000000002; the person meant 0.15.
    return round(float(value), 9) if spec.kind == "float" else value


def _preset_hint() -> str:
    return " ".join(f"{name}: {doc}." for name, (doc, _) in PRESETS.items())


def _summary(changed: int, preset_name: str) -> str:
    if changed == 0:
        return f"As in *{preset_name}*."
    differ = "value differs" if changed == 1 else "values differ"
    return f"**{changed}** {differ} from *{preset_name}* (marked ●)."
