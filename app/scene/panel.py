"""The panel of viser: a slider for each of the main parameters, and the commands of the scene to the server.

The tab Tune of the page has all parameters, see `static/js/tune/`. The page moves the sliders of the panel
(`static/js/scene/panel.js`); what is typed into their number boxes arrives here.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import viser

from app.common.user import current_user
from app.scene.viser_server import set_value
from pipeline.config import PRESETS, FieldSpec, Parameters, field_specs, preset
from pipeline.errors import StemmapError

Value = float | int | bool | str
CHANGED = "● "
# In the order of the tab Tune of the page: the filters, which are changed least, come last.
MAIN = tuple(sorted((spec for spec in field_specs() if spec.main), key=lambda spec: spec.stage == "Filters"))

#: Calls a function with arguments on the loop of the server.
LoopCaller = Callable[..., None]


class TunePanel:
    """Sliders, a list of presets and a reset button. Actions of people, not changes by the server, become
    commands.

    Args:
        gui: Panel of viser, at the place of the new widgets.
        parameters, preset_name: Initial values.
        tuning: Sends the commands.
        call_on_loop: Called in the thread of viser to use `tuning` on the loop of the server.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        parameters: Parameters,
        preset_name: str,
        tuning: PanelCommands,
        call_on_loop: LoopCaller,
    ) -> None:
        self._tuning, self._call_on_loop = tuning, call_on_loop
        self._widgets: dict[str, viser.GuiSliderHandle[Any]] = {}
        self._folders: list[viser.GuiFolderHandle] = []
        self._preset = gui.add_dropdown(
            "Preset", tuple(PRESETS), initial_value=preset_name, hint=_preset_hint()
        )
        self._summary = gui.add_markdown("")
        self._reset = gui.add_button("Reset all", color="gray", hint="Reset to the values of the preset.")

        @self._reset.on_click
        async def _(event: viser.GuiEvent[Any]) -> None:
            if (client := event.client) is not None:
                call_on_loop(lambda: tuning.ask(tuning.commands.reset_parameters([]), client))

        @self._preset.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if (client := event.client) is not None:
                name = event.target.value
                call_on_loop(lambda: tuning.ask(tuning.commands.use_preset(name), client))

        values = parameters.flat()
        for stage, specs in itertools.groupby(MAIN, lambda spec: spec.stage):
            folder = gui.add_folder(stage)
            self._folders.append(folder)
            with folder:
                for spec in specs:
                    self._widgets[spec.name] = self._add_widget(gui, spec, values[spec.name])
        gui.add_markdown("All parameters are in the tab *Tune*.")
        self.show(parameters, preset_name, frozenset())

    def show(self, parameters: Parameters, preset_name: str, moving: frozenset[str]) -> None:
        """Set the sliders and widen them to values beyond their declared ends, flag the values that differ
        from the preset, and show the number of all that differ. No callback is called.

        Args:
            parameters, preset_name: Present values and their preset.
            moving: Parameters that a person is moving; their sliders are not set.
        """
        changed = parameters.changes_from(preset(preset_name))
        values = parameters.flat()
        for spec in MAIN:
            widget, value = self._widgets[spec.name], values[spec.name]
            widget.min, widget.max = _range(spec, value)
            if spec.name not in moving:
                set_value(widget, _kind(spec)(value))
            widget.label = _label(spec, spec.name in changed)
        set_value(self._preset, preset_name)
        self._summary.content = _summary(len(changed), preset_name)

    def suit(self, *, drive: bool) -> None:
        """Hide the sliders without a drive, whose parameters they are."""
        for folder in self._folders:
            folder.visible = drive

    def _add_widget(self, gui: viser.GuiApi, spec: FieldSpec, value: Value) -> viser.GuiSliderHandle[Any]:
        """Add the slider of a parameter, whose changes by people are sent, and return it.

        Args:
            gui: Panel of viser.
            spec: Declaration of the parameter.
            value: Initial value.
        """
        kind = _kind(spec)
        low, high = _range(spec, value)
        step = kind(spec.step or 1) if kind is int else (spec.step or 1.0) / 10  # digits of the number box
        hint = f"{spec.doc} ({spec.name})"
        widget = gui.add_slider(_label(spec, changed=False), low, high, step, kind(value), hint=hint)

        @widget.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:  # None: set by the server
                self._call_on_loop(
                    self._tuning.change, spec.name, _meant(spec, event.target.value), event.client
                )

        return widget


def _kind(spec: FieldSpec) -> type[int] | type[float]:
    """Return the type of a numeric parameter: int for the kind "int", else float."""
    return int if spec.kind == "int" else float


def _range(spec: FieldSpec, value: Value) -> tuple[float, float]:
    """Return the lower and upper end of a slider: `spec.shown`, or 0 and 1 if there are none, widened to the
    value if it is beyond them."""
    low, high = spec.shown or (0.0, 1.0)
    kind = _kind(spec)
    return kind(min(low, float(value))), kind(max(high, float(value)))


def _label(spec: FieldSpec, changed: bool) -> str:
    """Return title and unit of a parameter, "TITLE [UNIT]", with CHANGED in front if `changed`."""
    unit = f" [{spec.unit}]" if spec.unit else ""
    return f"{CHANGED if changed else ''}{spec.title}{unit}"


def _meant(spec: FieldSpec, value: Value) -> Value:
    """Return the value of a widget as the value of a parameter: rounded to 9 decimals for the kind "float",
    else unchanged."""
    # A slider of step 0.01 gives 0.15000000000000002 for 0.15.
    return round(float(value), 9) if spec.kind == "float" else value


def _preset_hint() -> str:
    """Return names and descriptions of all presets as text."""
    return " ".join(f"{name}: {doc}." for name, (doc, _) in PRESETS.items())


def _summary(changed: int, preset_name: str) -> str:
    """Return the number of values that differ from the preset as Markdown."""
    if changed == 0:
        return f"As in *{preset_name}*."
    differ = "value differs" if changed == 1 else "values differ"
    return f"**{changed}** {differ} from *{preset_name}* (marked ●)."


class SceneCommands(Protocol):
    """Commands of the scene to the server; they run on the loop of the server."""

    async def change_parameters(self, changes: dict[str, Value]) -> None:
        """Change parameters by dotted name.

        Raises:
            StemmapError: The values are refused and nothing changes.
        """

    async def use_preset(self, name: str) -> None:
        """Use all values of a preset. Raises ParameterError if there is none of this name, and StemmapError
        if its forest cannot be read; nothing changes then."""

    async def reset_parameters(self, names: list[str]) -> None:
        """Reset parameters to the preset; an empty list means all. Raises ParameterError for an unknown name,
        and StemmapError if the values are refused; nothing changes then."""

    async def choose_view(self, name: str, value: str | bool) -> None:
        """Set one choice of the view.

        Args:
            name: Name of a layer, "follow", or a name in colours.CHOICES.
            value: Visibility or following as bool; for CHOICES one of their values.

        Raises:
            ParameterError: There is no such choice, or the value is not one of it.
        """

    async def select_tree(self, number: int | None) -> None:
        """Select a tree in all views; None clears the selection."""

    async def select_cluster(self, scan: int, cluster: int) -> None:
        """Select a cluster of a scan in all views.

        Args:
            scan: Index of the scan.
            cluster: Row of the cluster in it.

        Raises:
            StemmapError: The scan is not stored any more or has no such cluster, or the worker does not
                answer in time.
        """


#: The name of the person and the connection from which a change comes.
_Origin = tuple[str, viser.ClientHandle | None]


class PanelCommands:
    """Sends changes of the panel to the server, one at a time, on the event loop of the server.

    Args:
        commands: Commands to the server.
        put_back: Resets the widgets to the present values after a refusal.
    """

    def __init__(self, commands: SceneCommands, put_back: Callable[[], None]) -> None:
        self.commands, self._put_back = commands, put_back
        self._waiting: dict[str, tuple[Value, _Origin]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._busy = False

    @property
    def moving(self) -> frozenset[str]:
        """Parameters whose newest value is not sent yet."""
        return frozenset(self._waiting)

    def change(self, name: str, value: Value, client: viser.ClientHandle | None) -> None:
        """Send a value; while the server is busy, only the newest value of each parameter waits. A refusal
        resets the widgets and is shown in the browser of `client`.

        Args:
            name: Dotted name of the parameter.
            value: New value.
            client: Browser that made the change; None if unknown.
        """
        self._waiting[name] = (value, (current_user.get(), client))
        if not self._busy:
            self._busy = True
            self._start(self._send_waiting())

    def ask(self, command: Awaitable[None], client: viser.ClientHandle | None) -> None:
        """Run another command in the background. A refusal resets the widgets and is shown in the browser of
        `client`, if it is known."""
        self._start(self._run_command(command, client))

    def stop(self) -> None:
        """Cancel all commands in progress."""
        for task in self._tasks:
            task.cancel()

    async def _send_waiting(self) -> None:
        """Send the waiting values, those of one person and browser in one change, until none waits."""
        try:
            while self._waiting:
                _, origin = next(iter(self._waiting.values()))
                user, client = origin
                changes = {name: value for name, (value, of) in self._waiting.items() if of == origin}
                self._waiting = {k: each for k, each in self._waiting.items() if k not in changes}
                current_user.set(user)  # of this task only
                await self._run_command(self.commands.change_parameters(changes), client)
        finally:
            self._busy = False

    async def _run_command(self, command: Awaitable[None], client: viser.ClientHandle | None) -> None:
        """Await a command. A StemmapError resets the widgets and is shown in the browser of `client`; other
        errors are raised."""
        try:
            await command
        except StemmapError as error:
            self._put_back()
            if client is not None:
                client.add_notification("Not changed", str(error), color="orange", auto_close_seconds=8.0)

    def _start(self, work: Awaitable[None]) -> None:
        """Run a coroutine as a task that `stop` cancels."""
        task: asyncio.Task[None] = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
