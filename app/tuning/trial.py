"""What came of one set of parameters that was tried."""

from __future__ import annotations

import msgspec

from app.tuning.goal import RunScore
from pipeline.config.model import Value


class Trial(msgspec.Struct, frozen=True):
    """What came of a trial.

    Attributes:
        number: In the order in which they began.
        values: What was tried, by the parameters' names.
        loss: See `Goal.loss`; None where the set cannot be mapped with.
        training, held_out: Scores by run; held_out only of a set that was the best when it was made.
    """

    number: int
    values: dict[str, Value]
    loss: float | None
    training: tuple[RunScore, ...] = ()
    held_out: tuple[RunScore, ...] = ()
