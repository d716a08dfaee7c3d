"""The benchmarks' machinery, and the peer: a comparison is worth something when its peer is right."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from tests.benchmarks import recorded, runner
from tests.benchmarks.campaign import Result
from tests.benchmarks.cases import campaign
from tests.benchmarks.cases.peer import Comparison, compare
from tests.benchmarks.peer.fastslam import FastSlam, Landmark, Particle, resample
from tests.benchmarks.peer.stages import Detection, detect
from tests.benchmarks.peer.trees import TreeMap
from tests.benchmarks.timing import quantile

PAPER: dict[str, Any] = dict(preset("paper").flat())


# --- tables and times ------------------------------------------------------------------------------


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.01, 1.0))
def test_a_quantile_is_a_value_that_bounds_its_part(values: list[float], part: float) -> None:
    q = quantile(values, part)
    assert q in values
    assert sum(v <= q for v in values) >= part * len(values) - 1e-6
    assert sum(v < q for v in values) < part * len(values) + 1e-6


# --- the file and the command ----------------------------------------------------------------------


def test_every_benchmark_has_the_name_of_its_module() -> None:
    assert list(runner.descriptions()) == [
        path.stem for path in sorted((Path(runner.__file__).parent / "cases").glob("[a-z]*.py"))
    ]


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
