"""Whether what a worker or the disk says is an answer that can be compared."""

from __future__ import annotations

import math

from app.tuning.sweep.comparing import figures
from app.tuning.sweep.jobs import Answer


def is_answer(answer: Answer) -> bool:
    """Whether the scores, where there are any, tell all figures, each a finite number or nothing; and
    otherwise why there are none."""
    if answer.scores is None:
        return bool(answer.error)
    try:
        told = figures(answer.scores)
    except (KeyError, TypeError):
        return False
    if any(told[name] is None for name in ("TA", "TA_of", "FR", "TR", "TR_of", "FA", "spurious")):
        return False
    return math.isfinite(answer.seconds) and all(
        value is None or (type(value) in (int, float) and math.isfinite(value)) for value in told.values()
    )
