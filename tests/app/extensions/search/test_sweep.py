"""All jobs are done once, whichever process is lost on the way; what is known is not done again."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import pytest

from app.common.text import code_digest
from app.extensions.search.jobs import (
    MOST_LOSSES,
    Job,
    JobResult,
    LostError,
    ResultStore,
    ScoringProcesses,
)
from app.extensions.search.report import sweep
from tests.app.extensions.search.inline_worker import InlineProcesses
from tests.app.extensions.search.jobs import job, scores
from tests.app.extensions.search.scores import scores as plain_scores


def fine(_worker: int, asked: Job) -> JobResult:
    """Every job works."""
    return JobResult(scores(asked.parameters["clustering"]["eps"]), seconds=1.0)


@contextmanager
def processes(count: int, folder: Path) -> Iterator[ScoringProcesses[int]]:
    """Real processes that cost little, see `fake_worker`."""
    command = (sys.executable, "-m", "tests.app.extensions.search.fake_worker", str(folder))
    with closing(ScoringProcesses[int](count, command)) as made:
        yield made


def f1_of(answers: list[JobResult]) -> list[float | None]:
    return [None if answer.scores is None else answer.scores.f1 for answer in answers]


def test_answers_come_in_the_order_of_the_jobs_and_like_jobs_are_done_once():
    jobs = [job(eps) for eps in (0.3, 0.1, 0.2, 0.1, 0.3)]
    told: list[int] = []
    workers = InlineProcesses(fine, 2)
    answers = sweep(jobs, workers, told.append)
    assert f1_of(answers) == [0.3, 0.1, 0.2, 0.1, 0.3]
    assert (len(workers.done), sum(told)) == (3, 5)


def test_a_worker_goes_on_with_the_scans_that_it_looked_at():
    looks = [job(eps, particles=particles) for particles in (5, 6, 7) for eps in (0.1, 0.2)]
    workers = InlineProcesses(fine, 2)
    sweep(looks, workers)
    for name in (0, 1):
        assert len({asked.parameters["clustering"]["eps"] for who, asked in workers.done if who == name}) == 1


def test_threads_that_store_the_same_result_do_not_disturb_one_another(tmp_path):
    kept, answer = ResultStore(tmp_path), JobResult(scores(0.5))
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda _: kept.put("job", answer), range(100)))
        assert list(threads.map(lambda _: kept.get("job"), range(100))) == [answer] * 100
    assert (kept.refusal, kept.used) == ("", 100)


def test_only_the_results_used_last_stay(tmp_path, monkeypatch):
    monkeypatch.setattr("app.extensions.search.jobs.MOST_FILES", 3)
    kept, answer = ResultStore(tmp_path), JobResult(scores(0.5))
    for number in range(6):
        kept.put(str(number), answer)
        os.utime(ResultStore._file(tmp_path, str(number)), (number, number))
    later = ResultStore(tmp_path)
    assert later.get("1") == answer, "used now"
    later.put("6", answer)
    assert [number for number in range(7) if later.get(str(number))] == [1, 4, 5, 6]


def test_processes_that_are_killed_in_the_middle_are_replaced_and_counted(tmp_path):
    jobs = [job(0.1), job(0.2, seed=13), job(0.3), job(0.4, seed=666)]
    with processes(2, tmp_path) as workers:
        answers = sweep(jobs, workers)
    assert f1_of(answers) == [0.1, 0.2, 0.3, None]
    assert workers.lost == {"signal 9, SIGKILL": 1 + MOST_LOSSES}
    assert f"{MOST_LOSSES} processes were lost" in answers[3].error


def test_what_a_killed_sweep_had_done_is_not_done_again(tmp_path):
    jobs = [job(eps) for eps in (0.1, 0.2, 0.3)]

    def stopped(worker: int, asked: Job) -> JobResult:
        if asked == jobs[2]:
            raise KeyboardInterrupt
        return fine(worker, asked)

    with pytest.raises(KeyboardInterrupt):
        sweep(jobs, InlineProcesses(stopped, kept=ResultStore(tmp_path)))
    workers = InlineProcesses(fine, kept=ResultStore(tmp_path))
    answers = sweep(jobs, workers)
    assert (workers.kept.used, len(workers.done)) == (2, 1)
    assert f1_of(answers) == [0.1, 0.2, 0.3]


def test_damaged_and_foreign_files_are_computed_again_and_failures_are_not_kept(tmp_path):
    jobs = [job(0.1), job(0.2)]
    fails = InlineProcesses(lambda *_: JobResult(None, error="no"), kept=ResultStore(tmp_path))
    assert f1_of(sweep(jobs, fails)) == [None, None]
    sweep(jobs, InlineProcesses(fine, kept=ResultStore(tmp_path)))
    files = sorted(tmp_path.rglob("*.json"))
    assert len(files) == 2
    files[0].write_bytes(files[0].read_bytes()[:-5])
    kept, again = ResultStore(tmp_path), ResultStore(tmp_path)
    sweep(jobs, InlineProcesses(fine, kept=kept))
    assert kept.used == 1
    assert any("1 stored result could not be read" in warning for warning in kept.warnings())
    sweep(jobs, InlineProcesses(fine, kept=again))
    assert again.used == 2


@pytest.mark.parametrize(
    "harm",
    [{"TA": 3}, {"f1": "0.5"}, {"spurious": True}, None],
)
def test_an_answer_without_the_figures_is_none_wherever_it_comes_from(harm, tmp_path):
    good = plain_scores(0.1)
    text = json.dumps({"scores": {} if harm is None else {**good, **harm}})
    code = f"import sys\nsys.stdin.readline()\nprint({text!r}, flush=True)\nsys.stdin.read()"
    with closing(ScoringProcesses[int](1, (sys.executable, "-c", code))) as invalid:
        answers = sweep([job(0.1)], invalid)
    assert answers[0].scores is None
    assert [count for reason, count in invalid.lost.items() if "protocol error" in reason] == [MOST_LOSSES]
    kept = ResultStore(tmp_path)
    kept.put(job(0.1).key(), fine(0, job(0.1)))
    (file,) = tmp_path.rglob("*.json")
    file.write_text(text)
    answers = sweep([job(0.1)], InlineProcesses(fine, kept=kept))
    assert (kept.used, f1_of(answers)) == (0, [0.1])
    assert any("1 stored result could not be read" in warning for warning in kept.warnings())


def test_a_process_that_ends_with_an_error_is_lost_and_the_other_jobs_go_on():
    """Lack of memory, for example, reaches the parent as a line."""
    code = """
import sys
for job in sys.stdin:
    bad = '"eps":0.1' in job
    print('!["out of memory","",""]' if bad else '{"scores":null,"error":"fine"}', flush=True)
    if bad:
        break
"""
    with closing(ScoringProcesses[int](1, (sys.executable, "-c", code))) as failing:
        answers = sweep([job(0.1), job(0.2)], failing)
    assert [answer.scores for answer in answers] == [None, None]
    assert answers[0].error.endswith("the last one: out of memory")
    assert answers[1].error == "fine"
    assert failing.lost == {"out of memory": MOST_LOSSES}


def test_where_nothing_can_be_written_the_results_come_all_the_same(tmp_path):
    (tmp_path / "file").touch()
    kept = ResultStore(tmp_path / "file")
    assert f1_of(sweep([job(0.1)], InlineProcesses(fine, kept=kept))) == [0.1]
    assert any("not stored" in warning for warning in kept.warnings())


@pytest.mark.parametrize(
    "change",
    [
        {"eps": 0.2},
        {"seed": 1},
        {"digest": "other"},
        {"particles": 5},
    ],
    ids=str,
)
def test_another_run_or_set_has_another_key(change):
    assert job(0.1).key() != job(**{"eps": 0.1, **change}).key()
    source = msgspec.structs.replace(job(0.1).run.source, uri="/else")
    elsewhere = msgspec.structs.replace(job(0.1), run=msgspec.structs.replace(job(0.1).run, source=source))
    assert job(0.1).key() == elsewhere.key()


def test_results_of_other_code_are_computed_again(tmp_path, monkeypatch):
    sweep([job(0.1)], InlineProcesses(fine, kept=ResultStore(tmp_path)))
    monkeypatch.setattr("app.extensions.search.jobs.code_digest", lambda: "older")
    assert ResultStore(tmp_path).get(job(0.1).key()) is None


def test_processes_that_are_closed_during_a_job_leave_none_behind(tmp_path):
    (tmp_path / "wait").touch()
    with processes(1, tmp_path) as made:
        doing = made.submit(job(0.1))
        while not made._children:
            time.sleep(0.01)
    assert isinstance(doing.exception(10.0), LostError)
    assert [child.returncode is None for child in made._children.values()] == [False]


def test_the_digest_of_the_code_depends_on_the_sources_of_the_pipeline(monkeypatch):
    monkeypatch.setattr("pathlib.Path.rglob", lambda *_: iter(()))
    assert code_digest.__wrapped__() != code_digest()
