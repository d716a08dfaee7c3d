"""The command palette (Ctrl+K) finds every action, and the list of shortcuts names every key."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

FOUND = {
    "tree_share": "Tree threshold",
    "score against": "Score against",
    "topics": "Topics and mounting",
    "chart time": "Chart: Time per stage",
    "label dbh": "Label the scene with DBH",
    "upload rec": "Upload a recording",
    "fewer points in a cluster": "Minimum points",
}


def test_arrow_keys_select_and_the_list_is_accessible(dashboard: Dashboard):
    page = dashboard.page
    page.locator("#palette-button").click()
    find = page.locator("#palette-find")
    for place in (1, 2):
        find.press("ArrowDown")
        expect(find).to_have_attribute("aria-activedescendant", f"palette-{place}")
        expect(page.locator(f"#palette-{place}")).to_have_attribute("aria-selected", "true")
    find.press("Escape")
    expect(page.locator("#palette")).to_be_hidden()
    expect(page.locator("#palette-button")).to_be_focused()


def test_the_list_of_shortcuts_names_every_key(dashboard: Dashboard):
    page = dashboard.page
    page.locator("#map").press("?")
    told = page.locator("#keys-list kbd").all_inner_texts()
    acting = page.evaluate(
        "() => import('/static/js/shell/actions.js')"
        ".then(all => all.ACTIONS.map(row => row[2]).filter(Boolean))"
    )
    shown = {" ": "space", "Escape": "esc"}
    assert {shown.get(key, key) for key in acting} <= set(told)
    assert {"ctrl+k", "1", "0", "y", "n", "r", "P", "ctrl+z", "←", "→", "f", "t", "b"} <= set(told)
    page.keyboard.press("Escape")


def test_every_control_has_a_name_and_every_parameter_its_description(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Tune")
    assert page.evaluate(NAMELESS) == []
    docs = page.evaluate("() => [...document.querySelectorAll('.tune-row label')].map(label => label.title)")
    specs = dashboard.ask("/api/parameters")["specs"]
    # The main parameters come first.
    assert sorted(docs) == sorted(f"{spec['doc']} ({spec['name']})" for spec in specs)
    assert dashboard.errors == []


NAMELESS = """() => [...document.querySelectorAll('button, input, select, a[href], canvas, dialog')]
  .filter(node => !(node.getAttribute('aria-label') || node.labels?.length || node.title
    || node.textContent.trim() || node.getAttribute('aria-labelledby')))
  .map(node => node.outerHTML.slice(0, 120))"""


def test_actions_are_found_and_executed(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand()  # where there are trees
    dashboard.tab("Trees")
    dashboard.until("() => document.querySelectorAll('#trees tbody tr').length > 0")
    page.locator("#map").press("Control+k")
    find = page.get_by_role("combobox", name="Search all actions")
    expect(find).to_be_focused()
    find.fill("preset paper")
    options = page.locator("#palette-list [role=option]")
    expect(options.first).to_contain_text("Use the preset paper")
    find.press("Enter")
    dashboard.until_server("/api/parameters", "it.preset === 'paper'")
    expect(page.locator("#palette")).to_be_hidden()

    page.locator("#map").press("Control+k")
    find.fill("eps")
    expect(options.first).to_contain_text("Radius eps (0.25 m)")
    find.press("Enter")
    expect(page.locator("[id='tune-clustering.eps']")).to_be_focused()

    page.keyboard.press("Control+k")  # also while somebody types
    find.fill("layer raw")
    find.press("Enter")
    expect(page.locator("[data-layer=raw]")).not_to_be_checked()
    page.keyboard.press("Control+k")
    find.fill("layer raw")
    expect(options.first).to_contain_text("show")
    options.first.click()
    page.keyboard.press("Control+k")
    for words, first in FOUND.items():  # what stands in the panels, and parameters by their names
        find.fill(words)
        expect(options.first).to_contain_text(first)
    find.fill("no such thing")
    expect(page.locator("#palette-none")).to_be_visible()
    find.fill("preset forest")
    find.press("Enter")
    dashboard.until_server("/api/parameters", "it.preset === 'forest'")
    dashboard.tab("Trees")
    dashboard.until("() => document.querySelectorAll('#trees tbody tr').length > 20")  # more than by `paper`
    number = page.locator("#trees tbody tr").first.get_attribute("data-tree")
    page.keyboard.press("Control+k")
    find.fill(f"tree {number}")
    page.locator("#palette-list [role=option]", has_text=re.compile(f"^Tree {number}$")).click()
    expect(page.locator("#panel-story")).to_have_attribute("data-story", f"tree {number}")
    page.locator("#map").press("Escape")
    assert dashboard.errors == []


@pytest.mark.parametrize(
    ("word", "found"),
    [
        ("annotate", "Tab Annotate"),
        ("help", "Settings and keyboard shortcuts"),
        ("zoom", "Zoom in on the map"),
        ("delete", "Annotate: delete the chosen annotation"),
        ("screenshot", "Save the map as a picture (PNG)"),
        ("qgis", "Export the map: GeoPackage"),
        ("resolution", "Voxel size"),
    ],
)
def test_actions_and_settings_are_found_by_other_words(dashboard: Dashboard, word: str, found: str):
    page = dashboard.page
    page.locator("#palette-button").click()
    page.locator("#palette-find").fill(word)
    expect(page.locator("#palette-list [role=option]", has_text=found).first).to_be_visible()
    if found.startswith("Tab "):
        expect(page.locator("#palette-list [role=option]").first).to_have_text(found)
    page.keyboard.press("Escape")
