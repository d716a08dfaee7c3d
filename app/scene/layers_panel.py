"""The Layers panel: colours, labels, switches and cameras."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from app.scene.view import COLOUR_BY, LABEL_BY, LAYERS, View
from app.scene.widgets import set_value

OnView = Callable[[str, Any], None]
OnCamera = Callable[[str, viser.ClientHandle], None]


def add_layers_panel(gui: viser.GuiApi, view: View, on_view: OnView, on_camera: OnCamera) -> None:
    """Add the panel's widgets to where `gui` stands now.

    Args:
        gui: viser's panel.
        view: What is chosen at first.
        on_view: Called in viser's thread with the name of a choice and its value.
        on_camera: Called in viser's thread with "top" or "behind" and the browser that asked.
    """
    _add_cameras(gui, view, on_view, on_camera)
    with gui.add_folder("Scan"):
        colour_by = gui.add_dropdown(
            "Colour by", COLOUR_BY, initial_value=view.colour_by, hint="What the colour of a cluster says."
        )
        label_by = gui.add_dropdown(
            "Label with", LABEL_BY, initial_value=view.label_by, hint="What stands above each cluster."
        )
    for name, widget in (("colour_by", colour_by), ("label_by", label_by)):
        _report(widget, name, on_view)
    with gui.add_folder("Layers"):
        for layer, title in LAYERS.items():
            _report(gui.add_checkbox(title, view.layers[layer]), layer, on_view)


def _report(widget: viser.GuiInputHandle[Any], name: str, on_view: OnView) -> None:
    @widget.on_update
    async def _(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:  # None: it was set by us
            on_view(name, event.target.value)


def _add_cameras(gui: viser.GuiApi, view: View, on_view: OnView, on_camera: OnCamera) -> None:
    # The same as buttons and as commands with a key, which the page forwards when it has the focus.
    buttons = gui.add_button_group("Camera", ("Top view", "Behind robot"))
    follow = gui.add_checkbox(
        "Follow robot", view.follow, hint="Keep the robot where it is in the picture. Key f"
    )
    _report(follow, "follow", on_view)

    @buttons.on_click
    async def _(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            on_camera("top" if event.target.value == "Top view" else "behind", event.client)

    @gui.add_command("Top view", description="Look down on the robot", hotkey="T").on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if event.client is not None:
            on_camera("top", event.client)

    @gui.add_command("Behind the robot", description="Look from behind", hotkey="B").on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if event.client is not None:
            on_camera("behind", event.client)

    @gui.add_command("Follow the robot", description="Start or stop following", hotkey="F").on_trigger
    async def _(_event: viser.CommandEvent) -> None:
        followed = not follow.value
        set_value(follow, followed)
        on_view("follow", followed)
