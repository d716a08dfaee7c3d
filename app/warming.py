"""Has the mapper's compiled code ready before the first scan of a robot comes, which would not wait."""

from __future__ import annotations

from app.forests import kept_forests
from app.stopwatch import Stopwatch
from pipeline.parameters import Parameters

_SCENE = "sim:stand?duration=1"


def warm_up(parameters: Parameters | None = None) -> None:
    """Map a second of a simulated stand; the first time on a machine this takes up to a minute."""
    from pipeline.mapper import Mapper
    from pipeline.sources import open_source
    from pipeline.steps import steps

    source = open_source(_SCENE)
    known = source.description
    mapper = Mapper(
        parameters or Parameters(),
        sensor=known.sensor,
        T_base_lidar=known.T_base_lidar,
        seed=0,
        watch=Stopwatch(),
        forests=kept_forests(),
    )
    for step in steps(source.records()):
        mapper.process(step)
