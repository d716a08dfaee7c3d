"""The tab Plots: a plot is drawn on the map, has its figures, and is undone; viewers see it."""

from __future__ import annotations

import json
import re

import pytest
from playwright.sync_api import Browser, Route, expect

from tests.browser.conftest import opened_by_another
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server
from tests.browser.test_accessibility import in_both_themes
from tests.browser.test_annotate import place_of


@pytest.fixture
def person(mapped: Dashboard) -> Dashboard:
    return shown_plots(mapped)


def shown_plots(dashboard: Dashboard) -> Dashboard:
    """The dashboard with the tab Plots and the whole map."""
    dashboard.tab("Plots")
    dashboard.page.get_by_role("button", name="Fit").click()
    dashboard.drawn()
    return dashboard


def test_a_plot_is_drawn_has_figures_and_is_undone(person: Dashboard) -> None:
    page = person.page
    canvas, rows = page.locator("#map"), page.locator("#plots-table tr[data-plot]")
    expect(page.locator("#plots-table .sum")).to_contain_text("all observed")
    assert person.ask("/api/plots")["all"]["plots"]["all"]["trees"] > 5

    # A circle by dragging, a rectangle by two clicks, a polygon by its corners.
    x, y = 4.0, 2.0
    page.get_by_role("button", name="Circle").click()
    start, end = place_of(person, x, y), place_of(person, x + 5.0, y)
    box = canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + start["x"], box["y"] + start["y"])
    page.mouse.down()
    page.mouse.move(box["x"] + end["x"], box["y"] + end["y"], steps=4)
    page.mouse.up()
    expect(rows).to_have_count(1)
    expect(page.locator("#plot-circle")).to_have_attribute("aria-pressed", "false")
    (plot,) = person.ask("/api/annotations")["others"]["plot"]
    assert plot["shape"]["radius"] == pytest.approx(5.0, abs=0.15)
    expect(rows.locator("td").nth(3)).to_contain_text(re.compile(r"\d+ ± "))

    page.get_by_role("button", name="Rectangle").click()
    canvas.click(position=place_of(person, x - 2.0, y - 2.0))
    canvas.click(position=place_of(person, x + 2.0, y + 2.0))
    expect(rows).to_have_count(2)
    page.get_by_role("button", name="Polygon").click()
    for corner in ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0)):
        canvas.click(position=place_of(person, *corner))
    canvas.press("Enter")
    expect(rows).to_have_count(3)
    assert [each["shape"]["kind"] for each in person.ask("/api/annotations")["others"]["plot"]] == [
        "circle",
        "rectangle",
        "polygon",
    ]
    expect(page.locator("#plots-table .sum")).to_have_count(2)
    heads = page.locator("#plots-table thead th").all_inner_texts()
    assert heads[-3:] == ["Dq cm", "mean DBH cm", "dominant DBH cm"]
    expect(page.locator("#plots-table .sum td").nth(heads.index("dominant DBH cm") - 1)).to_contain_text(
        re.compile(r"\d")
    )
    expect(page.locator("#plots-detection")).to_have_text(
        re.compile("Use the figures above|Detection does not decrease|Detection is not estimated")
    )
    review = page.locator("#plots-review")
    expect(review).to_have_text(re.compile(r"Review: 0 of \d+ found trees reviewed\.$"))

    # Typed values; a name is changed; all is undone and repeated.
    page.get_by_text("Type a plot").click()
    form = page.locator(".plot-form").first
    form.locator("[name=radius]").fill("0")
    form.get_by_role("button", name="Add").click()
    assert "0.01" in form.locator("[name=radius]").evaluate("node => node.validationMessage")
    form.locator("[name=radius]").fill("5.64")
    form.locator("[name=x]").fill("6")
    form.locator("[name=y]").fill("1")
    form.locator("[name=name]").fill("north")
    form.get_by_role("button", name="Add").click()
    expect(rows).to_have_count(4)
    name = page.get_by_label("Name of plot north")
    name.evaluate("node => { node.select(); window.selected = node; }")
    page.get_by_label("count trees from").dispatch_event("change")  # the table is filled again
    assert page.evaluate("document.activeElement === window.selected")
    assert name.evaluate("node => node.selectionEnd - node.selectionStart") == len("north")
    name.fill("south")
    name.press("Enter")
    person.until_server("/api/annotations", "it.others.plot[3].name === 'south'")
    page.get_by_label("Delete plot south").click()
    expect(rows).to_have_count(3)
    canvas.press("Control+z")
    expect(rows).to_have_count(4)
    expect(page.locator("#problem")).to_contain_text("Undone: 1 plot deleted.")
    for _ in range(5):
        page.locator("#plot-undo").click()
    expect(rows).to_have_count(0)
    page.locator("#plot-redo").click()
    expect(rows).to_have_count(1)
    page.locator("#plot-undo").click()
    expect(rows).to_have_count(0)


# The names that are drawn beside added trees.
NAMES_DRAWN = """async () => {
  const { drawPlots } = await import('/static/js/extensions/stand/draw.js');
  const names = [];
  const get = (_, name) => (name === 'fillText' ? (text) => names.push(text) : () => {});
  drawPlots(new Proxy({}, { get, set: () => true }), { scale: 10, toScreen: (x, y) => [x, y] });
  return names;
}"""


def test_what_people_measured_is_stated_below_the_figures(person: Dashboard) -> None:
    tree = person.ask("/api/trees")["trees"][0]
    signed = {"run": person.ask("/api/annotations")["run"], "browser": "a" * 16, "who": "Ann"}
    send = (
        "([path, body]) => fetch(path, { method: 'POST', body: JSON.stringify(body),"
        " headers: { 'Content-Type': 'application/json' } })"
    )
    place = {"x": tree["x"], "y": tree["y"]}
    person.page.evaluate(send, ["/api/annotations", {**signed, **place, "kind": "tree", "dbh_cm": 44.4}])
    review = person.page.locator("#plots-review")
    expect(review).to_have_text(
        re.compile(r"Review: 1 of .*\(1 confirmed\)\. By people: 1 diameter by tape\.$")
    )
    legend = person.page.locator("#legend-added")
    expect(legend).to_be_hidden()
    far = {"x": 500.0, "y": 1.5, "kind": "tree"}
    person.page.evaluate(send, ["/api/annotations", {**signed, **far}])
    expect(legend).to_have_text("added tree")
    assert person.page.evaluate(NAMES_DRAWN) == ["A1"]
    unseen = "Added by people outside the observed area: 500.000, 1.500 m."
    expect(person.page.locator("#plots-hint")).to_contain_text(unseen)
    for _ in range(2):
        person.page.evaluate(send, ["/api/annotations/undo", {**signed, "subjects": ["tree"]}])
    expect(review).to_have_text(re.compile(r"Review: 0 of \d+ found trees reviewed\.$"))


# The text about corrected figures of the whole area, of two plots of which one was observed, and of two.
CORRECTIONS = """async () => {
  const { correctionText } = await import('/static/js/extensions/stand/panel.js');
  const figures = { detection_sigma_m: 8, mean: { n_ha_corrected: [521, 79], g_ha_corrected: [30.1, 4.2] } };
  const [seen, hidden] = [{ seen_m2: 100 }, { seen_m2: 0 }];
  return [
    correctionText({ ...figures, plots: { all: seen } }, true),
    correctionText({ ...figures, plots: { north: seen, south: hidden } }, false),
    correctionText({ ...figures, plots: { a: seen, b: seen } }, false),
  ];
}"""


def test_corrected_figures_say_of_which_area_they_are(person: Dashboard) -> None:
    said = [
        re.findall("the corrected ones, (.*?) stems/ha", text) for text in person.page.evaluate(CORRECTIONS)
    ]
    places = ("the whole observed area", "plot north", "the mean of 2 plots")
    assert said == [[f"of {place}: 521 ± 79"] for place in places]


def test_the_heading_of_the_report_is_typed_once(person: Dashboard) -> None:
    page = person.page
    fields = page.locator("#report-heading input")
    assert len(set(fields.evaluate_all("all => all.map(({ offsetWidth }) => offsetWidth)"))) == 1
    fields.nth(0).fill("Hohe Warte <3b>")
    fields.nth(0).press("Tab")
    fields.nth(2).fill("Ann")
    fields.nth(2).press("Enter")
    person.until_server("/api/annotations", "it.others.heading?.[0].author === 'Ann'")
    with page.expect_download() as download:
        page.locator("#plots-report").select_option("en.html")
    text = download.value.path().read_text(encoding="utf-8")
    assert "Hohe Warte &lt;3b&gt;" in text
    page.locator("#plot-undo").click()
    expect(fields.nth(2)).to_have_value("")
    page.locator("#plot-undo").click()
    expect(fields.nth(0)).to_have_value("")


def test_names_of_the_heading_stay_while_others_are_stored_and_after_a_refusal(person: Dashboard) -> None:
    page = person.page
    fields = page.locator("#report-heading input")
    sent: list[Route] = []
    page.route("**/api/heading", lambda route: sent.append(route))
    for row, name in enumerate(("Hohe Warte", "the town")):
        fields.nth(row).fill(name)
        fields.nth(row).press("Tab")
    person.eventually(lambda: len(sent) == 1, lambda: sent)
    sent[0].continue_()
    person.eventually(lambda: len(sent) == 2, lambda: sent)  # the first edit has come back
    names = [json.loads(route.request.post_data or "")["names"] for route in sent]
    assert names == [{"stand": "Hohe Warte"}, {"client": "the town"}]
    expect(fields.nth(1)).to_have_value("the town")
    refusal = {"error": {"what": "the names are refused", "where": "", "remedy": ""}}
    sent[1].fulfill(status=422, json=refusal)
    expect(page.locator("#plots-error")).to_have_text("The names are refused.")
    expect(fields.nth(1)).to_have_attribute("aria-invalid", "true")
    expect(fields.nth(1)).to_have_value("the town")
    page.unroute("**/api/heading")
    fields.nth(2).fill("Ann")
    fields.nth(2).press("Tab")
    person.until_server("/api/annotations", "it.others.heading?.[0].author === 'Ann'")
    expect(fields.nth(1)).to_have_value("the town")
    fields.nth(1).fill("the city")
    fields.nth(1).press("Tab")
    person.until_server("/api/annotations", "it.others.heading?.[0].client === 'the city'")
    expect(fields.nth(1)).to_have_attribute("aria-invalid", "false")
    assert person.ask("/api/annotations")["others"]["heading"][0]["stand"] == "Hohe Warte"
    for _ in range(3):
        page.locator("#plot-undo").click()
    person.until_server("/api/annotations", "!it.others.heading?.length")
    expect(fields.nth(1)).to_have_value("")
    person.errors.clear()  # the browser logs an answer that refuses


def test_another_run_begins_with_empty_fields(person: Dashboard) -> None:
    page = person.page
    page.get_by_text("Type a plot").click()
    form = page.locator(".plot-form").first
    form.locator("[name=kind]").select_option("rectangle")
    form.locator("[name=x]").fill("6")
    form.locator("[name=name]").fill("north")
    page.locator("#plot-crs").fill("EPSG:25832")
    page.locator("#report-heading input").first.fill("typed for the run before")
    person.open("sim:stand?seed=3&duration=2")
    expect(form.locator("[name=x]")).to_have_value("0")
    expect(form.locator("[name=name]")).to_have_value("")
    expect(form.locator("[name=radius]")).to_have_value("5.64")
    expect(page.locator("#plot-crs")).to_have_value("")
    expect(page.locator("#report-heading input").first).to_have_value("")


def test_viewers_see_plots_and_cannot_change_them(
    chromium: Browser, server: Server, person: Dashboard
) -> None:
    page = person.page
    page.get_by_text("Type a plot").click()
    page.get_by_role("button", name="Add circles").click()
    rows = page.locator("#plots-table tr[data-plot]")
    expect(rows.first).to_be_visible()
    number = rows.count()
    link = person.ask("/api/access")["viewer_link"]
    with opened_by_another(chromium, f"http://127.0.0.1:{server.port}{link}") as viewer:
        viewer.tab("Plots")
        shown = viewer.page.locator("#plots-table tr[data-plot]")
        expect(shown).to_have_count(number)
        expect(viewer.page.locator("#plots-table input")).to_have_count(0)
        expect(viewer.page.get_by_label(re.compile("Delete plot"))).to_be_hidden()
        assert viewer.page.locator("#plots-edit").evaluate("node => node.inert")
    page.locator("#plot-undo").click()
    expect(rows).to_have_count(0)


def test_a_plot_in_the_list_has_no_violation_and_no_text_that_cannot_be_read(person: Dashboard) -> None:
    page = person.page
    page.emulate_media(reduced_motion="reduce")  # colours change at once
    page.get_by_text("Type a plot").click()
    page.locator(".plot-form").first.get_by_role("button", name="Add").click()
    expect(page.locator("#plots-table tr[data-plot]")).to_have_count(1)
    assert in_both_themes(page, "#panel-plots") == []
