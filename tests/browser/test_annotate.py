"""The tab Annotate: review of detected trees, new annotations, edits, undo, two users, and training."""

from __future__ import annotations

import csv
import json
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Position, Response, Route, expect

from tests.browser.conftest import opened, opened_by_another
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server


@pytest.fixture
def person(chromium: Browser, server: Server) -> Iterator[Dashboard]:
    """A new page on a run without annotations."""
    with opened(chromium, server.link) as dashboard:
        dashboard.reset()
        dashboard.stand()
        dashboard.until_server("/api/trees", "it.trees.length > 20")
        dashboard.tab("Annotate")
        expect(dashboard.page.locator("#annotations tbody tr")).to_have_count(0)
        yield dashboard


# Two edits of which the second one waits while another run is opened.
OTHER_RUN = """async () => {
  const [{ edit, draft }, { state }] = await Promise.all([
    import('/static/js/annotate/annotations.js'), import('/static/js/core/store.js'),
  ]);
  const made = [], { annotations } = state;
  const first = edit(async () => {
    made.push(1);
    state.annotations = { ...annotations, run: annotations.run + 1 };
    return { undo: 0, redo: 0, serial: 0 };
  });
  const second = edit(async () => { made.push(2); return { undo: 0, redo: 0, serial: 0 }; });
  await Promise.all([first, second]);
  state.annotations = annotations;
  return { made, error: draft.error };
}"""


def rows(dashboard: Dashboard) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = dashboard.ask("/api/annotations")["trees"]
    return found


def doubted(dashboard: Dashboard) -> list[dict[str, Any]]:
    """The found trees, the most doubted first, once the page asks for them in that order."""
    trees = {tree["number"]: tree for tree in dashboard.ask("/api/trees")["trees"]}
    told = [trees[each["tree"]] for each in dashboard.ask("/api/doubts")["trees"]]
    module = "import('/static/js/annotate/annotations.js')"
    numbers = f"() => {module}.then(it => it.unreviewed().map(tree => tree.number))"
    wanted = [tree["number"] for tree in told[:2]]
    dashboard.eventually(
        lambda: dashboard.page.evaluate(numbers)[:2] == wanted, lambda: dashboard.page.evaluate(numbers)
    )
    return told


def place_of(dashboard: Dashboard, x: float, y: float) -> Position:
    """Where a place of the map [m] is seen on the canvas [pixels]."""
    scale = "([x, y]) => import('/static/js/map/map.js').then(map => map.screenOf(x, y))"
    px, py = dashboard.page.evaluate(scale, [x, y])
    return {"x": px, "y": py}


def test_trees_are_reviewed_added_edited_and_undone(person: Dashboard):
    page = person.page
    canvas = page.locator("#map")
    expect(page.locator("#annotate-count")).to_contain_text("0 of")
    found = person.ask("/api/trees")["trees"]
    first, second = doubted(person)[:2]

    # The tree that the votes are least sure of first, with them; y confirms it, and the next is selected.
    canvas.press("s")
    hint = page.locator("#annotate-hint")
    expect(hint).to_contain_text(f"Tree {first['number']}, detected in")
    expect(hint).to_contain_text(re.compile(r"votes: tree [\d.]+ % \(40 % needed\)"))
    size = canvas.bounding_box()
    person.answer("y")
    expect(page.locator("#annotate-count")).to_contain_text(f"1 of {len(found)} trees reviewed")
    expect(page.locator("#legend-annotation")).to_be_visible()
    assert canvas.bounding_box() == size
    (row,) = rows(person)
    assert (row["kind"], row["x"], row["y"]) == ("tree", first["x"], first["y"])
    mark = page.locator("#marks .mark.annotation")
    expect(mark).to_have_attribute("title", re.compile(r"0:15\.0 annotated: .+ edited (an|\d+) annotation"))
    expect(page.locator("#annotate-hint")).to_contain_text(f"Tree {second['number']}, detected in")

    # n refuses one that lies near the path: the scores know it at once.
    near = min(found, key=lambda tree: (tree["x"] - 4.0) ** 2 + (tree["y"] - 2.0) ** 2)
    before = person.ask("/api/evaluation")
    page.get_by_role("button", name="Fit").click()
    person.drawn()
    canvas.click(position=place_of(person, near["x"], near["y"]))
    page.locator("#annotate-kind").select_option("pole")
    person.answer("n")
    expect(page.locator("#annotations tbody tr")).to_have_count(2)
    expect(page.locator("#legend-rejected")).to_be_visible()  # its tree is crossed out on the map
    assert canvas.bounding_box() == size
    person.until_server("/api/evaluation", f"it.FA.count === {before['FA']['count'] + 1}")
    person.tab("Scores")
    expect(page.locator("#truth-used")).to_contain_text("corrected by 2 annotations")
    expect(page.locator("[data-rate=FA] small")).to_have_text(f"1 of {before['FA']['of'] + 1}")
    person.tab("Annotate")

    # It contradicts what is known for certain: that is said, and whose word counts is chosen.
    expect(page.locator("#annotate-warned")).to_contain_text("the ground truth of this run and")
    page.locator("#annotate-against").select_option("own")
    person.until_server("/api/evaluation", f"it.FA.count === {before['FA']['count']}")
    expect(page.locator("#annotate-warned")).to_be_hidden()
    page.locator("#annotate-against").select_option("both")
    person.until_server("/api/evaluation", f"it.FA.count === {before['FA']['count'] + 1}")

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

    # One that is not chosen stays: such a drag moves the map.
    canvas.press("Escape")
    moved = rows(person)[-1]
    at = place_of(person, moved["x"], moved["y"])
    page.mouse.move(box["x"] + at["x"], box["y"] + at["y"])
    page.mouse.down()
    page.mouse.move(box["x"] + at["x"] + 20, box["y"] + at["y"] + 12, steps=4)
    page.mouse.up()
    new = place_of(person, moved["x"], moved["y"])
    assert new["x"] - at["x"] == pytest.approx(20.0, abs=8.0)
    assert new["y"] - at["y"] == pytest.approx(12.0, abs=8.0)
    assert rows(person)[-1] == moved

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
    line.locator("td").first.click()
    canvas.press("Delete")
    person.until_server("/api/annotations", "it.trees.length === 2")
    mine = page.evaluate("() => localStorage.getItem('stemmap.browser')")
    edits = f"/api/annotations?browser={mine}"
    for left in range(person.ask(edits)["undo"]["tree"] - 1, -1, -1):
        page.locator("#annotate-undo").click()
        person.until_server(edits, f"(it.undo.tree ?? 0) === {left}")
    assert rows(person) == []
    expect(page.locator("#annotate-undo")).to_be_disabled()
    person.until_server("/api/evaluation", f"it.FA.count === {before['FA']['count']}")
    assert person.errors == []


ANSWERS = """async (keys) => {
  const given = [], card = document.getElementById("review");
  const { draft } = await import('/static/js/annotate/annotations.js');
  for (const key of keys) {
    const title = document.getElementById("review-title").textContent;
    const busy = card.getAttribute("aria-busy") !== "false";
    const event = new KeyboardEvent("keydown", { key, bubbles: true });
    const isSeen = !busy && performance.now() - draft.shownAt >= 150;
    document.getElementById("map").dispatchEvent(event);
    given.push([key, title, busy, isSeen]);
    await new Promise((resolve) => setTimeout(resolve, 250));
  }
  return given;
}"""


def test_quick_answers_belong_to_the_tree_on_the_card(person: Dashboard):
    page = person.page
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    expect(page.locator("#review-title")).to_be_hidden()  # else the key answers for a tree of the test before
    page.locator("#map").press("s")
    person.card_shown()
    given = page.evaluate(ANSWERS, list("yynynnsyynysnyny"))
    told: dict[int, str] = {}
    for key, title, busy, is_seen in given:
        assert busy == title.endswith("loading …")
        if is_seen:
            told[int(title.split()[1])] = {"y": "tree", "n": "other", "s": "skipped"}[key]
    assert len(told) > 3
    number = len(told)
    person.until_server("/api/annotations", f"it.trees.length + it.skipped.length === {number}")
    answers = person.ask("/api/annotations")
    number_of = "import('/static/js/annotate/annotations.js').then(it => rows.map(it.treeNumberOf))"
    every = [*answers["trees"], *answers["skipped"]]
    of_tree = page.evaluate(f"(rows) => {number_of}", every)
    assert {tree: row["kind"] for tree, row in zip(of_tree, every, strict=True)} == told
    last = page.locator("#review-last")
    expect(last).to_be_visible()
    last.get_by_role("button").click()
    person.until_server("/api/annotations", f"it.trees.length + it.skipped.length === {number - 1}")
    expect(last).to_be_hidden()
    assert person.errors == []


# Presses keys three times per second until `wanted` answers have counted, and notes at each press which tree
# the card shows, since when, and for which tree the page has taken it.
REVIEWED = """async ([keys, wanted]) => {
  const { draft } = await import('/static/js/annotate/annotations.js');
  const evidence = document.getElementById('review-evidence'), map = document.getElementById('map');
  let since = performance.now(), last = evidence.dataset.tree, counted = 0, undone = 0;
  const look = new MutationObserver(() => {
    if (evidence.dataset.tree !== last) since = performance.now();
    last = evidence.dataset.tree;
  });
  look.observe(evidence, { attributes: true, attributeFilter: ['data-tree'] });
  const given = [];
  for (const key of keys) {
    if (counted === wanted) break;
    if (key === 'z' && undone >= counted) continue;
    await new Promise((resolve) => setTimeout(resolve, 1000 / 3));
    const title = document.getElementById('review-title').textContent, tree = Number(evidence.dataset.tree);
    const before = draft.answer, now = performance.now();
    const event = { key, ctrlKey: key === 'z', bubbles: true };
    map.dispatchEvent(new KeyboardEvent('keydown', event));
    const taken = key !== 'z' && draft.answer !== before ? draft.answer.number : null;
    given.push({ key, title, tree, taken, seen: now - since, at: now });
    counted += taken !== null;
    undone += key === 'z';
  }
  look.disconnect();
  return given;
}"""
ANSWERED = {"y": "tree", "n": "other", "s": "skipped"}


@pytest.mark.slow
def test_two_hundred_answers_at_three_per_second_belong_to_the_shown_trees(person: Dashboard):
    page = person.page
    person.open("sim:dense")
    person.stand(40.05)
    person.until_server("/api/trees", "it.trees.length > 140")
    person.tab("Annotate")
    sent: list[tuple[str, int, Any]] = []

    def note(response: Response) -> None:
        request = response.request
        if request.method in ("POST", "PATCH") and "/api/annotations" in request.url:
            sent.append(
                (request.url.partition("/api/annotations")[2], response.status, request.post_data_json)
            )

    page.locator("#map").press("s")
    person.card_shown()
    page.on("response", note)
    chance = random.Random(39)
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as load:
        try:
            given = page.evaluate(REVIEWED, [chance.choices("ynsz", k=1000), 200])
        finally:
            load.kill()
    counted = [press for press in given if press["taken"] is not None]
    edits = [press for press in given if press["taken"] is not None or press["key"] == "z"]
    person.eventually(lambda: len(sent) == len(edits), lambda: (len(sent), len(edits)))

    # What was sent is what was shown, and the store has accepted it.
    place = {tree["number"]: (tree["x"], tree["y"]) for tree in person.ask("/api/trees")["trees"]}
    assert all(status < 300 for _, status, _ in sent)
    stored: dict[int, str] = {}
    steps: list[tuple[int, str | None]] = []  # tree of each edit, and its class before
    for press, (where, _, body) in zip(edits, sent, strict=True):
        if press["key"] == "z":
            assert where == "/undo"
            tree, kind = steps.pop()
            stored.pop(tree)
            stored |= {} if kind is None else {tree: kind}
            continue
        tree = press["tree"]
        assert press["title"] == f"Tree {tree}"
        assert press["taken"] == tree
        assert press["seen"] >= 150, press
        assert (body["x"], body["y"], body["kind"]) == (*place[tree], ANSWERED[press["key"]])
        steps.append((tree, stored.get(tree)))
        stored[tree] = body["kind"]

    # What is stored is what was sent, with the undone edits taken back.
    answers = person.ask("/api/annotations")
    number_of = {at: number for number, at in place.items()}
    found = {number_of[row["x"], row["y"]]: row["kind"] for row in [*answers["trees"], *answers["skipped"]]}
    assert found == stored
    assert len(counted) == 200
    took = (given[-1]["at"] - given[0]["at"]) / 1000
    undone = len(edits) - len(counted)
    print(
        f"{len(given)} keys in {took:.0f} s: {len(counted)} answers stored with the tree that was shown, "
        f"{undone} undone, {len(given) - len(edits)} not counted, {len(stored)} annotations"
    )
    assert person.errors == []


# Key presses at intervals [ms]; `repeat` is what a held key sends.
PRESSES = """async ([key, number, wait, held]) => {
  for (let k = 0; k < number; k++) {
    const event = new KeyboardEvent("keydown", { key, bubbles: true, repeat: held && k > 0 });
    document.getElementById("map").dispatchEvent(event);
    if (wait) await new Promise((resolve) => setTimeout(resolve, wait));
  }
}"""


# How the answers look when a card comes into view: whether they are disabled, and their places.
ANSWERS_LOOK = """() => ['yes', 'no', 'next'].map((name) => {
  const button = document.getElementById(`annotate-${name}`);
  const { x, y, width, height } = button.getBoundingClientRect();
  return [button.getAttribute('aria-disabled'), x, y, width, height];
})"""
CARD_COMES = """async () => {
  const { draft, news } = await import('/static/js/annotate/annotations.js');
  draft.shownAt = performance.now();
  news();
}"""


def test_the_answers_show_whether_they_count(person: Dashboard):
    page = person.page
    tree = doubted(person)[0]
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({tree['number']}))")
    person.card_shown()
    page.evaluate(CARD_COMES)
    waiting = page.evaluate(ANSWERS_LOOK)
    assert [disabled for disabled, *_ in waiting] == ["true"] * 3
    for name in ("yes", "no", "next"):
        expect(page.locator(f"#annotate-{name}")).to_have_attribute("aria-disabled", "false")
    assert [place for _, *place in page.evaluate(ANSWERS_LOOK)] == [place for _, *place in waiting]
    page.locator("#map").press("y")
    person.until_server("/api/annotations", "it.trees.length === 1")
    expect(page.locator("#review-refused")).to_be_hidden()


def test_a_held_key_and_keys_faster_than_a_look_answer_for_no_unseen_tree(person: Dashboard):
    page = person.page
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    expect(page.locator("#review-title")).to_be_hidden()
    page.locator("#map").press("s")
    toast = page.locator("#problem")
    for number, (keys, wait, held) in enumerate([(8, 33, True), (2, 0, False), (2, 60, False)], start=1):
        person.card_shown()
        page.evaluate(PRESSES, ["y", keys, wait, held])
        expect(toast).to_contain_text("Not counted (7 times): " if held else "Not counted: ")
        person.until_server("/api/annotations", f"it.trees.length === {number}")
        toast.get_by_role("button").click()
    person.card_shown()
    assert len(rows(person)) == 3
    assert person.errors == []


def test_a_second_click_adds_no_second_annotation_and_the_same_answer_has_no_undo(person: Dashboard):
    page = person.page
    canvas = page.locator("#map")
    canvas.press("a")
    free: Position = {"x": 20.0, "y": 60.0}  # far from all trees
    canvas.dblclick(position=free)
    expect(page.locator("#annotations tbody tr")).to_have_count(1)
    canvas.click(position=free)
    expect(page.locator("#problem")).to_contain_text("no second one was added")
    canvas.press("Escape")
    assert len(rows(person)) == 1

    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    canvas.press("s")
    person.answer("y")
    person.card_shown()
    expect(page.locator("#review-back")).to_be_visible()
    canvas.press("r")
    person.answer("y")
    expect(page.locator("#review-last")).to_contain_text("as before")
    expect(page.locator("#review-back")).to_be_hidden()
    assert len(rows(person)) == 2

    person.card_shown()
    canvas.press("p")  # leaves the review neither for "Find a parameter" nor with an answer
    expect(page.locator("#problem")).to_contain_text("Shift+P")
    expect(page.locator("#review-title")).to_be_visible()
    assert person.errors == []


def test_last_answers_are_listed_and_previous_returns_to_them(person: Dashboard):
    page = person.page
    canvas = page.locator("#map")
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    first, second, third = (tree["number"] for tree in doubted(person)[:3])
    history, title = page.locator("#review-history"), page.locator("#review-title")
    expect(history).to_be_hidden()
    canvas.press("s")
    for key, number in zip(("y", "Shift+P", "Shift+H"), (first, second, third), strict=True):
        expect(title).to_have_text(f"Tree {number}")
        person.answer(key)
    expect(history.get_by_role("button")).to_have_text(
        ["Previous (R)", f"{third} person", f"{second} pole", f"{first} tree"]
    )
    person.card_shown()
    canvas.press("r")
    expect(title).to_have_text(f"Tree {third}")
    canvas.press("r")
    expect(title).to_have_text(f"Tree {second}")
    expect(page.locator("#review-state")).to_have_text("rejected: pole")
    expect(page.locator("#annotate-kind")).to_have_value("pole")
    page.locator("#review-story").click()
    expect(page.locator("#panel-story [data-rejected=pole]")).to_contain_text("rejected this tree")
    person.tab("Annotate")
    canvas.press("b")  # the view from behind is no answer
    person.answer("Shift+B")
    expect(history.get_by_role("button").nth(1)).to_have_text(f"{second} bush")
    history.get_by_role("button", name=f"{first} tree").click()
    expect(title).to_have_text(f"Tree {first}")
    canvas.press("Control+z")
    expect(history.get_by_role("button").nth(1)).to_have_text(f"{second} pole")
    expect(page.locator("#problem")).to_contain_text(f"Undone: the answer bush of tree {second}.")
    canvas.press("Control+y")
    expect(history.get_by_role("button").nth(1)).to_have_text(f"{second} bush")
    expect(page.locator("#problem")).to_contain_text(f"Redone: the answer bush of tree {second}.")
    canvas.press("Control+z")
    expect(history.get_by_role("button").nth(1)).to_have_text(f"{second} pole")
    canvas.press("Control+z")  # the answer before, which makes its tree open again
    expect(history.get_by_role("button")).to_have_text(["Previous (R)", f"{second} pole", f"{first} tree"])
    assert person.errors == []


# How many rings of the selection the map draws.
RINGS = """async () => {
  const [{ changed }, { colours }] = await Promise.all([
    import('/static/js/core/store.js'), import('/static/js/core/theme.js'),
  ]);
  const pen = document.getElementById('map').getContext('2d');
  const ring = document.createElement('canvas').getContext('2d');
  ring.strokeStyle = colours.selection;
  let rings = 0;
  pen.stroke = function () {
    rings += this.strokeStyle === ring.strokeStyle && this.lineWidth === 3;
    CanvasRenderingContext2D.prototype.stroke.call(this);
  };
  changed('annotating');
  await new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
  delete pen.stroke;
  return rings;
}"""


def test_a_chosen_annotation_and_the_card_are_one_selection(person: Dashboard):
    page = person.page
    canvas, title = page.locator("#map"), page.locator("#review-title")
    first, second = doubted(person)[:2]
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({first['number']}))")
    for tree in (first, second):
        expect(title).to_have_text(f"Tree {tree['number']}")
        person.answer("y")
    person.until_server("/api/annotations", "it.trees.length === 2")
    page.get_by_role("button", name="Fit").click()
    person.drawn()

    # On the map.
    canvas.click(position=place_of(person, first["x"], first["y"]))
    expect(title).to_have_text(f"Tree {first['number']}")
    assert page.evaluate(RINGS) == 1
    person.answer("Shift+P")
    person.until_server("/api/annotations", "it.trees.some(row => row.kind === 'pole')")
    assert [row["kind"] for row in rows(person)] == ["pole", "tree"]

    # In the table.
    row = page.locator("#annotations tbody tr").filter(has_text=str(second["number"])).first
    row.locator("td").first.click()
    expect(title).to_have_text(f"Tree {second['number']}")
    expect(row).to_have_attribute("aria-selected", "true")
    assert page.evaluate(RINGS) == 1
    person.answer("Shift+H")
    person.until_server("/api/annotations", "it.trees.some(row => row.kind === 'person')")
    assert [row["kind"] for row in rows(person)] == ["pole", "person"]

    # An added object without a tree has no card: the keys set its own class.
    page.evaluate("import('/static/js/annotate/annotations.js').then(it => it.addAt({ x: 4, y: 30 }))")
    expect(title).to_be_hidden()
    expect(page.locator("#annotate-hint")).to_contain_text("belongs to no found tree")
    assert page.evaluate(RINGS) == 1
    canvas.press("Shift+B")
    person.until_server("/api/annotations", "it.trees[2]?.kind === 'bush'")
    assert [row["kind"] for row in rows(person)] == ["pole", "person", "bush"]
    canvas.press("s")
    expect(title).to_be_visible()
    assert page.evaluate(RINGS) == 1
    person.answer("y")
    person.until_server("/api/annotations", "it.trees.length === 4")
    assert [row["kind"] for row in rows(person)] == ["pole", "person", "bush", "tree"]
    assert person.errors == []


def test_an_answer_counts_only_while_the_card_is_in_view(person: Dashboard):
    page = person.page
    canvas, refused = page.locator("#map"), page.locator("#review-refused")
    page.set_viewport_size({"width": 1280, "height": 720})
    first, second = doubted(person)[:2]
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({first['number']}))")
    person.card_shown()
    expect(page.locator("#review-votes > *")).to_be_attached()
    page.get_by_role("button", name="Fit").click()
    person.drawn()
    scroll = "document.querySelector('#panel-annotate').scrollTop = 1e4"
    for number, key in enumerate(("y", "n", "s", "Shift+P"), start=1):
        page.evaluate(scroll)
        expect(page.locator("#review-title")).not_to_be_in_viewport()
        canvas.press(key)
        times = f" ({number} times)" if number > 1 else ""
        text = f"Not counted{times}: the card of tree {first['number']} was out of view."
        expect(refused).to_have_text(text)
        expect(page.locator("#problem")).to_contain_text(text)
        expect(page.locator("#review-title")).to_be_in_viewport()
        expect(page.locator("#review-evidence svg").first).to_be_in_viewport()
    page.evaluate(scroll)
    canvas.click(position=place_of(person, second["x"], second["y"]))
    expect(page.locator("#review-title")).to_have_text(f"Tree {second['number']}")
    expect(page.locator("#review-title")).to_be_in_viewport()
    expect(refused).to_be_hidden()
    assert rows(person) == []
    person.answer("y")
    person.until_server("/api/annotations", "it.trees.length === 1 && it.skipped.length === 0")
    assert person.errors == []


# The first or second click on Yes, at a time [ms] that does not depend on the speed of the machine.
CLICK = """([detail, timeStamp]) => {
  const click = new MouseEvent('click', { bubbles: true, detail });
  Object.defineProperty(click, 'timeStamp', { value: timeStamp });
  document.getElementById('annotate-yes').dispatchEvent(click);
}"""


def test_the_second_click_of_a_double_click_answers_nothing(person: Dashboard):
    page = person.page
    first, second = doubted(person)[:2]
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({first['number']}))")
    person.card_shown()
    page.evaluate(CLICK, [1, 1000])
    person.card_shown()
    page.evaluate(CLICK, [2, 1250])
    expect(page.locator("#review-refused")).to_contain_text("Not counted: the second click")
    expect(page.locator("#review-title")).to_have_text(f"Tree {second['number']}")
    person.until_server("/api/annotations", "it.trees.length === 1")
    page.locator("#annotate-no").click()
    expect(page.locator("#review-refused")).to_be_hidden()
    person.until_server("/api/annotations", "it.trees.length === 2")
    assert [row["kind"] for row in rows(person)] == ["tree", "other"]

    # The reason covers the picture for a while only.
    person.card_shown()
    page.evaluate("import('/static/js/annotate/annotations.js').then(it => it.refuseHeld())")
    expect(page.locator("#review-refused")).to_be_visible()
    expect(page.locator("#review-refused")).to_be_hidden()
    assert person.errors == []


def test_the_class_of_a_rejected_tree_holds_for_that_tree_only(person: Dashboard):
    page, kind = person.page, person.page.locator("#annotate-kind")
    first, second = doubted(person)[:2]
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({first['number']}))")
    person.card_shown()
    kind.select_option("bush")
    person.answer("n")
    expect(page.locator("#review-title")).to_have_text(f"Tree {second['number']}")
    expect(kind).to_have_value("other")
    person.answer("n")
    person.until_server("/api/annotations", "it.trees.length === 2")
    assert [row["kind"] for row in rows(person)] == ["bush", "other"]
    kind.select_option("pole")
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({first['number']}))")
    expect(kind).to_have_value("bush")  # what it is; the pole was another tree
    expect(page.locator("#review-state")).to_have_text("rejected: bush")
    person.answer("n")
    expect(page.locator("#review-last")).to_contain_text(f"Tree {first['number']}: bush, as before")
    assert [row["kind"] for row in rows(person)] == ["bush", "other"]


def test_edits_that_wait_while_another_run_is_opened_are_not_made_in_it(person: Dashboard):
    told = person.page.evaluate(OTHER_RUN)
    assert told == {"made": [1], "error": "Another run was opened meanwhile: this edit belongs to the one "
                    "before and was not made."}  # fmt: skip


def test_the_name_is_asked_until_it_is_given_and_stored_with_answers(person: Dashboard):
    page = person.page
    ask, history = page.locator("#annotate-ask"), page.locator("#review-history").get_by_role("button")
    first, second, other = doubted(person)[:3]
    expect(ask).to_be_visible()
    expect(page.locator("#annotate-name")).to_be_hidden()
    page.locator("#map").press("s")
    person.answer("y")
    expect(history).to_have_text(["Previous (R)", f"{first['number']} tree"])
    page.locator("#annotate-asked").fill("Ann")
    page.locator("#annotate-asked").press("Enter")
    expect(ask).to_be_hidden()
    expect(page.locator("#annotate-name")).to_be_visible()
    expect(page.locator("#annotate-name")).to_have_value("Ann")
    expect(page.locator("#review-title")).to_have_text(f"Tree {second['number']}")
    person.answer("Shift+P")
    person.until_server("/api/annotations", "it.trees.length === 2 && it.trees[1].who === 'Ann'")
    imported = "table => import('/static/js/annotate/annotations.js').then(it => it.importTable(table, ''))"
    page.evaluate(imported, f"x_m,y_m,class\n{other['x']},{other['y']},tree\n")
    expect(page.locator("#annotations tbody tr")).to_have_count(3)
    # The answers before the name are there, and rows that this person imported are no answers.
    answered = ["Previous (R)", f"{second['number']} pole", f"{first['number']} tree"]
    expect(history).to_have_text(answered)
    page.reload()
    person.until("() => document.querySelector('#annotate-name')?.value === 'Ann'")
    expect(ask).to_be_hidden()
    expect(page.locator("#panel-annotate")).to_be_visible()  # the tab that was open
    expect(history).to_have_text(answered)


def test_keys_work_after_a_click_on_next(person: Dashboard):
    page = person.page
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    nothing = "() => import('/static/js/core/store.js').then(({ state }) => state.selected === null)"
    person.eventually(lambda: bool(page.evaluate(nothing)), lambda: "a tree of the test before is selected")
    first, second = doubted(person)[:2]
    hint = page.locator("#annotate-hint")
    page.locator("#tab-annotate").click()
    page.keyboard.press("s")
    expect(hint).to_contain_text(f"Tree {first['number']}, detected in")
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    person.eventually(lambda: bool(page.evaluate(nothing)), lambda: "a tree is selected")
    page.locator("#annotate-next").click()
    expect(hint).to_contain_text(f"Tree {first['number']}, detected in")
    person.card_shown()
    page.keyboard.press("s")
    expect(hint).to_contain_text(f"Tree {second['number']}, detected in")
    person.card_shown()
    page.keyboard.press("n")
    expect(page.locator("#annotations tbody tr")).to_have_count(1)
    (row,) = rows(person)
    assert (row["x"], row["y"]) == (second["x"], second["y"])
    page.locator("#annotate-next").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#annotate-next")).to_be_focused()  # who walks by Tab stays among the buttons


def test_skipped_trees_are_stored_come_last_and_are_listed_by_their_state(person: Dashboard):
    page = person.page
    canvas = page.locator("#map")
    hint = page.locator("#annotate-hint")
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    first, second, third = doubted(person)[:3]
    for tree in (first, second):
        canvas.press("s")
        expect(hint).to_contain_text(f"Tree {tree['number']}, detected in")
        person.card_shown()
    canvas.press("s")
    expect(page.locator("#annotate-skipped")).to_have_text("2 skipped")
    person.until_server("/api/annotations", "it.skipped.length === 2 && it.trees.length === 0")
    expect(page.locator("#annotations tbody tr")).to_have_count(0)  # a skip states nothing
    unreviewed = "import('/static/js/annotate/annotations.js').then(it => it.unreviewed().map(t => t.number))"
    order = page.evaluate(f"() => {unreviewed}")
    assert (order[0], order[-2:]) == (third["number"], [first["number"], second["number"]])

    # The table marks and lists them; who returns to one and decides replaces the skip.
    page.locator("#annotate-skipped").click()
    listed = page.locator("#trees tbody tr")
    expect(listed).to_have_count(2)
    mine = listed.and_(page.locator(f"[data-tree='{first['number']}']"))
    expect(mine.locator("td").first).to_have_text(f"{first['number']} ↷")
    mine.click()
    person.tab("Annotate")
    person.answer("y")
    expect(page.locator("#annotate-confirmed")).to_have_text("1 confirmed")
    expect(page.locator("#annotate-skipped")).to_have_text("1 skipped")
    row = page.locator("#annotations tbody tr")
    expect(row.locator("td").first).to_have_text(str(first["number"]))
    canvas.press("Control+z")
    expect(page.locator("#annotate-skipped")).to_have_text("2 skipped")
    expect(row).to_have_count(0)

    # Tab is no key of the review: it moves the focus out of the panel.
    page.locator("#annotate-add").focus()
    for _ in range(3):
        page.keyboard.press("Tab")
    assert page.evaluate("() => document.activeElement.id") != "annotate-add"
    person.until_server("/api/annotations", "it.skipped.length === 2")
    assert person.errors == []


def test_the_card_shows_the_evidence_on_the_selected_tree(person: Dashboard):
    page = person.page
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    expect(page.locator("#review-title")).to_be_hidden()
    for tree in doubted(person)[:2]:
        page.locator("#annotate-next").click()
        number = tree["number"]
        evidence = page.locator(f"#review-evidence[data-tree='{number}']")
        expect(evidence.locator("svg")).to_have_count(2)
        expect(page.locator("#review-title")).to_have_text(f"Tree {number}")
        story = person.ask(f"/api/story/tree/{number}")
        expect(page.locator("#review-votes [data-gathered]")).to_have_attribute(
            "data-gathered", story["column"]["verdict"]
        )
        drawn = evidence.locator("svg").first.locator(".cloud")
        places = drawn.evaluate_all("all => all.map(it => it.getAttribute('d').split('M').length - 1)")
        assert sum(places) == sum(z < 3.0 for _, _, z in story["points"])
        if story["dbh"] is None:  # less than half of the trunk was seen
            expect(evidence.locator("circle.fit")).to_have_count(0)
        else:
            # The picture reaches 1.5 diameters from its middle, 0.4 m at least.
            radius = float(evidence.locator("circle.fit").get_attribute("r") or 0)
            assert radius == pytest.approx(story["dbh"] / 2 * 120 / max(0.4, 1.5 * story["dbh"]), rel=1e-3)
        expect(page.locator("#review-state")).to_have_text("open")
    for name in ("yes", "no", "next"):
        box = page.locator(f"#annotate-{name}").bounding_box()
        assert box is not None
        assert min(box["width"], box["height"]) >= 44  # fingers
    page.locator("#annotate-no").click()
    person.until_server("/api/annotations", "it.trees.length === 1 && it.trees[0].kind === 'other'")
    assert person.errors == []


def test_a_tree_that_is_selected_again_while_its_evidence_loads_is_shown(person: Dashboard):
    page = person.page
    tree = doubted(person)[3]["number"]  # not one that is loaded ahead
    select = "tree => import('/static/js/core/live_feed.js').then(({ select }) => select(tree))"
    page.evaluate(select, None)
    expect(page.locator("#review-title")).to_be_hidden()
    held: list[Route] = []
    page.route(f"**/api/story/tree/{tree}", lambda route: held.append(route))
    page.evaluate(select, tree)
    person.eventually(lambda: len(held) == 1, lambda: held)
    page.evaluate(select, None)
    with page.expect_response(f"**/api/story/tree/{tree}"):
        held[0].continue_()
    page.unroute_all()
    page.evaluate(select, tree)
    expect(page.locator(f"#review-evidence[data-tree='{tree}'] svg")).to_have_count(2)
    expect(page.locator("#review-title")).to_have_text(f"Tree {tree}")


def test_a_dbh_is_an_answer_and_gives_the_keys_back_to_the_review(person: Dashboard):
    page = person.page
    number = next(tree["number"] for tree in person.ask("/api/trees")["trees"] if tree["dbh_cm"] is not None)
    page.evaluate(f"import('/static/js/core/live_feed.js').then(({{ select }}) => select({number}))")
    field = page.locator("#review-dbh")
    expect(page.locator("#review-title")).to_have_text(f"Tree {number}")
    expect(field).to_have_attribute("placeholder", re.compile(r"mapped [\d.]+"))
    wrong = page.locator("#review-dbh-error")
    field.fill("wide")
    field.press("Enter")
    expect(wrong).to_contain_text("“wide” is not a DBH")
    expect(wrong).to_be_in_viewport()
    expect(field).to_be_focused()
    expect(field).to_have_value("wide")
    field.press("Escape")
    expect(field).not_to_be_focused()
    expect(field).to_have_value("")
    expect(wrong).to_be_empty()
    assert rows(person) == []

    # Enter stores it, goes on to the next tree, and the next key answers for that.
    field.fill("25,4")
    field.press("Enter")
    expect(field).not_to_be_focused()
    expect(page.locator("#review-title")).not_to_have_text(f"Tree {number}")
    expect(page.locator("#review-title")).to_be_in_viewport()
    person.card_shown()
    page.keyboard.press("n")
    person.until_server("/api/annotations", "it.trees.length === 2")
    assert [(row["kind"], row["dbh_cm"]) for row in rows(person)] == [("tree", 25.4), ("other", None)]

    # A correction; who leaves the field by the pointer stays at the tree.
    page.evaluate(f"import('/static/js/core/live_feed.js').then(({{ select }}) => select({number}))")
    expect(field).to_have_value("25.4")
    field.fill("")
    page.locator("#annotate-count").click()
    person.until_server("/api/annotations", "it.trees[0].dbh_cm === null")
    expect(page.locator("#review-title")).to_have_text(f"Tree {number}")
    expect(page.locator("#annotate-error")).to_be_hidden()


def test_a_dbh_far_from_that_of_the_map_is_questioned_and_its_key_gives_the_keys_back(person: Dashboard):
    page, canvas = person.page, person.page.locator("#map")
    page.set_viewport_size({"width": 1280, "height": 720})
    trees = person.ask("/api/trees")["trees"]
    first, second = [tree for tree in trees if tree["dbh_cm"] is not None][:2]
    select = "number => import('/static/js/core/live_feed.js').then(({ select }) => select(number))"
    field, last = page.locator("#review-dbh"), page.locator("#review-last")
    page.evaluate(select, first["number"])
    person.answer("d")
    expect(field).to_be_focused()
    expect(field).to_be_in_viewport()
    field.fill("2.6")
    field.press("Enter")
    mapped = f"{first['dbh_cm']:.1f} ± {first['sigma_dbh_cm']:.1f}"
    asked = "Press Enter again to store 2.6 cm, Escape to restore it."
    said = f"The map has {mapped} cm. Was it typed in cm? {asked}"
    expect(page.locator("#review-dbh-error")).to_have_text(said)
    expect(field).to_be_focused()
    page.locator("#review-title").click()  # who goes on without the second Enter has not confirmed it
    expect(page.locator("#problem")).to_contain_text(
        f"The DBH 2.6 cm of tree {first['number']} was not stored."
    )
    expect(field).to_have_value("")
    assert not rows(person)
    person.answer("d")
    field.fill("2.6")
    # A second Enter before the question can be read, and a held key, do not confirm the diameter.
    enter = "{ key: 'Enter', bubbles: true, cancelable: true, repeat }"
    field.evaluate(
        "node => [false, false, true].forEach(repeat =>"
        f" node.dispatchEvent(new KeyboardEvent('keydown', {enter})))"
    )
    expect(page.locator("#review-dbh-error")).to_have_text(said)
    expect(field).to_be_focused()
    assert not rows(person)
    page.wait_for_timeout(600)
    field.press("Enter")
    expect(last.locator("span")).to_have_text(f"Tree {first['number']}: tree, 2.6 cm (map {mapped} cm)")
    page.evaluate(select, second["number"])
    person.answer("d")
    field.fill(str(second["dbh_cm"]))
    field.press("Enter")
    expect(last.locator("span")).to_contain_text(f"Tree {second['number']}: tree, {second['dbh_cm']:g} cm")

    # The keys of the card act again after Escape.
    page.evaluate(select, first["number"])
    person.answer("d")
    expect(field).to_be_focused()
    page.evaluate("document.querySelector('#panel-annotate').scrollTop = 1e4")
    field.press("Escape")
    expect(page.locator("#review-title")).to_be_in_viewport()
    person.card_shown()
    page.keyboard.press("Shift+P")
    person.until_server("/api/annotations", "it.trees.some(row => row.kind === 'pole')")
    # The doubt is not repeated: the diameter was confirmed.
    said = f"Tree {first['number']}: pole, 2.6 cm (before: tree, 2.6 cm)"
    expect(last.locator("span")).to_have_text(said)
    canvas.press("Control+z")
    expect(page.locator("#problem")).to_contain_text(
        f"Undone: the answer pole, 2.6 cm of tree {first['number']}."
    )
    canvas.press("Control+z")
    canvas.press("Control+z")
    person.until_server("/api/annotations", "it.trees.length === 0")


# The questions about three typed diameters [cm] of a tree without DBH, in maps with 9 and 8 diameters.
DOUBTS = """async () => {
  const { state } = await import('/static/js/core/store.js');
  const { typedDoubt } = await import('/static/js/annotate/annotations.js');
  const { map } = state, [tree] = map.trees;
  const said = [9, 8].map((number) => {
    const trees = Array.from({ length: number }, (_, k) => ({ ...tree, number: k + 1, dbh_cm: 10.5 + k }));
    state.map = { ...map, trees };
    return [9.8, 15, 41].map((dbh) => typedDoubt({ dbh_cm: null }, dbh));
  });
  state.map = map;
  return said;
}"""


def test_a_dbh_beyond_those_of_the_map_is_questioned_where_the_map_has_none(person: Dashboard):
    doubts = person.page.evaluate(DOUBTS)
    thin, thick = "No mapped stem is thinner than 10.5 cm", "No mapped stem is thicker than 18.5 cm"
    assert doubts == [[f"{thin}. Is it right, in cm?", "", f"{thick}. Is it right, in cm?"], ["", "", ""]]


def test_the_line_with_undo_belongs_to_the_last_edit_and_undo_says_what_it_did(person: Dashboard):
    page, canvas = person.page, person.page.locator("#map")
    last, news = page.locator("#review-last"), page.locator("#problem")
    tree = doubted(person)[0]
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({tree['number']}))")
    person.answer("y")
    expect(last).to_contain_text(f"Tree {tree['number']}: tree")
    page.evaluate("import('/static/js/annotate/annotations.js').then(it => it.addAt({ x: 4, y: 30 }))")
    person.until_server("/api/annotations", "it.trees.length === 2")
    expect(last).to_contain_text("Added: tree at 4.000, 30.000")
    canvas.press("ArrowRight")
    person.until_server("/api/annotations", "Math.abs(it.trees[1].x - 4.01) < 1e-6")
    row = page.locator("#annotations tbody tr").first
    row.get_by_label(re.compile("Class")).select_option("bush")
    person.until_server("/api/annotations", "it.trees[1].kind === 'bush'")
    row.get_by_label(re.compile("Delete")).click()
    person.until_server("/api/annotations", "it.trees.length === 1")
    undone = ["the bush deleted", "class of the tree changed to bush", "the tree moved", "tree added"]
    for text in [*undone, f"the answer tree of tree {tree['number']}"]:
        canvas.press("Control+z")
        expect(news).to_contain_text(f"Undone: {text}.")
    canvas.press("Control+y")
    expect(news).to_contain_text(f"Redone: the answer tree of tree {tree['number']}.")

    # The arrows move the annotation of a tree, and its line goes.
    row.locator("td").first.click()
    person.answer("Shift+P")
    expect(last).to_contain_text(f"Tree {tree['number']}: pole")
    row.locator("td").first.click()
    canvas.press("ArrowRight")
    expect(last).to_be_hidden()
    person.until_server("/api/annotations", "it.trees[0].version === 5")
    canvas.press("Control+z")
    expect(news).to_contain_text(f"Undone: tree {tree['number']} moved.")


def test_the_map_names_the_source_of_class_and_dbh(person: Dashboard):
    page, tip = person.page, person.page.locator("#map-tip")
    assert person.ask("/api/annotations")["used"] == "source"
    truth = page.evaluate("import('/static/js/core/store.js').then(({ state }) => state.truth)")
    known = [each for each in truth if each["kind"] == "tree" and each["dbh_cm"] is not None]
    alone = [
        each
        for each in known
        if sum((each["x"] - o["x"]) ** 2 + (each["y"] - o["y"]) ** 2 < 4.0 for o in truth) == 1
    ]
    confirmed, measured, other = sorted(alone, key=lambda each: each["x"] ** 2 + each["y"] ** 2)[:3]
    imported = "table => import('/static/js/annotate/annotations.js').then(it => it.importTable(table, ''))"
    table = f"{confirmed['x']},{confirmed['y']},\n{measured['x']},{measured['y'] + 0.1},2.6\n"
    page.evaluate(imported, f"x_m,y_m,dbh_cm\n{table}")
    person.until_server("/api/annotations", "it.trees.length === 2")
    page.get_by_role("button", name="Fit").click()
    person.drawn()
    for place, text in (
        (confirmed, f"Annotation: tree\nGround truth: DBH {confirmed['dbh_cm']:.1f} cm"),
        (measured, "Annotation: tree, DBH 2.6 cm"),
        (other, f"Ground truth: tree, DBH {other['dbh_cm']:.1f} cm"),
    ):
        page.locator("#map").hover(position=place_of(person, place["x"], place["y"]))
        expect(tip).to_contain_text(text)


def test_the_table_has_the_diameter_that_counts(person: Dashboard):
    page, found = person.page, person.ask("/api/trees")["trees"]
    taped, rejected = [tree for tree in found if tree["dbh_cm"] is not None][:2]
    add = """([x, y, kind, dbh]) => import('/static/js/annotate/annotations.js').then(
        (it) => it.edit(() => it.send('POST', '/api/annotations', { x, y, kind, dbh_cm: dbh })))"""
    page.evaluate(add, [taped["x"], taped["y"], "tree", 98.7])
    page.evaluate(add, [rejected["x"], rejected["y"], "pole", 97.6])
    person.tab("Trees")
    cell = page.locator(f"#trees [data-tree='{taped['number']}'] td").nth(4)
    expect(cell).to_have_text("98.7 by tape")
    mapped = [f"{each['dbh_cm']:.1f} ± {each['sigma_dbh_cm']:.1f}" for each in (taped, rejected)]
    expect(cell).to_have_attribute("title", f"In the map: {mapped[0]} cm")
    other = page.locator(f"#trees [data-tree='{rejected['number']}'] td").nth(4)
    expect(other).to_have_text(mapped[1])
    expect(other).to_have_attribute("title", "")
    page.locator("#find").fill("dbh > 90")
    expect(page.locator("#trees tbody tr")).to_have_count(1)
    page.locator("#find").fill("")


def test_accumulated_points_lie_under_the_map_of_the_tab(person: Dashboard):
    page = person.page
    page.get_by_role("button", name="Fit").click()
    person.eventually(lambda: page.evaluate(CELLS_DRAWN) == 1.0, lambda: page.evaluate(CELLS_DRAWN))
    person.tab("Scores")
    person.drawn()
    assert page.evaluate(CELLS_DRAWN) < 1.0
    person.tab("Annotate")
    person.eventually(lambda: page.evaluate(CELLS_DRAWN) == 1.0, lambda: page.evaluate(CELLS_DRAWN))
    assert person.errors == []


def test_the_camera_follows_the_selection_unless_it_is_switched_off(person: Dashboard):
    page, scene = person.page, person.scene
    trees = person.ask("/api/trees")["trees"]

    def looks_at(tree: dict[str, Any]) -> bool:
        x, y, z = scene.evaluate(LOOKED_AT)
        return bool(abs(x - tree["x"]) < 0.05 and abs(y - tree["y"]) < 0.05 and abs(z - 1.3) < 1.0)

    def until_seen(tree: dict[str, Any]) -> None:
        person.eventually(lambda: looks_at(tree), lambda: (scene.evaluate(LOOKED_AT), tree))

    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    first = doubted(person)[0]
    page.locator("#annotate-next").click()  # from the review
    expect(page.locator("#review-title")).to_have_text(f"Tree {first['number']}")
    tree = next(each for each in trees if each["number"] == first["number"])
    until_seen(tree)
    assert scene.evaluate(DISTANCE) <= 12.01
    person.tab("Trees")  # from the table
    wanted, other = [each for each in trees if each is not tree][:2]
    page.locator(f"#trees [data-tree='{wanted['number']}']").click()
    until_seen(wanted)
    page.locator("#focus-selection").click()
    expect(page.locator("#focus-selection")).to_have_attribute("aria-pressed", "false")
    person.tab("Trees")
    page.locator(f"#trees [data-tree='{other['number']}']").click()
    page.wait_for_timeout(1500)
    assert looks_at(wanted)
    page.locator("#focus-selection").click()
    until_seen(other)
    assert person.errors == []


def test_two_users_see_the_same_annotations_and_a_stale_edit_is_refused(
    person: Dashboard, chromium: Browser, server: Server
):
    page = person.page
    page.locator("#annotate-asked").fill("Ann")
    page.locator("#annotate-asked").press("Enter")
    page.locator("#annotate-file").set_input_files(
        {"name": "plot.csv", "mimeType": "text/csv", "buffer": b"X,Y,dbh_cm\n1.5,30.5,22\n-4.0,31.0,\n"}
    )
    expect(page.locator("#annotate-hint")).to_contain_text("2 trees imported from plot.csv")
    with opened_by_another(chromium, server.link) as other:
        other.tab("Annotate")
        theirs = other.page.locator("#annotations tbody tr")
        expect(theirs).to_have_count(2)
        expect(theirs.first).to_contain_text("import of plot.csv")
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


def test_two_annotators_get_different_trees_and_a_page_on_another_tab_follows(
    person: Dashboard, chromium: Browser, server: Server
):
    first, second, *_ = doubted(person)
    numbers = [tree["number"] for tree in (first, second)]
    title = person.page.locator("#review-title")
    with opened_by_another(chromium, server.link) as other:
        theirs = other.page.locator("#review-title")
        row = other.page.locator(f"#trees tr[data-tree='{numbers[0]}']")
        person.page.locator("#map").press("s")
        expect(title).to_have_text(f"Tree {numbers[0]}")
        expect(row).to_have_attribute("aria-selected", "true")  # on the tab Trees

        # The tree that the other page followed is left to who answers for it.
        other.tab("Annotate")
        expect(theirs).to_have_text(f"Tree {numbers[0]}")
        expect(other.page.locator("#annotate-next")).to_have_text("Next (S)")
        other.page.locator("#map").press("s")
        expect(theirs).to_have_text(f"Tree {numbers[1]}")
        held = "() => import('/static/js/core/store.js').then(({ state }) => state.selectedByOthers)"
        person.eventually(
            lambda: person.page.evaluate(held) == [numbers[1]], lambda: person.page.evaluate(held)
        )
        assert person.ask("/api/annotations")["skipped"] == []

        expect(title).to_have_text(f"Tree {numbers[0]}")
        person.answer("y")
        person.until_server("/api/annotations", "it.trees.length === 1")
        expect(title).not_to_have_text(re.compile(rf"^Tree ({numbers[0]}|{numbers[1]})\b"))
        expect(theirs).to_have_text(f"Tree {numbers[1]}")

        other.tab("Trees")
        person.answer("y")
        expect(title).to_have_text(re.compile(r"^Tree \d+$"))
        number = title.inner_text().split()[1]
        row = other.page.locator(f"#trees tr[data-tree='{number}']")
        expect(row).to_have_attribute("aria-selected", "true")
        assert other.errors == []
    assert person.errors == []


# Next, before the message on the selection of the other page has come.
NEXT_BEFORE_MESSAGE = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  const { skip } = await import('/static/js/annotate/annotations.js');
  state.selectedByOthers = [];
  changed('others'); // it has left no tree either
  changed('annotations');
  await skip();
  return state.selected;
}"""


def test_of_two_annotators_who_come_to_one_tree_at_once_the_second_goes_on(
    person: Dashboard, chromium: Browser, server: Server
):
    first, second, *_ = doubted(person)
    title = person.page.locator("#review-title")
    with opened_by_another(chromium, server.link) as other:
        other.tab("Annotate")
        person.page.evaluate("import('/static/js/core/live_feed.js').then(it => it.select(null))")
        select = "number => import('/static/js/core/live_feed.js').then(it => it.select(number))"
        other.page.evaluate(select, first["number"])
        held = "() => import('/static/js/core/store.js').then(({ state }) => state.selectedByOthers)"
        person.eventually(
            lambda: person.page.evaluate(held) == [first["number"]], lambda: person.page.evaluate(held)
        )
        assert person.page.evaluate(NEXT_BEFORE_MESSAGE) == first["number"]
        expect(title).to_have_text(f"Tree {second['number']}")
        expect(other.page.locator("#review-title")).to_have_text(f"Tree {first['number']}")
        # Who chooses a tree that another page has stays there.
        person.page.evaluate(select, first["number"])
        person.answer("y")
        expect(person.page.locator("#review-last")).to_contain_text(f"Tree {first['number']}: tree")
        person.until_server("/api/annotations", "it.trees.length === 1 && it.skipped.length === 0")
        assert other.errors == []
    assert person.errors == []


# The next tree of the review after another page has selected a tree, has left it, and its answer has come.
NEXT_BESIDE_ANOTHER = """async (number) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const { following } = await import('/static/js/annotate/annotations.js');
  const next = [];
  for (const [others, topic] of [[[number], 'others'], [[], 'others'], [[], 'annotations']]) {
    state.selectedByOthers = others;
    changed(topic);
    next.push(following()[0].number);
  }
  return next;
}"""


def test_a_tree_that_another_page_has_just_left_is_not_the_next_one(person: Dashboard):
    first, second, *_ = doubted(person)
    person.page.evaluate("import('/static/js/core/live_feed.js').then(it => it.select(null))")
    person.until("() => document.getElementById('review-title').textContent === ''")
    found = person.page.evaluate(NEXT_BESIDE_ANOTHER, first["number"])
    assert found == [second["number"], second["number"], first["number"]]


@pytest.mark.slow
def test_annotations_survive_a_killed_server_and_are_exported(chromium: Browser, tmp_path: Path):
    with Server(STEMMAP_FOLDER=str(tmp_path)) as first, opened(chromium, first.link) as person:
        person.stand(15.05)
        person.until_server("/api/trees", "it.trees.length > 20")
        person.tab("Annotate")
        person.page.locator("#map").press("s")
        person.answer("y")
        person.page.locator("#annotate-asked").fill("Ann")
        person.page.locator("#annotate-asked").press("Enter")
        person.answer("y")
        person.until_server("/api/annotations", "it.trees.length === 2")  # the page counts those on their way
        before = rows(person)
        first.kill()
    with Server(STEMMAP_FOLDER=str(tmp_path)) as again, opened(chromium, again.link) as other:
        page = other.page
        panel = other.tab("Annotate")
        expect(page.locator("#annotations tbody tr")).to_have_count(2)
        assert rows(other) == before
        files = {}
        for name in ("Save CSV", "Save GeoJSON"):
            with page.expect_download() as download:
                panel.get_by_role("link", name=name, exact=True).click()
            files[name] = download.value.path().read_text(encoding="utf-8")
        head, *lines = csv.reader(files["Save CSV"].splitlines())
        written = [dict(zip(head, line, strict=True)) for line in lines]
        for axis in ("x", "y"):
            places = sorted(row[axis] for row in before)
            assert sorted(float(row[f"{axis}_m"]) for row in written) == pytest.approx(places, abs=1e-3)
        assert len(json.loads(files["Save GeoJSON"])["features"]) == 2
        assert other.errors == []


# A table is imported, as another browser would.
IMPORTED = """async table => {
  const { run } = await (await fetch("/api/annotations")).json();
  const said = { run, table, browser: "c".repeat(32), who: "another" };
  await fetch("/api/annotations/import", { method: "POST", headers: { "Content-Type": "application/json" },
    body: JSON.stringify(said) });
}"""

# The share of the cells of the section inside of the map whose centre is painted.
CELLS_DRAWN = """async () => {
  const [{ unpack }, { screenOf }] = await Promise.all([
    import('/static/js/scene/points.js'), import('/static/js/map/map.js'),
  ]);
  const answer = await fetch('/api/section');
  if (!answer.ok) return -1;
  const { side, origin, arrays: { cells } } = unpack(await answer.arrayBuffer());
  const canvas = document.querySelector('#map'), pen = canvas.getContext('2d');
  const image = pen.getImageData(0, 0, canvas.width, canvas.height);
  let inside = 0, drawn = 0;
  for (let k = 0; k < cells.length; k += 2) {
    const centre = screenOf(origin[0] + side * (cells[k] + 0.5), origin[1] + side * (cells[k + 1] + 0.5));
    const [x, y] = centre.map(at => Math.floor(at * devicePixelRatio));
    if (x < 1 || y < 1 || x >= canvas.width - 1 || y >= canvas.height - 1) continue;
    inside += 1;
    drawn += image.data[4 * (y * canvas.width + x) + 3] > 0;
  }
  return inside > 50 ? drawn / inside : -2;
}"""

# The place at which the camera looks, in the frame of the map, and its distance from it.
LOOKED_AT = """() => {
  const { camera, cameraControl, nodeRefFromName } = window.__viserMutable;
  const target = cameraControl.getTarget(camera.position.clone());
  return target.applyMatrix4(nodeRefFromName['/world'].matrixWorld.clone().invert()).toArray();
}"""
DISTANCE = """() => {
  const { camera, cameraControl } = window.__viserMutable;
  const [at, from] = [camera.position.clone(), camera.position.clone()];
  return cameraControl.getTarget(at).distanceTo(cameraControl.getPosition(from));
}"""

# At once, however slow the machine is: a pause between them would make two edits of it.
FIVE_TIMES_RIGHT = """canvas => {
  for (let k = 0; k < 5; k += 1) {
    const press = { key: 'ArrowRight', bubbles: true, cancelable: true };
    canvas.dispatchEvent(new KeyboardEvent('keydown', press));
  }
}"""


FORGET_REFUSAL = """async () => {
  const { draft, news } = await import('/static/js/annotate/annotations.js');
  draft.refused = "";
  news();
}"""


def test_picture_question_and_answers_are_in_view_together(person: Dashboard):
    page = person.page
    page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    page.locator("#map").press("s")
    person.card_shown()
    parts = ["#review-evidence .picture:has(.fit)", "#annotate-hint", "#annotate-yes", "#annotate-no"]
    parts += ["#annotate-next", "#annotate-kind", "#review-title", "#annotate-asked"]
    title = page.locator("#review-title").inner_text()
    for width, height in ((1440, 900), (1280, 720), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        person.drawn()
        page.evaluate("() => scrollTo(0, 0)")
        top = page.locator("header.strip").bounding_box()
        bottom = page.locator("footer.transport").bounding_box()
        assert top is not None
        assert bottom is not None
        for part in parts:
            box = page.locator(part).first.bounding_box()
            assert box is not None, (width, part)
            assert box["y"] >= top["y"] + top["height"] - 0.5, (width, part, box)
            assert box["y"] + box["height"] <= bottom["y"] + 0.5, (width, part, box, bottom)
            assert box["x"] >= 0, (width, part, box)
            assert box["x"] + box["width"] <= width + 0.5, (width, part, box)
        assert page.locator("#review-title").inner_text() == title, width
        # A line over the picture moves nothing.
        places = [page.locator(part).first.bounding_box() for part in parts]
        page.evaluate("import('/static/js/annotate/annotations.js').then(it => it.refusePlain())")
        expect(page.locator("#review-refused")).to_be_visible()
        assert [page.locator(part).first.bounding_box() for part in parts] == places
        page.evaluate(FORGET_REFUSAL)
        expect(page.locator("#review-refused")).to_be_hidden()


def test_an_import_says_how_many_trees_of_the_map_it_confirms(person: Dashboard):
    tree = person.ask("/api/trees")["trees"][0]
    table = f"x_m,y_m,class\n{tree['x']},{tree['y']},tree\n500,500,tree\n"
    person.page.evaluate("() => import('/static/js/core/live_feed.js').then(({ select }) => select(null))")
    person.page.locator("#annotate-file").set_input_files(
        {"name": "plot.csv", "mimeType": "text/csv", "buffer": table.encode()}
    )
    said = "2 trees imported from plot.csv; 1 tree of the map is confirmed by them"
    expect(person.page.locator("#annotate-hint")).to_contain_text(said)
    expect(person.page.locator("#problem")).to_contain_text(said)
    expect(person.page.locator("#annotate-confirmed")).to_have_text("1 confirmed")


def test_an_own_export_is_imported_with_diameters_and_its_contradictions_are_named(person: Dashboard):
    page, hint = person.page, person.page.locator("#annotate-hint")
    trees = person.ask("/api/trees")["trees"]
    table = "x_m,y_m,class\n" + "".join(f"{tree['x']},{tree['y']},tree\n" for tree in trees)
    file = page.locator("#annotate-file")
    file.set_input_files({"name": "plot.csv", "mimeType": "text/csv", "buffer": table.encode()})
    expect(hint).to_contain_text(f"{len(trees)} trees imported from plot.csv")
    page.evaluate(f"import('/static/js/core/live_feed.js').then(it => it.select({trees[0]['number']}))")
    expect(hint).to_contain_text(f"All {len(trees)} trees are reviewed.")
    with page.expect_download() as download:
        page.get_by_role("link", name="Save CSV", exact=True).click()
    assert download.value.suggested_filename == "sim_stand_truth.csv"
    lines = download.value.path().read_text(encoding="utf-8").splitlines()
    lines[1], lines[2] = lines[1].replace(",,tree,", ",31.5,tree,"), lines[2].replace(",tree,", ",pole,")
    table = "\n".join(lines)
    file.set_input_files({"name": "plot.csv", "mimeType": "text/csv", "buffer": table.encode()})
    expect(hint).to_contain_text(
        "0 trees imported from plot.csv; 1 diameter added; 1 differs from its annotation and was left out: "
        f"tree {trees[1]['number']} is tree here, pole in the file; {len(trees) - 2} left out because"
    )
    assert len(rows(person)) == len(trees)
    assert rows(person)[0]["dbh_cm"] == 31.5
    page.locator("#annotate-replaces").check()
    file.set_input_files({"name": "plot.csv", "mimeType": "text/csv", "buffer": table.encode()})
    expect(hint).to_contain_text(
        f"0 trees imported from plot.csv; 1 annotation replaced (tree {trees[1]['number']}: tree -> pole); "
        f"{len(trees) - 1} left"
    )
    assert rows(person)[1]["kind"] == "pole"
    page.locator("#annotate-replaces").uncheck()
    page.locator("#annotate-undo").click()
    expect(page.locator("#annotate-rejected")).to_have_text("0 rejected")
    beside = f"x_m,y_m\n{trees[0]['x'] + 0.02},{trees[0]['y']}\n"
    file.set_input_files({"name": "gnss.csv", "mimeType": "text/csv", "buffer": beside.encode()})
    expect(hint).to_contain_text("1 row lies 0.020 m beside an annotation and counts as the same object")
    page.locator("#annotate-undo").click()
    expect(page.locator("#problem")).to_contain_text(f"Undone: DBH of tree {trees[0]['number']} set to 31.5")
    page.locator("#annotate-undo").click()
    expect(page.locator("#problem")).to_contain_text(f"Undone: {len(trees)} annotations added.")


# A later map in which the tree of an annotation is gone, and another one is 0.3 m from its place.
WITHOUT_OWN_TREE = """async ([number, reach, kind]) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const { reviewOf, withoutTree } = await import('/static/js/annotate/annotations.js');
  const { map, annotations } = state, [row] = annotations.trees;
  const beside = { ...map.trees.find((tree) => tree.number !== number), x: row.x + 0.3, y: row.y };
  state.map = { ...map, trees: [beside] };
  state.annotations = { ...annotations, trees: [{ ...row, kind, reach_m: reach }] };
  changed('map');
  changed('annotations');
  const said = document.querySelector('#annotate-without');
  return [reviewOf(beside), withoutTree().length, said.hidden ? '' : said.innerText.trim().split('\\n')[0]];
}"""


def test_a_rejection_does_not_pass_to_a_neighbour_when_its_tree_is_gone(person: Dashboard):
    tree = doubted(person)[0]
    person.page.evaluate(
        "number => import('/static/js/core/live_feed.js').then(it => it.select(number))", tree["number"]
    )
    person.answer("Shift+P")
    person.until_server("/api/annotations", "it.trees.length === 1")
    later, number = person.page.evaluate, tree["number"]
    assert later(WITHOUT_OWN_TREE, [number, 0.5, "pole"]) == ["rejected", 0, ""]
    said = "1 answer belongs to no tree of this map, so it"
    assert later(WITHOUT_OWN_TREE, [number, 0.25, "pole"]) == ["open", 1, f"{said} decides nothing:"]
    assert later(WITHOUT_OWN_TREE, [number, 0.25, "tree"]) == ["open", 0, f"{said} counts as an added tree:"]


# 14 rejections of things that this map has not.
MANY_WITHOUT_TREE = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  const authors = { who: 'Ann', dbh_who: '', by: 'Ann' };
  const same = { ...authors, y: 900, kind: 'pole', dbh_cm: null, reach_m: 0.5, at_s: 0, version: 1 };
  const row = (id) => ({ ...same, id, x: id });
  state.annotations = { ...state.annotations, trees: Array.from({ length: 14 }, (_, k) => row(1e6 + k)) };
  changed('annotations');
}"""


def test_a_long_list_says_how_many_more_there_are(person: Dashboard):
    person.page.evaluate(MANY_WITHOUT_TREE)
    listed = person.page.locator("#annotate-without [role=group]")
    expect(listed.get_by_role("button")).to_have_count(12)
    expect(listed).to_contain_text("and 2 more")
    person.page.reload()


def test_an_answer_that_replaces_that_of_another_person_says_so(
    person: Dashboard, chromium: Browser, server: Server
):
    number = doubted(person)[0]["number"]
    select = "number => import('/static/js/core/live_feed.js').then(it => it.select(number))"
    person.page.locator("#annotate-asked").fill("Ann")
    person.page.locator("#annotate-asked").press("Enter")
    person.page.evaluate(select, number)
    person.answer("y")
    person.until_server("/api/annotations", "it.trees.length === 1")
    with opened_by_another(chromium, server.link) as other:
        other.tab("Annotate")
        other.page.evaluate(select, number)
        expect(other.page.locator("#review-state")).to_have_text("confirmed by Ann")
        other.answer("Shift+P")
        expect(other.page.locator("#review-last span")).to_have_text(
            f"Tree {number}: pole (before: tree by Ann)"
        )
        assert other.errors == []
    assert person.errors == []


def test_the_map_names_the_filter_that_makes_it_pale_and_removes_it(person: Dashboard):
    page, chip = person.page, person.page.locator("#map-filter")
    expect(chip).to_be_hidden()
    page.locator("#annotate-skipped").click()
    expect(chip).to_have_text("Filter: skipped ✕")
    person.tab("Repair")
    chip.click()
    expect(chip).to_be_hidden()
    assert page.evaluate("() => import('/static/js/core/store.js').then(({ state }) => state.holds)") is None
    person.tab("Trees")
    expect(page.locator("#find")).to_have_value("")
