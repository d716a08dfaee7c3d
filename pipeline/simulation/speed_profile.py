"""How fast a way is driven when neither speed nor turn rate may change suddenly, and turns on the spot."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipeline.types.records import Bool, Float, Int

ACCELERATION = 0.5  # m/s^2
YAW_RATE = 0.5  # rad/s
YAW_GAIN = 1.0  # rad/s^2, of the turn rate
CREEP = 0.1  # m/s; where even this is too fast for its turn, the robot turns on the spot
_APART = 5  # samples; turns on the spot nearer to one another are one, and those nearer to an end reach it


def sharp_cells(s: Float, yaw: Float) -> Bool:
    """Where a line goes back on itself or turns so sharply that none drives through, from each of N
    samples to the next, shape (N - 1,). Its yaw tells: a cusp between two has no curvature at them."""
    sharp = np.abs(np.diff(yaw)) > YAW_RATE / CREEP * np.diff(s)
    if sharp.any():
        rows = np.concatenate([[-1], np.flatnonzero(sharp), [sharp.size]])
        for before, after in pairwise(rows):
            sharp[before + 1 : after] |= after - before <= _APART
    return sharp


def curvature_beside(sharp: Bool, s: Float, yaw: Float, closed: bool) -> Float:
    """Curvature at each sample by the yaw of the cells beside it that are not sharp, else 0 [1/m]."""
    slope = np.where(sharp, np.nan, np.diff(yaw) / np.diff(s))
    before = np.concatenate([slope[-1:] if closed else slope[:1], slope])
    after = np.concatenate([slope, slope[:1] if closed else slope[-1:]])
    before, after = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    beside: Float = np.nan_to_num(0.5 * (before + after))
    return beside


def runs_of(sharp: Bool) -> Int:
    """First and last sample of each run of sharp cells, shape (K, 2)."""
    edges = np.diff(np.concatenate([[0], sharp.astype(np.int8), [0]]))
    return np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)], axis=1)


def within_gains(v: Float, s: Float, curvature: Float) -> Float:
    """The fastest speeds, none above `v`, between which a robot can change on its way: for all samples i

        v_i^2 <= v_(i -+ 1)^2 + 2 a ds  with  a = min(ACCELERATION, YAW_GAIN / (2 |k|))
        v_i^2 |dk / ds| <= YAW_GAIN / 2

    so that the turn rate k v changes by no more than a |k| + v^2 |dk / ds| <= YAW_GAIN.

    Args:
        v: Limit at each sample, shape (N,) [m/s]; s: its way [m]; curvature: k, linear between two [1/m].
    """
    ds, k = np.diff(s), np.abs(curvature)
    bend = np.abs(np.diff(curvature)) / ds
    bend = np.maximum(np.append(bend, 0.0), np.append(0.0, bend))
    limit = np.minimum(v, np.sqrt(0.5 * YAW_GAIN / np.maximum(bend, 1e-9)))
    gain = np.minimum(ACCELERATION, 0.5 * YAW_GAIN / np.maximum(np.maximum(k[1:], k[:-1]), 1e-9))
    far = np.append(0.0, np.cumsum(2.0 * gain * ds))
    square = limit * limit
    forth = np.minimum.accumulate(square - far) + far
    back = (np.minimum.accumulate((square + far)[::-1]))[::-1] - far
    reached = np.maximum(np.minimum(forth, back), 0.0)
    # What was within already stays as it is, to the last bit.
    bounded: Float = np.where(reached < square * (1.0 - 1e-9), np.sqrt(reached), limit)
    return bounded


class Spin(NamedTuple):
    """A turn on the spot, from rest to rest: a part f of the way and of the turn, with f'' = gain, 0, -gain.

    Attributes:
        begin, takes: [s]; gain: [1/s^2]; ramp: how long it gains [s].
        first, way: Where it begins, and how far it leads along the line [m]; yaw, turn: the same [rad].
    """

    begin: float
    takes: float
    gain: float
    ramp: float
    first: float
    way: float
    yaw: float
    turn: float

    @classmethod
    def over(cls, first: float, way: float, yaw: float, turn: float) -> Spin:
        """As fast as turn rate, creep and their gains allow; it begins at time 0."""
        rate = min(YAW_RATE / max(abs(turn), 1e-9), CREEP / way)
        gain = min(YAW_GAIN / max(abs(turn), 1e-9), ACCELERATION / way)
        ramp = min(rate / gain, gain**-0.5)  # a short turn is slowed before it is fast
        return cls(0.0, 1.0 / (gain * ramp) + ramp, gain, ramp, first, way, yaw, turn)

    def at(self, t: Float) -> tuple[Float, Float]:
        """The part f, and f' [1/s], at times of shape (N,) [s]."""
        up = np.clip(t - self.begin, 0.0, self.takes)
        left = self.takes - up
        even = self.gain * self.ramp * (up - 0.5 * self.ramp)
        part = np.where(up < self.ramp, 0.5 * self.gain * up * up, even)
        part = np.where(left < self.ramp, 1.0 - 0.5 * self.gain * left * left, part)
        return part, self.gain * np.minimum(np.minimum(up, left), self.ramp)
