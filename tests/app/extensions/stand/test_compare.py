"""Two visits of one stand."""

from __future__ import annotations

import csv
import json
import math
import shutil
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from app.batch.run_edits import reviewed_run
from app.batch.run_folder import TAPE_SIGMA, read_run
from app.batch.visits import VisitTrees, compare_visits
from app.extensions.stand.comparison import read_visit
from app.store.records import Content
from pipeline.geometry.poses import Pose2
from tests.app.batch.finished_runs import grid_run, write_run
from tests.app.cli.test_commands import stemmap

ELSEWHERE = Pose2(12.0, 5.0, 2.1)  # the frame of the first visit in that of the second


@pytest.fixture(scope="module")
def visits(tmp_path_factory):
    """Two runs: all trees but the first ten grew by 3 cm, tree 21 was felled, tree 41 moved by 0.6 m, and one
    tree is new. The second run is in another frame and numbers its trees from 501."""
    folder = tmp_path_factory.mktemp("visits")
    random = np.random.default_rng(1)
    place: list[np.ndarray] = []
    while len(place) < 60:
        point = random.uniform(1, 19, 2)
        if all(np.hypot(*(point - other)) > 1.3 for other in place):
            place.append(point)
    before = np.array(place)
    dbh = random.uniform(0.1, 0.5, 60)
    growth = np.where(np.arange(60) < 10, 0.0, 0.03)
    after = before + random.normal(0, 0.02, before.shape)
    after[40] += [0.45, 0.4]
    grown = dbh + growth + random.normal(0, 0.004, 60)
    keep = np.arange(60) != 20
    after = np.vstack([after[keep], [10.0, 10.0]])
    dbh_b = np.append(grown[keep], 0.12)
    a = write_run(folder / "a", before, dbh, dbh_sigma=0.004)
    b = write_run(folder / "b", ELSEWHERE.apply(after), dbh_b, dbh_sigma=0.004, numbers=np.arange(501, 561))
    # what the second run saw is in its own frame
    seen = b / "seen.csv"
    head, *rows = seen.read_text().splitlines()
    moved = []
    for row in rows:
        x, y, *rest = row.split(",")
        x, y = ELSEWHERE.apply(np.array([[float(x), float(y)]]))[0]
        moved.append((math.floor(x / 0.5), math.floor(y / 0.5), *rest))
    cells = {cell[:2]: cell for cell in moved}
    text = [f"{0.5 * x + 0.25:.3f},{0.5 * y + 0.25:.3f},{','.join(rest)}" for x, y, *rest in cells.values()]
    seen.write_text("\n".join([head, *text]) + "\n")
    return a, b


def rows(folder):
    """The rows of the table."""
    with (folder / "comparison.csv").open(newline="") as text:
        return list(csv.DictReader(text))


def test_growth_new_missing_and_moved_trees_are_found_in_another_frame(visits, tmp_path, capsys):
    result = stemmap(capsys, "compare", *visits, "--out", tmp_path / "out")
    assert result.code == 0, result.err
    assert "59 trees in both of 60 and 60; aligned by" in result.out
    table = rows(tmp_path / "out")
    by_a = {row["tree_a"]: row for row in table}
    assert (by_a["21"]["status"], by_a["21"]["tree_b"]) in {("missing", ""), ("not seen in b", "")}
    assert [row["tree_a"] for row in table if row["status"] == "moved"] == ["41"]
    new = [row for row in table if row["status"] == "new"]
    assert [row["tree_b"] for row in new] == ["560"]
    assert (float(new[0]["x_m"]), float(new[0]["y_m"])) == pytest.approx((10.0, 10.0), abs=0.05)
    pairs = [row for row in table if row["tree_a"] and row["tree_b"]]
    assert all(int(row["tree_b"]) - 500 in (int(row["tree_a"]), int(row["tree_a"]) - 1) for row in pairs)
    significant = {int(row["tree_a"]) for row in pairs if row["significant"] == "true"}
    grown = set(range(11, 61)) - {21}
    assert len(significant & grown) >= 45
    assert len(significant - grown) <= 2
    assert float(by_a["30"]["sigma_growth_cm"]) == pytest.approx(0.57, abs=0.01)


def test_the_map_and_the_files_show_every_tree(visits, tmp_path, capsys):
    stemmap(capsys, "compare", *visits, "--out", tmp_path / "out")
    svg = ElementTree.fromstring((tmp_path / "out" / "comparison.svg").read_text())  # noqa: S314 - our own
    circles = [e for e in svg.iter() if e.tag.endswith("circle") and e.get("r") == "1.3"]
    assert len(circles) == 61 + 8  # and those of the legend
    points = json.loads((tmp_path / "out" / "comparison.geojson").read_text())
    assert len(points["features"]) == 61
    assert points["coordinateFrame"]["type"] == "local"
    record = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert record["pairs"] == 59
    assert sum(record["counts"].values()) == 61
    # The 0.4 cm of each visit are an error that its diameters may share.
    growth = [float(row["growth_cm"]) for row in rows(tmp_path / "out") if row["growth_cm"]]
    own = np.std(growth, ddof=1) / math.sqrt(len(growth))
    assert record["growth_se_cm"] == pytest.approx(math.hypot(own, 0.4, 0.4), abs=0.01)


def test_a_tree_rejected_in_one_visit_is_neither_missing_nor_new(visits, tmp_path, capsys):
    shutil.copytree(visits[0], tmp_path / "later")
    file = tmp_path / "later" / "trees.csv"
    lines = file.read_text().splitlines(keepends=True)
    lines[5] = lines[5].replace(",open", ",rejected")
    file.write_text("".join(lines))
    for later, status in ((True, "rejected in b"), (False, "rejected in a")):
        order = (visits[0], tmp_path / "later") if later else (tmp_path / "later", visits[0])
        stemmap(capsys, "compare", *order, "--same-frame", "--out", tmp_path / status)
        found = [row for row in rows(tmp_path / status) if row["status"] != "same"]
        assert [(row["status"], row["tree_a"] or row["tree_b"]) for row in found] == [(status, "5")]


def test_diameters_in_other_units_are_a_warning(visits, tmp_path, capsys):
    table = tmp_path / "survey.csv"
    trees = [row.split(",") for row in (visits[0] / "trees.csv").read_text().splitlines()]
    x, y, dbh = (trees[0].index(name) for name in ("x_m", "y_m", "dbh_cm"))
    girth = [f"{row[x]},{row[y]},{math.pi * float(row[dbh]):.1f}" for row in trees[1:]]
    table.write_text("\n".join(["x_m,y_m,dbh_cm", *girth]) + "\n")
    result = stemmap(capsys, "compare", visits[0], table, "--same-frame")
    assert result.code == 3
    assert "3.14 times those of the earlier one" in result.err
    assert "circumferences" in result.err


def test_the_same_run_twice_has_no_change(visits, tmp_path, capsys):
    result = stemmap(capsys, "compare", visits[0], visits[0], "--same-frame", "--out", tmp_path / "out")
    assert "60 same" in result.out
    assert "significant for 0" in result.out
    assert {row["significant"] for row in rows(tmp_path / "out")} == {"false"}


def test_a_diameter_by_tape_takes_the_place_of_that_of_the_map(tmp_path):
    folder = grid_run(tmp_path / "run")
    (x, y), before = read_run(folder).trees.position[4].tolist(), read_visit(folder).trees
    with reviewed_run(folder, [Content(x, y, "tree", 0.234)]) as reviewed:
        trees = read_visit(reviewed).trees
    assert (trees.dbh[4], trees.dbh_sigma[4]) == pytest.approx((0.234, TAPE_SIGMA))
    others = np.arange(len(trees.dbh)) != 4
    np.testing.assert_array_equal(trees.dbh[others], before.dbh[others])
    np.testing.assert_array_equal(trees.dbh_sigma[others], before.dbh_sigma[others])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize(("trees", "numbers"), [((7, 12), [7, 12]), ((7, 7), [1, 2]), ((7, 10**30), [1, 2])])
def test_trees_of_a_table_keep_their_numbers_if_these_are_unique(tmp_path, delimiter, trees, numbers):
    table = tmp_path / "trees.csv"
    text = f"Tree,x_m,y_m\n{trees[0]},1.0,2.0\n\n{trees[1]},3.0,4.0\n"
    table.write_text(text.replace(",", delimiter))
    assert read_visit(table).trees.number.tolist() == numbers


def test_only_what_the_other_visit_looked_at_is_missing(visits, tmp_path, capsys):
    a = read_run(visits[0]).trees
    half = a.position[:, 0] < 10.0
    table = tmp_path / "half.csv"
    lines = [
        f"{x:.3f},{y:.3f},{100 * d:.1f}" for (x, y), d in zip(a.position[half], a.dbh[half], strict=True)
    ]
    table.write_text("\n".join(["x_m,y_m,dbh_cm", *lines]))
    result = stemmap(capsys, "compare", visits[0], table, "--out", tmp_path / "out")
    assert result.code == 0, result.err
    by_status: dict[str, list[float]] = {}
    for row in rows(tmp_path / "out"):
        by_status.setdefault(row["status"], []).append(float(row["x_m"]))
    assert len(by_status["same"]) == half.sum()
    assert min(by_status["not seen in b"]) > 9.0
    assert "missing" not in by_status


def test_a_real_survey_and_a_lidar_map_are_aligned_without_hints(shared_data, tmp_path, capsys):
    field = shared_data / "stem_maps" / "prf025_field.csv"
    with (shared_data / "stem_maps" / "prf025_lidar.csv").open(newline="") as text:
        lidar = list(csv.DictReader(text))
    place = np.array([[float(row["easting"]), float(row["northing"])] for row in lidar])
    place = Pose2(3.0, 8.0, 2.4).apply(place - place.mean(axis=0))  # nothing is left of the coordinates
    table = tmp_path / "lidar.csv"
    lines = [f"{x},{y},{row['dbh_m']}" for (x, y), row in zip(place, lidar, strict=True)]
    table.write_text("\n".join(["x_m,y_m,dbh_m", *lines]))
    result = stemmap(capsys, "compare", field, table, "--out", tmp_path / "out")
    assert result.code == 0, result.err
    record = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert (record["trees_a"], record["trees_b"]) == (62, 93)
    assert record["pairs"] >= 57
    assert record["shift_rms_m"] < 0.32
    assert record["dbh_rms_difference_cm"] < 1.3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_m,y_m,dbh_cm\n", "no trees"),
        ("x_m,y_m,dbh_m\n1,2,30\n3,4,25\n", "median diameter is 27.5 m"),
        ("x_m,y_m,dbh_cm\n1,2,0.3\n3,4,0.25\n", "dbh_cm"),
        ("x_m,y_m,dbh\n1,2,30\n", "unit"),
        ("x_m,y_m\n1,2\n3,4\n9,9\n", "do not agree"),
    ],
)
def test_tables_that_cannot_be_compared_are_refused(visits, tmp_path, capsys, text, message):
    table = tmp_path / "t.csv"
    table.write_text(text)
    stemmap(capsys, "compare", visits[0], table).refused(1, message)


def test_noise_alone_is_rarely_called_growth():
    random = np.random.default_rng(7)
    place = random.uniform(0, 100, (200, 2))
    marked = 0
    for _ in range(50):
        visits = [
            VisitTrees(
                np.arange(200),
                place,
                np.full(200, 0.02),
                0.3 + random.normal(0, 0.01, 200),
                np.full(200, 0.01),
            )
            for _ in range(2)
        ]
        found = compare_visits(visits[0], visits[1], Pose2(), reach=1.0, refine=False)
        marked += bool(found.significant.any())
        assert np.nanstd(found.growth / found.growth_sigma) == pytest.approx(1.0, abs=0.25)
    assert marked <= 8  # 5 % of 50 comparisons, with luck
