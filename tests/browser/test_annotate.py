"""A person annotates: judges what was found, adds what was missed, corrects, takes back; another looks on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Position, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server


@pytest.fixture(scope="module")
def annotated(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server whose annotations no other test sees."""
    folder: Path = tmp_path_factory.mktemp("annotated")
    with Server(STEMMAP_FOLDER=str(folder)) as running:
        yield running


@pytest.fixture
def person(chromium: Browser, annotated: Server) -> Iterator[Dashboard]:
    with opened(chromium, annotated.link) as dashboard:
        dashboard.stand(15.05)
        dashboard.until_server("/api/trees", "it.trees.length > 20")
        # Whatever became of the test before.
        dashboard.page.evaluate(CLEARED)
        dashboard.until_server("/api/annotations", "it.trees.length === 0")
        dashboard.tab("Annotate")
        expect(dashboard.page.locator("#annotations tbody tr")).to_have_count(0)
        yield dashboard


def rows(dashboard: Dashboard) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = dashboard.ask("/api/annotations")["trees"]
    return found


def place_of(dashboard: Dashboard, x: float, y: float) -> Position:
    """Where a place of the map [m] is seen on the canvas [pixels]."""
    scale = "([x, y]) => import('/static/js/map.js').then(map => map.screenOf(x, y))"
    px, py = dashboard.page.evaluate(scale, [x, y])
    return {"x": px, "y": py}


def test_a_person_judges_adds_corrects_and_takes_back(person: Dashboard):
    page = person.page
    canvas = page.locator("#map")
    expect(page.locator("#annotate-count")).to_contain_text("0 of")
    found = person.ask("/api/trees")["trees"]
    first = min(found, key=lambda tree: (tree["observations"], tree["number"]))

    # The tree that was seen least often first; y confirms it, and the next is selected.
    canvas.press("Tab")
    expect(page.locator("#annotate-hint")).to_contain_text(f"Tree {first['number']}, seen in")
    canvas.press("y")
    expect(page.locator("#annotate-count")).to_contain_text(f"1 of {len(found)} found trees judged")
    (row,) = rows(person)
    assert (row["kind"], row["x"], row["y"]) == ("tree", first["x"], first["y"])
    mark = page.locator("#marks .mark.annotation")
    expect(mark).to_have_attribute("title", re.compile(r"0:15\.0 annotated: .+ edited an annotation"))
    (second, *_) = sorted(
        (tree for tree in found if tree is not first), key=lambda tree: (tree["observations"], tree["number"])
    )
    expect(page.locator("#annotate-hint")).to_contain_text(f"Tree {second['number']}, seen in")

    # n refuses one that lies near the path: the scores know it at once.
    near = min(found, key=lambda tree: (tree["x"] - 4.0) ** 2 + (tree["y"] - 2.0) ** 2)
    before = person.ask("/api/evaluation")
    page.get_by_role("button", name="Fit").click()
    person.drawn()
    canvas.click(position=place_of(person, near["x"], near["y"]))
    page.locator("#annotate-kind").select_option("pole")
    canvas.press("n")
    expect(page.locator("#annotations tbody tr")).to_have_count(2)
    person.until_server("/api/evaluation", f"it.FA.count === {before['FA']['count'] + 1}")
    person.tab("Scores")
    expect(page.locator("#truth-used")).to_contain_text("2 annotations laid over it")
    expect(page.locator("[data-rate=FA] small")).to_have_text(f"1 of {before['FA']['of'] + 1}")
    person.tab("Annotate")

    # A click beside a tree snaps to it, one in the open does not.
    tree = max(found, key=lambda each: each["observations"])
    canvas.press("a")
    at = place_of(person, tree["x"] + 0.3, tree["y"])
    canvas.hover(position=at)
    canvas.click(position=at)
    expect(page.locator("#annotations tbody tr")).to_have_count(3)
    added = rows(person)[-1]
    assert abs(added["x"] - tree["x"]) < 0.7
    assert abs(added["y"] - tree["y"]) < 0.7
    canvas.press("Escape")

    # Arrows nudge by a centimetre, and count as one edit.
    canvas.evaluate(FIVE_TIMES_RIGHT)
    person.until_server("/api/annotations", f"Math.abs(it.trees[2].x - {added['x'] + 0.05}) < 1e-3")
    canvas.press("Control+z")
    person.until_server("/api/annotations", f"Math.abs(it.trees[2].x - {added['x']}) < 1e-3")
    canvas.press("Control+Shift+Z")
    person.until_server("/api/annotations", f"Math.abs(it.trees[2].x - {added['x'] + 0.05}) < 1e-3")

    # Dragging moves it.
    at = place_of(person, added["x"] + 0.05, added["y"])
    box = canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + at["x"], box["y"] + at["y"])
    page.mouse.down()
    page.mouse.move(box["x"] + at["x"] + 20, box["y"] + at["y"] + 12, steps=4)
    page.mouse.up()
    person.until_server("/api/annotations", f"it.trees[2].x > {added['x'] + 0.3}")

    # DBH and class are typed; what is no number is refused in words.
    line = page.locator("#annotations tbody tr").first
    dbh = line.get_by_label(re.compile("DBH"))
    dbh.fill("31,5")
    dbh.press("Enter")
    person.until_server("/api/annotations", "it.trees[2].dbh_cm === 31.5")
    dbh.fill("thick")
    dbh.press("Enter")
    expect(page.locator("#annotate-error")).to_contain_text("centimetres")
    page.locator("#annotate-undo").focus()
    line.get_by_label(re.compile("Class")).select_option("bush")
    person.until_server("/api/annotations", "it.trees[2].kind === 'bush'")
    expect(dbh).to_have_value("31.5")

    # Delete, and all back to nothing.
    line.click(position={"x": 5, "y": 5})
    canvas.press("Delete")
    person.until_server("/api/annotations", "it.trees.length === 2")
    mine = page.evaluate("() => localStorage.getItem('stemmap.browser')")
    edits = f"/api/annotations?browser={mine}"
    for left in range(person.ask(edits)["undo"] - 1, -1, -1):
        page.locator("#annotate-undo").click()
        person.until_server(edits, f"it.undo === {left}")
    assert rows(person) == []
    expect(page.locator("#annotate-undo")).to_be_disabled()
    person.until_server("/api/evaluation", f"it.FA.count === {before['FA']['count']}")
    assert person.errors == []


def test_two_people_see_one_another_and_a_stale_edit_is_refused(
    person: Dashboard, chromium: Browser, annotated: Server
):
    page = person.page
    page.locator("#annotate-name").fill("Ann")
    page.locator("#annotate-name").press("Enter")
    page.locator("#annotate-file").set_input_files(
        {"name": "plot.csv", "mimeType": "text/csv", "buffer": b"X,Y,dbh_cm\n1.5,30.5,22\n-4.0,31.0,\n"}
    )
    expect(page.locator("#annotate-hint")).to_contain_text("2 taken from plot.csv")
    with opened(chromium, annotated.link) as other:
        other.tab("Annotate")
        theirs = other.page.locator("#annotations tbody tr")
        expect(theirs).to_have_count(2)
        expect(theirs.first).to_contain_text("Ann")
        # The other one begins to type; meanwhile Ann changes the same.
        field = theirs.first.get_by_label(re.compile("DBH"))
        field.focus()
        page.locator("#annotations tbody tr").first.get_by_label(re.compile("Class")).select_option("pole")
        other.until_server("/api/annotations", "it.trees[1].kind === 'pole'")
        other.page.wait_for_timeout(500)
        field.fill("40")
        field.press("Enter")
        expect(other.page.locator("#annotate-error")).to_contain_text("was changed by Ann at")
        assert [(row["kind"], row["dbh_cm"]) for row in rows(other)] == [("tree", 22.0), ("pole", None)]
        assert [error for error in other.errors if "409" not in error] == []
    page.locator("#annotate-undo").click()
    person.until_server("/api/annotations", "it.trees[1].kind === 'tree'")
    page.locator("#annotate-undo").click()
    person.until_server("/api/annotations", "it.trees.length === 0")
    assert person.errors == []


def test_a_shift_click_on_a_stem_in_the_scene_adds_it(person: Dashboard):
    page = person.page
    found = person.ask("/api/trees")["trees"]
    box = page.locator("#scene").bounding_box()
    assert box is not None
    for x, y in person.settled_places("/world/trees"):
        # Not below viser's own panel and notices.
        right, below = box["x"] + box["width"] - 360, box["y"] + box["height"] - 60
        if not (box["x"] + 20 < x < right and 280 < y < below):
            continue
        page.keyboard.down("Shift")
        page.mouse.click(x, y)
        page.keyboard.up("Shift")
        person.until_server("/api/annotations", "it.trees.length === 1")
        (row,) = rows(person)
        gaps = [((row["x"] - tree["x"]) ** 2 + (row["y"] - tree["y"]) ** 2) ** 0.5 for tree in found]
        assert min(gaps) < 0.3, "a stem was clicked, and something else was added"
        break
    else:
        pytest.fail("no tree was in sight")
    page.locator("#map").press("Control+z")
    person.until_server("/api/annotations", "it.trees.length === 0")
    assert person.errors == []


# All annotations of the run are deleted, as another browser would.
CLEARED = """async () => {
  const { run, trees } = await (await fetch("/api/annotations")).json();
  for (const { id, version } of trees)
    await fetch(`/api/annotations/${id}`, { method: "DELETE", headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ run, version, browser: "c".repeat(32), who: "the test before" }) });
}"""

# At once, however slow the machine is: a pause between them would make two edits of it.
FIVE_TIMES_RIGHT = """canvas => {
  for (let k = 0; k < 5; k += 1) {
    const press = { key: 'ArrowRight', bubbles: true, cancelable: true };
    canvas.dispatchEvent(new KeyboardEvent('keydown', press));
  }
}"""
