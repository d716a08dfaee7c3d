"""Small files that take gigabytes or hang are refused, whatever door they come through."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from app.cli import main
from app.robot.source import open_any
from app.sources.opening import ProcessLimits, open_source
from pipeline.errors import SourceError
from pipeline.io.readers.base import SourceOptions

_PAGE = 4096
_DEFINITIONS = (
    "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n)"
    " SELECT 'a' || k AS topic_type, 'ros2msg' AS encoding, 'x' AS encoded_message_definition FROM n"
)


def bag(path: Path, *, stamp: str = ", timestamp INTEGER", messages: int = 300) -> None:
    """Write a bag with a topic of clouds and messages of one byte."""
    with sqlite3.connect(path) as database:
        database.execute(f"PRAGMA page_size = {_PAGE}")
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, data BLOB{stamp})")
        database.execute("INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr')")
        rows = [(k,) for k in range(messages)]
        database.executemany("INSERT INTO messages(id, topic_id, data) VALUES (?, 1, x'00')", rows)
    database.close()


def endless_definitions(path: Path) -> None:
    """`message_definitions` is a view without end."""
    bag(path)
    with sqlite3.connect(path) as database:
        database.execute(f"CREATE VIEW message_definitions AS {_DEFINITIONS}")
    database.close()


def computed_column(path: Path) -> None:
    """The time of a message takes long to compute, and SQL allows to leave out the word GENERATED."""
    bag(path, stamp="")
    with sqlite3.connect(path) as database:  # only now: each row that is inserted computes it
        computed = "timestamp INTEGER AS (id + 0 * length(hex(zeroblob(20000000))))"
        database.execute(f"ALTER TABLE messages ADD COLUMN {computed}")
    database.close()


def pages_that_name_one_child(path: Path) -> None:
    """Three levels of pages that name one child 400 times: 6 * 10^9 rows in 40 kB."""
    bag(path)
    with sqlite3.connect(path) as database:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
        root = int(database.execute(query).fetchone()[0])
    database.close()
    content = bytearray(path.read_bytes())
    leaf = bytes(content[(root - 1) * _PAGE : root * _PAGE])
    count = len(content) // _PAGE
    pages = [leaf, _interior(count + 1), _interior(count + 2)]
    content[(root - 1) * _PAGE : root * _PAGE] = _interior(count + 3)
    struct.pack_into(">I", content, 28, count + 3)
    path.write_bytes(bytes(content) + b"".join(pages))


def _interior(child: int, cells: int = 400) -> bytes:
    """A page of a table that names one child `cells` times."""
    page = bytearray(_PAGE)
    end = _PAGE
    for k in range(cells):
        end -= 6
        page[end : end + 6] = struct.pack(">I", child) + b"\x81\x01"
        struct.pack_into(">H", page, 12 + 2 * k, end)
    struct.pack_into(">BHHHBI", page, 0, 5, 0, cells, end, 0, child)
    return bytes(page)


@pytest.fixture
def little_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow a second of computing time for any file."""
    limits = ProcessLimits(512 << 20, 1, 60.0)
    monkeypatch.setattr("app.sources.opening.ProcessLimits.for_size", lambda _size: limits)


@pytest.mark.usefixtures("little_time")
@pytest.mark.parametrize("make", [endless_definitions, computed_column, pages_that_name_one_child])
def test_a_small_bag_that_computes_without_end_is_refused(make: Callable[[Path], None], tmp_path: Path):
    path = tmp_path / "hostile.db3"
    make(path)
    assert path.stat().st_size < 100_000
    with pytest.raises(SourceError, match=r"hostile\.db3"):
        open_any(str(path), SourceOptions())


@pytest.mark.usefixtures("little_time")
def test_the_command_line_refuses_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "hostile.db3"
    pages_that_name_one_child(path)
    assert main(["info", str(path)]) == 1
    error = capsys.readouterr().err
    assert "takes too long" in error
    assert error.count("\n") == 1


def test_a_folder_is_as_large_as_what_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    sizes: list[int] = []

    def limits(size: int) -> ProcessLimits:
        sizes.append(size)
        return ProcessLimits(512 << 20, 10, 60.0)

    monkeypatch.setattr("app.sources.opening.ProcessLimits.for_size", limits)
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "0.bin").write_bytes(bytes(1000))
    (tmp_path / "notes.txt").write_bytes(bytes(234))
    with pytest.raises(SourceError):
        open_source(str(tmp_path))
    assert sizes == [1234]


def test_a_simulated_run_needs_no_check(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.sources.opening.run_limited", lambda *_: pytest.fail("a copy was made"))
    open_source("sim:stand").close()
