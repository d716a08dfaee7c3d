"""Answers kept on disk by all that they hang on, so that what was computed once is not computed again."""

from __future__ import annotations

from pathlib import Path

import msgspec

from app.tuning.sweep.checking import is_answer
from app.tuning.sweep.jobs import Answer
from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside

_LARGEST_FILE = 1 << 20


class KeptAnswers:
    """A folder with a file an answer; None keeps nothing.

    Attributes:
        damaged: How many files could not be read; their answers are computed again.
        refusal: Why nothing is written any more; empty while it is.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self.damaged = 0
        self.refusal = ""

    def get(self, key: str) -> Answer | None:
        """The answer of a job with this key, None where it is not known."""
        file = self._file(key)
        if file is None:
            return None
        try:
            if file.stat().st_size <= _LARGEST_FILE:
                answer = msgspec.json.decode(file.read_bytes(), type=Answer)
                if answer.scores is not None and is_answer(answer):
                    return answer
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError):
            pass
        self.damaged += 1
        return None

    def put(self, key: str, answer: Answer) -> None:
        """Keep an answer that has scores; a failure may be another one next time. Where the disk refuses,
        `refusal` says so, and nothing more is tried."""
        file = self._file(key)
        if file is None or answer.scores is None or self.refusal:
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with write_beside(file) as partial:
                partial.write_bytes(msgspec.json.encode(answer))
        except (OSError, StemmapError) as error:
            why = getattr(error, "strerror", None) or str(error)
            self.refusal = f"results are not kept for another time: {why}"

    def _file(self, key: str) -> Path | None:
        return None if self._folder is None else self._folder / key[:2] / f"{key}.json"
