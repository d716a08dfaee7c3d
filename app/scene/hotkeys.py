"""Commands with a key, which work while the scene has the focus; the page forwards the same keys."""

from __future__ import annotations

from collections.abc import Callable

import viser

OnCamera = Callable[[str, viser.ClientHandle], None]


def add_hotkeys(gui: viser.GuiApi, on_camera: OnCamera, on_follow: Callable[[], None]) -> None:
    """Add the commands.

    Args:
        gui: viser's panel.
        on_camera: Called in viser's thread with "top" or "behind" and the browser that asked.
        on_follow: Called in viser's thread when following is to start or stop.
    """

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
        on_follow()
