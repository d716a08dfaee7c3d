"""The server of the dashboard as in `stemmap serve`, which reports when it received each scan.

`python -m tests.benchmarks.served.server SOURCE FOLDER [WORKER]` answers each line of JSON on stdin with one
on stdout. WORKER is the module of the mapping process.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import uvicorn

from app.common.child_process import python_module
from app.common.memory import return_freed_memory
from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.parameters import ParameterState
from app.scene.scene import RENEW_AFTER, Scene
from app.web.app import build
from app.web.auth import AccessTokens, new_token
from app.web.serving import bind, uvicorn_config
from app.worker.protocol import FromWorker, Open, Shown
from app.worker.supervisor import OnMessage, WorkerProcess
from tests.benchmarks.child import answers

# Number of the missing messages that are sent before other tasks run.
_AT_ONCE = 1_000
_LEFT = 1_000  # remaining messages before the renewal of the scene
_TICKS = os.sysconf("SC_CLK_TCK")


class Served:
    """A server in this process, and the requests to it."""

    def __init__(self, source: str, folder: Path, worker: str = "app.worker.process") -> None:
        self._worker_command = python_module(worker)
        self._heard: list[tuple[int, float, float]] = []
        settings = Settings(port=0, folder=folder)
        self._listening = bind(settings)
        self._port, self._token = self._listening.getsockname()[1], new_token()
        app = build(
            settings,
            port=self._port,
            tokens=AccessTokens(self._token),
            source=Open(source),
            parameter_state=ParameterState(),
            make_worker=self._worker,
        )
        self._dashboard: Dashboard = app.state.dashboard
        self._server = uvicorn.Server(uvicorn_config(app))

    async def run(self) -> None:
        """Serve until the requests end."""
        return_freed_memory()
        serving = asyncio.create_task(self._server.serve(sockets=[self._listening]))
        with answers() as pipe:
            while line := await asyncio.to_thread(sys.stdin.readline):
                answer = await self._answer(json.loads(line))
                pipe.write(json.dumps(answer) + "\n")
                pipe.flush()
        self._server.should_exit = True
        await serving

    def _worker(self) -> WorkerProcess:
        heard = self._heard

        class ObservedWorker(WorkerProcess):
            async def start(self, on_message: OnMessage) -> None:
                async def receive(message: FromWorker) -> None:
                    if isinstance(message, Shown):
                        heard.append((message.frame.index, time.monotonic(), time.time()))
                    await on_message(message)

                await super().start(receive)

        return ObservedWorker(self._worker_command)

    async def _answer(self, question: dict[str, Any]) -> dict[str, Any]:
        match question["do"]:
            case "link":
                while not self._server.started:
                    await asyncio.sleep(0.01)
                return {"port": self._port, "token": self._token}
            case "heard":
                heard = self._heard.copy()
                self._heard.clear()  # the worker appends to this list
                return {"heard": heard}
            case "cpu":
                return {"web": _cpu_s(os.getpid()), "worker": _cpu_s(self._dashboard.worker.pid)}
            case "pids":
                return {"web": os.getpid(), "worker": self._dashboard.worker.pid}
            case "messages":
                return {"messages": self._scene.messages}
            case "age":
                return {"messages": await self._age()}
        raise ValueError(question)

    @property
    def _scene(self) -> Scene:
        assert isinstance(self._dashboard.scene, Scene)
        return self._dashboard.scene

    async def _age(self) -> int:
        """Send messages to the scene until just before its renewal; return their number."""
        from viser import _messages

        scene = self._scene
        node = scene._server.scene.add_frame("/traffic", visible=False)
        while scene.messages < RENEW_AFTER - _LEFT:
            with scene._server.atomic():
                for k in range(_AT_ONCE):  # as the node itself would send it
                    moved = _messages.SetPositionMessage(node.name, (0.0, 0.0, float(k)))
                    scene._server._websock_server.queue_message(moved)
            await asyncio.sleep(0.0)
        node.remove()
        return scene.messages


def _cpu_s(pid: int | None) -> float:
    """Return the CPU time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


if __name__ == "__main__":
    asyncio.run(Served(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:]).run())
