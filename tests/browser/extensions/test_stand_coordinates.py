"""Coordinates on the tab Plots: control points are picked and typed, have residuals, and place the files."""

from __future__ import annotations

import math
import re
from pathlib import Path

import geopandas
import pytest
from playwright.sync_api import Route, expect

from tests.browser.dashboard import Dashboard
from tests.browser.extensions.test_stand_plots import shown_plots
from tests.browser.test_annotate import place_of

EAST, NORTH = 500000.0, 5300000.0


@pytest.fixture
def person(mapped: Dashboard) -> Dashboard:
    return shown_plots(mapped)


def far_from_trees(person: Dashboard) -> tuple[float, float]:
    """A place within the stand that is far from each tree."""
    trees = [(tree["x"], tree["y"]) for tree in person.ask("/api/trees")["trees"]]
    places = [((a[0] + b[0]) / 2, (a[1] + b[1]) / 2) for a in trees for b in trees]
    return max(places, key=lambda place: min(math.dist(place, tree) for tree in trees))


def test_each_wrong_row_of_a_file_is_marked_until_it_is_changed(person: Dashboard, tmp_path: Path) -> None:
    page, problem = person.page, person.page.locator("#plots-error")
    page.locator("#coordinates-now").click()
    page.locator("#coordinates-crs").fill("EPSG:25832")
    trees = person.ask("/api/trees")["trees"][:5]
    lines = [f"{t['number']},{EAST + t['x']:.3f},{NORTH + t['y']:.3f},high" for t in trees]
    lines[0] = lines[0].replace("high", "9.5")
    file = tmp_path / "points.csv"
    file.write_text("\n".join(["tree,easting,northing,elevation_m", *lines]))
    page.get_by_label("File of control points").set_input_files(file)
    expect(problem).to_have_text(re.compile(r"and 1 more row\. Correct or delete them"))
    rows = page.locator("#control-points tbody tr")
    wrong = page.locator("#control-points [aria-invalid=true]")
    expect(rows.nth(0).locator("[name=z]")).to_have_attribute("aria-invalid", "false")
    fault = re.compile("line 6: elevation_m = 'high' is not a number")
    expect(rows.nth(4).locator("[name=z]")).to_have_attribute("aria-invalid", "true")
    expect(rows.nth(4).locator("[name=z]")).to_have_attribute("title", fault)
    for row in (1, 2, 3):
        rows.nth(row).locator("[name=z]").fill("9.5")
    expect(rows.nth(3).locator("[name=z]")).to_have_attribute("title", re.compile("^Height"))
    page.locator("#coordinates-apply").click()
    expect(problem).to_have_text(fault)
    assert person.ask("/api/annotations")["frame"] is None
    rows.nth(4).locator("[name=z]").fill("9.5")
    expect(wrong).to_have_count(0)
    for row in range(5):
        rows.nth(row).locator("[name=z]").fill("")  # not every tree has terrain yet
    page.locator("#coordinates-apply").click()
    expect(page.locator("#coordinates-now")).to_have_text("Coordinates: EPSG:25832")


def test_a_file_that_is_read_while_another_run_is_opened_is_not_applied(
    person: Dashboard, tmp_path: Path
) -> None:
    page, sent = person.page, list[Route]()
    page.locator("#coordinates-now").click()
    page.locator("#coordinates-crs").fill("EPSG:25832")
    trees = person.ask("/api/trees")["trees"][:2]
    lines = [f"{t['number']},{EAST + t['x']:.3f},{NORTH + t['y']:.3f}" for t in trees]
    file = tmp_path / "points.csv"
    file.write_text("\n".join(["tree,easting,northing", *lines]))
    page.route("**/api/georeference/points", lambda route: sent.append(route))
    page.get_by_label("File of control points").set_input_files(file)
    person.eventually(lambda: bool(sent), lambda: sent)
    person.open("sim:stand?seed=3&duration=2")
    expect(page.locator("#coordinates-crs")).to_have_value("")  # the page shows the other run
    unknown = dict.fromkeys(("x", "y", "z"))
    points = [
        {"name": "", "tree": t["number"], "east": EAST + t["x"], "north": NORTH + t["y"], **unknown}
        for t in trees
    ]
    sent[0].fulfill(json={"points": points, "faults": []})
    expect(page.locator("#plots-error")).to_have_text(re.compile("^Another run was opened meanwhile"))
    expect(page.locator("#control-points tbody tr")).to_have_count(0)


def test_control_points_are_picked_fitted_and_undone(person: Dashboard, tmp_path: Path) -> None:
    page, canvas = person.page, person.page.locator("#map")
    now, problem = page.locator("#coordinates-now"), page.locator("#plots-error")
    now.click()
    rows = page.locator("#control-points tbody tr")
    trees = person.ask("/api/trees")["trees"][:2]
    page.locator("#coordinates-pick").click()
    for tree in trees:
        canvas.click(position=place_of(person, tree["x"], tree["y"]))
    page.keyboard.press("Escape")
    expect(page.locator("#coordinates-pick")).to_have_attribute("aria-pressed", "false")
    expect(rows).to_have_count(2)

    page.locator("#coordinates-apply").click()
    expect(problem).to_have_text(re.compile("reference system"))
    page.locator("#coordinates-crs").fill("EPSG:25832")
    page.locator("#coordinates-apply").click()
    expect(problem).to_have_text(
        f"East or north is missing: tree {trees[0]['number']}, tree {trees[1]['number']}."
    )
    for row, tree in enumerate(trees):
        rows.nth(row).locator("[name=east]").fill(f"{EAST + tree['x']:.3f}")
        expect(problem).to_be_hidden()  # it was about the empty fields
        rows.nth(row).locator("[name=north]").fill(f"{NORTH + tree['y']:.3f}")
    page.locator("#coordinates-apply").click()
    expect(now).to_have_text("Coordinates: EPSG:25832")
    expect(problem).to_be_hidden()
    expect(page.locator("#coordinates-result")).to_have_text(re.compile("UTM zone 32N: 9.00° E, 47.85° N"))
    expect(rows.first.locator(".residual")).to_have_text(re.compile(r"^-?0\.\d, -?0\.\d$"))
    file = page.request.get(f"{person.page.url.split('?')[0]}api/export/gpkg").body()
    (tmp_path / "out.gpkg").write_bytes(file)
    layer = geopandas.read_file(tmp_path / "out.gpkg", layer="trees")
    assert layer.crs == "EPSG:25832"
    assert layer.geometry[0].x == pytest.approx(EAST + layer["map_x_m"][0], abs=0.05)

    # A change of any field is shown as not applied, and a typed place stays when the table is filled again.
    page.locator("#coordinates-sigma").fill("0.2")
    expect(page.locator("#coordinates-result")).to_have_text(re.compile("not applied yet"))
    page.locator("#coordinates-pick").click()
    canvas.click(position=place_of(person, *far_from_trees(person)))
    canvas.press("Escape")
    rows.nth(2).locator("[name=x]").fill("12.5")
    page.locator("#coordinates-sigma").fill("0.125")
    expect(rows.nth(2).locator("[name=x]")).to_have_value("12.500")
    rows.nth(2).get_by_label("Delete point 3").click()

    # A wrong point is refused by name; nothing changes.
    rows.first.locator("[name=east]").fill(f"{EAST + 300.0:.3f}")
    page.locator("#coordinates-apply").click()
    expect(problem).to_have_text(re.compile("control points"))
    expect(now).to_have_text("Coordinates: EPSG:25832")
    expect(page.locator("#coordinates-result")).to_have_text(re.compile("earlier fit is still in force"))
    expect(rows.first.locator(".residual")).to_have_text(re.compile(r"^-?\d{4,5}\.\d, "))
    rows.first.get_by_label("Delete point 1").click()
    expect(rows).to_have_count(1)

    page.locator("#coordinates-how").select_option("gnss")
    page.locator("#coordinates-apply").click()
    expect(problem).to_have_text(re.compile("no GNSS fixes"))
    page.locator("#coordinates-how").select_option("file")  # the map is local
    page.locator("#coordinates-apply").click()
    expect(problem).to_have_text(re.compile("do not fit"))
    page.locator("#coordinates-how").select_option("hand")
    page.locator("#coordinates-east").fill("500100")
    page.locator("#coordinates-apply").click()
    expect(page.locator("#coordinates-result")).to_have_text(re.compile("By hand"))
    assert person.ask("/api/annotations")["frame"]["frame"]["east_m"] == 500100.0
    page.locator("#plot-undo").click()
    expect(page.locator("#coordinates-how")).to_have_value("control")
    expect(rows).to_have_count(2)
    page.locator("#coordinates-remove").click()
    expect(now).to_have_text("Coordinates: local")
    page.locator("#plot-undo").click()
    expect(now).to_have_text("Coordinates: EPSG:25832")
    page.locator("#plot-undo").click()
    expect(now).to_have_text("Coordinates: local")
