"""`stemmap doctor` says for each need whether it is met, and what to do."""

from __future__ import annotations

import socket
import tomllib
from pathlib import Path

import pytest

from app.cli import doctor, main

PROJECT = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
EXTRAS = sorted(PROJECT["optional-dependencies"])


def test_the_doctor_prints_a_line_per_test_and_ends_with_its_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "data"))
    monkeypatch.setattr(doctor, "available_memory", lambda: 4_000_000_000)
    monkeypatch.setattr(doctor, "usable_cores", lambda: 2)
    monkeypatch.setattr(doctor, "DISK", 1.0)
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.partition(":")[0] for line in lines]
    assert names[:7] == ["memory", "processor", "instructions", "data folder", "disk", "clock", "port"]
    assert names[7:] == [f"extra {name}" for name in EXTRAS]
    assert not any("TO DO" in line for line in lines)
    monkeypatch.setattr(doctor, "available_memory", lambda: 1_000_000_000)
    assert main(["doctor"]) == 1
    assert "memory: 1.0 GB are free: TO DO: free 2 GB" in capsys.readouterr().out


def test_a_data_folder_that_is_a_file_is_named_with_what_to_do(tmp_path: Path):
    (tmp_path / "file").touch()
    (check,) = doctor.folder_checks(tmp_path / "file")
    assert str(check).endswith("TO DO: make it writable, or name another with STEMMAP_FOLDER")
    assert str(doctor.folder_checks(None)[0]).endswith("TO DO: name one with STEMMAP_FOLDER")


def test_a_data_folder_needs_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "DISK", 1e18)
    writable, room = doctor.folder_checks(tmp_path)
    assert writable.remedy == ""
    assert room.remedy
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_is_in_use_must_be_changed_only_if_it_was_chosen():
    with socket.create_server(("127.0.0.1", 0)) as busy:
        number = busy.getsockname()[1]
        chosen = doctor.port_check("127.0.0.1", number)
        assert chosen.is_needed
        assert "--port N" in chosen.remedy
    assert doctor.port_check("127.0.0.1", 0).remedy == ""


def test_cores_clock_instructions_and_memory_are_judged_by_what_is_found():
    assert doctor.cores_check(1).remedy
    assert not doctor.cores_check(2).remedy
    assert doctor.clock_check(0.0).remedy
    assert not doctor.clock_check(doctor.EARLIEST_S).remedy
    assert not doctor.instructions_check("x86-64-v3").remedy
    assert not doctor.instructions_check(None).is_needed
    assert not doctor.memory_check(None).remedy


def test_an_extra_that_is_missing_is_offered_and_not_needed():
    checks = doctor.extra_checks(lambda _package: True)
    assert [check.name for check in checks] == [f"extra {name}" for name in EXTRAS]
    assert not any(check.is_needed for check in checks)
    assert f"uv sync --extra {EXTRAS[-1]}" in str(checks[-1])
    assert not any(check.remedy for check in doctor.extra_checks(lambda _package: False))
