"""Stands without a scanner, for SLAM alone: positions of the trees, and paths of the robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Pose2
from pipeline.types.records import Float

APART = 1.5  # m between two trees


@dataclass(frozen=True, slots=True)
class Stand:
    """A stand with the path of the robot.

    Attributes:
        name: Displayed name.
        trees: Draws the positions of the trees, shape (N, 2) [m], in the frame of the first pose.
        strides: The true motion to each scan but the first.
        comes_back: Whether known trees are seen again, so that all trees are near their true positions at the
        end.
    """

    name: str
    trees: Callable[[np.random.Generator], Float]
    strides: tuple[Pose2, ...]
    comes_back: bool = True


def ring(radius: float, trees: int, scans: int) -> Stand:
    """A circle that is driven twice counter-clockwise, with trees on both sides."""

    def drawn(random: np.random.Generator) -> Float:
        places: list[Float] = []
        while len(places) < trees:
            place = random.uniform(-radius - 6.0, radius + 6.0, 2) + np.array([0.0, radius])
            if _is_apart(place, places) and abs(np.hypot(place[0], place[1] - radius) - radius) > 0.8:
                places.append(place)
        return np.array(places)

    stride = Pose2(4.0 * np.pi * radius / scans, 0.0, 4.0 * np.pi / scans)
    return Stand(f"ring of {2 * radius:.0f} m, {trees} trees", drawn, (stride,) * (scans - 1))


def lane(length: float, trees: int, stride: float, *, back: bool) -> Stand:
    """A straight path between trees, one way or there and back."""

    def drawn(random: np.random.Generator) -> Float:
        places: list[Float] = []
        while len(places) < trees:
            x, side = random.uniform(-5.0, length + 5.0), random.choice([-1.0, 1.0])
            place = np.array([x, side * random.uniform(1.5, 7.0)])
            if _is_apart(place, places):
                places.append(place)
        return np.array(places)

    ahead = (Pose2(stride, 0.0, 0.0),) * round(length / stride)
    turn = (Pose2(0.3, 0.0, np.pi / 10),) * 10
    name = f"lane of {length:.0f} m, {trees} trees, {'there and back' if back else 'one way'}"
    return Stand(name, drawn, (*ahead, *turn, *ahead) if back else ahead, comes_back=back)


def _is_apart(place: Float, others: list[Float]) -> bool:
    return all(np.hypot(*(place - other)) > APART for other in others)


RING = ring(8.0, 40, 160)
STRAIGHT = lane(120.0, 30, 0.6, back=False)
OTHERS = (ring(18.0, 90, 240), lane(40.0, 26, 0.4, back=True), STRAIGHT)
