"""The whole command, on a process here and on two workers of a Dask cluster, of which one is killed."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from app.cli import main
from app.tuning.sweep import ResultStore, sweep
from pipeline.errors import StemmapError
from tests.app.tuning.jobs import job

RUN = "sim:paper?duration=1"
FILES = ("results.csv", "means.csv", "results.json")


def evaluate(folder: Path, *words: str) -> int:
    """Two sets on a run that there is and one that there is not."""
    runs = [RUN, "none.mcap"]
    return main(["evaluate", *runs, "--param-grid", "slam.particles=5..7/3", "--out", str(folder), *words])


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a process of this machine found; what it keeps lies beside."""
    folder = tmp_path_factory.mktemp("here")
    assert evaluate(folder / "out", "--jobs", "1", "--keep", str(folder / "keep")) == 3
    return folder


def test_what_is_known_is_not_computed_again_and_a_run_that_fails_is_said(
    here, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("app.tuning.workers.COMMAND", ("false",))  # a worker that ends at once
    assert evaluate(tmp_path, "--jobs", "1", "--keep", str(here / "keep")) == 3
    told = capsys.readouterr()
    assert "3 stored results used" in told.err
    assert told.err.count("left out: ") == 1
    assert "none.mcap" in told.err
    assert told.out.count("slam.particles=7") >= 1
    for name in FILES:
        assert (here / "out" / name).read_bytes() == (tmp_path / name).read_bytes()


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a scheduler with two workers that are processes."""
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setenv("STEMMAP_TEST_MARK", str(tmp_path / "died"))
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address=None,
        host="127.0.0.1",
        silence_logs=logging.CRITICAL,
    ) as running:
        yield running.scheduler_address


def test_a_worker_of_a_cluster_that_is_killed_is_survived_and_counted(tmp_path, cluster):
    from app.tuning.workers import DaskWorkers
    from tests.app.tuning.dask_work import dies_once_for_nothing

    jobs = [job(0.1), job(0.2, particles=7), job(0.3), job(0.4)]
    with closing(DaskWorkers(cluster, dies_once_for_nothing)) as workers:
        outcome = sweep(jobs, workers, ResultStore(None))
    assert [answer.scores and answer.scores.f1 for answer in outcome.answers] == [0.1, 0.2, 0.3, 0.4]
    assert (tmp_path / "died").exists()
    assert sum(outcome.lost.values()) == 1


@pytest.mark.slow
def test_results_of_a_cluster_that_lost_a_worker_are_those_of_a_process_to_the_byte(
    here, tmp_path, cluster, capsys, monkeypatch
):
    from tests.app.tuning.dask_work import dies_once

    monkeypatch.setattr("app.tuning.scoring.score_json", dies_once)
    keep = ("--keep", str(tmp_path / "keep"))
    assert evaluate(tmp_path / "out", "--dask", cluster, *keep) == 3
    assert (tmp_path / "died").exists()
    assert "1 worker lost during a job" in capsys.readouterr().err
    for name in FILES:
        assert (here / "out" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


def test_a_scheduler_that_does_not_answer_is_said():
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    from app.tuning.workers import DaskWorkers

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with pytest.raises(StemmapError, match="no Dask scheduler answers"):
        DaskWorkers("tcp://127.0.0.1:9", connect_s=0.5)
