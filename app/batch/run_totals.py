"""What is counted over a run, for run.json and for people."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from app.worker.run_health import RunHealth
from pipeline.evaluation import Evaluation
from pipeline.types.records import Frame, Verdict


@dataclass(slots=True, eq=False)
class Tally:
    """What is counted over a run."""

    warned: Counter[str]
    points: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    health: RunHealth = field(default_factory=RunHealth)

    def add(self, frame: Frame) -> None:
        self.health.add(frame)
        self.points.update(frame.counts)
        self.verdicts.update(Verdict(int(v)).label for v in frame.clusters.verdict)
        self.warned.update(frame.warnings)

    def tell_of_far_truth(self, evaluation: Evaluation | None) -> None:
        if evaluation is not None and evaluation.TA.of + evaluation.TR.of == 0:
            self.warned[far_truth(evaluation.reach)] += 1

    def tell_of_unconfirmed(self, frame: Frame, hits: int) -> None:
        tentative = int(np.count_nonzero(~frame.trees.confirmed))
        if tentative:
            them = "1 tree was" if tentative == 1 else f"{tentative} trees were"
            self.warned[
                f"{them} seen fewer than {hits} times and left out of the map; "
                "--set tracking.hits_to_confirm=1 takes them too"
            ] += 1

    def warnings(self) -> list[str]:
        return [text if n == 1 else f"{text} ({n:,} times)" for text, n in self.warned.items()]


def far_truth(reach: float) -> str:
    """What to say when nothing of the truth lies near the path."""
    return (
        f"no ground truth lies within {reach:g} m of the path: it must be in the frame of the map, "
        "with the first pose as the origin and x along its heading "
        "(what stands farther away is asked for with evaluation.reach)"
    )
