"""What people state about trees in the stand figures: diameters by tape, added and rejected trees."""

from __future__ import annotations

import asyncio
import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.batch.run_edits import reviewed_run
from app.batch.run_folder import TAPE_SIGMA, ByPeople, read_run
from app.dashboard.shown_run import ShownRun
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plots import rectangle
from app.extensions.stand.report import report_page
from app.extensions.stand.run_figures import counted_trees, stand_of, stand_record, stand_summary
from app.store.records import Content
from pipeline.types.records import TruthTrees
from tests.app.batch.finished_runs import grid_run
from tests.app.cli.test_commands import stemmap
from tests.app.dashboard.test_annotations import both, edit
from tests.app.extensions.stand.test_plot_routes import CIRCLE, act, look

__all__ = ["both"]

VOLUME = Stand(volume="10 * (dbh_cm / 100)^2")
WEST, EAST = rectangle("west", 5, 10, 10, 20), rectangle("east", 15, 10, 10, 20)
REVIEWS = {"open", "confirmed, by tape", "added by people, by tape", "added by people"}
DASH = "\N{EN DASH}"
# In the grid: a diameter by tape, two added trees, one with a diameter, and two rejected trees, one outside.
STATED = [
    Content(1.0, 1.0, "tree", 0.4),
    Content(2.0, 2.0, "tree", 0.3),
    Content(4.0, 2.0),
    Content(3.0, 1.0, "pole"),
    Content(19.0, 19.0, "bush"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return grid_run(tmp_path_factory.mktemp("run"))


def figures_of_stated(run, contents, parameters=None, plots=()):
    with reviewed_run(run, contents) as folder:
        return stand_of(folder, parameters or Stand(), plots)


def test_figures_follow_what_people_state(run):
    result = figures_of_stated(run, STATED, VOLUME)
    f, v = result.figures["all"], result.figures["all"].values
    assert (f.trees, f.without_dbh) == (100, 1)
    assert v["n_ha"].value == pytest.approx(100 / 0.04)
    dbh = np.array([0.2] * 97 + [0.3, 0.4])
    assert v["mean_dbh_cm"].value == pytest.approx(100.0 * dbh.mean())
    basal = math.pi / 4 * np.square(dbh).sum() * 100 / 99  # one tree without a diameter
    assert v["g_ha"].value == pytest.approx(basal / 0.04)
    assert v["v_ha"].value == pytest.approx(10.0 * np.square(dbh).sum() * 100 / 99 / 0.04)
    assert [(c.low, c.trees) for c in f.classes if c.trees] == [(20.0, 97), (28.0, 1), (40.0, 1)]
    assert result.by_people == {"all": (2, 2, 2)}
    assert "by people: 2 diameters by tape, 2 trees added, 2 trees removed" in stand_summary(result)
    assert result.left_out["rejected"] == 2


def test_the_numbers_are_those_of_each_plot(run):
    result = figures_of_stated(run, STATED, plots=[WEST, EAST])
    assert result.by_people == {"west": (2, 2, 1), "east": (0, 0, 1)}
    lines = stand_summary(result)
    assert "by people, plot west: 2 diameters by tape, 2 trees added, 1 tree removed" in lines
    assert "by people, plot east: 1 tree removed" in lines
    assert not any("by people" in line for line in stand_summary(figures_of_stated(run, [])))


def test_an_added_tree_out_of_sight_is_listed(run):
    result = figures_of_stated(run, [Content(90.0, 2.0), Content(2.0, 2.0, "tree", 0.05)])
    record = stand_record(result)
    assert (record["trees_in_map"], record["trees_added"]) == (100, 2)
    assert record["trees_left_out"] == {
        "rejected": 0,
        "outside_of_observed_area": 1,
        "below_minimum_dbh": 1,
    }
    assert result.by_people == {"all": (0, 0, 0)}
    assert result.figures["all"].trees == 100
    assert record["added_out_of_sight"] == [[90.0, 2.0]]
    many = figures_of_stated(run, [Content(90.0 + k, 2.0) for k in range(5)])
    named = "90.00, 2.00; 91.00, 2.00; 92.00, 2.00; and 2 more"
    told = [line for line in stand_summary(many) if line.startswith("added by people outside")]
    assert told == [f"added by people outside of the observed area, not counted: {named}"]
    # Outside of the plots, too, it is listed as such.
    assert len(figures_of_stated(run, [Content(90.0, 2.0)], plots=[WEST]).added_out_of_sight) == 0


def test_a_thin_tree_by_tape_does_not_count(run):
    assert figures_of_stated(run, [Content(1.0, 1.0, "tree", 0.05)]).figures["all"].trees == 99


def test_the_diameter_of_a_rejected_tree_does_not_count(run):
    result = figures_of_stated(run, [Content(1.0, 1.0, "pole", 0.4)])
    assert result.by_people == {"all": (0, 0, 1)}
    assert result.figures["all"].values["mean_dbh_cm"].value == pytest.approx(20.0)


def test_a_stem_beside_a_rejected_stake_counts(run):
    result = figures_of_stated(run, [Content(1.0, 1.0, "pole"), Content(1.0, 1.3, "tree", 0.31)])
    assert result.by_people == {"all": (1, 1, 1)}
    assert result.figures["all"].trees == 100
    assert result.figures["all"].values["mean_dbh_cm"].value == pytest.approx((99 * 20.0 + 31.0) / 100)


@given(st.permutations(range(6)), st.lists(st.none() | st.floats(0.08, 0.6), min_size=6, max_size=6))
def test_trees_of_the_figures_do_not_depend_on_the_order_of_what_people_state(run, order, dbh):
    trees = read_run(run).trees
    tape = {k + 1: each for k, each in enumerate(dbh[:3]) if each is not None}
    place = np.arange(6.0).reshape(3, 2)
    added = np.array([np.nan if each is None else each for each in dbh[3:]])
    people = ByPeople(tape, place, added)
    counted = counted_trees(trees, {}, people, VOLUME)
    n = len(trees.number)
    assert counted.by_tape is not None
    assert counted.volume is not None
    assert len(counted.dbh) == n + 3
    np.testing.assert_array_equal(counted.of_map, np.arange(n + 3) < n)
    expected = [tape.get(k + 1, trees.dbh[k]) for k in range(n)]
    np.testing.assert_array_equal(counted.dbh, [*expected, *added])
    np.testing.assert_array_equal(counted.dbh_sigma[counted.by_tape], TAPE_SIGMA)
    assert not counted.shared(0.005)[counted.by_tape].any()
    assert counted.by_tape.sum() == sum(each is not None for each in dbh)
    np.testing.assert_allclose(counted.volume, 10.0 * np.square(counted.dbh))
    rows = [k for k in order if k < 3]
    other = counted_trees(trees, {}, replace(people, added=place[rows], added_dbh=added[rows]), VOLUME)
    np.testing.assert_array_equal(other.dbh[:n], counted.dbh[:n])
    np.testing.assert_array_equal(other.dbh[n:], counted.dbh[n:][rows])


def test_without_statements_the_trees_are_those_of_the_map(run):
    trees = read_run(run).trees
    counted = counted_trees(trees, {}, ByPeople({}, np.zeros((0, 2)), np.zeros(0)), VOLUME)
    for name in ("position", "dbh", "dbh_sigma"):
        np.testing.assert_array_equal(getattr(counted, name), getattr(trees, name))
    assert counted.of_map.all()


def test_the_report_lists_what_people_state(run, tmp_path, capsys):
    with reviewed_run(run, STATED) as folder:
        words = ["--rectangle", "5,10,10,20", "--rectangle", "15,10,10,20"]
        stemmap(capsys, "report", folder, "--out", tmp_path / "r.html", *words)
        stemmap(capsys, "report", folder, "--out", tmp_path / "de.html", "--language", "de")
    page = (tmp_path / "r.html").read_text()
    notes = re.findall(r'<p class="note">(By people.*?)</p>', page)
    assert notes == [
        "By people: diameters by tape: 2, trees added: 2, trees removed: 2",
        "By people, Plot 1: diameters by tape: 2, trees added: 2, trees removed: 1",
        "By people, Plot 2: trees removed: 1",
    ]
    assert "trees in the map: 100, added by people: 2 (not counted: 2 rejected in the review)" in page
    rows = [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", page)]
    rows = [row for row in rows if len(row) == 8 and row[-1] in REVIEWS]
    assert len(rows) == 100
    assert rows[0] == ["1", "1.000", "1.000", "40.0", "0.3", "20", "229", "confirmed, by tape"]
    assert rows[-2:] == [
        ["A1", "2.000", "2.000", "30.0", "0.3", DASH, DASH, "added by people, by tape"],
        ["A2", "4.000", "2.000", DASH, DASH, DASH, DASH, "added by people"],
    ]
    assert [re.findall(rf">{name}</text>", page) for name in ("A1", "A2", "A3")] == [
        [">A1</text>"],
        [">A2</text>"],
        [],
    ]
    assert page.count("<circle cx=") == 102  # two in the legend
    german = (tmp_path / "de.html").read_text()
    assert "Von Hand: Durchmesser mit Maßband: 2, Bäume ergänzt: 2, Bäume verworfen: 2" in german


def test_tables_have_the_numbers(run, tmp_path, capsys):
    with reviewed_run(run, STATED) as folder:
        stemmap(capsys, "stand", folder, "--out", tmp_path)
    header, row = (line.split(",") for line in (tmp_path / "stand.csv").read_text().splitlines())
    of = dict(zip(header, row, strict=True))
    assert [of[name] for name in ("dbh_by_tape", "trees_added", "trees_removed")] == ["2", "2", "2"]


@pytest.mark.parametrize(
    ("against", "words"),
    [("both", "ground truth of the run with the annotations of people")],
)
async def test_the_report_names_the_references_of_its_scores(both, against, words) -> None:
    client, dashboard = both
    await look(dashboard)
    trees = dashboard.shown.frame.trees
    x, y = trees.position[trees.confirmed][0].tolist()
    truth = TruthTrees(np.array([x]), np.array([y]), np.array([0.4]), ("tree",))
    editor = dashboard.annotation_editor
    await editor.begin(dashboard.digest, dashboard.source.uri, truth)
    await edit(client, "POST", x=x, y=y, kind="tree", dbh_cm=44.4)
    editor.score_against(against)
    with ShownRun.of(dashboard).folder() as folder:
        page = report_page(folder)
    assert f"<tr><td>Reference trees and diameters</td><td>{words}</td></tr>" in page


async def test_page_and_command_give_the_same_figures(both, tmp_path, capsys) -> None:
    """The command reads by_people.csv of a folder without a store, or the annotations in the store."""
    client, dashboard = both
    await look(dashboard)
    assert dashboard.shown is not None
    trees = dashboard.shown.frame.trees
    with ShownRun.of(dashboard).folder() as there:
        shutil.copytree(there, tmp_path / "mapped")
    (ax, ay), (bx, by), *_ = trees.position[trees.confirmed].tolist()
    before = (await client.get("/api/plots")).json()["all"]
    await edit(client, "POST", x=ax, y=ay, kind="tree", dbh_cm=44.4)
    await edit(client, "POST", x=bx, y=by, kind="person")
    await edit(client, "POST", x=ax + 0.9, y=ay, kind="tree", dbh_cm=31.7)
    await act(client, "POST", plots=[{**CIRCLE, "name": "one"}])
    page = (await client.get("/api/plots")).json()
    counted = page["all"]["plots"]["all"]
    assert [counted[name] for name in ("dbh_by_tape", "trees_added", "trees_removed")] == [2, 1, 1]
    assert counted["g_ha"] != before["plots"]["all"]["g_ha"]
    with ShownRun.of(dashboard).folder() as there:
        shutil.copytree(there, tmp_path / "reviewed")
    contents = [row.content for row in ShownRun.of(dashboard).edits if row.content.kind in ("tree", "person")]
    with reviewed_run(tmp_path / "mapped", contents) as there:
        shutil.copytree(there, tmp_path / "of_store")
    shape = CIRCLE["shape"]
    for name in ("reviewed", "of_store"):
        words = ["stand", str(tmp_path / name), "--out", str(tmp_path / "out"), "--plots", "none"]
        await asyncio.to_thread(stemmap, capsys, *words)
        assert json.loads((tmp_path / "out" / "stand.json").read_text()) == page["all"]
        words = [*words[:4], "--circle", f"{shape['x']},{shape['y']},{shape['radius']}"]
        await asyncio.to_thread(stemmap, capsys, *words)
        of_plot = json.loads((tmp_path / "out" / "stand.json").read_text())["plots"]["1"]
        assert of_plot == page["plots"]["plots"]["one"]
