"""Two machines at one search, by way of a PostgreSQL server."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from typing import Any

import msgspec
import pytest

from app.tuning.plan import Plan, RunScore, Trial
from app.tuning.search import Search, SearchRun
from pipeline.config import Parameters
from tests.app.tuning.test_search import exhaust, plan, searched
from tests.postgresql import empty, running

TRIALS = 6


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running() as address:
        yield address


@pytest.fixture
def told(server: str, tmp_path: Path) -> Plan:
    """A search that nobody has begun."""
    empty(server, "stemmap_tuning")
    return plan(tmp_path, storage=server, trials=TRIALS)


@pytest.fixture(autouse=True)
def _scored_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a set scores is no matter here; the run itself is opened and mapped with the start."""

    def scores(runs: list[SearchRun], parameters: Parameters, _tick: object) -> list[RunScore]:
        found = round(parameters.detection.e_max)
        return [RunScore(found, 200 - found, 0, 0, 0, 0.1, 1.0) for _ in runs]

    monkeypatch.setattr("app.tuning.search.scores_of", scores)


def on_machine(search: Search, name: str) -> Search:
    """The search as another machine makes it, on which nobody sees the processes of this one."""
    search._host, search._me = f"{name} ", f"{name} 1"
    return search


def by_whom(search: Search) -> dict[int, str]:
    """Which machine made each trial, by the trials' numbers."""
    return {
        t.number: t.user_attrs["by"].split()[0]
        for t in search._all()
        if t.state.name in ("COMPLETE", "PRUNED")
    }


def test_a_search_on_a_server_makes_the_trials_that_a_journal_gets(told: Plan, tmp_path: Path):
    assert searched(told) == searched(plan(tmp_path, "journal", trials=TRIALS))


def test_two_machines_share_the_trials(told: Plan):
    together = Barrier(2, timeout=60)

    def machine(name: str) -> tuple[list[Trial], dict[int, str]]:
        together.wait()
        search = on_machine(Search(told), name)
        try:
            search.begin()
            ask: Any = search.study.ask
            meetings = iter(range(2))

            def asked() -> Any:
                if next(meetings, None) is not None:  # the first ones are asked for at the same time
                    together.wait()
                return ask()

            search.study.ask = asked
            exhaust(search)
            return search.trials(), by_whom(search)
        finally:
            search.close()

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(machine, ["red", "blue"]))
    search = Search(told)
    try:
        made, who = search.trials(), by_whom(search)
        assert search.step() is None
    finally:
        search.close()
    assert len(made) == TRIALS
    assert set(who.values()) == {"red", "blue"}
    assert len({tuple(trial.values.items()) for trial in made}) == TRIALS
    assert made[0].values == {"detection.e_max": 60.0, "classification.tree_share": 0.4}


def test_the_last_trial_is_begun_by_one_of_two_that_ask_at_once(told: Plan):
    one, other = on_machine(Search(told), "red"), on_machine(Search(told), "blue")
    try:
        one.begin()
        other.begin()
        while len(one.trials()) < TRIALS - 1:
            one.step()
        ask: Any = one.study.ask

        def asked() -> Any:
            one.study.ask = ask
            assert other.step() is not None  # between the look at what is left and the worker_client
            return ask()

        one.study.ask = asked
        assert one.step() is None
        assert len(one.trials()) == len(other.trials()) == TRIALS
    finally:
        one.close()
        other.close()


HANG = """
import sys, time
import msgspec
from app.tuning.plan import Plan
from app.tuning.search import Search

def hang(*_):
    print("begun", flush=True)
    time.sleep(600)

search = Search(msgspec.json.decode(sys.stdin.buffer.read(), type=Plan))
search._make = hang
search.step()
"""


def test_a_machine_that_is_killed_blocks_nobody(told: Plan):
    machine = subprocess.Popen([sys.executable, "-c", HANG], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert machine.stdin is not None
    assert machine.stdout is not None
    with machine.stdin, machine.stdout:
        machine.stdin.write(msgspec.json.encode(told))
        machine.stdin.close()
        try:
            assert machine.stdout.readline() == b"begun\n"
        finally:
            machine.kill()
            machine.wait(30)
    search = Search(told)
    try:
        search.begin()
        exhaust(search)
        assert [trial.number for trial in search.trials()] == list(range(TRIALS))
    finally:
        search.close()


def test_a_trial_of_a_machine_that_tells_nothing_is_made_by_another_once_patience_ends(
    told: Plan, monkeypatch
):
    lost, search = on_machine(Search(told), "red"), on_machine(Search(told), "blue")
    try:
        lost.begin()
        monkeypatch.setattr(lost, "_make", lambda *_: None)  # it begins the first trial and tells no more
        assert lost.step() is None
        search.begin()
        exhaust(search)
        assert [trial.number for trial in search.trials()] == list(range(1, TRIALS))
        monkeypatch.setattr("app.tuning.search._ABANDONED_S", 0.0)
        exhaust(search)
        assert [trial.number for trial in search.trials()] == list(range(TRIALS))
    finally:
        lost.close()
        search.close()
