"""The web process's side of learning from annotations: asks a process of its own, and tells the browsers."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from app.common.child_process import ChildProcess, python_module
from app.common.timers import cancel
from app.store.async_store import AsyncStore
from app.store.store import AnnotatedSource
from app.training.learned_forests import Forests
from pipeline.classification.forest import PACKAGE
from pipeline.config import Parameters
from pipeline.errors import StemmapError

LEARN = python_module("app.training.learn_process")
LONGEST_LINE = 1 << 20
# As in app.training.learning, which the web process does not load.
LEAST_TREES, LEAST_OTHERS = 10, 5
_UNDER_WAY = "decision trees are being grown already"


class Learning:
    """Learns when somebody asks, one thing at a time.

    Args:
        keeper: Of the store.
        folder: The data folder, None where nothing is kept.
        tell: Called with what the browsers are to know.
        command: The process that learns.
    """

    def __init__(
        self,
        keeper: AsyncStore,
        folder: Path | None,
        tell: Callable[[dict[str, Any]], None],
        command: Sequence[str] = LEARN,
    ) -> None:
        self._keeper, self._folder, self._tell, self._command = keeper, folder, tell, command
        self._forests = Forests(folder)
        self._task: asyncio.Task[None] | None = None
        self.state = "idle"
        self.words = ""
        self.learned: dict[str, Any] | None = None

    async def known(self, in_force: str = PACKAGE) -> dict[str, Any]:
        """What there is to learn from: annotations by class, runs, and what is needed; and where the decision
        trees in force come from, None for those of the package.
        """
        in_use = await asyncio.to_thread(self._forests.provenance, in_force)
        sources = await self._keeper.ask(lambda store: store.annotated_sources())
        by_class = Counter(each.kind for source in sources for each in source.annotations)
        needed = {"trees": LEAST_TREES, "others": LEAST_OTHERS}
        return {
            "runs": len(sources),
            "annotations": dict(by_class),
            "needed": needed,
            "in_use": in_use,
            **self.as_plain(),
        }

    async def begin(self, parameters: Parameters) -> None:
        """Grow new decision trees in a process of its own.

        Raises:
            StemmapError: It is under way already, or there is nowhere to keep them.
        """
        if self._task is not None:
            raise StemmapError(_UNDER_WAY)
        if self._folder is None:
            raise StemmapError("there is no data folder for the decision trees")
        sources = await self._keeper.ask(lambda store: store.annotated_sources())
        if self._task is not None:  # somebody else asked meanwhile
            raise StemmapError(_UNDER_WAY)
        self._task = asyncio.create_task(self._learn(sources, parameters, self._folder), name="learning")
        self._become("working", "Beginning")

    async def forget(self) -> None:
        """Stop what is under way, and forget what came of it; its file stays."""
        await self.close()
        self._become("idle", "")

    async def close(self) -> None:
        """End the process."""
        task, self._task = self._task, None
        await cancel(task)

    def as_plain(self) -> dict[str, Any]:
        """For the browsers."""
        return {"state": self.state, "words": self.words, "learned": self.learned}

    def _become(self, state: str, words: str, learned: dict[str, Any] | None = None) -> None:
        self.state, self.words, self.learned = state, words, learned
        self._tell(self.as_plain())

    async def _learn(self, sources: list[AnnotatedSource], parameters: Parameters, folder: Path) -> None:
        question = {
            "sources": sources,
            "classification": parameters.classification.model_dump(),
            "folder": str(folder),
            "date": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
        }
        try:
            told = await self._ask(question)
        except StemmapError:
            told = {}
        self._task = None
        if learned := told.get("learned"):
            self._become("done", "", learned)
        else:
            broke = "the process ended without an answer; nothing was changed"
            self._become("failed", str(told.get("error") or broke))

    async def _ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return the last message of the process; those before are progress."""
        last: dict[str, Any] = {}
        async with await ChildProcess.start(self._command, line_limit=LONGEST_LINE) as process:
            await process.send(question)
            while (message := await process.receive(dict)) is not None:
                last = message
                if "progress" in message:
                    self._become("working", str(message["progress"])[:300])
        return last
