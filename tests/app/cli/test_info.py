"""`stemmap info`: what it says of a source is what stands in it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.app.cli.test_commands import stemmap
from tests.pipeline.io.recordings import START_NS, STEP_NS, points_of, write_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Two seconds of a simulated drive as standard ROS 2 messages."""
    from app.cli import main

    file = tmp_path_factory.mktemp("info") / "run.mcap"
    assert main(["simulate", "paper?duration=2", "--out", str(file)]) == 0
    return file


def test_it_names_what_is_in_a_recording_and_what_to_do_with_it(capsys, recording):
    told = stemmap(capsys, "info", recording)
    assert (told.code, told.err) == (0, "")
    said = {line[:10].strip(): line[10:] for line in told.out.splitlines()}
    assert said["kind"] == "ROS 2 MCAP"
    assert said["scans"] == "20 in 1.9 s, 10.0 Hz"
    assert (said["odometry"], said["IMU"]) == ("yes, /odom", "yes, /imu/data")
    assert said["truth"].startswith("7 trees, ")
    assert f"stemmap map {recording} --out out" in told.out


@pytest.mark.parametrize("times", ["none", "times.txt", "poses.tum", "names"])
def test_a_rate_that_is_assumed_is_said(tmp_path, capsys, times):
    for k in range(3):
        name = f"{1_645_000_000 + k}.000000000" if times == "names" else f"{k:06}"
        np.random.default_rng(k).uniform(-20.0, 20.0, (200, 4)).astype("<f4").tofile(tmp_path / f"{name}.bin")
    if times == "times.txt":
        (tmp_path / times).write_text("0.0\n1.0\n2.0\n")
    elif times == "poses.tum":
        (tmp_path / times).write_text("".join(f"{k}.0 {k} 0 0 0 0 0 1\n" for k in range(3)))
    told = stemmap(capsys, "info", tmp_path).out
    [scans] = [line[10:] for line in told.splitlines() if line.startswith("scans")]
    if times == "none":
        assert scans == "3 in 0.2 s, 10.0 Hz, assumed: times.txt gives the times"
    else:
        assert scans == "3 in 2.0 s, 1.0 Hz"
    assert json.loads(stemmap(capsys, "info", tmp_path, "--json").out)["times"] is (times != "none")


def test_it_lists_every_topic_with_its_use(capsys, recording):
    record = json.loads(stemmap(capsys, "info", recording, "--json").out)
    topics = {topic["read_as"]: topic for topic in record["topics"]}
    assert topics["scan"]["type"] == "sensor_msgs/msg/PointCloud2"
    assert topics["scan"]["messages"] == record["scans"] == 20
    assert {"odometry", "imu", "transforms"} <= topics.keys()


def test_a_topic_that_the_user_chose_is_the_one_that_is_read(capsys, recording):
    record = json.loads(stemmap(capsys, "info", recording, "--json").out)
    name = next(topic["name"] for topic in record["topics"] if topic["read_as"] == "scan")
    chosen = stemmap(capsys, "info", recording, "--topic", f"scan={name}", "--json")
    assert json.loads(chosen.out)["topics"] == record["topics"]
    stemmap(capsys, "info", recording, "--topic", "scan=/none").refused(1, "/none", name)


def bare(author, write) -> None:
    """Scans whose times are all zero, without odometry, IMU and transforms."""
    for k in range(20):
        table = points_of(0)
        table["time"] = 0.0
        stamp_ns = START_NS + k * STEP_NS
        write("/velodyne_points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, table))


def test_it_tells_what_each_topic_holds(capsys, recording):
    told = stemmap(capsys, "info", recording).out
    said = [line.strip() for line in told.splitlines()]
    assert any(line.startswith("times   field t in ns, relative to the stamp:") for line in said)
    assert "frame   velodyne > base_link" in said
    assert "frame   pose of base_link in odom" in said
    assert any(line.startswith("noise   ") and line.endswith("cm of a range (one sigma)") for line in said)
    assert any(line.startswith("fields  x float32, y float32, z float32") for line in said)
    assert "missing" not in told
    record = json.loads(stemmap(capsys, "info", recording, "--json").out)
    topics = {topic["read_as"]: topic for topic in record["topics"]}
    assert topics["scan"]["rate_hz"] == 10.0
    assert topics["scan"]["chain"] == ["velodyne", "base_link"]
    assert topics["scan"]["family"] == "Velodyne"


def two_lidars(author, write) -> None:
    """The LiDAR on the robot, and one that no transform links to it, which has more messages, times by
    another clock in microseconds, and Livox's fields."""
    write(
        "/tf_static", "tf2_msgs/msg/TFMessage", START_NS,
        author.transforms(START_NS, ("base_link", "velodyne", (0.1, 0.0, 1.1, 0.0))),
    )  # fmt: skip
    for k in range(20):
        stamp_ns = START_NS + k * STEP_NS
        write("/front/points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, points_of(k)))
        write("/wheels/odom", "nav_msgs/msg/Odometry", stamp_ns, author.odometry(stamp_ns, 0.1 * k, 0.0))
        for half in (0, STEP_NS // 2):
            table = points_of(k)
            kinds = [(name, table.dtype[name]) for name in ("x", "y", "z", "intensity")]
            other = np.zeros(len(table), [*kinds, ("tag", "u1"), ("line", "u1"), ("timestamp", "f8")])
            for name, _ in kinds:
                other[name] = table[name]
            other["timestamp"] = 5e6 + (k * STEP_NS + half) * 1e-3 + np.linspace(0.0, 49_000.0, len(table))
            cloud = author.cloud(stamp_ns + half, other, "side")
            write("/side/points", "sensor_msgs/msg/PointCloud2", stamp_ns + half, cloud)


def test_each_topic_of_points_tells_what_it_holds_also_when_it_is_not_read(capsys, tmp_path):
    file = write_recording("mcap", tmp_path, two_lidars)
    record = json.loads(stemmap(capsys, "info", file, "--json").out)
    topics = {topic["name"]: topic for topic in record["topics"]}
    assert topics["/front/points"]["read_as"] == "scan", "it is linked to the robot"
    assert topics["/front/points"]["why"] == "nearest to the robot by its frame"
    other = topics["/side/points"]
    assert (other["read_as"], other["why_not"]) == ("", "/front/points is nearer to the robot by its frame")
    assert (other["family"], other["rate_hz"], other["chain"]) == ("Livox", pytest.approx(20.0, abs=0.6), [])
    assert other["times"].startswith("field timestamp in us, by another clock than the stamp")
    assert 0.01 <= other["range_sigma"] <= 0.03
    told = stemmap(capsys, "info", file).out
    assert "frame   side, which no fixed transform links to the base" in told
    assert "odometry  yes, /wheels/odom\n" in told


def test_what_is_missing_is_told_with_its_cost_and_the_remedy(capsys, tmp_path):
    told = stemmap(capsys, "info", write_recording("mcap", tmp_path, bare)).out
    said = told[told.index("\nmissing\n") :].splitlines()
    lacks = {line[3:].split(":")[0]: line for line in said if line.startswith(" - ")}
    assert lacks.keys() == {"odometry", "IMU", "times of points"}
    assert "--odometry file:poses.txt" in lacks["odometry"]
    assert "smeared by up to 10 cm" in lacks["times of points"]
    assert "times   not used: the field time is 0 in all points of a scan" in told


def test_a_simulated_run_has_no_topics(capsys, monkeypatch):
    monkeypatch.delenv("UV_RUN_RECURSION_DEPTH", raising=False)
    told = stemmap(capsys, "info", "sim:paper?duration=2")
    assert "topics" not in told.out
    assert "watch it:  stemmap 'sim:paper?duration=2'" in told.out


def test_the_commands_that_it_names_can_be_pasted(capsys, monkeypatch):
    monkeypatch.setenv("UV_RUN_RECURSION_DEPTH", "1")
    assert "map it:    uv run stemmap map sim:stand " in stemmap(capsys, "info", "sim:stand").out
    monkeypatch.delenv("UV_RUN_RECURSION_DEPTH")
    assert "map it:    stemmap map sim:stand " in stemmap(capsys, "info", "sim:stand").out


def test_what_cannot_be_read_is_said_in_one_line(capsys, tmp_path):
    (tmp_path / "empty.mcap").touch()
    stemmap(capsys, "info", tmp_path / "empty.mcap").refused(1, "the file is empty")
    stemmap(capsys, "info", tmp_path / "none").refused(1, "no such file")


def test_a_name_from_a_file_cannot_steer_the_terminal():
    from app.cli.flags import plain

    assert plain("/points\x1b[2J\n\u202e") == "/points?[2J??"
    assert plain("/wäldchen/points") == "/wäldchen/points"
