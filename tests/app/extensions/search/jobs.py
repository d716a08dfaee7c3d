"""Jobs that need no computation, and their scores."""

from __future__ import annotations

import msgspec

from app.extensions.search.jobs import Job, RunWithTruth
from app.sources.request import SourceRequest
from app.store.records import Content
from pipeline.config import preset
from pipeline.evaluation import MapScores
from tests.app.extensions.search.scores import scores as plain_scores


def scores(f1: float | None, *, found: int = 3, wrong: int = 0) -> MapScores:
    """Return scores that differ only in their F1."""
    return msgspec.convert(plain_scores(f1, found=found, wrong=wrong), MapScores)


def job(eps: float, *, seed: int = 0, digest: str = "d", particles: int = 100) -> Job:
    """A job that differs by its eps, particles, seed and source."""
    truth = [Content(1.0, 2.0)]
    parameters = preset("forest").replace({"clustering.eps": eps, "slam.particles": particles})
    run = RunWithTruth(SourceRequest("sim:nothing", seed=seed), digest, truth)
    return Job(run, parameters.model_dump())


def counted(
    ta: int, fr: int, fa: int, tr: int, spurious: int, rmse: float | None, pair: float | None
) -> MapScores:
    """Return scores with these counts, position RMSE [m] and pair error [%]."""
    trees, others = ta + fr, fa + tr
    rates = {"TA": (ta, trees), "FR": (fr, trees), "FA": (fa, others), "TR": (tr, others)}
    plain = plain_scores(None) | {name: {"count": n, "of": of} for name, (n, of) in rates.items()}
    plain |= {"spurious": spurious, "position_rmse": rmse, "mean_pair_error_percent": pair}
    return msgspec.convert(plain, MapScores)
