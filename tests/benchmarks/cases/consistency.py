"""Whether the reported sigmas are correct: normalised errors of fifty simulated runs, against chi-square."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.geometry.poses import Float, Pose2
    from pipeline.types.records import Detections
    from tests.benchmarks.stands import Stand

NAME = "consistency"
LINE = "NEES of pose and trees and NIS over fifty simulated runs, against the 95 % band of chi-square"

RUNS = 50
SIGMA = 0.05  # m; reported sigma of a detection
SEEN = 10.0  # m
WARM = 20  # scans before the first figure
MATCH = 0.6  # m between a tree of the map and the true one


@dataclass(slots=True)
class Errors:
    """Normalised squared errors of the pose by run and scan, of each tree at the end, and of innovations; and
    the number of scans with the state "lost"."""

    pose: list[list[float]] = field(default_factory=list)
    position: list[list[float]] = field(default_factory=list)
    trees: list[float] = field(default_factory=list)
    innovations: list[float] = field(default_factory=list)
    astray: int = 0


def run() -> list[Table]:
    """The ring with two numbers of particles, and the other stands."""
    from tests.benchmarks.stands import OTHERS, RING

    rows: list[tuple[Cell, ...]] = []
    for stand, particles in ((RING, 100), (RING, 400), *((other, 100) for other in OTHERS)):
        errors = Errors()
        for seed in range(RUNS):
            one_run(seed, particles, errors, stand)
        rows += [(stand.name, *row) for row in summary(particles, errors)]
    columns = (
        "stand",
        "particles",
        "figure",
        "freedom",
        "mean",
        "band from",
        "band to",
        "inside the band [%]",
    )
    return [
        Table(
            LINE,
            columns,
            tuple(rows),
            (
                "Rings are driven twice; odometry and detections have the errors that the filter "
                "assumes. The mean of the 50 runs is inside the band in 95 % of the scans if the "
                "sigmas are correct; above the band they are too small, below it too large.",
                "Trees: the trees of the tracker at the end of all runs, in one mean. The band is "
                "that of 50 runs with one tree each, because the trees of a run share the error of "
                "its path. NIS: mean of a run, one degree of freedom. Its band is that of 50 runs "
                "with one scan each, because views of successive scans are not independent.",
            ),
        )
    ]


def summary(particles: int, errors: Errors) -> list[tuple[Cell, ...]]:
    """A row of each figure."""
    import numpy as np
    from scipy.stats import chi2

    rows: list[tuple[Cell, ...]] = []
    for name, freedom, values in (("pose", 3, errors.pose), ("position", 2, errors.position)):
        mean = np.mean(values, axis=0)
        low, high = chi2.ppf([0.025, 0.975], freedom * RUNS) / RUNS
        inside = 100.0 * float(np.mean((mean >= low) & (mean <= high)))
        rows.append((particles, f"NEES of the {name}", freedom, float(mean.mean()), low, high, inside))
    if errors.trees:
        low, high = chi2.ppf([0.025, 0.975], 2 * RUNS) / RUNS
        mean = float(np.mean(errors.trees))
        rows.append((particles, "NEES of the trees", 2, mean, low, high, 100.0 * float(low <= mean <= high)))
    low, high = chi2.ppf([0.025, 0.975], RUNS) / RUNS
    mean = float(np.mean(errors.innovations))
    rows.append((particles, "NIS", 1, mean, low, high, 100.0 * float(low <= mean <= high)))
    return rows


def one_run(seed: int, particles: int, errors: Errors, stand: Stand | None = None) -> None:
    """Drive once (the ring) among trees, with errors and with a filter of this seed, whose map the
    graph of keyframes smooths as in the mapper."""
    import numpy as np

    from pipeline.config import Parameters
    from pipeline.detection.free_space import BINS
    from pipeline.geometry.poses import Pose2, wrap_angle
    from pipeline.slam import FastSlam
    from pipeline.slam.motion import noise_of, step_variances
    from pipeline.tracking import Tracker
    from tests.benchmarks.stands import RING

    parameters = Parameters().replace({"slam.particles": particles, "classification.method": "none"})
    random = np.random.default_rng([7, seed])
    drive = stand or RING
    trees_there = drive.trees(random)
    slam, tracker = FastSlam(parameters.slam, seed), Tracker(parameters.tracking)
    truth, pose, position, nis, stamps = Pose2(), [], [], [], list[int]()
    free = np.zeros(BINS)
    for k, stride in enumerate((None, *drive.strides)):
        told = Pose2()
        if stride is not None:
            truth = truth @ stride
            along, turn = step_variances(stride.x, stride.y, stride.yaw, noise_of(parameters.slam))
            sigma = np.sqrt([along, along, turn])
            noise = sigma * random.standard_normal(3)
            told = Pose2(stride.x + noise[0], stride.y + noise[1], stride.yaw + noise[2])
        found = _detections(truth, trees_there, random)
        at = slam.process(k, told, found, free)
        stamps.append(k * 100_000_000)
        tracker.process(stamps[-1], at, found, slam.landmarks())
        if slam.is_smoothing_due and (correction := slam.smooth(k)) is not None:
            at = slam.estimate(at)
            landmarks = slam.landmarks()
            tracker.correct(correction, np.array(stamps), at, landmarks, slam.map_error(landmarks))
        if k >= WARM:
            error = at.T_map_base.as_array() - truth.as_array()
            error[2] = wrap_angle(error[2])
            pose.append(float(error @ np.linalg.solve(at.covariance, error)))
            position.append(float(error[:2] @ np.linalg.solve(at.covariance[:2, :2], error[:2])))
            nis.append(at.health.innovation)
            errors.astray += slam.is_lost
    errors.pose.append(pose)
    errors.position.append(position)
    errors.innovations.append(float(np.nanmean(nis)))
    if not drive.comes_back:
        return  # a mapped tree may be nearer to the true position of another tree than to its own
    trees = tracker.trees()
    for place, covariance in zip(
        trees.position[trees.confirmed], trees.covariance[trees.confirmed], strict=True
    ):
        gap = trees_there - place
        y = gap[np.argmin(np.hypot(gap[:, 0], gap[:, 1]))]
        if np.hypot(*y) < MATCH:
            errors.trees.append(float(y @ np.linalg.solve(covariance, y)))


def _detections(truth: Pose2, stand: Float, random: object) -> Detections:
    import numpy as np

    from tests.benchmarks.cases.slam import detections_of

    assert isinstance(random, np.random.Generator)
    centre = truth.inverse().apply(stand)
    centre = centre[np.hypot(centre[:, 0], centre[:, 1]) < SEEN]
    return detections_of(centre + random.normal(0.0, SIGMA, centre.shape), SIGMA)
