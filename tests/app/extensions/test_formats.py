"""Formats of extensions beside those of the program, and of extensions that are switched off."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import app.sources
from app.extension import VARIABLE, Extension, Found
from app.sources.opening import check_source
from app.sources.request import SourceRequest
from pipeline.errors import UsageError
from pipeline.io import readers
from pipeline.io.readers import Format, file_format, folder_opener, is_recording, recordings_in


def extension(name: str, kind: Format, *, is_on: bool) -> Found:
    """An extension with one format."""
    return Found(name, "package 1", Extension(help="", formats=lambda: (kind,)), "", is_on)


@pytest.mark.parametrize("address", ["sim:cloud", "sim:cloud?fil=plot.laz", "sim:stand?fil=plot.laz"])
async def test_the_options_of_an_address_are_checked_before_it_is_opened(address: str):
    with pytest.raises(UsageError):
        await check_source(SourceRequest(address))


def test_a_format_that_is_on_goes_before_one_that_is_off(monkeypatch: pytest.MonkeyPatch):
    wanted = Format("wanted", (), (".abc",), lambda *_: None)  # type: ignore[arg-type]
    rival = replace(wanted, words="rival")
    found = extension("a", rival, is_on=False), extension("b", wanted, is_on=True)
    monkeypatch.setattr(app.sources, "all_extensions", lambda: found)
    kind = file_format(Path("run.abc"), b"x")
    assert kind is not None
    assert (kind.words, kind.refusal) == ("wanted", "")


def test_a_folder_of_the_program_is_not_refused_by_an_extension_that_is_off(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    greedy = Format("greedy", (), (), lambda *_: None, is_folder=lambda _: True)  # type: ignore[arg-type]
    monkeypatch.setattr(app.sources, "all_extensions", lambda: [extension("a", greedy, is_on=False)])
    (tmp_path / "run.mcap").touch()
    opener = folder_opener(tmp_path)
    assert opener is not None
    assert opener is readers._recording


def test_files_of_an_extension_that_is_off_are_no_recordings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    for name in ("run.bag", "notes.zip", "scan.ptx"):
        (tmp_path / name).touch()
    assert recordings_in(tmp_path) == ["notes.zip", "run.bag"]
    monkeypatch.setenv(VARIABLE, "")
    assert recordings_in(tmp_path) == ["run.bag"]


def test_a_ptx_file_is_a_recording(tmp_path: Path):
    rows = ["1", "2", "0 0 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    file = tmp_path / "scan.ptx"
    file.write_text("\n".join([*rows, "1 2 3 0.5", "2 3 4 0.5"]) + "\n")
    assert is_recording(file)


def test_an_e57_file_with_the_name_of_scans_is_read_by_its_contents(tmp_path: Path):
    from pipeline.io.readers.point_files import ScanFileError, open_table

    file = tmp_path / "scan.bin"
    file.write_bytes(b"ASTM-E57" + bytes(4096))
    with pytest.raises(ScanFileError, match="E57"):
        open_table(file)


def test_a_folder_of_captures_is_several_runs_in_a_process_of_its_own(tmp_path: Path):
    for name in ("a.pcap", "b.pcap"):
        (tmp_path / name).touch()
    code = "import sys; from app.extensions.cluster.map_command import _runs_in; print(_runs_in(sys.argv[1]))"
    words = [sys.executable, "-P", "-c", code, str(tmp_path)]
    environment = {**os.environ, VARIABLE: "cluster,formats"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "['a.pcap', 'b.pcap']\n"
