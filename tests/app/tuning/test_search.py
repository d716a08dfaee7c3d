"""The search over a short simulated run: the same each time, stopped and gone on with, shared and refused."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from app.batch.run_folder import read_run_record
from app.cli import main
from app.cli.flags import files_of
from app.dashboard.parameters import read_file
from app.sources.request import SourceRequest
from app.store.records import Content, as_truth, contents_of
from app.tuning.jobs import Job, JobResult
from app.tuning.plan import Plan, PlannedRun, Trial, axes_of
from app.tuning.result import result_of
from app.tuning.search import Search, search_processes
from pipeline.config import preset
from pipeline.errors import ParameterError, StemmapError
from tests.app.tuning.inline_worker import InlineProcesses
from tests.app.tuning.provenance import provenance_in

RUN, OTHER = "sim:stand?duration=1", "sim:stand?duration=1&seed=3"
OVER = ["detection.e_max=5..200", "classification.tree_share=0.1..1"]


def plan(folder: Path, name: str = "a", **changes: object) -> Plan:
    """A search over two parameters of a short run."""
    search_plan = Plan(
        runs=(PlannedRun(SourceRequest(RUN)),),
        axes=axes_of(OVER),
        start=preset("forest").model_dump(),
        journal=str(folder / f"{name}.journal"),
        trials=9,
    )
    return msgspec.structs.replace(search_plan, **changes)


def exhaust(search: Search, most: int = 1000) -> None:
    """Make all trials that are left, or so many."""
    made = 0
    while not search.is_complete and made < most:
        made += len(search.advance())


def searched(search_plan: Plan, most: int = 1000) -> list[Trial]:
    """The trials of a search, after so many more."""
    with closing(InlineProcesses()) as worker, closing(Search(search_plan, worker)) as search:
        exhaust(search, most)
        return search.trials()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[Trial]:
    return searched(plan(tmp_path_factory.mktemp("whole")))


def test_the_start_is_tried_first_and_is_never_better_than_the_best(whole):
    assert len(whole) == 9
    assert whole[0].values == {"detection.e_max": 60.0, "classification.tree_share": 0.4}
    assert min(trial.loss for trial in whole) <= whole[0].loss
    assert len({trial.loss for trial in whole}) > 1


def test_a_stopped_search_goes_on_to_the_same_trials(whole, tmp_path):
    search_plan = plan(tmp_path)
    assert searched(search_plan, 5) == whole[:5]

    # Stopped in the middle of a trial, and killed while it wrote.
    def stopped(_worker: int, _job: Job) -> JobResult:
        raise KeyboardInterrupt

    with closing(Search(search_plan, InlineProcesses(stopped))) as search, pytest.raises(KeyboardInterrupt):
        exhaust(search)
    with Path(search_plan.journal).open("ab") as journal:
        journal.write(b'{"number": 5, "val')
    assert searched(search_plan) == whole


def test_a_search_goes_on_from_trials_in_memory(whole, tmp_path):
    search_plan = plan(tmp_path, journal="")
    with closing(InlineProcesses()) as worker, closing(Search(search_plan, worker, whole[:5])) as search:
        exhaust(search)
        assert search.trials() == whole


def test_what_a_trial_scores_is_what_map_scores(whole, tmp_path):
    trial = whole[3]
    sets = [word for name, value in trial.values.items() for word in ("--set", f"{name}={value}")]
    assert main(["map", RUN, "--out", str(tmp_path / "out"), *sets]) == 0
    written = read_run_record(tmp_path / "out")["evaluation"]
    score = trial.training[0]
    assert (score.TA, score.FA, score.spurious) == (
        written["TA"]["count"],
        written["FA"]["count"],
        written["spurious"],
    )
    assert (score.position_rmse, score.pair_error) == (
        written["position_rmse"],
        written["mean_pair_error_percent"],
    )


def test_a_journal_of_another_search_is_left_alone(tmp_path):
    search_plan = plan(tmp_path, trials=1)
    searched(search_plan)
    before = Path(search_plan.journal).read_bytes()
    for changes, words in (
        ({"goal": "position"}, "another goal"),
        ({"axes": axes_of(OVER[:1])}, "other parameters or bounds"),
        ({"seed": 7}, "other runs or another truth, another seed"),
        ({"start": preset("paper").model_dump()}, "to begin with"),
    ):
        with pytest.raises(StemmapError, match=words):
            Search(msgspec.structs.replace(search_plan, **changes), InlineProcesses())
    assert Path(search_plan.journal).read_bytes() == before


def test_a_journal_of_another_version_is_reported(tmp_path, monkeypatch):
    search_plan = plan(tmp_path, trials=1)
    searched(search_plan)
    monkeypatch.setattr("app.tuning.plan.version", lambda: "9.9.9")
    with pytest.raises(StemmapError, match="another version of stemmap"):
        Search(search_plan, InlineProcesses())


@pytest.mark.parametrize(
    "text", [b"x_m,y_m\n1,2\n", b'{"op_code": 0}\n{"op_code": "?"}\n', b"\xff\xfe\n", b"\xff\xfe", b"\n"]
)
def test_a_file_that_is_no_journal_is_left_alone(tmp_path, text):
    search_plan = plan(tmp_path)
    Path(search_plan.journal).write_bytes(text)
    with pytest.raises(StemmapError, match="journal"):
        Search(search_plan, InlineProcesses())
    assert Path(search_plan.journal).read_bytes() == text


def test_sets_that_contradict_themselves_are_counted_and_left_out(tmp_path):
    search_plan = plan(
        tmp_path, axes=axes_of(["detection.e_min=1..100", "detection.e_max=10..100"]), trials=6
    )
    with closing(InlineProcesses()) as worker, closing(Search(search_plan, worker)) as search:
        exhaust(search)
        result = result_of(search)
    assert result.made == 6
    assert 0 < result.refused < 6
    preset("forest").replace(dict(result.best.values))  # else it would say what contradicts


def test_a_job_that_fails_ends_the_search(tmp_path):
    dead = InlineProcesses(lambda *_: JobResult(None, error="exit code 1"))
    with (
        closing(Search(plan(tmp_path), dead)) as search,
        pytest.raises(StemmapError, match="exit code 1"),
    ):
        exhaust(search)


@pytest.mark.slow  # the processes start
def test_two_processes_make_as_many_trials_and_one_that_is_killed_is_replaced(whole, tmp_path):
    search_plan = plan(tmp_path, trials=4)
    with (
        closing(search_processes(search_plan, 2)) as workers,
        closing(Search(search_plan, workers)) as search,
    ):
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
        assert sum(search.lost.values()) <= 1


# --- the command ----------------------------------------------------------------------------------


def test_the_command_writes_a_set_with_its_provenance(tmp_path, capsys):
    words = ["tune", RUN, "--held-out", OTHER, "--trials", "3", "--out", str(tmp_path / "best.toml")]
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
    # The same command goes on with its journal, and another one with more trials makes them.
    assert main([*words, "--trials", "4"]) == 0
    said = capsys.readouterr()
    assert "continuing after 3 trials" in said.err
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


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["sim:stand?duration=1", "--truth", "{far}"], 1, "no ground truth is within"),
        (["sim:stand?duration=1", "--truth", "{aside}"], 1, "has a mapped tree within"),
        (["{room}"], 1, "has no true trees"),
        (["sim:nowhere"], 2, "nowhere"),
        ([RUN, RUN], 2, "named twice"),
        (["zenoh:tcp/127.0.0.1:7447"], 2, "live run"),
        ([RUN, "--over", "detection.e_min=9..1"], 2, "must be less"),
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
