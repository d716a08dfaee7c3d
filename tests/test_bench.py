"""The benchmarks' machinery, and the peer: a comparison is worth something when its peer is right."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from datetime import date
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.cli import FAILED, WRONG_USAGE
from pipeline.config import preset
from pipeline.errors import StemmapError
from tests.benchmarks import process, recorded, runner
from tests.benchmarks.__main__ import main
from tests.benchmarks.campaign import Result
from tests.benchmarks.cases import campaign, rivals
from tests.benchmarks.cases.peer import Comparison, compare
from tests.benchmarks.peer.fastslam import FastSlam, Landmark, Particle, resample
from tests.benchmarks.peer.stages import Detection, detect
from tests.benchmarks.peer.trees import TreeMap
from tests.benchmarks.table import Table, ratio
from tests.benchmarks.timing import in_turns, quantile

DAY = date(2026, 1, 31)
TABLE = Table(
    "Times of A and B", ("side", "ms"), (("ours", 1.234), ("peer", 1234.5), ("none", None)), ("a note",)
)
PAPER: dict[str, Any] = dict(preset("paper").flat())


# --- tables and times ------------------------------------------------------------------------------


def test_a_table_as_markdown() -> None:
    assert TABLE.markdown().splitlines() == [
        "### Times of A and B",
        "",
        "| side |    ms |",
        "| ---- | ----: |",
        "| ours |  1.23 |",
        "| peer | 1,234 |",
        "| none |       |",
        "",
        "- a note",
    ]


def test_a_table_through_json() -> None:
    from dataclasses import asdict

    assert Table.from_json(json.loads(json.dumps(asdict(TABLE)))) == TABLE


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="1 cells for 2 columns"):
        Table("t", ("a", "b"), ((1,),))


def test_a_ratio_is_the_peers_over_ours() -> None:
    assert ratio(600.0, 3.0) == "200x"
    assert ratio(1.0, 0.0) == "-"


def test_sides_take_turns() -> None:
    order: list[str] = []
    ticks = iter(range(100))
    times = in_turns(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")},
        2,
        clock=lambda: float(next(ticks)),
    )
    assert order == ["a", "b", "a", "b", "a", "b"]
    assert times == {"a": [1000.0, 1000.0], "b": [1000.0, 1000.0]}


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.01, 1.0))
def test_a_quantile_is_a_value_that_bounds_its_part(values: list[float], part: float) -> None:
    q = quantile(values, part)
    assert q in values
    assert sum(v <= q for v in values) >= part * len(values) - 1e-6
    assert sum(v < q for v in values) < part * len(values) + 1e-6


# --- the file and the command ----------------------------------------------------------------------


def test_sections_of_other_benchmarks_stay() -> None:
    first = runner.merged(
        "", {name: runner.section(name, "line", [TABLE], "CPU", DAY) for name in "ac"}, "abc"
    )
    second = runner.merged(first, {"b": runner.section("b", "other", [TABLE], "CPU", DAY)}, "abc")
    third = runner.merged(second, {"b": runner.section("b", "new", [TABLE], "CPU", DAY)}, "abc")
    assert [line for line in second.splitlines() if line.startswith("## ")] == ["## a", "## b", "## c"]
    assert third == second.replace("other.", "new.")


def test_every_benchmark_has_the_name_of_its_module() -> None:
    assert list(runner.descriptions()) == [
        path.stem for path in sorted((Path(runner.__file__).parent / "cases").glob("[a-z]*.py"))
    ]


def test_a_run_writes_both_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail_for_slam(name: str) -> list[Table]:
        if name == "slam":
            raise StemmapError("no")
        return [TABLE]

    monkeypatch.setattr(runner, "tables_of", fail_for_slam)
    out, json_file = tmp_path / "b.md", tmp_path / "b.json"
    arguments = ["scan", "slam", "--date", "2026-01-31", "--out", str(out), "--json", str(json_file)]
    assert main(arguments) == FAILED  # one failed, the other is written
    text = out.read_text(encoding="utf-8")
    assert "## scan" in text
    assert "`python -m tests.benchmarks scan`, 2026-01-31" in text
    assert "## slam" not in text
    written = json.loads(json_file.read_text(encoding="utf-8"))
    assert list(written["benchmarks"]) == ["scan"]
    assert written["benchmarks"]["scan"][0]["rows"][1] == ["peer", 1234.5]


def test_a_campaign_goes_on_after_its_finished_steps_and_reports_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "campaign"
    folder.mkdir()
    before = {"kind": "a", "seconds": 0.0, "result": asdict(Result(done=3, peak_mib=5.0))}
    (folder / "steps.jsonl").write_text(json.dumps(before) + "\n")
    kinds = {
        "a": lambda _turn, _folder: Result(),
        "b": lambda _turn, _folder: Result(done=1, faults=["it hangs"]),
    }
    monkeypatch.setattr(campaign, "FOLDER", folder)
    monkeypatch.setattr(campaign, "KINDS", kinds)
    monkeypatch.setattr(campaign, "HOURS", 1e-12)
    (table,) = campaign.run()
    assert [row[:5] for row in table.rows] == [("a", 1, 3, 0, 0), ("b", 1, 1, 0, 1)]
    assert "b: it hangs" in table.notes
    assert not folder.exists()


def test_the_list_runs_nothing(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "tables_of", lambda _name: pytest.fail("it ran"))
    assert main(["--list"]) == 0
    assert set(runner.descriptions()) <= set(capsys.readouterr().out.split())


def test_wrong_words_are_said_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["speed"]) == WRONG_USAGE
    assert "there is no benchmark 'speed'" in capsys.readouterr().err
    assert main(["scan", "--out", str(tmp_path / "none" / "b.md")]) == FAILED
    assert "no such folder" in capsys.readouterr().err
    assert main(["scan", "--pictures", str(tmp_path)]) == WRONG_USAGE
    assert "'scan' has no picture" in capsys.readouterr().err
    assert main(["loops", "--pictures", str(tmp_path / "none")]) == FAILED
    assert "no such folder" in capsys.readouterr().err
    assert main(["--date", "tomorrow"]) == WRONG_USAGE
    assert "not a date" in capsys.readouterr().err


def test_a_process_that_fails_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(StemmapError, match="ended with code 1"):
        process.tables_of("none_such")
    assert "No module named" in capfd.readouterr().err
    with (
        process.sides({"x": "tests.benchmarks.none_such"}) as both,
        pytest.raises(StemmapError, match="the process ended with code 1"),
    ):
        both["x"].ask({"result": True})


# --- the peer is right -----------------------------------------------------------------------------


def particles_of(weights: list[float]) -> list[Particle]:
    return [
        Particle(x=float(k), weight=w, landmarks=[Landmark(np.zeros(2), np.eye(2))])
        for k, w in enumerate(weights)
    ]


def test_weights_on_three_of_a_hundred_give_those_three() -> None:
    weights = [0.0] * 100
    weights[7], weights[40], weights[99] = 0.5, 0.25, 0.25
    chosen = resample(particles_of(weights), 0.3)
    assert [sum(particle.x == k for particle in chosen) for k in (7.0, 40.0, 99.0)] == [50, 25, 25]
    assert sum(particle.weight for particle in chosen) == pytest.approx(1.0)


def test_particles_share_no_map_after_resampling() -> None:
    chosen = resample(particles_of([1.0, 0.0]), 0.5)
    chosen[0].landmarks[0].mean += 5.0
    chosen[0].landmarks.append(Landmark(np.zeros(2), np.eye(2)))
    assert chosen[1].landmarks[0].mean.tolist() == [0.0, 0.0]
    assert len(chosen[1].landmarks) == 1


def test_the_peers_slam_corrects_its_odometry() -> None:
    slam = FastSlam({**PAPER, "slam.particles": 50}, seed=0)
    landmarks = np.array([[4.0, 2.0], [6.0, -3.0], [8.0, 3.0]])
    pose, covariance = slam.estimate()
    for k in range(30):
        seen = landmarks - [0.1 * k, 0.0]
        detections = [Detection(z, 0.02**2 * np.eye(2), 5.0) for z in seen]
        slam.process((0.1 if k else 0.0, 0.01, 0.0), detections)  # the wheels drift to the left
        pose, covariance = slam.estimate()
        slam.resample_if_needed()
    assert pose[0] == pytest.approx(2.9, abs=0.08)
    assert abs(pose[1]) < 0.15  # 0.3 by the wheels alone
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
    assert {len(particle.landmarks) for particle in slam.particles} == {3}


def test_the_peers_eccentricity_of_a_half_circle() -> None:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2001)
    points = np.stack([5.0 - 0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.0 * angle], axis=1)
    (found,) = detect(points, np.zeros(2001, np.int32), np.array([1.0, 0.0, 0.0]), 0.02, PAPER)
    assert found.eccentricity == pytest.approx(5.28, abs=0.01)  # the closed form
    assert found.place.tolist() == pytest.approx([6.0 - 0.2 * 2 / np.pi, 0.0], abs=1e-3)


def test_the_peers_trees_merge_within_the_radius() -> None:
    trees = TreeMap({**PAPER, "tracking.hits_to_confirm": 1})
    places = [np.array([5.0, 0.0]), np.array([9.0, 0.0])]
    for k in range(5):
        detections = [Detection(z, 0.01 * np.eye(2), 5.0) for z in places]
        trees.process(k * 100_000_000, np.zeros(3), np.zeros((3, 3)), detections)
    assert [tree.hits for tree in trees.trees] == [5, 5]
    near = Detection(np.array([5.9, 0.0]), 1e-4 * np.eye(2), 5.0)
    trees.process(500_000_000, np.zeros(3), np.zeros((3, 3)), [near])
    assert [tree.hits for tree in trees.trees] == [6, 5]


@pytest.mark.slow
def test_both_sides_map_the_same_scans() -> None:
    time_table, map_table = compare(Comparison("sim:paper", 10, 8, "paper", {}, "paper"), 3600.0)
    assert [row[0] for row in time_table.rows][-2:] == ["total", "peak memory MiB"]
    assert "8 scans" in time_table.title
    assert [row[0] for row in map_table.rows] == ["ours", "peer"]
    ours, peers = (str(row[1]) for row in map_table.rows)
    assert ours == peers
    assert not ours.startswith("0/")


def test_a_rival_that_fails_is_a_row_with_its_last_words(tmp_path: Path) -> None:
    def words(python: Path, cloud: Path, out: Path) -> list[str]:
        return [str(python), "-c", "raise ValueError('no stems')"]

    failing = rivals.Program("failing", (), words, lambda _: (np.zeros((0, 2)), np.zeros(0)))
    row = rivals._row(failing, Path(sys.executable), tmp_path / "cloud.laz", "pine_plot")
    assert len(row) == len(rivals.COLUMNS) - 1
    assert row[-1] == "ValueError: no stems"
    missing = rivals._row(failing, "not installed: no such package", tmp_path / "cloud.laz", "pine_plot")
    assert missing[0] == "failing"
    assert missing[-1] == "not installed: no such package"


def test_a_recording_gives_back_what_was_written(tmp_path: Path) -> None:
    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps

    recorded.write("sim:paper", tmp_path, stride=3, scans=2)
    read = recorded.Recording.read(tmp_path)
    wanted = list(islice(steps(open_source("sim:paper").records()), 0, 4, 3))
    assert len(read) == 2
    for k, step in enumerate(wanted):
        scan = read.scan(k)
        assert scan.index == k
        assert scan.stamp_ns == step.scan.stamp_ns
        assert np.array_equal(scan.points, step.scan.points)
        assert scan.twist == step.twist


def test_the_table_of_a_campaign_counts_steps_and_lists_faults() -> None:
    results = [
        ("requests", Result(3, ["GET /: 500"], 1.5, 200.0)),
        ("requests", Result(4)),
        ("link", Result(1)),
    ]
    steps = [{"kind": kind, "seconds": 1800.0, "result": asdict(result)} for kind, result in results]
    table = campaign._table(steps)
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.title.startswith("1.50 h")
    assert rows["requests"] == (2, 7, 0, 1, 1.5, 200.0)
    assert rows["link"][:2] == (1, 1)
    assert "requests: GET /: 500" in table.notes
    assert "NOT reached" in table.notes[1]
