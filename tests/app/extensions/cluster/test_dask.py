"""Tasks on a Dask cluster of two workers: results as in this process, also after the loss of a worker."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from app.cli import main
from app.extensions.cluster.dask_pool import DaskPool
from app.extensions.search.jobs import Job, ScoringProcesses
from app.extensions.search.plan import PlannedRun
from app.extensions.search.report import sweep
from app.extensions.search.scoring import Scorer, prepare_run
from app.sources.request import SourceRequest
from pipeline.config import preset
from pipeline.errors import StemmapError
from tests.app.extensions.cluster.dask_cluster import dask_cluster, end_one_process, end_the_worker, fail
from tests.app.extensions.cluster.test_many_runs import bytes_in, record_runs

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with dask_cluster(tmp_path_factory.mktemp("dask")) as found:
        yield found


@contextmanager
def connected(address: str) -> Iterator[DaskPool]:
    """Yield a pool, which is closed at the end."""
    pool = DaskPool(address)
    try:
        yield pool
    finally:
        pool.close(nothing)


def nothing() -> None:
    """Do nothing."""


def test_a_task_whose_worker_died_is_repeated_and_the_loss_is_a_warning(address, tmp_path):
    with connected(address) as pool:
        task = str(tmp_path / "killed").encode()
        assert pool.call(end_one_process, task) == task
        assert pool.warnings() == ["1 worker of the cluster lost; its tasks were repeated"]


def test_a_task_is_repeated_after_the_only_worker_died(tmp_path, monkeypatch):
    monkeypatch.setattr("app.extensions.cluster.dask_pool._POLL_S", 0.2)
    with dask_cluster(tmp_path, workers=1) as address, connected(address) as pool:
        task = str(tmp_path / "killed").encode()
        assert pool.call(end_one_process, task) == task


def test_a_cluster_whose_workers_are_gone_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("app.extensions.cluster.dask_pool._POLL_S", 0.2)
    with dask_cluster(tmp_path, workers=1) as address, connected(address) as pool:
        assert pool.count == 1
        monkeypatch.setattr("app.extensions.cluster.dask_pool._PATIENCE_S", 1.0)
        with pytest.raises(StemmapError, match="all workers of the cluster are gone"):
            pool.call(end_the_worker, b"")


def test_a_task_that_always_fails_is_an_error(address):
    with connected(address) as pool, pytest.raises(StemmapError, match="ValueError: no tree"):
        pool.call(fail, b"no tree")


def test_a_folder_of_runs_is_mapped_to_the_same_bytes_as_here(address, tmp_path, capsys):
    runs = record_runs(tmp_path / "runs", 2)
    assert main(["map", str(runs), "--out", str(tmp_path / "here"), "--jobs", "1"]) == 0
    assert main(["map", str(runs), "--out", str(tmp_path / "there"), "--dask", address]) == 0
    assert bytes_in(tmp_path / "there") == bytes_in(tmp_path / "here")
    assert capsys.readouterr().err == ""


def test_jobs_are_scored_as_here(address):
    run = prepare_run(PlannedRun(SourceRequest("sim:stand?duration=1"))).run
    sets = [preset("forest").replace({"clustering.eps": eps}).model_dump() for eps in (0.2, 0.4)]
    jobs = [Job(run, values) for values in sets]
    with closing(ScoringProcesses[int](1, pool=DaskPool(address))) as processes:
        assert processes.count == 2
        answers = sweep(jobs, processes)
    expected = [Scorer().score(job) for job in jobs]
    assert [answer.scores for answer in answers] == [each.scores for each in expected]
    assert not [answer.error for answer in answers if answer.error]


def test_workers_of_another_version_are_refused(address, monkeypatch):
    monkeypatch.setattr("app.extensions.cluster.dask_pool.code_digest", _other_version)
    with pytest.raises(StemmapError, match="Install the same version there"):
        _ = DaskPool(address).count


def test_without_a_scheduler_the_command_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("app.extensions.cluster.dask_pool._PATIENCE_S", 0.5)
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    out = tmp_path / "out"
    assert main(["map", str(tmp_path), "--out", str(out), "--dask", "tcp://127.0.0.1:9"]) == 1
    assert "no Dask scheduler answers" in capsys.readouterr().err
    assert not out.exists()


def _other_version() -> str:
    return f"another version in each process, as {os.getpid()}"
