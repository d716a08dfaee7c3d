"""The parameters of the way that the robot drives: what is an obstacle, and how near it may come."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import model_validator

from pipeline.config.declare import Stage, choice, count, number


class Obstacles(Stage):
    """Obstacles: what stands in the robot's way, and where it should slow down and stop."""

    method: Literal["none", "way"] = choice(
        "way", "Obstacles", "Look for them along the way that the present velocities lead, or not at all."
    )
    width: float = number(
        0.9, "Width of the way", "m", 0.1, 10.0, 0.05, "The robot's width and what must be free beside it."
    )
    reach: float = number(
        0.4,
        "Reach of the robot",
        "m",
        0.0,
        5.0,
        0.05,
        "How far it reaches before and behind its base; to its sensor at least.",
    )
    height_min: float = number(
        0.25, "Lowest obstacle", "m", -10.0, 5.0, 0.05, "What is lower above the ground is driven over."
    )
    height_max: float = number(
        1.5,
        "Height of the robot",
        "m",
        0.1,
        10.0,
        0.05,
        "What hangs higher above the ground is driven under.",
    )
    stop_distance: float = number(
        1.0, "Stop zone", "m", 0.1, 20.0, 0.1, "An obstacle nearer than this means stop."
    )
    slow_distance: float = number(
        3.0, "Slow zone", "m", 0.2, 40.0, 0.1, "An obstacle nearer than this means drive slowly."
    )
    min_points: int = count(
        5, "Returns of an obstacle", "", 1, 100, "Fewer returns within half a metre are rain or insects."
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for low, high in (("height_min", "height_max"), ("stop_distance", "slow_distance")):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(
                    f"obstacles.{low} = {getattr(self, low)} must be less than "
                    f"obstacles.{high} = {getattr(self, high)}"
                )
        return self
