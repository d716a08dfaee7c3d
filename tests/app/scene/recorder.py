"""Stands in for the server's commands, and tells what reached viser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from app.scene import Scene
from pipeline.config import Parameters, preset
from pipeline.errors import ParameterError

Value = float | int | bool | str


class Recorder:
    """Commands that remember what they were asked, and validate as the server does."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Any]] = []
        self.parameters: Parameters = preset("forest")
        self.after: Callable[[], None] = lambda: None

    async def change_parameters(self, changes: dict[str, Value]) -> None:
        self.asked.append(("change", changes))
        self.parameters = self.parameters.replace(changes)
        self.after()

    async def use_preset(self, name: str) -> None:
        self.asked.append(("preset", name))

    async def reset_parameters(self, names: list[str]) -> None:
        self.asked.append(("reset", names))

    async def choose_view(self, name: str, value: str | bool) -> None:
        self.asked.append(("view", (name, value)))

    async def select_tree(self, number: int | None) -> None:
        self.asked.append(("select", number))

    async def select_cluster(self, scan: int, cluster: int) -> None:
        self.asked.append(("cluster", (scan, cluster)))


class Refusing(Recorder):
    """Refuses every change."""

    async def change_parameters(self, changes: dict[str, Value]) -> None:
        self.asked.append(("change", changes))
        raise ParameterError("refused for the test")


def buffered(scene: Scene) -> dict[str, Any]:
    """The messages that a browser that comes now would be sent, the newest by node name and kind."""
    buffer = scene._server._websock_server.get_message_buffer()
    return {f"{type(m).__name__} {getattr(m, 'name', '')}": m for m in buffer.message_from_id.values()}
