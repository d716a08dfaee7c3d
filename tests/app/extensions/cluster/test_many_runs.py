"""A folder of runs: each is mapped as alone, failures are named in the table, and nothing is lost."""

from __future__ import annotations

import csv
from argparse import Namespace
from pathlib import Path

import msgspec
import pytest

from app.cli import main
from app.extensions.cluster import many_runs
from app.extensions.cluster.many_runs import LocalPool, MappedFiles, map_runs
from app.extensions.cluster.map_command import _other_words


def record_runs(folder: Path, number: int) -> Path:
    """Write short simulated runs, run_0.mcap and so on, to a new folder; return it."""
    folder.mkdir()
    for seed in range(number):
        run = folder / f"run_{seed}.mcap"
        assert main(["simulate", f"sim:stand?duration=1&seed={seed}", "--out", str(run)]) == 0
        run.with_suffix(".trees.csv").unlink(missing_ok=True)
    return folder


def bytes_in(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files in a folder by their relative names."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def rows_of(folder: Path) -> dict[str, dict[str, str]]:
    """Return the rows of the table by run."""
    with (folder / "runs.csv").open(encoding="utf-8", newline="") as file:
        return {row["run"]: row for row in csv.DictReader(file)}


def test_each_run_is_mapped_as_alone_and_a_damaged_one_is_named(tmp_path, capsys):
    runs, out = record_runs(tmp_path / "runs", 1), tmp_path / "out"
    (runs / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    words = ["--seed", "7", "--set", "clustering.eps=0.3"]
    assert main(["map", str(runs), "--out", str(out), "--jobs", "2", *words]) == 3
    said = capsys.readouterr().out
    assert "run_0: " in said
    assert "broken: failed" in said
    assert main(["map", str(runs / "run_0.mcap"), "--out", str(tmp_path / "alone"), *words]) == 0
    alone = {f"run_0/{name}": content for name, content in bytes_in(tmp_path / "alone").items()}
    found = bytes_in(out)
    table = found.pop("runs.csv")
    assert found == alone
    rows = rows_of(out)
    assert {name: row["exit_code"] for name, row in rows.items()} == {"broken": "1", "run_0": "0"}
    assert rows["broken"]["message"].startswith("stemmap: ")
    assert table.count(b"\n") == 3


class _Pool(LocalPool):
    """Results without processes: the words are the only file, beside run.json."""

    def call(self, function, task, place=0):
        del function, place
        words = msgspec.json.decode(task)
        record = msgspec.json.encode(
            {"source": {"sha256": words[0]}, "parameters": {}, "trees": 3, "scans": 2}
        )
        return msgspec.msgpack.encode(MappedFiles(0, [], {"run.json": record, "words.txt": task}))


def test_a_folder_with_the_map_of_another_source_is_kept_unless_forced(tmp_path):
    def mapped(source: str, *, force: bool = False) -> list[int]:
        return map_runs({"a": [source]}, tmp_path, _Pool(1), lambda *_: None, force=force)

    assert mapped("first") == [0]
    (tmp_path / "a" / "notes.txt").write_text("by a person")
    earlier = [tmp_path / "a" / name for name in ("seen.csv", "by_people.csv")]
    for file in earlier:
        file.write_text("of an earlier map")
    assert mapped("first") == [0]
    assert not any(file.exists() for file in earlier)
    assert mapped("second") == [1]
    assert "another source" in rows_of(tmp_path)["a"]["message"]
    assert (tmp_path / "a" / "words.txt").read_text() == '["first"]'
    assert mapped("second", force=True) == [0]
    assert (tmp_path / "a" / "words.txt").read_text() == '["second"]'
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "runs.csv"]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["notes.txt", "run.json", "words.txt"]


def test_a_process_that_dies_is_a_failed_run(tmp_path, monkeypatch):
    monkeypatch.setattr(many_runs, "python_module", lambda _: ("false",))
    codes = map_runs({"a": ["sim:stand"]}, tmp_path, LocalPool(1), lambda *_: None, force=False)
    assert codes == [1]
    assert "was lost" in rows_of(tmp_path)["a"]["message"]


@pytest.mark.parametrize("flag", [["--jobs", "2"], ["--dask", "tcp://127.0.0.1:9"]])
def test_flags_of_many_runs_are_refused_for_one(tmp_path, capsys, flag):
    assert main(["map", "sim:stand", "--out", str(tmp_path / "out"), *flag]) == 2
    assert "for a folder of several runs" in capsys.readouterr().err


def test_maps_are_not_written_among_the_recordings(tmp_path, capsys):
    (tmp_path / "a.mcap").touch()
    (tmp_path / "b.mcap").touch()
    assert main(["map", str(tmp_path), "--out", str(tmp_path / "x" / "..")]) == 2
    assert "among the recordings" in capsys.readouterr().err


def test_a_value_that_is_equal_to_the_source_stays_with_its_flag():
    words = ["--preset", "forest", "--seed", "3", "forest", "--truth=true.csv"]
    arguments = Namespace(words=["map", *words, "--out", "maps"], source="forest")
    found = _other_words(arguments)
    assert found == ["--preset", "forest", "--seed", "3", f"--truth={Path('true.csv').absolute()}"]
