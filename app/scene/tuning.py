"""From the sliders to the server: newest value wins, and what is refused goes back."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Protocol

import viser

from pipeline.errors import StemmapError

Value = float | int | bool | str


class SceneCommands(Protocol):
    """What the scene asks of the server; all of it runs on the server's loop."""

    async def change_parameters(self, changes: dict[str, Value]) -> None:
        """Change parameters by dotted name.

        Raises:
            ParameterError: The values are refused; nothing changed.
        """

    async def use_preset(self, name: str) -> None:
        """Take all values of a preset."""

    async def reset_parameters(self, names: list[str]) -> None:
        """Bring parameters back to the preset; an empty list means all."""

    async def choose_view(self, name: str, value: str | bool) -> None:
        """Choose what is seen in the scene.

        Raises:
            ParameterError: There is no such choice.
        """

    async def select_tree(self, number: int | None) -> None:
        """Select a tree everywhere; None selects nothing."""

    async def select_cluster(self, scan: int, cluster: int) -> None:
        """Select a cluster of a scan everywhere.

        Raises:
            StemmapError: It is not known any more.
        """


class Tuning:
    """Carries what people do to the commands, one change after the other, on the server's loop.

    Args:
        commands: The server.
        put_back: Shows again what really holds, after a refusal.
    """

    def __init__(self, commands: SceneCommands, put_back: Callable[[], None]) -> None:
        self._commands, self._put_back = commands, put_back
        self._waiting: dict[str, Value] = {}
        self._asker: viser.ClientHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._busy = False

    @property
    def moving(self) -> frozenset[str]:
        """Parameters with a value that the server does not know yet."""
        return frozenset(self._waiting)

    def change(self, name: str, value: Value, client: viser.ClientHandle | None) -> None:
        """Take a value; while the server is busy with one, only the newest of each slider is kept."""
        self._waiting[name] = value
        self._asker = client
        if not self._busy:
            self._busy = True
            self._start(self._send_waiting())

    def ask(self, command: Awaitable[None], client: viser.ClientHandle | None) -> None:
        """Run another command; its refusal is told to the browser that asked."""
        self._start(self._told(command, client))

    def stop(self) -> None:
        """Forget what is under way."""
        for task in self._tasks:
            task.cancel()

    async def _send_waiting(self) -> None:
        try:
            while self._waiting:
                changes, self._waiting = self._waiting, {}
                await self._told(self._commands.change_parameters(changes), self._asker)
        finally:
            self._busy = False

    async def _told(self, command: Awaitable[None], client: viser.ClientHandle | None) -> None:
        try:
            await command
        except StemmapError as error:
            self._put_back()
            if client is not None:
                client.add_notification("Not changed", str(error), color="orange", auto_close_seconds=8.0)

    def _start(self, work: Awaitable[None]) -> None:
        task: asyncio.Task[None] = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
