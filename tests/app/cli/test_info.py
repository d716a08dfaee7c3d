"""`stemmap info`: what it says of a source is what stands in it."""

from __future__ import annotations

import json

import pytest

from tests.app.cli.test_commands import stemmap


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
    assert (said["odometry"], said["IMU"]) == ("yes", "yes")
    assert said["truth"].startswith("7 trees, ")
    assert f"stemmap map {recording} --out out" in told.out


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
