"""The mapper of a source, with the decision trees that this machine keeps."""

from __future__ import annotations

from app.training.learned_forests import kept_forests
from pipeline.config import Parameters
from pipeline.io.readers import SourceDescription
from pipeline.mapper import Mapper


def mapper_of(known: SourceDescription, parameters: Parameters, seed: int) -> Mapper:
    """A mapper at the beginning of a run.

    Args:
        known: Of the source; tells the sensor and where it stands on the robot.
        seed: Of its random numbers.
    """
    return Mapper(
        parameters,
        sensor=known.sensor,
        T_base_lidar=known.T_base_lidar,
        seed=seed,
        forests=kept_forests(),
    )
