"""What the dashboard needs of the scene and of the worker, whatever stands behind them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from app.worker_messages import ToWorker
from pipeline.parameters import Parameters
from pipeline.records import Frame, TruthTrees


class SceneLike(Protocol):
    """What the dashboard needs of `app.scene.Scene`."""

    @property
    def port(self) -> int: ...

    secret: str

    def show(self, frame: Frame, path: NDArray[np.float64], /) -> None: ...
    def show_parameters(self, parameters: Parameters, preset_name: str, /) -> None: ...
    def show_truth(self, trees: TruthTrees | None, /) -> None: ...
    def select(self, tree: int | None, ring: tuple[float, float, float] | None, /) -> None: ...
    def choose(self, name: str, value: str | bool, /) -> None: ...
    @property
    def view(self) -> dict[str, Any]: ...
    def clear(self) -> None: ...
    def close(self) -> None: ...


class WorkerLike(Protocol):
    """What the dashboard needs of `app.worker_process.WorkerProcess`."""

    restarts: int

    @property
    def pid(self) -> int | None: ...

    async def start(self) -> None: ...
    async def send(self, command: ToWorker, /) -> None: ...
    async def close(self) -> None: ...
