"""Errors of `open_source` for files, folders and addresses that it cannot open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.io import readers
from pipeline.io.readers import open_source, runs_in
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.test_scan_folders import save


@pytest.mark.parametrize("uri", ["ros2:robot", "udp://0.0.0.0:2368"])
def test_live_input_is_refused_with_a_remedy(uri: str):
    with pytest.raises(SourceError, match=r"does not read (ros2|udp): live.*over Zenoh"):
        open_source(uri)


def test_an_unknown_scheme_names_what_can_be_read():
    with pytest.raises(SourceError, match=r"unknown kind of source 'http'.*\.mcap.*sim:"):
        open_source("http://example.org/run.mcap")


@pytest.mark.parametrize("name", ["nowhere.mcap", "nowhere", "no\0where", ""])
def test_what_is_not_there_is_told(name: str, tmp_path: Path):
    uri = str(tmp_path / name) if name else "  "
    with pytest.raises(SourceError, match="no such file or folder"):
        open_source(uri)


def test_a_folder_without_scans_is_told(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(SourceError, match="nothing in the folder can be read"):
        open_source(str(tmp_path))


def test_a_folder_of_data_sets_names_the_folders_that_can_be_opened(tmp_path: Path):
    for name in ("b_run", "a_run", "notes"):
        (tmp_path / name).mkdir()
    (tmp_path / "a_run" / "run.mcap").touch()
    (tmp_path / "b_run" / "000000.bin").touch()
    with pytest.raises(SourceError, match=r"the folder is no run.*Open what is in it: a_run/, b_run/\."):
        open_source(str(tmp_path))


def test_recordings_in_folders_beside_other_files_are_named(tmp_path: Path):
    save(tmp_path / "scan.pcd", np.random.default_rng(0).normal(size=(500, 3)))
    for name in ("drive", "notes"):
        (tmp_path / name).mkdir()
    (tmp_path / "drive" / "drive_0.db3").touch()
    source = open_source(str(tmp_path))
    assert "not part of this run are drive/: open each of them by its name" in source.description.warnings
    (tmp_path / "scan.pcd").unlink()
    for name in ("a.bag", "b.bag"):
        (tmp_path / name).touch()
    with pytest.raises(SourceError, match=r"Open what is in it: a\.bag, b\.bag, drive/\."):
        open_source(str(tmp_path))


def test_an_unknown_file_is_told(tmp_path: Path):
    path = tmp_path / "notes.txt"
    path.write_text("hello")
    with pytest.raises(SourceError, match=r"not a LiDAR recording.*Supported formats"):
        open_source(str(path))


def test_errors_are_one_line(tmp_path: Path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(SourceError) as caught:
        open_source(str(path))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_folder_that_is_no_run_names_what_can_be_opened_in_it(tmp_path: Path):
    for k in range(7):
        (tmp_path / f"day{k}.bag").touch()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(SourceError, match=r"no run.*day0.bag, .*day4.bag and 2 more"):
        open_source(str(tmp_path))


def test_recordings_beside_scans_are_said_to_be_left_aside(tmp_path: Path, opened: Opened):
    np.ones((200, 4), "<f4").tofile(tmp_path / "000000.bin")
    assert opened(tmp_path).description.warnings == ()
    (tmp_path / "run.bag").touch()
    assert opened(tmp_path).description.warnings == (
        "not part of this run are run.bag: open each of them by its name",
    )


def test_the_suffix_of_a_bag_in_a_folder_is_known_in_any_case(tmp_path: Path):
    (tmp_path / "RUN.MCAP").write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    with pytest.raises(SourceError):
        open_source(str(tmp_path))


def test_a_folder_with_one_recording_that_is_no_run_is_that_recording(tmp_path: Path):
    recording = tmp_path / "run.bag"
    recording.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    (tmp_path / "calibration.xml").write_text("<boost/>")
    with pytest.raises(SourceError) as of_file:
        open_source(str(recording))
    with pytest.raises(SourceError) as of_folder:
        open_source(str(tmp_path))
    assert str(of_folder.value) == str(of_file.value)


@pytest.mark.parametrize("beside", ["LOAM/GlobalMap.pcd", "drive/more.bag"])
def test_a_single_recording_is_opened_whatever_folders_are_beside_it(beside: str, tmp_path: Path):
    recording = tmp_path / "run.bag"
    recording.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    (tmp_path / beside).parent.mkdir()
    (tmp_path / beside).touch()
    with pytest.raises(SourceError) as of_file:
        open_source(str(recording))
    with pytest.raises(SourceError) as of_folder:
        open_source(str(tmp_path))
    assert str(of_folder.value) == str(of_file.value)


def test_folders_of_results_are_no_runs(tmp_path: Path):
    for name in ("a_run", "b_run", "results"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000000.bin").touch()
    (tmp_path / "results" / "run.json").touch()
    assert runs_in(tmp_path) == ["a_run/", "b_run/"]


def test_no_file_is_opened_to_find_runs_in_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    texts = readers.Format(
        "text",
        (),
        (".txt",),
        table=lambda _: pytest.fail("opened"),
        accepts=lambda head: head.startswith(b"1 2 3"),
    )
    monkeypatch.setattr(readers, "_further", [lambda: [texts]])
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "points.txt").write_text("1 2 3\n4 5 6\n")
    assert readers.recordings_in(tmp_path / "notes") == ["points.txt"]
    monkeypatch.setattr(Path, "open", lambda *_: pytest.fail("a file is opened"))
    assert readers.folders_of_runs(tmp_path) == []
