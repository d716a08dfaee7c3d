"""The training process of the page: `python -m app.training.learn_process`.

It receives a `LearningRequest` and sends `{"progress": text}` messages, then `{"learned": ...}` or `{"error":
text}`. Recordings are read here and not in the server.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from app.common.child_process import ParentConnection, run_child
from app.store.store import AnnotatedSource
from app.training.annotated_runs import annotated_run
from app.training.learned_forests import Forests
from app.training.learning import LearningOptions, LearningResult, learn, seen_by
from pipeline.classification.forest import PACKAGE
from pipeline.config.stages import Classification
from pipeline.errors import StemmapError


class LearningRequest(msgspec.Struct, frozen=True):
    """Request for a training.

    Attributes:
        sources: The annotated runs.
        classification: Parameters of the classification in force, with the name of the present forest.
        folder: The data folder, where the new forest is stored.
        date: Date of the training.
        seed: Random seed.
    """

    sources: list[AnnotatedSource]
    classification: dict[str, Any]
    folder: str
    date: str
    seed: int = 0


def train(request: LearningRequest, progress: Callable[[str], None]) -> dict[str, Any]:
    """Train a forest and store it under its name. It is not in force yet."""
    folder = Path(request.folder)
    forests, present = Forests(folder), Classification.model_validate(request.classification)
    old = present.forest
    options = LearningOptions(
        in_force=present,
        forests=forests,
        seen=() if old == PACKAGE else seen_by(forests.read(old)),
        seed=request.seed,
        date=request.date,
        kept=folder / "examples",
        progress=progress,
    )
    learned = learn([annotated_run(source) for source in request.sources], options)
    return as_plain(learned, forests.keep(learned.data), old)


def as_plain(learned: LearningResult, name: str, old: str) -> dict[str, Any]:
    """Return the result for the page."""
    return {
        "name": name,
        "against": old,
        "things": learned.things,
        "old_saw": learned.old_saw,
        "warnings": learned.warnings[:20],
        "tables": [{"kind": kind, **msgspec.to_builtins(each)} for kind, each in learned.validated.items()],
    }


def serve(parent: ParentConnection) -> None:
    """Answer one request."""
    try:
        request = parent.receive(LearningRequest)
        parent.send({"learned": train(request, lambda text: parent.send({"progress": text}))})
    except StemmapError as error:
        parent.send({"error": str(error)})
    except MemoryError:
        parent.send({"error": "this needs more memory than this machine has"})


if __name__ == "__main__":
    run_child(serve)
