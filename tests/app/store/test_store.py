"""The laws of the store: nothing acknowledged is lost, undo and redo are inverse, stale edits are refused."""

from __future__ import annotations

import contextlib
import itertools
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from app.store.database import FILE_NAME
from app.store.records import FRAME, REPAIR, Author, Content, StaleError, UnknownError
from app.store.store import Store
from pipeline.errors import StemmapError

ANN, BOB = Author("a" * 16, "Ann"), Author("b" * 16, "Bob")
AUTHORS = (ANN, BOB)
Board = dict[int, Content]

contents = st.builds(
    Content,
    x=st.floats(-50, 50),
    y=st.floats(-50, 50),
    kind=st.sampled_from(("tree", "pole", "other", "skipped")),
    dbh=st.none() | st.floats(0.01, 2.0),
)


def ticking() -> Store:
    counter = itertools.count(1_700_000_000_000_000_000, 1_000_000_000)
    return Store(None, lambda: next(counter))


class Edits(RuleBasedStateMachine):
    """Two people edit; what stands is told by a model of plain dicts."""

    def __init__(self) -> None:
        super().__init__()
        self.store = ticking()
        self.run = self.store.open_run("digest", "run.mcap", "run.mcap")
        self.board: Board = {}
        self.versions: dict[int, int] = {}
        # Each person's steps: what they changed, before and after.
        self.done: dict[str, list[tuple[Board, Board]]] = {a.who: [] for a in AUTHORS}
        self.undone: dict[str, list[tuple[Board, Board]]] = {a.who: [] for a in AUTHORS}
        # Whose hand was the last at an annotation, and how often.
        self.touched: dict[int, object] = {}
        self.marks: dict[int, tuple[dict[int, object], dict[int, object]]] = {}

    def _did(self, author: Author, before: Board, after: Board) -> None:
        step = (before, after)
        self.done[author.who].append(step)
        self.undone[author.who].clear()
        ids = before.keys() | after.keys()
        marks_before = {i: self.touched.get(i) for i in ids}
        for i in ids:
            self.touched[i] = object()
        self.marks[id(step)] = (marks_before, {i: self.touched[i] for i in ids})

    @rule(who=st.sampled_from(AUTHORS), new=st.lists(contents, min_size=1, max_size=3))
    def add(self, who: Author, new: list[Content]) -> None:
        ids = self.store.add(self.run, who, new)
        after = dict(zip(ids, new, strict=True))
        assert not after.keys() & self.board.keys()
        self.board |= after
        self._did(who, {}, after)

    @precondition(lambda self: self.board)
    @rule(who=st.sampled_from(AUTHORS), content=st.none() | contents, data=st.data())
    def edit(self, who: Author, content: Content | None, data: st.DataObject) -> None:
        chosen = data.draw(st.sampled_from(sorted(self.board)))
        before = self.board[chosen]
        if content is None:
            self.store.change(self.run, who, chosen, self.versions[chosen], None)
            del self.board[chosen]
            self._did(who, {chosen: before}, {})
        else:
            self.store.change(self.run, who, chosen, self.versions[chosen], content)
            self.board[chosen] = content
            if content != before:
                self._did(who, {chosen: before}, {chosen: content})

    @precondition(lambda self: self.versions)
    @rule(who=st.sampled_from(AUTHORS), content=contents, data=st.data())
    def a_stale_edit_changes_nothing(self, who: Author, content: Content, data: st.DataObject) -> None:
        chosen = data.draw(st.sampled_from(sorted(self.versions)))
        with pytest.raises(StaleError, match=r"(changed|deleted) by (Ann|Bob) at 2023-11-"):
            self.store.change(self.run, who, chosen, self.versions[chosen] - 1, content)

    @rule(who=st.sampled_from(AUTHORS), back=st.booleans())
    def turn(self, who: Author, back: bool) -> None:
        source, target = (self.done, self.undone) if back else (self.undone, self.done)
        turn = self.store.undo if back else self.store.redo
        if not source[who.who]:
            with pytest.raises(StemmapError, match="nothing to"):
                turn(self.run, who)
            return
        step = source[who.who].pop()
        was, becomes = (step[1], step[0]) if back else step
        earlier, later = self.marks[id(step)]
        expected, following = (later, earlier) if back else (earlier, later)
        if any(self.touched.get(i) is not mark for i, mark in expected.items()):
            with pytest.raises(StaleError):
                turn(self.run, who)
            return
        turn(self.run, who)
        for i in was.keys() - becomes.keys():
            del self.board[i]
        self.board |= becomes
        self.touched |= following
        target[who.who].append(step)

    @invariant()
    def what_stands_is_what_was_said(self) -> None:
        rows = self.store.annotations(self.run)
        assert {row.id: row.content for row in rows} == self.board
        for row in rows:
            assert row.version >= self.versions.get(row.id, 1), "versions never go back"
        self.versions |= {row.id: row.version for row in rows}
        for author in AUTHORS:
            counts = (len(self.done[author.who]), len(self.undone[author.who]))
            of_trees = tuple(each.get("tree", 0) for each in self.store.steps(self.run, author.browser))
            assert of_trees == counts

    def teardown(self) -> None:
        self.store.close()


TestEdits = Edits.TestCase
TestEdits.settings = settings(stateful_step_count=25)


def test_all_is_undone_and_done_again_in_order():
    store = ticking()
    run = store.open_run("d", "u", "n")
    seen = [store.annotations(run)]
    (a,) = store.add(run, ANN, [Content(1.0, 2.0)])
    seen.append(store.annotations(run))
    for k in range(20):
        store.change(run, ANN, a, k + 1, Content(1.0, 2.0 + 0.01 * (k + 1)))
        seen.append(store.annotations(run))
    store.change(run, ANN, a, 21, None)
    contents_of = [[row.content for row in rows] for rows in seen]
    for expected in reversed(contents_of):
        store.undo(run, ANN)
        assert [row.content for row in store.annotations(run)] == expected
    for expected in (*contents_of[1:], []):
        store.redo(run, ANN)
        assert [row.content for row in store.annotations(run)] == expected


def test_steps_are_undone_by_their_subject():
    store = ticking()
    run = store.open_run("d", "u", "n")
    store.add(run, ANN, [Content(0.0, 0.0, REPAIR, None, {"kind": "delete"})])
    tree = Content(1.0, 2.0)
    (id_,) = store.add(run, ANN, [tree])
    with pytest.raises(StemmapError, match="nothing to undo"):
        store.undo(run, ANN, ["other"])
    store.undo(run, ANN, ["repair", "other"])
    assert [row.content for row in store.annotations(run)] == [tree]
    # A new annotation leaves the repair that can be redone, and a step of both belongs to its first change.
    moved = Content(0.0, 0.0, REPAIR, None, {"kind": "move"})
    store.change(run, ANN, id_, 1, Content(1.0, 2.0, "pole"))
    assert store.steps(run, ANN.browser) == ({"tree": 2}, {"repair": 1})
    store.edit(run, ANN, [moved], [(id_, 2, Content(3.0, 2.0, "pole"))])
    assert store.steps(run, ANN.browser) == ({"tree": 2, "repair": 1}, {})
    store.undo(run, ANN, ["repair"])
    assert [row.content for row in store.annotations(run)] == [Content(1.0, 2.0, "pole")]
    store.undo(run, ANN)
    assert [row.content for row in store.annotations(run)] == [tree]


def test_an_edit_below_a_later_one_waits_for_its_undo():
    store = ticking()
    run = store.open_run("d", "u", "n")
    (id_,) = store.add(run, ANN, [Content(1.0, 2.0)])
    moved = Content(0.0, 0.0, REPAIR, None, {"kind": "move"})
    store.edit(run, ANN, [moved], [(id_, 1, Content(3.0, 2.0))])
    with pytest.raises(StaleError, match="later edit of yours"):
        store.undo(run, ANN, ["tree"])
    store.undo(run, ANN, ["repair"])
    store.undo(run, ANN, ["tree"])
    assert store.annotations(run) == []
    store.redo(run, ANN, ["tree"])
    store.redo(run, ANN, ["repair"])
    assert Content(3.0, 2.0) in [row.content for row in store.annotations(run)]


def test_runs_are_known_by_what_was_recorded_and_do_not_mix():
    store = ticking()
    one, other = store.open_run("d1", "a.mcap", "a"), store.open_run("d2", "b.mcap", "b")
    assert one != other
    assert store.open_run("d1", "moved/a.mcap", "a") == one
    (id_,) = store.add(one, ANN, [Content(0.0, 0.0)])
    assert store.annotations(other) == []
    with pytest.raises(UnknownError):
        store.change(other, ANN, id_, 1, None)
    with pytest.raises(StemmapError, match="nothing to undo"):
        store.undo(other, ANN)


@pytest.mark.parametrize("back", ["redo of an addition", "undo of a deletion"])
def test_a_run_has_at_most_one_reference_system(back: str):
    store = ticking()
    run = store.open_run("d", "u", "n")
    frames = [Content(0.0, 0.0, FRAME, None, {"crs": crs}) for crs in ("EPSG:25832", "EPSG:25833")]
    (id_,) = store.add(run, ANN, frames[:1])
    with pytest.raises(StaleError, match="by Ann"):
        store.add(run, BOB, frames[1:])
    with pytest.raises(UnknownError):
        store.change(run, BOB, id_, 1, Content(1.0, 2.0))
    turn = store.redo
    if back == "redo of an addition":
        store.undo(run, ANN)
    else:
        store.change(run, ANN, id_, 1, None)
        turn = store.undo
    store.add(run, BOB, frames[1:])
    with pytest.raises(StaleError, match="by Bob"):
        turn(run, ANN)
    assert [row.content for row in store.annotations(run)] == frames[1:]


def test_a_run_has_a_largest_number_of_annotations(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.store.store.MOST_ANNOTATIONS", 50)
    store = ticking()
    run = store.open_run("d", "u", "n")
    many = [Content(float(k), 0.0) for k in range(50)]
    store.add(run, ANN, many)
    with pytest.raises(StemmapError, match="50 annotations"):
        store.add(run, ANN, many[:1])
    store.undo(run, ANN)
    assert store.annotations(run) == []


CHILD = """
import sys
from pathlib import Path
from app.store.records import Author, Content
from app.store.store import Store
store = Store(Path(sys.argv[1]))
run = store.open_run("d", "u", "n")
for k in range(100_000):
    print(*store.add(run, Author("c" * 16, "child"), [Content(float(k), 0.0)]), k, flush=True)
"""


def test_what_was_acknowledged_outlives_kill_9(tmp_path: Path):
    root = Path(__file__).resolve().parents[3]
    for round_ in range(3):
        command = [sys.executable, "-c", CHILD, str(tmp_path)]
        child = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        with contextlib.closing(child.stdout):
            told = [child.stdout.readline() for _ in range(20 + 7 * round_)]
            child.send_signal(signal.SIGKILL)
            told += child.stdout.readlines()
        child.wait(timeout=30)
        acknowledged = {tuple(map(int, line.split())) for line in told if line.endswith("\n")}
        assert len(acknowledged) >= 20
        with contextlib.closing(Store(tmp_path)) as store:
            run = store.open_run("d", "u", "n")
            kept = {(row.id, round(row.content.x)) for row in store.annotations(run)}
        assert acknowledged <= kept


def test_two_servers_on_one_folder_refuse_stale_edits(tmp_path: Path):
    with contextlib.closing(Store(tmp_path)) as one, contextlib.closing(Store(tmp_path)) as other:
        run = one.open_run("d", "u", "n")
        (id_,) = one.add(run, ANN, [Content(0.0, 0.0)])
        (row,) = other.annotations(run)
        other.change(run, BOB, id_, row.version, replace(row.content, x=1.0))
        with pytest.raises(StaleError, match="changed by Bob"):
            one.change(run, ANN, id_, row.version, replace(row.content, x=2.0))
        assert one.annotations(run)[0].content.x == 1.0


def spoil(path: Path, statement: str) -> None:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)
        connection.commit()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: path.write_bytes(b"no database" * 400), "not a database"),
        (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "malformed|damaged"),
        (lambda path: spoil(path, "PRAGMA user_version = 9999"), "newer stemmap"),
        (lambda path: spoil(path, "PRAGMA user_version = 3"), "older stemmap"),
        (lambda path: spoil(path, "PRAGMA user_version = 0"), "another program"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line_and_kept(tmp_path: Path, damage, words):
    store = Store(tmp_path)
    run = store.open_run("d", "u", "n")
    store.add(run, ANN, [Content(float(k), 0.0) for k in range(300)])
    store.close()
    path = tmp_path / FILE_NAME
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    damage(path)
    before = path.read_bytes()
    with pytest.raises(StemmapError, match=words) as refusal:
        Store(tmp_path)
    assert FILE_NAME in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert path.read_bytes() == before


def test_what_an_undo_restores_is_of_who_made_it(tmp_path: Path):
    with contextlib.closing(Store(tmp_path)) as store:
        run = store.open_run("d", "u", "n")
        (id_,) = store.add(run, ANN, [Content(0.0, 0.0)])
        store.change(run, BOB, id_, 1, Content(0.0, 0.0, "pole"))
        assert store.annotations(run)[0].who == BOB.who
        store.undo(run, BOB)
        (row,) = store.annotations(run)
        assert (row.who, row.content.kind) == (ANN.who, "tree")
        store.redo(run, BOB)
        assert store.annotations(run)[0].who == BOB.who
        store.undo(run, BOB)
        store.undo(run, ANN)
        assert store.annotations(run) == []


@pytest.mark.parametrize(("version", "later"), [(8, ("reach", "dbh_who")), (9, ("dbh_who",))])
def test_annotations_of_earlier_versions_are_kept(tmp_path: Path, version: int, later: tuple[str, ...]):
    with contextlib.closing(Store(tmp_path)) as store:
        run = store.open_run("d", "u", "n")
        store.add(run, ANN, [Content(1.0, 2.0, "pole")])
    path = tmp_path / FILE_NAME
    for column in later:
        spoil(path, f"ALTER TABLE annotations DROP COLUMN {column}")
    spoil(path, f"PRAGMA user_version = {version}")
    for _ in range(2):
        with contextlib.closing(Store(tmp_path)) as store:
            assert store.contents("d") == [Content(1.0, 2.0, "pole")]
    with contextlib.closing(Store(tmp_path)) as store:
        (row,) = store.annotations(run)
        store.change(run, ANN, row.id, row.version, replace(row.content, reach=0.2))
        assert store.contents("d") == [Content(1.0, 2.0, "pole", reach=0.2)]
        store.undo(run, ANN)
        assert store.contents("d") == [Content(1.0, 2.0, "pole")]


def test_a_database_of_another_program_stays_as_it_is(tmp_path: Path):
    path = tmp_path / FILE_NAME
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE other (x)")
    before = path.read_bytes()
    with pytest.raises(StemmapError, match="another program"):
        Store(tmp_path)
    assert path.read_bytes() == before


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StemmapError, match="STEMMAP_FOLDER"):
        Store(tmp_path / "file" / "below")
