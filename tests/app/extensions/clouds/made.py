"""A whole cloud in memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from app.extensions.clouds.records import CloudDescription


@dataclass
class Made:
    """A cloud in memory (see `app.extensions.clouds.records.WholeCloud`)."""

    points: np.ndarray
    losses: dict[str, int] = field(default_factory=dict)
    part: int = 50_000

    @property
    def description(self):
        return CloudDescription("made", "made", len(self.points), np.zeros(3), "", "")

    def parts(self):
        for k in range(0, len(self.points), self.part):
            yield self.points[k : k + self.part].astype(np.float32)
