"""The tab Repair: each repair by clicks on the map, undone and redone; loops; what does not apply."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import PRESET, Dashboard
from tests.browser.serving import Server
from tests.browser.test_annotate import place_of


@pytest.fixture
def person(chromium: Browser, server: Server) -> Iterator[Dashboard]:
    """A new page on a run without annotations."""
    with opened(chromium, server.link) as dashboard:
        dashboard.reset()
        dashboard.stand()
        dashboard.until_server("/api/trees", "it.trees.length > 20")
        dashboard.tab("Repair")
        expect(dashboard.page.locator("#repairs li")).to_have_count(0)
        dashboard.page.get_by_role("button", name="Fit").click()
        dashboard.drawn()
        yield dashboard


def trees(dashboard: Dashboard) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = dashboard.ask("/api/trees")["trees"]
    return found


def click(dashboard: Dashboard, x: float, y: float) -> None:
    dashboard.page.locator("#map").click(position=place_of(dashboard, x, y))


def apart(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The trees with the most room around them."""

    def room(tree: dict[str, Any]) -> float:
        others = [other for other in found if other is not tree]
        return min(math.hypot(tree["x"] - other["x"], tree["y"] - other["y"]) for other in others)

    return sorted(found, key=room, reverse=True)


def near(found: list[dict[str, Any]], tree: dict[str, Any], beside: float = 0.0) -> bool:
    """Whether a tree stands at the place of another one, or so far beside it in x."""
    return any(math.hypot(each["x"] - tree["x"] - beside, each["y"] - tree["y"]) < 0.4 for each in found)


FEWER_PARTICLES = """() => fetch('/api/parameters', { method: 'PATCH',
  body: JSON.stringify({ changes: { 'slam.particles': 60 } }),
  headers: { 'Content-Type': 'application/json' } })"""


def use(dashboard: Dashboard, name: str) -> None:
    dashboard.page.keyboard.press("Escape")
    dashboard.page.locator("#map").press("Escape")  # no tree is selected
    button = dashboard.page.locator(f"#repair-{name}")
    button.click()
    expect(button).to_have_attribute("aria-pressed", "true")


def test_each_repair_changes_the_map_and_is_undone_and_redone(person: Dashboard):
    page, found = person.page, trees(person)
    a, b, c, d, e, f = apart(found)[:6]
    listed = page.locator("#repairs li")

    use(person, "merge")
    expect(page.locator("#repair-hint")).to_contain_text("Click the tree that stays")
    click(person, a["x"], a["y"])
    expect(page.locator("#repair-hint")).to_contain_text(f"the same as tree {a['number']}")
    click(person, b["x"], b["y"])
    person.until_server("/api/trees", f"!it.trees.some(tree => tree.number === {b['number']})")

    use(person, "split")
    click(person, c["x"], c["y"])
    click(person, c["x"] + 0.6, c["y"])
    person.until_server("/api/trees", f"it.trees.length === {len(found)}")
    second = max(trees(person), key=lambda tree: tree["number"])
    assert abs(second["x"] - c["x"] - 0.6) < 0.2
    assert second["dbh_cm"] is None

    use(person, "move")
    click(person, d["x"], d["y"])
    click(person, d["x"] + 1.0, d["y"])
    person.until_server(
        "/api/trees", f"it.trees.some(tree => tree.number === {d['number']} && tree.x > {d['x'] + 0.7})"
    )

    click(person, e["x"], e["y"])
    expect(page.locator("#repair-hint")).to_contain_text(f"Tree {e['number']} is selected")
    page.locator("#repair-class").select_option("pole")
    person.until_server("/api/trees", f"!it.trees.some(tree => tree.number === {e['number']})")

    click(person, f["x"], f["y"])
    expect(page.locator("#repair-hint")).to_contain_text(f"Tree {f['number']} is selected")
    page.locator("#map").press("Delete")
    person.until_server("/api/trees", f"!it.trees.some(tree => tree.number === {f['number']})")
    expect(listed).to_have_count(5)
    expect(page.locator("#repair-count")).to_have_text("5 repairs")
    expect(listed.locator(".grow")).to_have_text(
        [
            f"tree {f['number']} deleted",
            f"tree {e['number']}: class pole",
            f"tree {d['number']} moved",
            f"tree {c['number']} split",
            f"tree {b['number']} merged into tree {a['number']}",
        ]
    )
    mended = trees(person)

    # The export has the repaired map and says so; another scan has it too.
    saved = person.ask("/api/repairs.json")["repairs"]
    assert [each["kind"] for each in saved] == ["merge", "split", "move", "class", "delete"]
    person.command({"type": "seek", "time_s": 14.05})
    person.until_server("/api/status", "it.time_s < 14.1 && it.going_to === ''")
    person.until_server("/api/trees", f"!it.trees.some(tree => tree.number === {f['number']})")
    person.stand()
    person.until_server("/api/trees", f"it.trees.length === {len(mended)}")

    for left in (4, 3, 2, 1, 0):
        page.locator("#map").press("Control+z")
        expect(listed).to_have_count(left)
    person.until_server("/api/trees", f"it.trees.length === {len(found)}")
    assert [tree["number"] for tree in trees(person)] == [tree["number"] for tree in found]
    for _ in range(5):
        page.locator("#repair-redo").click()
    expect(listed).to_have_count(5)
    person.until_server("/api/trees", f"it.trees.length === {len(mended)}")

    # They apply again after the run was mapped again with another value.
    revision = person.ask("/api/parameters")["revision"]
    page.evaluate(FEWER_PARTICLES)
    person.until_server("/api/parameters", f"it.revision > {revision}")
    revision = person.ask("/api/parameters")["revision"]
    person.until_server("/api/status", f"it.revision === {revision} && it.remapped === null")
    expect(page.locator("#repair-count")).to_have_text("5 repairs")
    person.eventually(
        lambda: all(not near(trees(person), at) for at in (b, e, f)) and near(trees(person), d, 1.0),
        lambda: trees(person),
    )
    page.evaluate(PRESET, "forest")

    page.locator("#repairs li button").first.click()  # the newest: the deletion
    person.until_server("/api/trees", f"it.trees.some(tree => tree.number === {f['number']})")


def test_a_tie_bends_the_path_and_is_forbidden_and_undone(person: Dashboard):
    page, found = person.page, trees(person)
    module = "import('/static/js/core/store.js')"
    end = f"() => {module}.then(it => it.state.path.at(-1).slice(0, 2))"
    loops = f"() => {module}.then(it => it.state.map.loops.length)"
    before, known = page.evaluate(end), page.evaluate(loops)
    first = min(found, key=lambda tree: tree["last_seen_s"])
    last = max((tree for tree in found if tree is not first), key=lambda tree: tree["first_seen_s"])
    use(person, "tie")
    click(person, first["x"], first["y"])
    expect(page.locator("#repair-hint")).to_contain_text("seen again")
    click(person, last["x"], last["y"])
    person.eventually(
        lambda: page.evaluate(loops) == known + 1, lambda: page.locator("#repairs").inner_text()
    )
    expect(page.locator("#repairs li")).to_contain_text(
        f"same place: trees {first['number']} and {last['number']}"
    )
    assert page.evaluate(end) != before
    page.locator("#map").press("Control+z")
    person.eventually(lambda: page.evaluate(end) == before, lambda: page.evaluate(end))
    use(person, "forbid")
    expect(page.locator("#repair-hint")).to_contain_text("no loop" if not known else "wrong loop")
    page.locator("#map").press("Escape")
    expect(page.locator("#repair-forbid")).to_have_attribute("aria-pressed", "false")


def test_a_repair_that_does_not_apply_says_so(person: Dashboard):
    send = (
        """([kind, places]) => import('/static/js/repair/repairs.js').then(it => it.add({ kind, places }))"""
    )
    person.page.evaluate(send, ["delete", [[500.0, 0.0]]])
    expect(person.page.locator("#repair-count")).to_have_text("1 repair, 1 not applied")
    expect(person.page.locator("#repairs li")).to_contain_text(
        "delete a tree at 500.0, 0.0Not applied: no tree is within 0.5 m of 500.00, 0.00"
    )


def test_undo_of_a_tab_takes_back_nothing_of_another_tab(person: Dashboard):
    page, tree = person.page, apart(trees(person))[0]
    person.tab("Annotate")
    click(person, tree["x"], tree["y"])
    person.answer("y")
    person.until_server("/api/annotations", "it.trees.length === 1")
    person.tab("Repair")
    expect(page.locator("#repair-undo")).to_be_disabled()
    page.locator("#map").press("Control+z")
    expect(page.locator("#repair-error")).to_contain_text("nothing to undo")
    assert len(person.ask("/api/annotations")["trees"]) == 1

    person.tab("Repair")
    click(person, tree["x"], tree["y"])
    page.locator("#repair-delete").click()
    person.until_server("/api/annotations", "it.others.repair?.length === 1")
    person.tab("Annotate")
    page.locator("#annotate-undo").click()
    person.until_server("/api/annotations", "it.trees.length === 0")
    expect(page.locator("#problem")).to_contain_text("Undone: tree added.")
    expect(page.locator("#annotate-undo")).to_be_disabled()
    person.tab("Repair")
    page.locator("#repair-undo").click()
    expect(page.locator("#repairs li")).to_have_count(0)
    assert [error for error in person.errors if "409" not in error] == []


def test_a_moved_tree_stays_confirmed(person: Dashboard):
    page, tree = person.page, apart(trees(person))[0]
    person.tab("Annotate")
    click(person, tree["x"], tree["y"])
    person.answer("y")
    expect(page.locator("#annotate-confirmed")).to_have_text("1 confirmed")
    person.tab("Repair")
    use(person, "move")
    click(person, tree["x"], tree["y"])
    click(person, tree["x"] + 2.0, tree["y"])
    person.until_server("/api/annotations", f"it.trees[0].x > {tree['x'] + 1.5}")
    person.until_server(
        "/api/trees",
        f"it.trees.some(tree => tree.number === {tree['number']} && tree.x > {tree['x'] + 1.5})",
    )
    person.tab("Annotate")
    expect(page.locator("#annotate-confirmed")).to_have_text("1 confirmed")
    person.tab("Repair")
    page.locator("#repairs li button").first.click()
    person.until_server("/api/annotations", f"Math.abs(it.trees[0].x - {tree['x']}) < 0.01")


def test_a_merge_of_trees_with_contradicting_diameters_says_so(person: Dashboard):
    page = person.page
    known = [tree for tree in apart(trees(person)) if tree["dbh_cm"] is not None]
    a, b = min(known, key=lambda tree: tree["dbh_cm"]), max(known, key=lambda tree: tree["dbh_cm"])
    use(person, "merge")
    click(person, a["x"], a["y"])
    click(person, b["x"], b["y"])
    expect(page.locator("#problem")).to_contain_text("have diameters that contradict each other (")
    half = abs(a["dbh_cm"] - b["dbh_cm"]) / 2
    person.until_server(
        "/api/trees",
        f"it.trees.some(tree => tree.number === {a['number']} && tree.sigma_dbh_cm > {0.8 * half})",
    )
    assert max(tree["observations"] for tree in trees(person)) <= person.ask("/api/status")["scan_index"] + 1


# The letters that are drawn for things with a class, and the legend for some marks.
SYMBOLS = """async () => {
  const [{ classedThings, drawTruth }, { state, changed }] = await Promise.all([
    import('/static/js/map/draw.js'), import('/static/js/core/store.js'),
  ]);
  const letters = [];
  const get = (_, name) => (name === 'fillText' ? (text) => letters.push(text) : () => {});
  const pen = new Proxy({}, { get, set: () => true });
  const repair = [
    { kind: 'class', places: [[1, 2]], value: 'pole' }, { kind: 'class', places: [[3, 4]], value: 'bush' },
    { kind: 'class', places: [[3, 4]], value: 'tree' }, { kind: 'delete', places: [[5, 6]] },
  ];
  const things = classedThings({ annotations: { others: { repair } } });
  for (const thing of [...things, { x: 0, y: 0, kind: 'person' }]) {
    drawTruth(pen, { scale: 10, toScreen: (x, y) => [x, y] }, thing);
  }
  state.truth = [{ x: 7, y: 8, dbh_cm: null, kind: 'tree', annotated: true, taped: false }];
  state.annotations = { ...state.annotations, trees: [{ id: 1, x: 7, y: 8, kind: 'tree', dbh_cm: null }],
    others: { repair }, used: 'annotations' };
  changed('truth');
  return letters;
}"""


def test_each_class_has_a_symbol_and_annotations_are_not_called_true(person: Dashboard):
    page = person.page
    expect(page.locator("#legend-truth")).to_have_text("true tree")
    assert page.evaluate(SYMBOLS) == ["P", "H"]
    expect(page.locator("#legend-truth")).to_have_text("annotated tree")
    expect(page.locator("#legend-other")).to_have_text("P pole")
