"""The dashboard in the words of a person who uses it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

from playwright.sync_api import ConsoleMessage, Error, Frame, Locator, Page, Response, Route

# Of a machine that is busy and compiles the kernels first.
PATIENCE_S = 150
# The first run of a fresh checkout compiles before anything is shown.
COMPILING_S = 600
STANDS = "['playing', 'paused', 'finished']"

# Time of the scan on which tests begin: trees are mapped and classified by then.
MIDDLE_S = 15.05
# The run that the server opens at its start.
RUN = "sim:stand"

# What software rendering says of itself is not an error of ours.
HARMLESS = ("GPU stall", "GL Driver Message", "Automatic fallback to software WebGL")


# Longer than the page wants a card to be on the screen before it is answered.
CARD_SEEN = """async () => {
  const { draft } = await import('/static/js/annotate/annotations.js');
  while (!(performance.now() - draft.shownAt > 160)) await new Promise((resolve) => setTimeout(resolve, 20));
}"""

# Where viser's client and its pictures come from.
SCENE = "**/viser/**"


class Dashboard:
    """A page, with what it complained about.

    The 3D scene is loaded when a test first looks into it: without a graphics card it takes most of a core
    for as long as it stands there, and tests that look at the page alone need none of it.

    Args:
        page: Of a browser.
        scene: Whether the scene is loaded with the page, as for a person.
    """

    def __init__(self, page: Page, scene: bool = False) -> None:
        self.page = page
        self.errors: list[str] = []
        self._has_scene = scene
        if not scene:
            page.route(SCENE, leave_empty)
        page.on("pageerror", self._note)
        page.on("console", self._listen)
        page.on("response", self._look_at)

    def leave(self) -> None:
        """Empty the tab, and forget what the page has stored in the browser."""
        self.page.remove_listener("pageerror", self._note)
        self.page.remove_listener("console", self._listen)
        self.page.remove_listener("response", self._look_at)
        self.page.unroute_all(behavior="ignoreErrors")
        self.page.evaluate(FORGET)
        self.page.goto("about:blank")

    def _note(self, error: Error) -> None:
        self.errors.append(str(error))

    def _listen(self, message: ConsoleMessage) -> None:
        if message.type == "error" and not any(word in message.text for word in HARMLESS):
            self.errors.append(message.text)

    def _look_at(self, response: Response) -> None:
        if response.status >= 400:
            self.errors.append(f"{response.status} {response.url}")

    # --- what the server holds -------------------------------------------------------------------

    def ask(self, path: str) -> dict[str, Any]:
        """The JSON of an address, asked for by the page."""
        answer = self.page.evaluate("path => fetch(path).then(answer => answer.json())", path)
        return cast(dict[str, Any], answer)

    def command(self, command: dict[str, Any]) -> None:
        """Send a command as the page does."""
        self.page.evaluate(
            "body => fetch('/api/command', { method: 'POST', body: JSON.stringify(body),"
            " headers: { 'Content-Type': 'application/json' } })",
            command,
        )

    def until(self, function: str, argument: object = None) -> None:
        """Wait until a function of JavaScript, not an async one, holds in the page."""
        self.page.wait_for_function(function, arg=argument, polling=200)

    def until_server(self, path: str, condition: str) -> None:
        """Wait until a condition in JavaScript holds for `it`, what an address answers."""
        # Not by wait_for_function: it takes the promise of an answer for a yes.
        test = (
            f"async path => {{ const it = await (await fetch(path)).json(); return Boolean({condition}); }}"
        )
        deadline = time.monotonic() + PATIENCE_S
        while not self.page.evaluate(test, path):
            assert time.monotonic() < deadline, f"{path} never fulfils {condition}: {self.ask(path)}"
            self.page.wait_for_timeout(100)

    def eventually(self, holds: Callable[[], bool], told: Callable[[], object]) -> None:
        """Wait until something holds that is asked of the page and the server in several steps."""
        deadline = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < deadline, f"it never came about: {told()}"
            self.page.wait_for_timeout(100)

    def points(self) -> tuple[int, int]:
        """Return how many points the raw and the filtered scan of the server have."""
        _, _, raw, filtered = self.page.evaluate(SHOWN)
        return raw, filtered

    def drawn(self) -> None:
        """Wait until what was planned to be drawn on the page is drawn."""
        self.page.evaluate(NEXT_FRAME)

    # --- the run ---------------------------------------------------------------------------------

    def reset(self) -> None:
        """Show the default run again, without annotations of any class, a selection, a loop or another
        speed, and with the preset."""
        self.open(RUN)
        self.pause()
        self.page.evaluate(RESET)
        self.page.evaluate(PRESET, "forest")
        self.until_server("/api/parameters", "it.preset === 'forest' && it.changed.length === 0")
        self.until_server("/api/annotations", "it.trees.length === 0")

    def open(self, uri: str) -> None:
        """Open a source unless it is the present one, and wait for its first scan."""
        if self.ask("/api/status")["source"] == uri:
            return
        self.page.evaluate(OPEN, uri)
        self.until_server("/api/status", f"it.source === {uri!r} && it.scan_index >= 0")

    def pause(self) -> None:
        """Stand still, wherever the run is."""
        self.page.wait_for_function(
            f"() => {STANDS}.includes(document.querySelector('#state').dataset.state)",
            polling=200,
            timeout=1000 * COMPILING_S,
        )
        # Not by a click: it would begin anew a run that has just come to its end.
        self.command({"type": "pause"})
        self.until_server("/api/status", f"{STANDS}.includes(it.state) && it.state !== 'playing'")
        self.until("() => ['paused', 'finished'].includes(document.querySelector('#state').dataset.state)")

    def stand(self, time_s: float = MIDDLE_S) -> None:
        """Stand in the middle of the run with the values of the preset, whatever was before.

        Args:
            time_s: Between two scans, so that the one before it is not taken for the end of the way.
        """
        self.pause()
        self.page.evaluate(PRESET, "forest")
        self.until_server("/api/parameters", "it.preset === 'forest' && it.changed.length === 0")
        self.command({"type": "seek", "time_s": time_s})
        there = f"it.time_s > {time_s} - 0.08 && it.time_s < {time_s} + 0.01"
        self.until_server("/api/status", f"it.state === 'paused' && it.remapped === null && {there}")
        self.until_shown()

    def go_to(self, time_s: float) -> None:
        """Pause and seek, and wait until the page shows the scan at a time.

        A long seek shows scans of the way, too.

        Args:
            time_s: Between two scans, or the time of one.
        """
        self.pause()
        self.command({"type": "seek", "time_s": time_s})
        there = f"it.time_s > {time_s} - 0.11 && it.time_s < {time_s} + 0.11"
        self.until_server("/api/status", f"it.state === 'paused' && it.going_to === '' && {there}")
        self.until_shown()

    def until_shown(self) -> None:
        """Wait until the page and the scene show the scan at which the server stands.

        The status comes before the pictures, and a busy machine draws the scene long after.
        """

        def told() -> tuple[list[int], list[int]]:
            return cast(list[int], self.page.evaluate(SHOWN)), [
                self.node_points(f"/world/robot/scan/{name}")
                for name in ("raw", "filtered")
                if self._has_scene
            ]

        def there() -> bool:
            (served, shown, *points), drawn = told()
            return served == shown and (points == drawn or not self._has_scene)

        self.eventually(there, told)

    @property
    def state(self) -> str:
        """The run's state as the page shows it."""
        return str(self.page.locator("#state").get_attribute("data-state"))

    def seek(self, fraction: float) -> None:
        """Take the thumb of the timeline to a part of the run."""
        line = self.page.locator("#timeline")
        box = line.bounding_box()
        assert box is not None
        line.click(position={"x": 8 + fraction * (box["width"] - 16), "y": box["height"] / 2})

    def tab(self, name: str) -> Locator:
        """Open a tab and give its panel."""
        self.page.get_by_role("tab", name=name).click()
        return self.page.locator(f"#panel-{name.lower()}")

    def tabs(self) -> list[str]:
        """Names of all tabs, also of those of extensions."""
        return self.page.locator(".tabs [role=tab]").all_inner_texts()

    def card_shown(self) -> None:
        """Wait until the review card has shown the selected tree for a moment; until then the review takes no
        answer."""
        self.until("() => document.getElementById('review').getAttribute('aria-busy') === 'false'")
        self.page.evaluate(CARD_SEEN)

    def answer(self, key: str) -> None:
        """Press a key of the review once the card shows the selected tree."""
        self.card_shown()
        self.page.locator("#map").press(key)

    def clusters(self) -> int:
        """How many clusters the standing scan has, as the tab Clusters says."""
        panel = self.tab("Clusters")
        # The status comes before the picture of the scan.
        self.until_server(
            "/api/status", "it.scan_index === Number(document.querySelector('[data-scan]').dataset.scan)"
        )
        return int(panel.locator("[data-clusters]").get_attribute("data-clusters") or -1)

    # --- the scene -------------------------------------------------------------------------------

    @property
    def scene(self) -> Frame:
        """The frame with viser in it, which is loaded if it was not."""
        self.load_scene()
        self.page.wait_for_function(
            "() => document.querySelector('#scene').contentWindow?.location.pathname === '/viser/'"
        )
        return next(frame for frame in self.page.frames if "/viser/" in frame.url)

    def load_scene(self) -> None:
        """Load viser if it was not, and wait for a scan in it."""
        if self._has_scene:
            return
        self.page.unroute(SCENE)
        with self.page.expect_response(SCENE):
            self.page.evaluate("() => document.querySelector('#scene').contentWindow.location.reload()")
        self._has_scene = True
        self.scene.wait_for_function(HAS_NODE, arg="/world/robot/scan/raw")
        self.until("() => document.querySelector('.scene.folded')")  # by the page, in a window of this width
        self.scene.locator("[data-dock-region] [aria-label^=Expand]").click()

    def until_scene_is_named(self) -> None:
        """Wait until the page has named the sliders of the scene."""
        self.scene.wait_for_function(
            "() => { const all = [...document.querySelectorAll('.mantine-Slider-root [role=slider]')];"
            " return all.length > 0 && all.every(node => node.getAttribute('aria-label')); }"
        )

    def row(self, label: str) -> Locator:
        """The row of a parameter in the Tune panel, by the text of its label."""
        text = self.scene.get_by_text(label, exact=False).first
        return text.locator("xpath=ancestor::*[contains(@class, 'mantine-Flex-root')][1]")

    def node_points(self, name: str) -> int:
        """How many points a cloud of the scene has."""
        read = "name => (window.__viserSceneTree?.getState()[name]?.message?.props?.points?.length ?? 0)"
        return int(self.scene.evaluate(read, name)) // 3

    def settled_places(self, name: str) -> list[tuple[float, float]]:
        """The same once the camera has come to rest."""
        before: list[tuple[float, float]] = []

        def rest() -> bool:
            nonlocal before
            self.scene.evaluate(NEXT_FRAME)  # within one of them everything rests
            earlier, before = before, self.places_in_scene(name)
            return len(before) == len(earlier) > 0 and all(
                abs(a - b) < 0.5
                for one, other in zip(before, earlier, strict=True)
                for a, b in zip(one, other, strict=True)
            )

        self.page.wait_for_timeout(300)  # the camera sets out
        self.eventually(lambda: rest() and rest() and rest(), lambda: before)
        return before

    def click_until(self, x: float, y: float, attribute: Callable[[], str | None], wanted: str) -> None:
        """Click a place of the scene until an attribute has a value: a scene that is just being drawn anew on
        a busy machine may miss a click.
        """
        deadline = time.monotonic() + PATIENCE_S
        while True:
            self.page.mouse.click(x, y)
            again = time.monotonic() + 8
            while time.monotonic() < again:
                if attribute() == wanted:
                    return
                self.page.wait_for_timeout(100)
            assert time.monotonic() < deadline, f"clicks give {attribute()}, not {wanted}"

    def places_in_scene(self, name: str) -> list[tuple[float, float]]:
        """Where the middles of a node's copies are seen, in pixels of the page; by the number of the copy."""
        frame = self.page.locator("#scene").bounding_box()
        assert frame is not None
        self.scene.wait_for_function(HAS_NODE, arg=name)
        found = self.scene.evaluate(PROJECTED, name)
        return [(frame["x"] + x, frame["y"] + y) for x, y in found]


def leave_empty(route: Route) -> None:
    route.fulfill(body="<!doctype html><title>3D scene</title>", content_type="text/html")


NEXT_FRAME = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"

# Not on the page of an error, which has no storage.
FORGET = "() => { try { localStorage.clear(); sessionStorage.clear(); } catch { /* nothing is stored */ } }"

# The scene is drawn ten times a second instead of sixty: it shows the same, and leaves the core to the tests.
FEW_FRAMES = """if (location.pathname.startsWith('/viser/')) {
  const draw = requestAnimationFrame.bind(window), drop = cancelAnimationFrame.bind(window);
  const planned = new Map();
  let last = 0;
  window.requestAnimationFrame = (act) => {
    const id = ++last;
    const timer = setTimeout(() => {
      const frame = draw((now) => { planned.delete(id); act(now); });
      planned.set(id, () => drop(frame));
    }, 100);
    planned.set(id, () => clearTimeout(timer));
    return id;
  };
  window.cancelAnimationFrame = (id) => { planned.get(id)?.(); planned.delete(id); };
}"""

# All annotations of the run are deleted, as another browser would; its loop and speed are those of the start.
RESET = """async () => {
  const send = (method, path, body) => fetch(path, { method, body: JSON.stringify(body),
    headers: { "Content-Type": "application/json" } });
  await send("POST", "/api/loop", { from_s: null, to_s: null });
  await send("POST", "/api/command", { type: "set_speed", factor: 1 });
  (await import("/static/js/core/live_feed.js")).select(null);
  const { run, trees, skipped, frame, others } = await (await fetch("/api/annotations")).json();
  const known = [...trees, ...skipped, ...(frame ? [frame] : []), ...Object.values(others).flat()];
  for (const { id, version } of known)
    await send("DELETE", `/api/annotations/${id}`, { run, version, browser: "c".repeat(32), who: "reset" });
}"""

OPEN = """uri => fetch('/api/open', { method: 'POST', body: JSON.stringify({ uri }),
  headers: { 'Content-Type': 'application/json' } })"""

PRESET = """name => fetch('/api/parameters/preset', { method: 'POST', body: JSON.stringify({ name }),
  headers: { 'Content-Type': 'application/json' } })"""

# The scan at which the server stands, that of the page, and the points of its first two stages.
SHOWN = """async () => {
  const [{ unpack }, { state }] = await Promise.all([
    import('/static/js/scene/points.js'), import('/static/js/core/store.js'),
  ]);
  const { index, arrays } = unpack(await (await fetch('/api/stages')).arrayBuffer());
  return [index, state.map?.index ?? -1, arrays.raw.length / 3, arrays.points.length / 3];
}"""

HAS_NODE = "name => window.__viserSceneTree?.getState()[name]?.message"

PROJECTED = """name => {
  const { props } = window.__viserSceneTree.getState()[name].message;
  const floats = ({ buffer, byteOffset, byteLength }) =>
    new Float32Array(buffer.slice(byteOffset, byteOffset + byteLength));
  const { scene, camera, canvas, nodeRefFromName } = window.__viserMutable;
  scene.updateMatrixWorld();
  const [at, size] = [floats(props.batched_positions), floats(props.batched_scales)];
  const box = canvas.getBoundingClientRect();
  return Array.from({ length: at.length / 3 }, (_, k) => {
    const v = camera.position.clone().set(at[3 * k], at[3 * k + 1], at[3 * k + 2] + size[3 * k + 2] / 2);
    v.applyMatrix4(nodeRefFromName[name].matrixWorld).project(camera);
    if (v.z > 1) return [-1, -1];
    return [box.x + box.width * (v.x + 1) / 2, box.y + box.height * (1 - v.y) / 2];
  });
}"""
