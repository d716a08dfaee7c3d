"""Asks the worker about the run that is shown."""

from __future__ import annotations

from collections.abc import Callable

from app.explain.questions import NoStoryError, Questions, Send
from app.explain.records import ClusterStory, TreeStory
from app.worker.camera import CameraPicture
from app.worker.internal_protocol import Answer
from pipeline.config import Parameters
from pipeline.types.records import Frame


class Asking:
    """Questions about the run that is shown.

    Args:
        send: Hands a question to the worker.
        run: Gives the run's number, None while there is none.
    """

    def __init__(self, send: Send, run: Callable[[], int | None]) -> None:
        self._questions, self._run = Questions(send), run

    def take(self, answer: Answer) -> None:
        """Hand an answer to who waits for it."""
        self._questions.take(answer)

    async def cluster(self, scan: int | None, cluster: int) -> ClusterStory:
        """The story of a cluster of a scan that was shown lately; None where none was shown.

        Raises:
            NoStoryError: There is none.
        """
        run = self._shown_run()
        if scan is None:
            raise _nothing()
        return await self._questions.cluster(run, scan, cluster)

    async def tree(self, number: int) -> TreeStory:
        """The story of a tree as it stands.

        Raises:
            NoStoryError: There is none.
        """
        return await self._questions.tree(self._shown_run(), number)

    async def compare(self, sets: list[Parameters]) -> list[Frame]:
        """The standing scan under each of other parameters.

        Raises:
            NoStoryError: There is none.
        """
        return await self._questions.compare(self._shown_run(), [each.model_dump() for each in sets])

    async def camera(self, stamp_ns: int) -> CameraPicture:
        """What the run's camera saw at a time.

        Raises:
            NoStoryError: There is no picture.
        """
        return await self._questions.camera(self._shown_run(), stamp_ns)

    def _shown_run(self) -> int:
        run = self._run()
        if run is None:
            raise _nothing()
        return run


def _nothing() -> NoStoryError:
    return NoStoryError("nothing is mapped yet", remedy="Press play, or open a run")
