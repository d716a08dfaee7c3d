"""The table of trees: sorting, filters, and the exported files of map, table and plots."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from tests.browser.dashboard import Dashboard


@pytest.fixture(autouse=True)
def _standing(dashboard: Dashboard):
    dashboard.stand()
    dashboard.tab("Trees")
    dashboard.page.locator("#find").fill("")
    expect(dashboard.page.locator("#trees tbody tr").first).to_be_visible()


def trees(dashboard: Dashboard) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = dashboard.ask("/api/trees")["trees"]
    return found


def listed(page: Page) -> list[int]:
    """The numbers in the table, from above."""
    rows = page.locator("#trees tbody tr").evaluate_all("all => all.map(row => Number(row.dataset.tree))")
    return [int(number) for number in rows]


def sigma(tree: dict[str, Any]) -> float:
    return float(max(tree["ellipse"][:2]))


# What the server holds, by the column of the table.
COLUMNS = {
    "number": lambda tree: tree["number"],
    "x": lambda tree: tree["x"],
    "y": lambda tree: tree["y"],
    "sigma": sigma,
    "dbh": lambda tree: tree["dbh_cm"],
    "e": lambda tree: tree["eccentricity"],
    "seen": lambda tree: tree["observations"],
}


def test_every_column_sorts_both_ways_by_what_the_server_holds(dashboard: Dashboard):
    page, held = dashboard.page, trees(dashboard)
    assert len(held) > 10
    assert page.locator("#trees th:visible").count() == len(COLUMNS)
    for key, value in reversed(COLUMNS.items()):  # back to the number in the end
        header = page.locator(f"#trees th[data-key={key}]")
        for order, sign in (("ascending", 1.0), ("descending", -1.0)):
            while header.get_attribute("aria-sort") != order:
                header.get_by_role("button").click()
            known = sorted(
                (tree for tree in held if value(tree) is not None),
                key=lambda tree: (sign * value(tree), tree["number"]),
            )
            unknown = [tree for tree in held if value(tree) is None]
            assert listed(page) == [tree["number"] for tree in (*known, *unknown)], (key, order)
    page.locator("#trees th[data-key=number] button").click()


def test_a_filter_selects_trees(dashboard: Dashboard):
    page, held = dashboard.page, trees(dashboard)
    thick = sorted(tree["dbh_cm"] for tree in held if tree["dbh_cm"] is not None)
    middle = thick[len(thick) // 2]
    often = sorted(tree["observations"] for tree in held)[len(held) // 2]
    wanted = {
        f"dbh {middle:g}..{thick[-1]:g}": lambda t: t["dbh_cm"] is not None and t["dbh_cm"] >= middle,
        f"DBH<{middle}": lambda t: t["dbh_cm"] is not None and t["dbh_cm"] < middle,
        "dbh none": lambda t: t["dbh_cm"] is None,
        f"seen >= {often} x > 0": lambda t: t["observations"] >= often and t["x"] > 0,
        f"scans >= {often} e < 6": lambda t: t["observations"] >= often and (t["eccentricity"] or 9) < 6,
        "y ..-1": lambda t: t["y"] <= -1,
        "x < \N{MINUS SIGN}1": lambda t: t["x"] < -1,
        "1": lambda t: str(t["number"]).startswith("1"),
        "unjudged": lambda _: True,
        "judged": lambda _: False,
    }
    for text, holds in wanted.items():
        page.locator("#find").fill(text)
        fits = [tree["number"] for tree in held if holds(tree)]
        assert sorted(listed(page)) == sorted(fits), text
        expect(page.locator("#tree-count")).to_have_text(f"{len(fits)} of {len(held)}")
    expect(page.locator("#trees-empty")).to_contain_text("No tree matches “judged”")
    page.locator("#find").fill("height > 10")
    expect(page.locator("#trees-empty")).to_contain_text("not measured in a drive")
    page.locator("#find").fill("as thick as my leg")
    expect(page.locator("#trees-empty")).to_contain_text("“as thick as my leg” is not a condition")
    expect(page.locator("#find")).to_have_attribute("aria-invalid", "true")


def test_trees_are_filtered_by_their_true_class(dashboard: Dashboard):
    page, held = dashboard.page, trees(dashboard)
    found = dashboard.ask("/api/evaluation")["TA"]["count"]
    numbers: list[int] = []
    for kind in ("tree", "pole", "person", "bush", "other", "none"):
        page.locator("#find").fill(kind)
        numbers += listed(page)
        if kind == "tree":
            assert len(numbers) >= found > 5
    assert sorted(numbers) == sorted(tree["number"] for tree in held)  # each is one of them, and only one


def saved(page: Page, button: Locator, folder: Path) -> Path:
    with page.expect_download() as download:
        button.click()
    file = folder / download.value.suggested_filename
    download.value.save_as(file)
    return file


def table(file: Path) -> list[list[str]]:
    return list(csv.reader(io.StringIO(file.read_text(encoding="utf-8"))))


def painted(file: Path) -> int:
    """How many colours a picture has."""
    with Image.open(file) as picture:
        return len(picture.convert("RGB").getcolors(1 << 24) or [])


def test_the_map_is_saved_as_a_picture_and_as_a_table(dashboard: Dashboard, tmp_path: Path):
    page, held = dashboard.page, trees(dashboard)
    picture = saved(page, page.locator("#map-png"), tmp_path)
    assert picture.name == "map.png"
    assert painted(picture) > 20
    head, *rows = table(saved(page, page.locator("#map-csv"), tmp_path))
    assert head == ["what", "number", "x_m", "y_m", "dbh_cm"]
    drawn = {int(row[1]): (float(row[2]), float(row[3])) for row in rows if row[0] == "tree"}
    assert drawn == {tree["number"]: (tree["x"], tree["y"]) for tree in held}
    scan = dashboard.ask("/api/status")["scan_index"]
    assert sum(row[0] == "path" for row in rows) == scan + 1
    assert any(row[0] == "truth: tree" for row in rows)


def test_the_table_is_saved_as_a_picture_and_as_a_table(dashboard: Dashboard, tmp_path: Path):
    page, held = dashboard.page, trees(dashboard)
    whole = saved(page, page.locator("#trees-png"), tmp_path)
    assert whole.name == "sim_stand_trees.png"
    with Image.open(whole) as picture:
        assert picture.height == 2 * 24 * (len(held) + 1)
    assert painted(whole) > 10
    page.locator("#find").fill("x > 5")
    fewer = len(listed(page))
    assert 0 < fewer < len(held)
    with Image.open(saved(page, page.locator("#trees-png"), tmp_path)) as picture:
        assert picture.height == 2 * 24 * (fewer + 1)
    head, *rows = table(saved(page, page.locator("#trees-csv"), tmp_path))
    assert head[:3] == ["tree", "x_m", "y_m"]
    assert [int(row[0]) for row in rows] == [tree["number"] for tree in held]


@pytest.mark.parametrize(("kind", "held"), [("distance", "distance_m"), ("error", "error_percent")])
def test_pairs_are_saved_as_a_picture_and_as_a_table(
    dashboard: Dashboard, tmp_path: Path, kind: str, held: str
):
    page = dashboard.page
    dashboard.tab("Charts")
    page.locator("#chart-choice").select_option(kind)
    expect(page.locator("#chart .hm").first).to_be_attached()
    page.wait_for_function("kind => document.querySelector('#chart').dataset.kind === kind", arg=kind)
    picture = saved(page, page.locator("#chart-png"), tmp_path)
    assert picture.name == f"{kind}.png"
    assert painted(picture) > 20
    head, *rows = table(saved(page, page.locator("#chart-csv"), tmp_path))
    pairs = dashboard.ask("/api/pairs")
    assert head == ["tree", *map(str, pairs["numbers"])]
    values = [[float(cell) if cell else None for cell in row[1:]] for row in rows]
    assert values == pairs[held]
    assert dashboard.errors == []


TALL = """rows => import('/static/js/trees/table.js').then(async ({ pictureOf }) => {
  const table = document.createElement('table');
  for (let k = 0; k <= rows; k += 1) for (const text of [k, 'a', 'b']) {
    (table.rows[k] ?? table.insertRow()).insertCell().textContent = text;
  }
  const canvas = pictureOf(table);
  const blob = await new Promise(done => canvas.toBlob(done, 'image/png'));
  return [canvas.width, canvas.height, blob?.size ?? 0];
})"""


def test_a_picture_of_a_table_of_any_size_is_made(dashboard: Dashboard):
    """Browsers make no picture of a canvas that is too tall, and the button did nothing then."""
    dashboard.pause()
    small, large, larger = (dashboard.page.evaluate(TALL, rows) for rows in (10, 580, 5000))
    assert small[1] == 2 * 24 * 11
    for width, height, size in (large, larger):
        assert width > 30
        assert 10_000 < height <= 16_000
        assert size > 1000


ASSUMED = """async number => {
  const { state, changed } = await import('/static/js/core/store.js');
  const { treeStory } = await import('/static/js/explain/tree.js');
  const story = await (await fetch(`/api/story/tree/${number}`)).json();
  state.map.trees.find(tree => tree.number === number).observations = 0;
  changed('map');
  const texts = treeStory({ ...story, observations: 0 }, () => {}).map(node => node.textContent);
  return texts.join(' ');
}"""


def test_an_unmeasured_sigma_is_called_assumed(dashboard: Dashboard):
    number = trees(dashboard)[0]["number"]
    cell = dashboard.page.locator(f"#trees tr[data-tree='{number}'] td").nth(list(COLUMNS).index("sigma"))
    assert "≈" not in (cell.text_content() or "")
    told = dashboard.page.evaluate(ASSUMED, number)
    assert "No single scan detected it" in told
    assert "cm, assumed" in told
    expect(cell).to_have_text(re.compile("^≈ "))
    expect(cell).to_have_attribute("title", re.compile("^Assumed"))
    dashboard.stand(23.05)  # takes the true map again
    expect(cell).not_to_have_text(re.compile("≈"))


def test_the_map_dims_the_trees_that_the_filter_leaves_out(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    picture = "() => document.querySelector('#map').toDataURL()"

    def drawn(text: str) -> str:
        page.locator("#find").fill(text)
        dashboard.drawn()
        dashboard.drawn()
        return str(page.evaluate(picture))

    whole = drawn("")
    assert drawn("dbh < 1") != whole
    assert drawn("seen > 0 no such word") == whole  # not understood: nothing is left out
    assert drawn("") == whole


def test_the_head_of_the_table_and_the_map_tell_what_lacks_for_a_diameter(dashboard: Dashboard):
    dashboard.stand(5.05)
    dashboard.tab("Trees")
    count = dashboard.page.locator("#tree-count")
    expect(count).to_contain_text(re.compile(r"\d+ trees, \d+ needs? 180° of view"))
    lacking = [tree for tree in dashboard.ask("/api/trees")["trees"] if tree["dbh_cm"] is None]
    assert lacking
    assert all(0 <= tree["sides"] < 2**36 for tree in lacking)
    entry = dashboard.page.locator("#legend-unseen").bounding_box()
    assert entry is not None
    assert entry["width"] > 60


def test_the_filter_ends_with_the_run(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    page.locator("#find").fill("dbh > 1000")
    expect(page.locator("#tree-count")).to_contain_text("0 of")
    dashboard.open("sim:stand?duration=3")
    expect(page.locator("#find")).to_have_value("")
