"""Two machines at one search, by way of a PostgreSQL server."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from threading import Barrier

import msgspec
import pytest

from app.tuning.jobs import Job, JobResult
from app.tuning.plan import Plan, Trial
from app.tuning.search import Search
from pipeline.errors import StemmapError
from tests.app.tuning.inline_worker import InlineWorker
from tests.app.tuning.scores import scores
from tests.app.tuning.test_search import exhaust, plan
from tests.postgresql import empty, running

TRIALS = 6


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running() as address:
        yield address


@pytest.fixture
def search_plan(server: str, tmp_path: Path) -> Plan:
    """A search that nobody has begun."""
    empty(server, "stemmap_search")
    return plan(tmp_path, storage=server, trials=TRIALS)


def scored(job: Job) -> JobResult:
    """What a set scores is no matter here, but it differs from set to set."""
    wrong = round(job.parameters["detection"]["e_max"])
    return msgspec.convert({"scores": scores(0.5, wrong=wrong)}, JobResult)


def searched(search_plan: Plan) -> list[Trial]:
    with closing(Search(search_plan, InlineWorker(scored))) as search:
        exhaust(search)
        return search.trials()


def test_a_search_on_a_server_makes_the_trials_that_a_journal_gets(search_plan: Plan, tmp_path: Path):
    made = searched(search_plan)
    assert made == searched(plan(tmp_path, "journal", trials=TRIALS))
    assert made == searched(search_plan)  # nothing is left to be done


def test_two_machines_share_the_trials(search_plan: Plan):
    together = Barrier(2, timeout=60)

    def machine(_name: str) -> int:
        with closing(Search(search_plan, InlineWorker(scored))) as search:
            together.wait()
            made = 0
            while not search.is_complete:
                made += len(search.advance())
                if made == 1:  # both are there from the first trial on
                    together.wait()
                    made += len(search.advance())
            return made

    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(machine, ["red", "blue"]))
    assert sum(made) == TRIALS
    assert min(made) >= 1
    trials = searched(search_plan)
    assert [trial.number for trial in trials] == list(range(TRIALS))
    assert len({tuple(trial.values.items()) for trial in trials}) == TRIALS
    assert {"detection.e_max": 60.0, "classification.tree_share": 0.4} in [trial.values for trial in trials]


def test_a_set_beyond_the_number_of_trials_is_not_stored(search_plan: Plan):
    with (
        closing(Search(search_plan, InlineWorker(scored))) as one,
        closing(Search(search_plan, InlineWorker(scored))) as other,
    ):
        while len(one.trials()) < TRIALS - 1:
            one.advance()

        def slow(job: Job) -> JobResult:
            exhaust(other)  # while the set is scored here
            return scored(job)

        one._workers = InlineWorker(slow)
        assert one.advance() == []
        assert one.is_complete
        assert one.trials() == other.trials()
        assert len(one.trials()) == TRIALS


HANG = """
import sys, time
import msgspec
from app.tuning.plan import Plan
from app.tuning.search import Search
from tests.app.tuning.inline_worker import InlineWorker
from tests.app.tuning.test_sharing import scored

begun = []

def hang(job):
    if begun:
        print("begun", flush=True)
        time.sleep(600)
    begun.append(job)
    return scored(job)

search = Search(msgspec.json.decode(sys.stdin.buffer.read(), type=Plan), InlineWorker(hang))
while True:
    search.advance()
"""


def test_a_machine_that_is_killed_in_a_trial_blocks_nobody(search_plan: Plan, tmp_path: Path):
    machine = subprocess.Popen([sys.executable, "-c", HANG], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert machine.stdin is not None
    assert machine.stdout is not None
    with machine.stdin, machine.stdout:
        machine.stdin.write(msgspec.json.encode(search_plan))
        machine.stdin.close()
        try:
            assert machine.stdout.readline() == b"begun\n"
        finally:
            machine.kill()
            machine.wait(30)
    made = searched(search_plan)
    assert [trial.number for trial in made] == list(range(TRIALS))
    assert made == searched(plan(tmp_path, "journal", trials=TRIALS))


def test_a_database_that_is_gone_is_reported_in_a_line(search_plan: Plan):
    with pytest.raises(StemmapError, match="the database cannot be used"):
        Search(
            msgspec.structs.replace(search_plan, storage="postgresql://nobody@127.0.0.1:9/none"),
            InlineWorker(),
        )
