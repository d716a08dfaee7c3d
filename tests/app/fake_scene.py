"""A scene that stands in for the real one; apart from `fakes`, because processes that need no scene start
faster without its libraries."""

from __future__ import annotations

from typing import Any

from app.scene import Scene
from pipeline.config import Parameters
from pipeline.errors import ParameterError
from pipeline.types.records import Frame, TruthTrees


class FakeScene(Scene):
    """Remembers what it was shown."""

    port = 1

    def __init__(self, port: int = 1) -> None:
        self.port = port
        self.secret = "secret"
        self.calls: list[tuple[str, Any]] = []

    def show(self, frame: Frame, path: Any, reflectance: Any = None) -> None:
        del reflectance
        assert path.shape[1] == 4
        self.calls.append(("show", frame.index))

    def show_parameters(self, parameters: Parameters, preset_name: str) -> None:
        assert isinstance(parameters, Parameters)
        self.calls.append(("parameters", preset_name))

    def show_truth(self, trees: TruthTrees | None) -> None:
        self.calls.append(("truth", trees is not None))

    def select(self, tree: int | None, ring: tuple[float, float, float] | None = None) -> None:
        self.calls.append(("select", tree if ring is None else (tree, ring)))

    @property
    def view(self) -> dict[str, Any]:
        return {"follow": True}

    @property
    def counts(self) -> dict[str, int]:
        return {"voxels": 0}

    def choose(self, name: str, value: str | bool) -> None:
        if name == "nothing":
            raise ParameterError("there is no such layer")
        self.calls.append(("choose", (name, value)))

    def suit(self, *, drive: bool) -> None:
        self.calls.append(("suit", drive))

    def clear(self) -> None:
        self.calls.append(("clear", None))

    def close(self) -> None:
        self.calls.append(("close", None))
