"""All jobs are done once, whoever is lost on the way; what is known is not done again."""

from __future__ import annotations

import json
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from app.tuning.jobs import Job, JobResult, code_digest
from app.tuning.sweep import MOST_LOSSES, ResultStore, sweep
from app.tuning.workers import Done, Event, Lost, Processes, answered
from tests.app.tuning.jobs import job, scores
from tests.app.tuning.scores import scores as plain_scores

NOTHING = ResultStore(None)
Does = Callable[[str, Job], JobResult | str]


def fine(_worker: str, asked: Job) -> JobResult:
    """Every job works."""
    return JobResult(scores(asked.parameters["clustering"]["eps"]), seconds=1.0)


class InMemory:
    """Workers without processes; `does` gives the answer, or why the worker is lost."""

    def __init__(self, names: list[str], does: Does) -> None:
        self._free, self._does = names, does
        self._events: deque[Event] = deque()
        self.done: list[tuple[str, Job]] = []

    def free(self) -> list[str]:
        return list(self._free)

    def give(self, worker: str, asked: Job) -> None:
        self._free.remove(worker)
        self.done.append((worker, asked))
        answer = self._does(worker, asked)
        self._events.append(Lost(worker, answer) if isinstance(answer, str) else Done(worker, answer))

    def events(self, _timeout_s: float, /) -> list[Event]:
        if not self._events:
            return []
        event = self._events.popleft()
        self._free.append(event.worker)
        return [event]

    def close(self) -> None:
        """Nothing is open."""


@contextmanager
def processes(count: int, folder: Path) -> Iterator[Processes]:
    """Real processes that cost little, see `fake_worker`."""
    workers = Processes(count, (sys.executable, "-m", "tests.app.tuning.fake_worker", str(folder)))
    try:
        yield workers
    finally:
        workers.close()


def f1_of(answers: list[JobResult]) -> list[float | None]:
    return [None if answer.scores is None else answer.scores.f1 for answer in answers]


def test_answers_come_in_the_order_of_the_jobs_and_like_jobs_are_done_once():
    jobs = [job(eps) for eps in (0.3, 0.1, 0.2, 0.1, 0.3)]
    told: list[int] = []
    workers = InMemory(["a", "b"], fine)
    outcome = sweep(jobs, workers, NOTHING, told.append)
    assert f1_of(outcome.answers) == [0.3, 0.1, 0.2, 0.1, 0.3]
    assert len(workers.done) == sum(told) == 3


def test_a_worker_goes_on_with_the_scans_that_it_looked_at():
    looks = [job(eps, particles=particles) for particles in (5, 6, 7) for eps in (0.1, 0.2)]
    workers = InMemory(["a", "b"], fine)
    sweep(looks, workers, NOTHING)
    for name in ("a", "b"):
        assert len({asked.parameters["clustering"]["eps"] for who, asked in workers.done if who == name}) == 1


def test_processes_that_are_killed_in_the_middle_are_replaced_and_counted(tmp_path):
    jobs = [job(0.1), job(0.2, seed=13), job(0.3), job(0.4, seed=666)]
    with processes(2, tmp_path) as workers:
        outcome = sweep(jobs, workers, NOTHING)
    assert f1_of(outcome.answers) == [0.1, 0.2, 0.3, None]
    assert outcome.lost == {"signal 9, SIGKILL": 1 + MOST_LOSSES}
    assert f"{MOST_LOSSES} workers were lost" in outcome.answers[3].error


def test_what_a_killed_sweep_had_done_is_not_done_again(tmp_path):
    jobs = [job(eps) for eps in (0.1, 0.2, 0.3)]

    def stopped(worker: str, asked: Job) -> JobResult:
        if asked == jobs[2]:
            raise KeyboardInterrupt
        return fine(worker, asked)

    with pytest.raises(KeyboardInterrupt):
        sweep(jobs, InMemory(["a"], stopped), ResultStore(tmp_path))
    workers = InMemory(["a"], fine)
    outcome = sweep(jobs, workers, ResultStore(tmp_path))
    # Of the second no answer was heard: the program was killed before.
    assert outcome.known + len(workers.done) == len(jobs)
    assert outcome.known >= 1
    assert f1_of(outcome.answers) == [0.1, 0.2, 0.3]


def test_damaged_and_foreign_files_are_computed_again_and_failures_are_not_kept(tmp_path):
    jobs = [job(0.1), job(0.2)]
    fails = InMemory(["a"], lambda *_: JobResult(None, error="no", fault="job"))
    assert f1_of(sweep(jobs, fails, ResultStore(tmp_path)).answers) == [None, None]
    sweep(jobs, InMemory(["a"], fine), ResultStore(tmp_path))
    files = sorted(tmp_path.rglob("*.json"))
    assert len(files) == 2
    files[0].write_bytes(files[0].read_bytes()[:-5])
    outcome = sweep(jobs, InMemory(["a"], fine), ResultStore(tmp_path))
    assert outcome.known == 1
    assert any("1 stored result could not be read" in warning for warning in outcome.warnings)
    assert sweep(jobs, InMemory(["a"], fine), ResultStore(tmp_path)).known == 2


@pytest.mark.parametrize(
    "harm",
    [{"TA": 3}, {"TA": {"count": None, "of": 4}}, {"f1": "0.5"}, {"f1": [1]}, {"spurious": True}, None],
)
def test_an_answer_without_the_figures_is_none_wherever_it_comes_from(harm, tmp_path):
    good = plain_scores(0.1)
    text = json.dumps({"scores": {} if harm is None else {**good, **harm}})
    assert answered("a", text.encode()) == Lost("a", "it sent an invalid answer")
    code = f"import sys\nsys.stdin.readline()\nprint({text!r}, flush=True)\nsys.stdin.read()"
    outcome = sweep([job(0.1)], Processes(1, (sys.executable, "-c", code)), NOTHING)
    assert outcome.answers[0].scores is None
    assert [count for reason, count in outcome.lost.items() if "protocol error" in reason] == [MOST_LOSSES]
    kept = ResultStore(tmp_path)
    kept.put(job(0.1).key(), fine("a", job(0.1)))
    (file,) = tmp_path.rglob("*.json")
    file.write_text(text)
    outcome = sweep([job(0.1)], InMemory(["b"], fine), kept)
    assert (outcome.known, f1_of(outcome.answers)) == (0, [0.1])
    assert any("1 stored result could not be read" in warning for warning in outcome.warnings)


def test_where_nothing_can_be_written_the_results_come_all_the_same(tmp_path):
    (tmp_path / "file").touch()
    outcome = sweep([job(0.1)], InMemory(["a"], fine), ResultStore(tmp_path / "file"))
    assert f1_of(outcome.answers) == [0.1]
    assert any("not stored" in warning for warning in outcome.warnings)


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
    other_code = msgspec.structs.replace(job(0.1), code="older")
    source = msgspec.structs.replace(job(0.1).run.source, uri="/else")
    elsewhere = msgspec.structs.replace(job(0.1), run=msgspec.structs.replace(job(0.1).run, source=source))
    assert other_code.key() != job(0.1).key() == elsewhere.key()


def test_a_worker_without_the_recording_leaves_it_to_others_and_is_told():
    def there_alone(worker: str, asked: Job) -> JobResult:
        return fine(worker, asked) if worker == "b" else JobResult(None, error="no such file", fault="worker")

    outcome = sweep([job(0.1), job(0.2)], InMemory(["a", "b"], there_alone), NOTHING)
    assert f1_of(outcome.answers) == [0.1, 0.2]
    assert outcome.warnings == ["a: no such file"]


def test_where_no_worker_has_the_recording_its_jobs_fail_and_others_go_on():
    def lacking(worker: str, asked: Job) -> JobResult:
        return (
            JobResult(None, error="no such file", fault="worker")
            if asked.run.digest == "x"
            else fine(worker, asked)
        )

    jobs = [job(0.1, digest="x"), job(0.2), job(0.3, digest="x")]
    outcome = sweep(jobs, InMemory(["a", "b"], lacking), NOTHING)
    assert f1_of(outcome.answers) == [None, 0.2, None]
    assert outcome.answers[0].error == "no such file"


def test_without_workers_the_sweep_ends_and_says_so():
    outcome = sweep([job(0.1)], InMemory([], fine), NOTHING, nobody_s=0.0)
    assert "no worker was available" in outcome.answers[0].error


def test_the_digest_of_the_code_depends_on_the_sources_of_the_pipeline(monkeypatch):
    monkeypatch.setattr("pathlib.Path.rglob", lambda *_: iter(()))
    assert code_digest.__wrapped__() != code_digest()
