"""Jobs that cost nothing, and what they are answered with."""

from __future__ import annotations

from app.sources.request import SourceRequest
from app.tuning.plan import TruthTable
from app.tuning.sweep.jobs import Job, RunWithTruth, code_digest
from pipeline.config import preset
from tests.app.tuning.sweep.scores import scores

__all__ = ["job", "scores"]


def job(eps: float, *, seed: int = 0, digest: str = "d", particles: int = 100) -> Job:
    """A job that differs by its eps, particles, seed and source."""
    truth = TruthTable([1.0], [2.0], [None], ["tree"])
    parameters = preset("forest").replace({"clustering.eps": eps, "slam.particles": particles})
    run = RunWithTruth(SourceRequest("sim:nothing", seed=seed), digest, truth)
    return Job(run, parameters.model_dump(), code_digest())
