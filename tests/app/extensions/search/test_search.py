"""The search over a short simulated run: the same each time, stopped and gone on with, shared and refused."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import closing
from typing import Any

import msgspec
import pytest

from app.batch.run_folder import read_run_record
from app.cli import main
from app.cli.flags import files_of
from app.dashboard.parameters import read_file
from app.extensions.search.jobs import JobResult, ResultStore
from app.extensions.search.plan import Plan, PlannedRun, Trial, axes_of
from app.extensions.search.result import result_of
from app.extensions.search.search import Search, search_processes
from app.sources.request import SourceRequest
from app.store.records import Content, as_truth, contents_of
from pipeline.config import preset
from pipeline.errors import ParameterError, StemmapError
from tests.app.extensions.search.inline_worker import InlineProcesses
from tests.app.extensions.search.provenance import provenance_in

RUN, OTHER = "sim:stand?duration=1", "sim:stand?duration=1&seed=3"
OVER = ["detection.e_max=5..200", "classification.tree_share=0.1..1"]


def plan(**changes: object) -> Plan:
    """A search over two parameters of a short run."""
    search_plan = Plan(
        runs=(PlannedRun(SourceRequest(RUN)),),
        axes=axes_of(OVER),
        start=preset("forest").model_dump(),
        trials=9,
    )
    return msgspec.structs.replace(search_plan, **changes)


def exhaust(search: Search, most: int = 1000) -> None:
    """Make all trials that are left, or so many."""
    made = 0
    while not search.is_complete and made < most:
        made += len(search.advance())


def searched(
    search_plan: Plan, most: int = 1000, kept: ResultStore | None = None, count: int = 1
) -> list[Trial]:
    """The first trials of a search."""
    with closing(InlineProcesses(kept=kept, count=count)) as worker:
        search = Search(search_plan, worker)
        exhaust(search, most)
        return search.trials()


@pytest.fixture(scope="module")
def whole() -> list[Trial]:
    return searched(plan())


def test_the_start_is_tried_first_and_is_never_better_than_the_best(whole):
    assert len(whole) == 9
    assert whole[0].values == {"detection.e_max": 60.0, "classification.tree_share": 0.4}
    assert min(trial.loss for trial in whole) <= whole[0].loss
    assert len({trial.loss for trial in whole}) > 1


def test_a_stopped_search_goes_on_to_the_same_trials(whole, tmp_path):
    assert searched(plan(), 5, ResultStore(tmp_path)) == whole[:5]
    kept = ResultStore(tmp_path)
    assert searched(plan(), kept=kept) == whole
    assert kept.used >= 6  # the start has the values of the first trial


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, -1])
def test_trials_do_not_depend_on_which_of_two_processes_is_faster(order):
    made: list[list[Trial]] = []

    class Reordered(InlineProcesses):
        def advance(self, *given: Any) -> list[Any]:
            return super().advance(*given)[::order]

    for workers in (InlineProcesses(count=2), Reordered(count=2)):
        with closing(workers):
            search = Search(plan(), workers)
            exhaust(search)
            made.append(search.trials())
    assert made[0] == made[1]
    assert [trial.number for trial in made[0]] == list(range(9))


def test_what_a_trial_scores_is_what_map_scores(whole, tmp_path):
    trial = whole[3]
    sets = [word for name, value in trial.values.items() for word in ("--set", f"{name}={value}")]
    assert main(["map", RUN, "--out", str(tmp_path / "out"), *sets]) == 0
    written = read_run_record(tmp_path / "out")["evaluation"]
    score = trial.training[0]
    assert (score.TA.count, score.FA.count, score.spurious) == (
        written["TA"]["count"],
        written["FA"]["count"],
        written["spurious"],
    )
    assert (score.position_rmse, score.mean_pair_error_percent) == (
        written["position_rmse"],
        written["mean_pair_error_percent"],
    )


def test_sets_that_contradict_themselves_are_counted_and_left_out():
    search_plan = plan(axes=axes_of(["detection.e_min=1..100", "detection.e_max=10..100"]), trials=6)
    with closing(InlineProcesses()) as worker:
        search = Search(search_plan, worker)
        exhaust(search)
        result = result_of(search)
    assert result.made == 6
    assert 0 < result.refused < 6
    preset("forest").replace(dict(result.best.values))  # else it would say what contradicts


def test_a_job_that_fails_ends_the_search():
    dead = InlineProcesses(lambda *_: JobResult(None, error="exit code 1"))
    with pytest.raises(StemmapError, match="exit code 1"):
        exhaust(Search(plan(), dead))


@pytest.mark.slow  # the processes start
def test_two_processes_make_as_many_trials_and_one_that_is_killed_is_replaced(whole):
    search_plan = plan(trials=4)
    with closing(search_processes(search_plan, 2)) as workers:
        search = Search(search_plan, workers)
        while search.start is None:
            search.advance()
        search.advance(0.0)
        for child in workers._children.values():
            os.kill(child.pid, signal.SIGKILL)
            break
        exhaust(search)
        made = search.trials()
        assert [trial.number for trial in made] == [0, 1, 2, 3]
        assert whole[0].values in [trial.values for trial in made]
        assert sum(workers.lost.values()) <= 1


# --- the command ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_a_set_with_its_provenance(tmp_path, capsys):
    words = ["tune", RUN, "--held-out", OTHER, "--trials", "3", "--out", str(tmp_path / "best.toml")]
    words += ["--keep", str(tmp_path / "results")]
    words += [word for text in OVER for word in ("--over", text)]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "3 trials over 2 parameters" in said.out
    assert "held out (1 run)" in said.out
    text = (tmp_path / "best.toml").read_text()
    name, values = read_file(text, "best.toml")
    assert name == "forest"
    provenance = provenance_in(text)
    assert [run["uri"] for run in provenance["run"]] == [RUN, OTHER]
    changed = values.changes_from(preset("forest"))
    assert set(changed) <= {"detection.e_max", "classification.tree_share"}
    # The same command uses the stored results, and another one with more trials makes them.
    before = len(list((tmp_path / "results").rglob("*.json")))
    assert main([*words, "--trials", "4"]) == 0
    assert 0 <= len(list((tmp_path / "results").rglob("*.json"))) - before <= 2
    assert provenance_in((tmp_path / "best.toml").read_text())["tuned"]["trials"] == 4


@pytest.mark.slow  # the process starts
def test_ctrl_c_keeps_what_is_there(tmp_path):
    out = tmp_path / "best.toml"
    code = "import sys; from app.cli import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "tune", RUN, "--over", OVER[0], "--trials", "100000", "--out", str(out)],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("trial 0"):
            break
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=120)
    assert process.returncode == 3, errors
    assert "the same command continues" in errors
    assert provenance_in(out.read_text())["tuned"]["trials"] >= 1
    assert "written to" in said


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["sim:stand?duration=1", "--truth", "{far}"], 1, "no ground truth is within"),
        (["sim:stand?duration=1", "--truth", "{aside}"], 1, "has a mapped tree within"),
        (["{room}"], 1, "has no true trees"),
        ([RUN, RUN], 2, "named twice"),
        (["zenoh:tcp/127.0.0.1:7447"], 2, "live run"),
        ([RUN, OTHER, "--truth", "{far}"], 2, "Name the run of each file"),
    ],
)
def test_bad_input_is_reported_in_a_line(words, code, message, tmp_path, capsys):
    (tmp_path / "far.csv").write_text("x_m,y_m\n900,900\n")
    (tmp_path / "aside.csv").write_text("x_m,y_m\n0.5,0.1\n")
    room = tmp_path / "room"
    room.mkdir()
    import numpy as np

    np.random.default_rng(0).normal(size=(200, 4)).astype("<f4").tofile(room / "000000.bin")
    places = {"far": tmp_path / "far.csv", "aside": tmp_path / "aside.csv", "room": room}
    given = [word.format(**places) for word in words]
    out = tmp_path / "best.toml"
    assert main(["tune", *given, "--trials", "2", "--out", str(out)]) == code
    said = capsys.readouterr().err.strip().splitlines()
    assert message in said[-1]
    assert not out.exists()


def test_truths_are_given_in_order_or_by_name():
    a, b = "sim:stand?seed=1", "sim:stand?seed=1&x=2"
    assert files_of([a, b], ["1.csv", "2.csv"]) == {a: "1.csv", b: "2.csv"}
    assert files_of([a, b], [f"{b}=2.csv"]) == {b: "2.csv"}
    assert files_of([a, b], [f"{b}=2.csv", "1.csv"]) == {a: "1.csv", b: "2.csv"}
    for wrong in (["1.csv"], [f"{a}=1.csv", f"{a}=2.csv"]):
        with pytest.raises(ParameterError):
            files_of([a, b], wrong)


def test_truth_goes_through_as_plain_values():
    contents = [Content(1.0, 2.0), Content(3.0, 4.0, "pole", 0.1)]
    assert contents_of(as_truth(contents)) == contents
