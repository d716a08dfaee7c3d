"""Answers to questions about the run; a question never changes the run."""

from __future__ import annotations

import sys
import traceback

from app.explain.history import RecentScans
from app.worker.camera import camera_picture
from app.worker.internal_protocol import Answer, AskCamera, AskCompare, AskTree, Question
from app.worker.session import Session
from app.worker.thin_frame import for_comparison
from pipeline.config.model import validated
from pipeline.errors import StemmapError


class QueryAnswerer:
    """Answers questions from a session.

    Args:
        session: Session of the run.
        recent: Recently sent frames, to which questions refer.
    """

    def __init__(self, session: Session, recent: RecentScans) -> None:
        self._session = session
        self._recent = recent

    def answer(self, question: Question, run: int) -> Answer:
        """Return the answer, or why there is none.

        Args:
            question: Question of any kind.
            run: Number of the open run.
        """
        try:
            if question.run != run:
                raise StemmapError("the run was left")
            return self._answer(question)
        except StemmapError as error:
            return Answer(question.ticket, missing=str(error))
        except Exception as error:  # an answer that fails must not stop the run
            traceback.print_exc(file=sys.stderr)
            fault = f"this is a fault in stemmap: {type(error).__name__}: {error}"
            return Answer(question.ticket, missing=f"{fault}. The terminal shows where")

    def _answer(self, question: Question) -> Answer:
        ticket = question.ticket
        if isinstance(question, AskCompare):
            sets = [validated(values) for values in question.sets]
            return Answer(ticket, frames=[for_comparison(f) for f in self._session.compare(sets)])
        if isinstance(question, AskCamera):
            run = self._session.run
            source = None if run is None else run.source
            return Answer(ticket, camera=camera_picture(source, question.stamp_ns))
        if isinstance(question, AskTree):
            return Answer(ticket, tree=self._session.tree_story(question.tree))
        frame = self._recent.find(question.run, question.scan)
        if frame is None:
            raise StemmapError(
                f"scan {question.scan} was shown too long ago", remedy="Click a cluster of the newest one"
            )
        return Answer(ticket, cluster=self._session.cluster_story(frame, question.cluster))
