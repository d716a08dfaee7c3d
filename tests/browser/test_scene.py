"""The 3D scene: its sliders, layers, keys and clicks, and the page that follows them. It is loaded once."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from math import hypot
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

pytestmark = pytest.mark.usefixtures("calm")

SCRIPTS = Path(__file__).resolve().parents[2] / "static" / "js"
MARKERS = "/world/robot/scan/markers"


def test_the_scene_shows_the_run_without_errors(dashboard: Dashboard):
    page = dashboard.page
    expect(page.locator("#source-name")).to_have_text("sim:stand")
    dashboard.tab("Trees")
    expect(page.locator("#trees tbody tr").first).to_be_visible()
    dashboard.scene.wait_for_function(
        """() => { let points = 0;
        window.__viserMutable?.scene?.traverse(o => {
          if (o.isPoints) points += o.geometry.attributes.position.count;
        });
        return points > 1000; }"""
    )
    assert dashboard.node_points("/world/robot/scan/raw") > 1000
    assert dashboard.errors == []


def test_the_eps_slider_changes_the_clusters_of_the_current_scan(dashboard: Dashboard):
    before = dashboard.clusters()
    assert before > 3
    box = dashboard.row("Radius eps").locator("input[type=text]")
    box.fill("0.05")  # the stems fall apart
    box.press("Tab")
    dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 0.05")
    dashboard.until(
        "was => Number(document.querySelector('[data-clusters]').dataset.clusters) !== was", before
    )
    expect(dashboard.scene.get_by_text("● Radius eps")).to_be_visible()
    expect(dashboard.page.locator("#preset")).to_have_text("● forest, 1 changed")
    dashboard.scene.get_by_role("button", name="Reset all").click()
    dashboard.until_server("/api/parameters", "it.changed.length === 0")
    dashboard.until(
        "was => Number(document.querySelector('[data-clusters]').dataset.clusters) === was", before
    )
    expect(box).to_have_value("0.15")
    eps = dashboard.page.locator("[id='tune-clustering.eps']")
    dashboard.tab("Tune")
    eps.fill("0.3")
    eps.press("Enter")
    dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 0.3")
    dashboard.tab("Trees")  # the panel of the scene is closed beside the tab Tune
    expect(box).to_have_value("0.3")  # both are in step
    box.fill("0.4")
    box.press("Tab")
    dashboard.tab("Tune")
    expect(eps).to_have_value("0.4")
    dashboard.tab("Trees")


# Of each slider of the scene: its label, and its thumb and the ends of its track in pixels of the page.
SLIDERS = """() => [...document.querySelectorAll('.mantine-Slider-root')].map(root => {
  const middle = (node) => {
    const box = node.getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
  };
  return [root.querySelector('[role=slider]').getAttribute('aria-label'),
    ...middle(root.querySelector('[role=slider]'))];
})"""


def test_a_press_on_a_slider_changes_nothing_and_a_drag_is_one_step(dashboard: Dashboard):
    page, scene = dashboard.page, dashboard.scene
    dashboard.until_scene_is_named()
    before = dashboard.ask("/api/parameters")
    main = sorted((spec for spec in before["specs"] if spec["main"]), key=lambda s: s["stage"] == "Filters")
    of_kind = {(spec["kind"], spec["log"]): (k, spec) for k, spec in reversed(list(enumerate(main)))}
    assert (
        len(of_kind) >= 3
    )  # whole numbers, and linear and logarithmic scales; all sliders of a kind are alike
    frame = page.locator("#scene").bounding_box()
    assert frame is not None
    steps = before["undo"]
    for turn, (k, spec) in enumerate(of_kind.values()):
        scene.locator(".mantine-Slider-root").nth(k).scroll_into_view_if_needed()
        label, x, y = scene.evaluate(SLIDERS)[k]
        assert label.startswith(spec["title"])
        # Off the centre of the thumb, where the pointer of a person lands.
        page.mouse.move(frame["x"] + x + 3, frame["y"] + y)
        page.mouse.down()
        page.mouse.up()
        pressed = dashboard.ask("/api/parameters")
        assert (pressed["values"], pressed["undo"]) == (before["values"], steps), spec["name"]
        value = before["values"][spec["name"]]
        towards = 1 if value < sum(spec["shown"]) / 2 else -1
        page.mouse.down()
        for travelled in range(1, 13):
            page.mouse.move(frame["x"] + x + 3 + towards * travelled, frame["y"] + y)
            if travelled == 6 and turn == 0:
                page.wait_for_timeout(2000)  # a person looks at the scene
        page.mouse.up()
        dashboard.until_server("/api/parameters", f"it.values['{spec['name']}'] !== {value}")
        page.wait_for_timeout(100)
        dragged = dashboard.ask("/api/parameters")
        steps += 1
        assert dragged["undo"] == steps, spec["name"]
        moved = abs(dragged["values"][spec["name"]] - value)
        whole = spec["shown"][1] - spec["shown"][0]
        largest = abs(value) * (1.01**13 - 1) if spec["log"] else 13 / 400 * whole  # 1 % per pixel
        assert moved <= largest + (1 if spec["kind"] == "int" else 0), spec["name"]
        before = dragged


@pytest.fixture
def wide(dashboard: Dashboard) -> Iterator[Dashboard]:
    """A window with room for the panel of the scene."""
    size = dashboard.page.viewport_size
    dashboard.load_scene()
    dashboard.tab("Trees")
    dashboard.page.set_viewport_size({"width": 1640, "height": 1300})
    yield dashboard
    assert size is not None
    dashboard.page.set_viewport_size(size)


def test_the_panel_of_the_scene_is_open_in_a_wide_window_unless_tune_is(wide: Dashboard):
    slider = wide.row("Radius eps").get_by_role("slider")
    expect(slider).to_be_visible()
    wide.tab("Tune")
    expect(slider).not_to_be_visible()
    wide.tab("Trees")
    expect(slider).to_be_visible()
    wide.page.set_viewport_size({"width": 1500, "height": 720})
    expect(slider).not_to_be_visible()
    opened = wide.scene.locator("[data-dock-region] [aria-label^=Expand]")
    opened.click()  # a person opens it, and it stays open
    wide.tab("Clusters")
    expect(slider).to_be_visible()


def test_both_panels_have_the_same_parameters_in_the_same_order_and_undo_works_from_both(
    dashboard: Dashboard,
):
    dashboard.until_scene_is_named()
    labels = [label for label, *_ in dashboard.scene.evaluate(SLIDERS)]
    dashboard.tab("Tune")
    own = dashboard.page.locator("[data-stage='Main parameters'] .tune-row label").all_inner_texts()
    assert len(own) == 12
    plain = [re.sub(r"[^\w ]", "", label).split() for label in labels]
    assert plain == [text.replace("●", "").split() for text in own]
    dashboard.tab("Trees")
    undo = dashboard.page.locator("#undo")
    slider = dashboard.row("Radius eps").get_by_role("slider")
    for back in (undo.click, lambda: slider.press("Control+z")):
        slider.press("ArrowRight")
        dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 0.16")
        expect(undo).to_be_enabled()
        back()
        dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 0.15")


def test_points_have_a_bounded_size_and_the_view_an_angle_of_45_degrees(dashboard: Dashboard):
    dashboard.scene.wait_for_function(
        """() => { const all = [];
        window.__viserMutable.scene.traverse(node => node.isPoints && all.push(node.material.vertexShader));
        return all.length > 0 && all.every(text => text.includes("clamp(scale")); }"""
    )
    assert dashboard.scene.evaluate("() => window.__viserMutable.camera.fov") == pytest.approx(45.0, abs=0.1)


def test_one_file_uses_private_objects_of_the_client_of_viser():
    private = re.compile(r"__viser|nodeRefFromName|cameraControl|uLabelData|setColorAt|vertexShader")
    used = [path.name for path in SCRIPTS.rglob("*.js") if private.search(path.read_text())]
    assert used == ["viser_client.js"]


def test_the_client_of_viser_has_the_private_parts_that_one_file_uses(dashboard: Dashboard):
    dashboard.scene.wait_for_function("() => window.__viserMutable?.nodeRefFromName?.['/world/trees']")
    missing = dashboard.scene.evaluate(
        """() => {
        const client = window.__viserMutable;
        const { props } = window.__viserSceneTree.getState()['/world/trees'].message;
        const parts = ["camera", "cameraControl", "canvas", "nodeRefFromName", "requestRender", "scene"];
        return [...parts.filter(name => !client[name]),
          ...["batched_positions", "batched_colors"].filter(name => !props[name])];
    }"""
    )
    assert missing == []


SELECTION_IS_PAINTED = """() => {
  const canvas = document.querySelector('#map');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  for (let i = 0; i < data.length; i += 4) {
    if (data[i] === 0x56 && data[i + 1] === 0xB4 && data[i + 2] === 0xE9 && data[i + 3] === 255) return true;
  }
  return false;
}"""


# At each picture that the scene draws: positions of the world, of a point, a circle and the robot in it.
PICTURES = """() => {
  const { scene, nodeRefFromName } = window.__viserMutable;
  window.__pictures = [];
  const first = (name) => {
    let found = null;
    nodeRefFromName[name]?.traverse((node) => {
      if (found !== null) return;
      const matrices = node.matricesTexture;
      if (matrices) found = (matrices._data ?? matrices.image.data).slice(12, 15).join();
      else if (node.geometry?.attributes.position) {
        found = node.geometry.attributes.position.array.slice(0, 3).join();
      }
    });
    return found;
  };
  const then = scene.onBeforeRender;
  scene.onBeforeRender = (...args) => {
    then?.apply(scene, args);
    const world = nodeRefFromName["/world"].matrixWorld.elements.slice(12, 15).join();
    const scan = ["scan/raw", "scan/filtered", "scan/markers", "body"];
    window.__pictures.push([world, ...scan.map((name) => first(`/world/robot/${name}`))]);
  };
}"""


def test_everything_in_a_picture_is_of_one_scan(dashboard: Dashboard):
    """Where one part of a picture is of a new scan, all others are."""
    dashboard.command({"type": "seek", "time_s": 3.0})  # the robot moves there
    dashboard.load_scene()
    dashboard.command({"type": "play"})
    dashboard.scene.evaluate(PICTURES)
    dashboard.scene.wait_for_function("() => window.__pictures.length > 40", timeout=150_000)
    pictures = dashboard.scene.evaluate("() => window.__pictures")[5:]
    dashboard.pause()
    news = [
        [now is not None and now != then for now, then in zip(new, old, strict=True)]
        for old, new in pairwise(pictures)
    ]
    assert sum(any(new) for new in news) >= 8, "the run plays"
    apart = [new for new in news if any(new) and not all(new)]
    assert apart == []


def test_a_tree_is_found_and_selected_everywhere(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    number = page.locator("#trees tbody tr").nth(2).get_attribute("data-tree")
    assert number is not None
    page.locator("body").press("/")
    page.locator("#find").fill(number)
    row = page.locator(f"tr[data-tree='{number}']")
    row.click()
    expect(row).to_have_attribute("aria-selected", "true")
    dashboard.until(SELECTION_IS_PAINTED)
    expect(dashboard.scene.locator("body")).to_be_visible()
    dashboard.scene.wait_for_function(
        "number => Object.values(window.__viserSceneTree.getState())"
        ".some(node => node?.message?.props?.text?.startsWith(`tree ${number}, DBH`))",
        arg=number,
    )
    expect(page.locator("#panel-story")).to_have_attribute("data-story", f"tree {number}")
    dashboard.tab("Trees")
    page.locator("#find").fill("")
    page.locator("#map").press("Escape")
    expect(row).to_have_attribute("aria-selected", "false")


def test_keys_work_on_the_page_and_in_the_scene(dashboard: Dashboard):
    page = dashboard.page
    start = dashboard.ask("/api/status")["scan_index"]
    page.locator("#map").press("ArrowRight")
    dashboard.until_server("/api/status", f"it.scan_index === {start + 1}")
    page.locator("#map").press("Shift+ArrowLeft")
    dashboard.until_server("/api/status", f"it.scan_index === {start - 9}")
    dashboard.scene.locator("canvas").first.press("ArrowRight")
    dashboard.until_server("/api/status", f"it.scan_index === {start - 8}")
    dashboard.scene.locator("canvas").first.press("Control+k")
    expect(page.get_by_role("combobox", name="Search all actions")).to_be_focused()
    page.keyboard.press("Escape")
    page.locator("#map").press("?")
    expect(page.get_by_role("heading", name="Settings and keyboard shortcuts")).to_be_visible()


def test_a_key_of_the_page_switches_following(dashboard: Dashboard):
    scene = dashboard.scene
    follow = dashboard.page.locator("#follow")
    expect(follow).to_have_attribute("aria-pressed", "true")
    dashboard.page.locator("#map").press("f")
    expect(follow).to_have_attribute("aria-pressed", "false")
    scene.locator("canvas").first.press("f")
    expect(follow).to_have_attribute("aria-pressed", "true")


def test_a_layer_is_switched_off(dashboard: Dashboard):
    scene = dashboard.scene
    page = dashboard.page
    page.get_by_role("button", name="Layers").click()
    switch = page.locator("#layer-list").get_by_role("checkbox", name="Raw scan")
    expect(page.locator("#layer-list label", has_text="Raw scan").locator(".count")).to_have_text(
        f"{dashboard.node_points('/world/robot/scan/raw'):,}"
    )
    hidden = "name => window.__viserSceneTree.getState()[name].visibility === false"
    switch.click()
    scene.wait_for_function(hidden, arg="/world/robot/scan/raw")
    switch.click()
    scene.wait_for_function(f"name => !({hidden})(name)", arg="/world/robot/scan/raw")
    page.get_by_role("combobox", name="Labels").select_option("DBH")
    centimetres = "() => Object.values(window.__viserSceneTree.getState())"
    centimetres += ".some(node => / cm$/.test(node?.message?.props?.text ?? '') && node.visibility !== false)"
    scene.wait_for_function(centimetres)
    page.get_by_role("combobox", name="Labels").select_option("eccentricity")
    key = (page.locator("#layer-list label", has_text="Raw scan").get_attribute("title") or "")[-1]
    page.get_by_role("button", name="Layers").click()
    page.locator("#map").press(key)
    scene.wait_for_function(hidden, arg="/world/robot/scan/raw")
    page.locator("#map").press(key)
    scene.wait_for_function(f"name => !({hidden})(name)", arg="/world/robot/scan/raw")


APART = 25  # [px] between markers, so that a click does not hit its neighbour


@pytest.fixture
def large_scene(dashboard: Dashboard) -> Iterator[None]:
    """The scene in the place of the map: markers that are small on the screen are not hit surely."""
    dashboard.page.locator("#map-exchange").click()
    yield
    dashboard.page.locator("#map-exchange").click()


@pytest.mark.usefixtures("large_scene")
def test_a_click_on_a_cluster_shows_why_it_is_not_a_tree(wide: Dashboard):
    dashboard, page = wide, wide.page
    dashboard.tab("Trees")
    scan = dashboard.ask("/api/status")["scan_index"]
    dashboard.until_server("/api/story/cluster/0", f"it.scan === {scan}")
    page.locator("#map").press("t")  # from above nothing hides anything
    box = page.locator("#scene").bounding_box()
    assert box is not None
    panel = page.locator("#panel-story")
    read: dict[str, int] = {}
    places = dashboard.settled_places(MARKERS)
    trees = dashboard.places_in_scene("/world/trees")  # which take the clicks on their clusters
    for cluster, (x, y) in enumerate(places):
        others = trees + [place for k, place in enumerate(places) if k != cluster]
        if any(hypot(x - u, y - v) < APART for u, v in others):
            continue
        # Not below viser's own panel and notices.
        left, top, width, height = (box[side] for side in ("x", "y", "width", "height"))
        if not (left + 20 < x < left + width - 360 and top + 60 < y < top + height - 30):
            continue
        wanted = f"cluster {scan} {cluster}"
        dashboard.click_until(x, y, lambda: panel.get_attribute("data-story"), wanted)
        expect(panel).to_be_visible()
        story = dashboard.ask(f"/api/story/cluster/{cluster}?scan={scan}")
        title = story["verdict"]
        if title == "tree" and story["column"] and story["column"]["verdict"] != "tree":
            title = f"A stem in this scan; not a tree in the map: {story['column']['verdict']}"
        expect(panel.locator(".verdict b")).to_have_text(title)
        expect(panel.locator("table.checks tr")).to_have_count(len(story["checks"]))
        expect(panel.locator(".story-fit circle.point")).to_have_count(len(story["points"]))
        if story["circle"] is not None:
            figures = panel.locator(".story-fit .list").inner_text()
            shown = re.search(r"radius\s*([\d.]+) ±", figures)
            assert shown is not None
            half_digit = 0.5 * 10 ** -len(shown[1].partition(".")[2])
            assert abs(float(shown[1]) - 100 * story["circle"]["radius"]) <= half_digit + 1e-9
        for check in story["checks"]:
            if check["fails"]:
                expect(panel.locator("tr.decides")).to_contain_text(story["verdict"])
                expect(panel.locator(".verdict p")).to_contain_text(check["title"] or "occluded")
                break
        read[story["verdict"]] = cluster
        if len(read) >= 2:
            break
    assert read, "no cluster was in sight"
    expect(panel.locator(".story-head")).to_contain_text(f"of scan {scan}")
    page.locator("#map").press("Escape")


def test_a_shift_click_on_a_stem_in_the_scene_adds_it(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Annotate")
    found = dashboard.ask("/api/trees")["trees"]
    box = page.locator("#scene").bounding_box()
    assert box is not None
    for x, y in dashboard.settled_places("/world/trees"):
        # Not below viser's own panel and notices.
        right, below = box["x"] + box["width"] - 360, box["y"] + box["height"] - 60
        if not (box["x"] + 20 < x < right and 280 < y < below):
            continue
        page.keyboard.down("Shift")
        page.mouse.click(x, y)
        page.keyboard.up("Shift")
        dashboard.until_server("/api/annotations", "it.trees.length === 1")
        (row,) = dashboard.ask("/api/annotations")["trees"]
        gaps = [((row["x"] - tree["x"]) ** 2 + (row["y"] - tree["y"]) ** 2) ** 0.5 for tree in found]
        assert min(gaps) < 0.3, "a stem was clicked, and something else was added"
        break
    else:
        pytest.fail("no tree was in sight")
    page.locator("#map").press("Control+z")
    dashboard.until_server("/api/annotations", "it.trees.length === 0")


@pytest.mark.usefixtures("large_scene")
def test_a_click_on_a_stem_in_the_scene_stays_in_annotate(wide: Dashboard):
    dashboard, page = wide, wide.page
    dashboard.tab("Annotate")
    page.locator("#map").press("t")
    box = page.locator("#scene").bounding_box()
    assert box is not None
    numbers = [tree["number"] for tree in dashboard.ask("/api/trees")["trees"]]
    places = dashboard.settled_places("/world/trees")
    title = page.locator("#review-title")
    for number, (x, y) in zip(numbers, places, strict=False):
        if not (box["x"] + 20 < x < box["x"] + box["width"] - 360 and box["y"] + 60 < y < box["y"] + 600):
            continue
        dashboard.click_until(x, y, lambda: (title.text_content() or "").split(":")[0], f"Tree {number}")
        page.wait_for_timeout(500)
        expect(page.locator("#panel-annotate")).to_be_visible()
        break
    else:
        pytest.fail("no tree was in sight")
    page.locator("#map").press("Escape")


# The rectangles of the labels that are drawn, and how many labels the server has sent.
LABELS = """() => {
  const { scene } = window.__viserMutable, nodes = window.__viserSceneTree.getState();
  const sent = Object.entries(nodes).filter(([name, node]) =>
    /^.world.(numbers|labels)\\/\\d+$/.test(name) && node.effectiveVisibility);
  return { boxes: scene.userData.labels, sent: sent.length };
}"""


@pytest.mark.usefixtures("calm")
def test_labels_do_not_cover_one_another_wherever_the_camera_is(dashboard: Dashboard):
    dashboard.load_scene()
    dashboard.page.locator("#map").press("Escape")
    hidden = 0
    for tree in (5, 23, 12):  # the camera flies to each of them
        dashboard.tab("Trees")
        dashboard.page.locator("#trees tbody tr").nth(tree).click()
        dashboard.settled_places("/world/trees")
        told = dashboard.scene.evaluate(LABELS)
        boxes = told["boxes"]
        assert 1 < len(boxes) <= told["sent"]
        hidden += told["sent"] - len(boxes)
        covered = [
            (a, b)
            for k, a in enumerate(boxes)
            for b in boxes[k + 1 :]
            if a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
        ]
        assert covered == []
    assert hidden > 0


def test_the_theme_is_stored(dashboard: Dashboard):
    page = dashboard.page
    dashboard.scene.evaluate("() => { window.isTheSame = true; }")
    page.get_by_role("button", name="Light or dark theme").click()
    expect(page.locator("html")).to_have_attribute("data-theme", "light")
    assert dashboard.scene.evaluate(GROUND) == "rgb(255, 255, 255)"
    assert page.evaluate("localStorage.getItem('stemmap.theme')") == "light"
    page.get_by_role("button", name="Light or dark theme").click()
    expect(page.locator("html")).to_have_attribute("data-theme", "dark")
    assert dashboard.scene.evaluate("() => window.isTheSame"), "the scene and its camera stay"
    assert dashboard.scene.evaluate(GROUND) != "rgb(255, 255, 255)"


# The colour behind the scene.
GROUND = """() => {
  let node = document.querySelector('canvas');
  while (node && !node.style.backgroundColor) node = node.parentElement;
  return getComputedStyle(node).backgroundColor;
}"""


# How many trees of the scene are grey, and how many there are.
GREYED = """() => {
  let mesh = null;
  const node = window.__viserMutable.nodeRefFromName['/world/trees'];
  node.traverse(each => { if (each.getColorAt) mesh ??= each; });
  const isGrey = (k) => { const { r, g, b } = mesh.getColorAt(k); return r === g && g === b; };
  const all = Array.from({ length: mesh.instancesCount }, (_, k) => isGrey(k));
  return [all.filter(Boolean).length, all.length];
}"""


@pytest.mark.usefixtures("calm")
def test_the_scene_greys_the_trees_that_the_filter_leaves_out(dashboard: Dashboard):
    dashboard.load_scene()
    dashboard.tab("Trees")
    measured = sum(row["dbh_cm"] is not None for row in trees_of(dashboard))
    greyed = lambda: dashboard.scene.evaluate(GREYED)  # noqa: E731
    assert greyed()[0] == 0
    dashboard.page.locator("#find").fill("dbh > 30")
    count = dashboard.page.locator("#trees tbody tr").count
    dashboard.eventually(lambda: greyed()[0] == greyed()[1] - count() and 0 < count() < measured, greyed)
    dashboard.page.locator("#find").fill("")
    dashboard.eventually(lambda: greyed()[0] == 0, greyed)


def trees_of(dashboard: Dashboard) -> list[dict[str, float | None]]:
    """The trees of the map that the page shows."""
    read = "async () => (await import('/static/js/core/store.js')).trees()"
    return list(dashboard.page.evaluate(read))


def test_the_notice_of_software_rendering_closes_by_itself(dashboard: Dashboard):
    """It covers a part of the scene; a browser that showed it before closes it at once."""
    scene = dashboard.scene
    shown = "() => localStorage.getItem('stemmap.rendering-notice')"
    if dashboard.page.evaluate(shown) is None:
        pytest.skip("this browser renders in hardware")
    scene.wait_for_function(
        "() => ![...document.querySelectorAll('[class*=mantine-Notification-root]')]"
        ".some(({ textContent }) => textContent.includes('Software WebGL'))"
    )


def test_the_panel_leaves_a_small_scene_free(wide: Dashboard):
    page, scene = wide.page, wide.scene
    slider = scene.get_by_role("slider", name="Radius eps").first
    expect(slider).to_be_visible()
    split = page.locator("#split-left")
    split.focus()
    for _ in range(60):
        if page.locator("#scene").evaluate("node => node.clientWidth") < 540:
            break
        split.press("ArrowLeft")
    expect(slider).to_be_hidden()
    split.dblclick()
    expect(slider).to_be_visible()
