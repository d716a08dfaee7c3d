"""A set's scores are those of mapping with it, whether or not the scans were looked at for another set."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import msgspec
import pytest

from app.cli import main
from app.extensions.search.jobs import Job
from app.extensions.search.plan import PlannedRun
from app.extensions.search.scoring import PreparedRun, Scorer, prepare_run
from app.sources.request import SourceRequest
from pipeline.config import preset

RUN = "sim:paper?duration=1"
LONGER = "sim:paper?duration=6"  # long enough for what is known of a run before to be gone on from
SETS: tuple[tuple[dict[str, float], bool], ...] = (
    ({}, True),
    ({"tracking.hits_to_confirm": 9}, False),
    ({"evaluation.match_distance": 0.05}, False),
    ({"detection.e_max": 20.0}, False),
    ({"detection.e_max": 20.0, "tracking.proximity_radius": 0.3}, False),
    ({"slam.particles": 7}, False),
    ({"clustering.eps": 0.3}, True),
    ({"clustering.eps": 0.3, "classification.tree_share": 0.9}, False),
)


def ready(name: str) -> PreparedRun:
    """A run as on the command line."""
    return prepare_run(PlannedRun(SourceRequest(name, seed=3)))


def test_scores_are_those_of_mapping(tmp_path, capsys):
    job = Job(ready(RUN).run, preset("forest").replace({"slam.gate": 2.0}).model_dump())
    answer = Scorer().score(job)
    assert main(["map", RUN, "--seed", "3", "--out", str(tmp_path), "--set", "slam.gate=2"]) == 0
    mapped = json.loads((tmp_path / "run.json").read_text())
    assert answer.scores is not None, answer.error
    assert json.loads(json.dumps(asdict(answer.scores))) == mapped["evaluation"]
    assert (answer.scans, answer.trees) == (mapped["scans"], mapped["trees"])


@pytest.mark.slow
def test_scans_are_looked_at_once_for_like_sets_and_the_scores_are_those_of_looking_anew():
    run, one = ready(LONGER), Scorer()
    for changes, looks in SETS:
        job = Job(run.run, preset("forest").replace(changes).model_dump())
        answer, fresh = one.score(job), Scorer()
        assert answer.scores == fresh.score(job).scores is not None, changes
        assert answer.looked == looks, changes
        fresh.close()
    one.close()


def test_a_cached_scan_that_is_damaged_is_reported(monkeypatch):
    run, scorer = ready(RUN), Scorer()
    job = Job(run.run, preset("forest").model_dump())
    assert scorer.score(job).scores is not None
    monkeypatch.setattr("pipeline.io.block_file.zstandard.frame_content_size", lambda _block: -1)
    second = scorer.score(job)
    scorer.close()
    assert "is damaged" in second.error


def test_a_recording_that_is_gone_or_was_replaced_is_reported():
    run = ready(RUN)
    fine = Job(run.run, preset("forest").model_dump())
    other = msgspec.structs.replace(fine, run=msgspec.structs.replace(run.run, digest="another"))
    gone = msgspec.structs.replace(
        fine, run=msgspec.structs.replace(run.run, source=SourceRequest("gone.mcap"))
    )
    for job, says in ((other, "replaced by another one"), (gone, "gone.mcap")):
        answer = Scorer().score(job)
        assert answer.scores is None
        assert says in answer.error


def test_truth_far_from_the_path_is_no_score():
    run = ready(RUN)
    far = [replace(content, x=content.x + 900.0) for content in run.run.truth]
    asked = msgspec.structs.replace(run.run, truth=far)
    scorer = Scorer()
    answer = scorer.score(Job(asked, preset("forest").model_dump()))
    scorer.close()
    assert "no ground truth is within 10 m" in answer.problem


# --- the command ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["none.mcap", "--param-grid", "slam.gate=2,3"], 1, "none.mcap"),
        ([RUN, "--param-grid", "filters.x_min=1", "--param-grid", "filters.x_max=-1"], 2, "none of 1 set"),
        ([RUN, "--out", "x"], 2, "--param-grid"),
        ([RUN, "--truth", "a", "--truth", "b"], 2, "2 files of true trees for 1 run"),
    ],
    ids=str,
)  # fmt: skip
def test_what_cannot_be_is_said_in_one_line(capsys, words, code, says):
    assert main(["evaluate", *words]) == code
    told = capsys.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert says in told.err
