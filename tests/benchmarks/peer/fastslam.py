"""FastSLAM 1.0 in plain Python, as in Probabilistic Robotics (table 13.1): every particle computes the
likelihood of each observation for each of its landmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tests.benchmarks.peer.stages import Detection, Float, Parameters


@dataclass(slots=True, eq=False)
class Landmark:
    """Mean (2,) [m], covariance (2, 2) [m^2] in the frame of the map, and number of observations."""

    mean: Float
    covariance: Float
    hits: int = 1

    def copy(self) -> Landmark:
        """An independent copy."""
        return Landmark(self.mean.copy(), self.covariance.copy(), self.hits)


@dataclass(slots=True, eq=False)
class Particle:
    """A hypothesis of the pose (x, y, yaw) with its own map."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    weight: float = 1.0
    landmarks: list[Landmark] = field(default_factory=list)

    def copy(self) -> Particle:
        """An independent copy."""
        return Particle(self.x, self.y, self.yaw, self.weight, [m.copy() for m in self.landmarks])


class FastSlam:
    """Particles that move with the odometry and are weighted by the observations."""

    def __init__(self, p: Parameters, seed: int) -> None:
        self.p = p
        self.particles = [Particle() for _ in range(p["slam.particles"])]
        self._random = np.random.default_rng(seed)

    def process(self, motion: tuple[float, float, float], detections: list[Detection]) -> None:
        """Predict, update, weight and resample the particles."""
        log_weights = []
        for particle in self.particles:
            self._move(particle, motion)
            log_weights.append(math.log(max(particle.weight, 1e-300)) + self._observe(particle, detections))
        largest = max(log_weights)
        weights = [math.exp(w - largest) for w in log_weights]
        total = sum(weights)
        for particle, weight in zip(self.particles, weights, strict=True):
            particle.weight = weight / total

    def resample_if_needed(self) -> None:
        """Low-variance resampling when few particles carry the weight."""
        effective = 1.0 / sum(particle.weight**2 for particle in self.particles)
        if effective < self.p["slam.resample_below"] * len(self.particles):
            self.particles = resample(self.particles, self._random.uniform())

    def _move(self, particle: Particle, motion: tuple[float, float, float]) -> None:
        distance, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
        sigma = self.p["slam.noise_distance"] * math.sqrt(distance)
        per_metre, per_turn = self.p["slam.noise_turn_distance"], self.p["slam.noise_turn"]
        sigma_yaw = math.radians(math.sqrt(per_metre**2 * distance + per_turn**2 * turn))
        noise = self._random.standard_normal(3)
        dx, dy = motion[0] + sigma * noise[0], motion[1] + sigma * noise[1]
        c, s = math.cos(particle.yaw), math.sin(particle.yaw)
        particle.x += c * dx - s * dy
        particle.y += s * dx + c * dy
        particle.yaw = wrap(particle.yaw + motion[2] + sigma_yaw * noise[2])

    def _observe(self, particle: Particle, detections: list[Detection]) -> float:
        """Update a particle's map; the logarithm of the observations' likelihood, up to a constant."""
        gate2 = self.p["slam.gate"] ** 2
        c, s = math.cos(particle.yaw), math.sin(particle.yaw)
        turn = np.array([[c, -s], [s, c]])
        place = np.array([particle.x, particle.y])
        known = particle.landmarks[:]
        taken: set[int] = set()
        total = 0.0
        for detection in detections:
            z = turn @ detection.place + place
            R = turn @ detection.covariance @ turn.T
            k, d2, log_det = self._most_likely(known, taken, z, R)
            if k >= 0 and known[k].hits >= self.p["slam.hits_to_weigh"]:
                total -= 0.5 * (d2 + log_det)
            else:
                total -= 0.5 * (gate2 + math.log(np.linalg.det(R)))
            if k >= 0:
                taken.add(k)
                update(known[k], z, R)
            else:
                particle.landmarks.append(Landmark(z, R))
        return total

    def _most_likely(
        self, known: list[Landmark], taken: set[int], z: Float, R: Float
    ) -> tuple[int, float, float]:
        """Index of the likeliest free landmark within the gate, -1 for none; d^2; log det S."""
        best, best_cost, best_d2, best_log_det = -1, math.inf, 0.0, 0.0
        for k, landmark in enumerate(known):
            if k in taken:
                continue
            y = z - landmark.mean
            S = landmark.covariance + R
            d2 = float(y @ np.linalg.inv(S) @ y)
            if d2 > self.p["slam.gate"] ** 2 or math.hypot(y[0], y[1]) > self.p["slam.distance_max"]:
                continue
            log_det = math.log(np.linalg.det(S))
            if d2 + log_det < best_cost:
                best, best_cost, best_d2, best_log_det = k, d2 + log_det, d2, log_det
        return best, best_d2, best_log_det

    def estimate(self) -> tuple[Float, Float]:
        """Mean pose (3,) and its covariance (3, 3)."""
        weights = np.array([particle.weight for particle in self.particles])
        poses = np.array([[particle.x, particle.y, particle.yaw] for particle in self.particles])
        yaw = math.atan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
        mean = np.array([weights @ poses[:, 0], weights @ poses[:, 1], yaw])
        deviation = poses - mean
        deviation[:, 2] = [wrap(angle) for angle in deviation[:, 2]]
        return mean, (deviation * weights[:, None]).T @ deviation


def update(landmark: Landmark, z: Float, R: Float) -> None:
    """The Kalman update of a static landmark, H = I."""
    K = landmark.covariance @ np.linalg.inv(landmark.covariance + R)
    landmark.mean = landmark.mean + K @ (z - landmark.mean)
    # Views of one trunk share an error of about a centimetre, which bounds the covariance from below.
    landmark.covariance = (np.eye(2) - K) @ landmark.covariance
    for a in range(2):
        landmark.covariance[a, a] = max(landmark.covariance[a, a], 1e-4)
    landmark.hits += 1


def resample(particles: list[Particle], offset: float) -> list[Particle]:
    """Low-variance resampling (table 4.4): as many particles, each a copy, with equal weights.

    Args:
        particles: With weights that sum to 1.
        offset: Uniform in [0, 1).
    """
    n = len(particles)
    chosen: list[Particle] = []
    total, k = particles[0].weight, 0
    for i in range(n):
        while (i + offset) / n >= total and k < n - 1:
            k += 1
            total += particles[k].weight
        copy = particles[k].copy()
        copy.weight = 1.0 / n
        chosen.append(copy)
    return chosen


def wrap(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
