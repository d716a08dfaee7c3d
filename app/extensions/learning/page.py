"""Training of the classifier with annotations, as the web process sees it: a child process trains, and the
progress is sent to the browsers."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from app.common.child_process import ChildProcess, ProtocolError, python_module
from app.common.timers import cancel
from app.extensions.learning import LEAST_OTHERS, LEAST_TREES
from app.store.async_store import AsyncStore
from app.store.forests import PACKAGE, Forests
from app.store.store import AnnotatedSource
from pipeline.config import Parameters
from pipeline.errors import StemmapError

LEARN = python_module("app.extensions.learning.learning")
LONGEST_LINE = 1 << 20
_UNDER_WAY = "decision trees are being grown already"


class Learning:
    """The newest training; one runs at a time.

    Args:
        store: Access to the store.
        folder: Data folder; None if nothing is stored.
        tell: Called with the state for the browsers whenever it changes.
        command: Program and arguments of the child process.

    Attributes:
        state: "idle", "working", "done" or "failed".
        words: Progress or reason of the failure, as text.
        learned: Result of the training, see `app.extensions.learning.learning.as_plain`; None before.
    """

    def __init__(
        self,
        store: AsyncStore,
        folder: Path | None,
        tell: Callable[[dict[str, Any]], None],
        command: Sequence[str] = LEARN,
    ) -> None:
        self._store, self._folder, self._tell, self._command = store, folder, tell, command
        self._forests = Forests(folder)
        self._task: asyncio.Task[None] | None = None
        self.state = "idle"
        self.words = ""
        self.learned: dict[str, Any] | None = None

    async def known(self, in_force: str = PACKAGE) -> dict[str, Any]:
        """Return what a training can use, as a dict of JSON values.

        The keys are `runs`, the number of annotated runs; `annotations`, a dict from each class to its number
        of annotations; `needed`, a dict with the minimum numbers `trees` and `others`; `in_use`, the
        provenance of the random forest in force (None for that of the package and for an unknown one); and
        those of `as_plain`.

        Args:
            in_force: Name of the forest in force.

        Raises:
            StemmapError: The store cannot be used.
        """
        in_use = await asyncio.to_thread(self._forests.provenance, in_force)
        sources = await self._store.ask(lambda store: store.annotated_sources())
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
        """Start a training with all annotations in the background.

        Args:
            parameters: Parameters in force, with the forest that is compared.

        Raises:
            StemmapError: A training runs already, there is no data folder, or the store cannot be used.
        """
        if self._task is not None:
            raise StemmapError(_UNDER_WAY)
        if self._folder is None:
            raise StemmapError("there is no data folder for the decision trees")
        sources = await self._store.ask(lambda store: store.annotated_sources())
        if self._task is not None:  # another training began meanwhile
            raise StemmapError(_UNDER_WAY)
        self._task = asyncio.create_task(self._learn(sources, parameters, self._folder), name="learning")
        self._become("working", "Beginning")

    async def forget(self) -> None:
        """Stop the training and remove its result; the file of a trained forest stays."""
        await self.close()
        self._become("idle", "")

    async def close(self) -> None:
        """End the child process, if one runs; the state is not changed."""
        task, self._task = self._task, None
        await cancel(task)

    def as_plain(self) -> dict[str, Any]:
        """Return the attributes `state`, `words` and `learned` as a dict."""
        return {"state": self.state, "words": self.words, "learned": self.learned}

    def _become(self, state: str, words: str, learned: dict[str, Any] | None = None) -> None:
        """Set the state and send it to the browsers.

        Args:
            state: "idle", "working", "done" or "failed".
            words: Progress or reason, as text.
            learned: Result; None removes it.
        """
        self.state, self.words, self.learned = state, words, learned
        self._tell(self.as_plain())

    async def _learn(self, sources: list[AnnotatedSource], parameters: Parameters, folder: Path) -> None:
        """Run a training in a child process and set the state to "done" or "failed".

        Args:
            sources: All annotated sources.
            parameters: Parameters in force.
            folder: Data folder, where the forest is stored.
        """
        question = {
            "sources": sources,
            "classification": parameters.classification.model_dump(),
            "folder": str(folder),
        }
        learned, why = None, "the process ended without an answer; nothing was changed"
        try:
            learned = await self._ask(question)
        except ProtocolError:
            pass
        except StemmapError as error:
            why = str(error)
        self._task = None
        if learned:
            self._become("done", "", learned)
        else:
            self._become("failed", why)

    async def _ask(self, question: dict[str, Any]) -> dict[str, Any] | None:
        """Send a question to a new child process and return "learned" of its last message; None if there is
        none. A message with "progress" sets the state "working".

        Raises:
            StemmapError: The process cannot be started, or the training failed.
            ProtocolError: The process sends something else.
        """
        last: dict[str, Any] = {}
        async with await ChildProcess.start(self._command, line_limit=LONGEST_LINE) as process:
            await process.send(question)
            while (message := await process.receive(dict)) is not None:
                last = message
                if "progress" in message:
                    self._become("working", str(message["progress"])[:300])
        return last.get("learned")
