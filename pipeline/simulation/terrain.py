"""Simulated ground: a smooth analytic height z(x, y), a tilted plane with a few long waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.jit import compiled
from pipeline.types.records import Float


@compiled
def sine_of_turns(turns: float) -> float:
    """Return sin(2 pi turns) for any finite number of turns, with an error of 4e-6. The polynomial has no
    branch: it is several times faster than the C library and gives the same bits on every machine."""
    u = turns - np.floor(turns + 0.5)
    x = 6.283185307179586 * (0.25 - abs(abs(u) - 0.25))
    q = x * x
    p = 1.0 + q * (-1.0 / 6.0 + q * (1.0 / 120.0 + q * (-1.0 / 5040.0 + q / 362880.0)))
    result: float = np.copysign(x, u) * p
    return result


@compiled
def height_at(terrain: Float, x: float, y: float) -> float:
    """Return the height [m] of a terrain at one position x, y [m]; `terrain` is `SimulatedTerrain.packed`,
    shape (1 + W, 4)."""
    z: float = terrain[0, 0] * x + terrain[0, 1] * y + terrain[0, 2]
    for i in range(1, terrain.shape[0]):
        z += terrain[i, 0] * sine_of_turns(terrain[i, 1] * x + terrain[i, 2] * y + terrain[i, 3])
    return z


@compiled
def gradient_at(terrain: Float, x: float, y: float) -> tuple[float, float]:
    """Return the slopes dz/dx and dz/dy of a terrain at x, y [m]; `terrain` is `SimulatedTerrain.packed`,
    shape (1 + W, 4)."""
    gx, gy = terrain[0, 0], terrain[0, 1]
    for i in range(1, terrain.shape[0]):
        turns = terrain[i, 1] * x + terrain[i, 2] * y + terrain[i, 3]
        slope = 6.283185307179586 * terrain[i, 0] * sine_of_turns(turns + 0.25)
        gx += slope * terrain[i, 1]
        gy += slope * terrain[i, 2]
    return gx, gy


@compiled
def _evaluate(terrain: Float, x: Float, y: Float) -> Float:
    """Return height [m], dz/dx and dz/dy, shape (N, 3), of a terrain at positions x, y of shape (N,) each
    [m]; `terrain` is `SimulatedTerrain.packed`, shape (1 + W, 4)."""
    out = np.empty((x.shape[0], 3))
    for n in range(x.shape[0]):
        out[n, 0] = height_at(terrain, x[n], y[n])
        out[n, 1], out[n, 2] = gradient_at(terrain, x[n], y[n])
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTerrain:
    """A plane with waves.

    Attributes:
        packed: Plane and waves, float64, shape (1 + W, 4). Row 0: slope along x, slope along y, height at the
            origin, 0. The others: amplitude [m], waves per metre along x and y, phase in turns.
    """

    packed: Float

    @classmethod
    def grow(
        cls, slope: float, amplitude: float, shortest: float, rng: np.random.Generator
    ) -> SimulatedTerrain:
        """Return a random terrain with height 0 at the origin: a plane with four waves, or without waves if
        the amplitude is 0.

        Args:
            slope: Slope of the plane along x (rise over run).
            amplitude: Amplitude of the longest wave [m]; the amplitudes of the others are proportional to
                their wavelengths.
            shortest: Shortest wavelength [m]; the longest is 3.1 times as long.
            rng: Random generator of directions and phases.
        """
        wavelengths = shortest * np.array([3.1, 2.2, 1.5, 1.0])
        directions = rng.uniform(0.0, np.pi, wavelengths.size)
        packed = np.zeros((1 + wavelengths.size, 4))
        packed[0, 0] = slope
        packed[1:, 0] = amplitude * wavelengths / wavelengths[0]
        packed[1:, 1] = np.cos(directions) / wavelengths
        packed[1:, 2] = np.sin(directions) / wavelengths
        packed[1:, 3] = rng.uniform(0.0, 1.0, wavelengths.size)
        if amplitude == 0.0:
            packed = packed[:1]
        packed[0, 2] = -height_at(packed, 0.0, 0.0)
        return cls(packed)

    def with_ditches(
        self, depth: float, width: float, spacing: float, direction: float, phase: float
    ) -> SimulatedTerrain:
        """Return a copy of this terrain with parallel drainage ditches, approximated by waves with amplitudes
        above 1 cm. The whole terrain is shifted so that the origin has the height 0.

        Args:
            depth: Depth of a ditch [m].
            width: Width of a ditch at 60 % of the depth [m]; the profile is a Gaussian bell.
            spacing: Distance between two ditches [m].
            direction: Direction across the ditches [rad].
            phase: Position of the first ditch as a share of the spacing.
        """
        # Fourier series of a periodic bell, as far as an amplitude is larger than a centimetre.
        sigma = 0.5 * width
        n = np.arange(1, int(spacing / sigma) + 1)
        share = np.sqrt(2.0 * np.pi) * sigma / spacing
        amplitude = 2.0 * depth * share * np.exp(-0.5 * (2.0 * np.pi * n * sigma / spacing) ** 2)
        n, amplitude = n[amplitude > 0.01], amplitude[amplitude > 0.01]
        # Amplitudes are positive for the bounds of `meet_ground`: -cos(a) is the sine of a + 3/4 of a turn.
        waves = (np.cos(direction) / spacing, np.sin(direction) / spacing)
        rows = np.stack([amplitude, n * waves[0], n * waves[1], 0.75 - n * phase], axis=1)
        packed = np.vstack([self.packed, rows])
        packed[0, 2] -= height_at(packed, 0.0, 0.0)
        return SimulatedTerrain(packed)

    def height(self, x: Float, y: Float) -> Float:
        """Return heights [m], shape (N,), at positions x, y of shape (N,) each [m]."""
        return self.evaluate(x, y)[:, 0]

    def evaluate(self, x: Float, y: Float) -> Float:
        """Return height [m], dz/dx and dz/dy at positions x, y of shape (N,) each [m]; shape (N, 3)."""
        result: Float = _evaluate(self.packed, np.ascontiguousarray(x), np.ascontiguousarray(y))
        return result


WHEELBASE = 0.8  # m; distance between the axles of a small forestry robot


@dataclass(frozen=True, slots=True, eq=False)
class WheelContact:
    """The ground as wheels average it. The height is the mean of the four points that are half a WHEELBASE
    away along the axes x and y of the map, and the slopes are those between opposite points."""

    terrain: SimulatedTerrain

    def evaluate(self, x: Float, y: Float) -> Float:
        """Return height [m], dz/dx and dz/dy of the wheel contact at positions x, y of shape (N,) each [m];
        shape (N, 3)."""
        half = 0.5 * WHEELBASE
        west, east, south, north = (
            self.terrain.height(x + dx, y + dy)
            for dx, dy in ((-half, 0.0), (half, 0.0), (0.0, -half), (0.0, half))
        )
        mean = 0.25 * (west + east + south + north)
        return np.stack([mean, (east - west) / WHEELBASE, (north - south) / WHEELBASE], axis=1)
