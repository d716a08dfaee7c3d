"""The mapper of a source, with the random forests of this machine."""

from __future__ import annotations

from app.store.forests import kept_forests
from pipeline.config import Parameters
from pipeline.front_end import StageTimer, no_timer
from pipeline.io.readers import SourceDescription
from pipeline.mapper import Mapper


def mapper_of(
    source: SourceDescription, parameters: Parameters, seed: int, timer: StageTimer = no_timer
) -> Mapper:
    """Return a mapper before the first scan of a source, with the forests that are kept on this machine.

    Args:
        source: Description with the sensor and its extrinsics.
        parameters: Parameters of the mapper.
        seed: Random seed.
        timer: Measures the stages, see `Mapper`.

    Raises:
        StemmapError: The forest that the parameters name does not exist.
    """
    return Mapper(
        parameters,
        sensor=source.sensor,
        T_base_lidar=source.T_base_lidar,
        seed=seed,
        timer=timer,
        forests=kept_forests(),
    )
