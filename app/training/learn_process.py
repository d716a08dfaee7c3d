"""The process that learns from annotations: `python -m app.training.learn_process`.

One question comes as JSON on stdin; lines of JSON go to stdout: `progress` in words, and at the end
`learned` or `error`. Recordings are read and trees are grown here, and not in the server; when that is gone,
nobody waits for them.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import msgspec

from app.common.parent_watch import end_with
from app.store.store import AnnotatedSource
from app.training.annotated_runs import annotated_run
from app.training.learned_forests import Forests
from app.training.learning import Asked, Learned, learn, seen_by
from pipeline.classification.forest import PACKAGE
from pipeline.config.stages import Classification
from pipeline.errors import StemmapError


class Question(msgspec.Struct, frozen=True):
    """What to learn from: `gathering` names the forest in force and the votes that make a tree; the new one
    is kept in `folder`, the data folder. `parent` asks, and it ends when that is gone; 0 for nobody."""

    sources: list[AnnotatedSource]
    gathering: dict[str, Any]
    folder: str
    date: str
    seed: int = 0
    parent: int = 0


def answer(question: Question, say: Any) -> dict[str, Any]:  # noqa: ANN401 - a function of one dict
    """Learn, and keep the new forest under its name; nothing uses it yet."""
    folder = Path(question.folder)
    forests, gathering = Forests(folder), Classification.model_validate(question.gathering)
    old = gathering.forest
    asked = Asked(
        in_force=gathering,
        forests=forests,
        seen=() if old == PACKAGE else seen_by(forests.read(old)),
        seed=question.seed,
        date=question.date,
        kept=folder / "examples",
        progress=lambda words: say({"progress": words}),
    )
    learned = learn([annotated_run(source) for source in question.sources], asked)
    return as_plain(learned, forests.keep(learned.data), old)


def as_plain(learned: Learned, name: str, old: str) -> dict[str, Any]:
    """For the page."""
    return {
        "name": name,
        "against": old,
        "things": learned.things,
        "old_saw": learned.old_saw,
        "warnings": learned.warnings[:20],
        "tables": [{"kind": kind, **msgspec.to_builtins(each)} for kind, each in learned.validated.items()],
    }


def main() -> None:
    """Answer one question."""
    outgoing = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a library may print

    def say(told: dict[str, Any]) -> None:
        outgoing.write(msgspec.json.encode(told) + b"\n")
        outgoing.flush()

    try:
        question = msgspec.json.decode(sys.stdin.buffer.read(), type=Question)
        if question.parent:
            end_with(question.parent)
        say({"learned": answer(question, say)})
    except StemmapError as error:
        say({"error": str(error)})
    except MemoryError:
        say({"error": "this needs more memory than this machine has"})
    os._exit(0)  # nothing is left to be saved


if __name__ == "__main__":
    main()
