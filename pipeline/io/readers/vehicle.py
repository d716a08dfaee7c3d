"""The car of Victoria Park: from its wheel and steering encoders to the motion of its laser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.types.records import Float


@dataclass(frozen=True, slots=True)
class Car:
    """Measures of a car with steered front wheels [m].

    Attributes:
        L: Wheelbase.
        H: From the left rear wheel, where the speed is measured, to the centre line.
        a: The laser stands so far ahead of the rear axle.
        b: The laser stands so far to the left of the centre line.
    """

    L: float = 2.83
    H: float = 0.76
    a: float = 3.78
    b: float = 0.5


def dead_reckoning(time: Float, speed: Float, steering: Float, car: Car) -> Float:
    """Pose of the laser at each encoder time, from (0, 0, 0) at the first; shape (N, 3): x, y, yaw.

    Speed and steering hold until the next reading, over which the motion is an arc and is
    integrated exactly. With v_c = v / (1 - tan(s) H / L) the laser moves in its own axes with
    v_c - b w ahead and a w to the left, and turns with w = v_c tan(s) / L.

    Args:
        time: [s], ascending, shape (N,).
        speed: Of the left rear wheel [m/s].
        steering: [rad], positive to the left, well below a right angle.
        car: Its measures.
    """
    dt = np.diff(time)
    tangent = np.tan(steering[:-1])
    v_c = speed[:-1] / (1.0 - tangent * car.H / car.L)
    w = v_c * tangent / car.L
    ahead, left = v_c - car.b * w, car.a * w
    yaw = np.concatenate([[0.0], np.cumsum(w * dt)])
    half = 0.5 * w * dt
    # The chord of an arc points along the heading half way and is shorter than the arc.
    chord = dt * np.sinc(half / np.pi)
    c, s = np.cos(yaw[:-1] + half), np.sin(yaw[:-1] + half)
    x = np.concatenate([[0.0], np.cumsum(chord * (ahead * c - left * s))])
    y = np.concatenate([[0.0], np.cumsum(chord * (ahead * s + left * c))])
    return np.stack([x, y, yaw], axis=1)
