"""How well wheels count, by name. Apart from the wheels, so that reading a URI needs no compiler."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WheelQuality:
    """How far wheels lie.

    Attributes:
        scale: Error of the distance [1], its sign drawn.
        slip: Distance lost per unit of uphill slope [1].
        turn_scale: Error of a turn [1], its sign drawn.
        turn_bias: Turn that did not happen per metre [rad/m], its sign drawn.
        distance_noise: Standard deviation of the distance [m] per square root of metre.
        turn_noise: Of the heading [rad] per square root of metre.
    """

    scale: float
    slip: float
    turn_scale: float
    turn_bias: float
    distance_noise: float
    turn_noise: float


QUALITIES = {
    "good": WheelQuality(0.003, 0.01, 0.002, 2e-4, 0.005, 0.002),
    "normal": WheelQuality(0.01, 0.04, 0.006, 6e-4, 0.01, 0.004),
    "poor": WheelQuality(0.03, 0.10, 0.006, 2.8e-3, 0.03, 0.006),
}
