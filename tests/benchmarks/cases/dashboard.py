"""Cost of connected browsers, and their delay: a replay of 30,000 returns per scan at 10 Hz."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pipeline.errors import StemmapError
from tests.benchmarks.process import Side
from tests.benchmarks.served import chromium, scans
from tests.benchmarks.table import Cell, Table, verdict
from tests.benchmarks.timing import middle, quantile

NAME = "dashboard"
LINE = "The dashboard with five browsers: what they cost the mapping, and how soon they see"

BROWSERS = 5
# Each window plays the same scans, so that equal work is compared.
FROM_S, WINDOW_S, ROUNDS = 14.0, 8.0, 5
IDLE_S, CHANGES, LATE, PAGES = 10.0, 30, 5, 3
SLOWER, LATENCY_MS, IDLE_PERCENT, READY_S, LATE_S = 5.0, 150.0, 5.0, 3.0, 2.0  # asked for
SLIDER_PAGE_MS, SLIDER_SCENE_MS = 100.0, 150.0  # asked for
MAPPED_MS = 150.0
LONGEST_S = 300.0


class Dashboard:
    """A server with a recording, and the connected browsers."""

    def __init__(self, source: Path, folder: Path, stack: ExitStack) -> None:
        self.server = Side("tests.benchmarks.served.server", str(source), str(folder))
        stack.callback(self.server.end)
        told = self.server.ask({"do": "link"})
        self.link = f"http://127.0.0.1:{told['port']}/?token={told['token']}"
        self.browsers = Side("tests.benchmarks.served.browsers", str(told["port"]), told["token"])
        stack.callback(self.browsers.end)

    def command(self, kind: str, **fields: float) -> None:
        """Send a command as the buttons of the page do."""
        self.browsers.ask({"do": "command", "command": {"type": kind, **fields}})

    def until(self, what: str, **wanted: Any) -> dict[str, Any]:
        """Wait for a status.

        Raises:
            StemmapError: The status did not occur in time.
        """
        deadline = time.monotonic() + LONGEST_S
        while True:
            status = self.browsers.ask({"do": "status"})
            if all(status[name] == value for name, value in wanted.items()):
                return status
            if time.monotonic() > deadline:
                raise StemmapError(f"the dashboard never {what}", where=json.dumps(status)[:300])
            time.sleep(0.05)

    def stand(self, time_s: float) -> None:
        """Pause at a time of the run."""
        self.command("pause")
        self.command("seek", time_s=time_s)
        self.until(f"stood at {time_s:g} s", state="paused", going_to="", time_s=time_s)

    def play(self, seconds: float) -> dict[str, Any]:
        """Play for a while from the beginning of the window; return the status at its end."""
        self.stand(FROM_S)
        self.server.ask({"do": "heard"})
        self.browsers.ask({"do": "heard"})
        self.command("play")
        time.sleep(seconds)
        status = self.browsers.ask({"do": "status"})
        self.command("pause")
        return status


def run() -> list[Table]:
    """Run all measurements on one recording."""
    if not Path("/proc/self/stat").exists():
        raise StemmapError("the processor time of other processes is read from /proc", remedy="Use Linux")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        recording = folder / "run.mcap"
        returns = scans.write(recording)
        dashboard = Dashboard(recording, folder / "kept", stack)
        dashboard.until("played", state="finished")  # one pass fills the caches
        return [
            _mapping(dashboard, returns),
            _waiting(dashboard, returns),
        ]


def _mapping(dashboard: Dashboard, returns: float) -> Table:
    """Mapping times without a browser and with five, in turns."""
    times: dict[int, list[float]] = {0: [], BROWSERS: []}
    rates: dict[int, list[float]] = {0: [], BROWSERS: []}
    cpu: dict[int, list[float]] = {0: [], BROWSERS: []}
    for _ in range(ROUNDS):
        for count in times:
            dashboard.browsers.ask({"do": "browsers", "count": count})
            before = dashboard.server.ask({"do": "cpu"})
            status = dashboard.play(WINDOW_S)
            after = dashboard.server.ask({"do": "cpu"})
            times[count].append(status["mapping_ms"])
            rates[count].append(status["scan_rate_hz"])
            cpu[count].append(100.0 * (after["web"] - before["web"]) / WINDOW_S)
    rows = tuple(
        (
            f"{count} browsers",
            middle(times[count]),
            min(times[count]),
            middle(rates[count]),
            middle(cpu[count]),
        )
        for count in times
    )
    slower = 100.0 * (middle(times[BROWSERS]) / middle(times[0]) - 1.0)
    least = 100.0 * (min(times[BROWSERS]) / min(times[0]) - 1.0)
    return Table(
        f"Mapping while others look on, {returns:,.0f} returns a scan at 10 Hz, preset forest",
        ("looking on", "median ms a scan", "least ms", "scans a second", "web process, % of a core"),
        rows,
        (
            f"The same {WINDOW_S:g} s of the run in turns, {ROUNDS} times each; of each the median over its "
            f"last 50 scans. With {BROWSERS} browsers the mapping takes {slower:+.1f} % "
            f"(least {least:+.1f} %); asked for: within {SLOWER:g} %: by the median "
            f"{verdict(slower <= SLOWER)}, by the least {verdict(least <= SLOWER)}.",
            "A browser here is both websockets of the page, read as fast as it comes by a process of its "
            "own; it draws nothing, because a browser's drawing is done on other machines.",
        ),
    )


def _waiting(dashboard: Dashboard, returns: float) -> Table:
    """Waiting times of users."""
    rows: list[tuple[Cell, ...]] = []

    def row(what: str, values: Sequence[float], unit: str, asked: float | None, part: float = 0.5) -> None:
        told = quantile(values, part)
        reached = "" if asked is None else verdict(told <= asked)
        rows.append((what, len(values), middle(values), quantile(values, 0.95), unit, asked, reached))

    dashboard.browsers.ask({"do": "browsers", "count": BROWSERS})
    dashboard.play(WINDOW_S)
    row("a scan, from the server to five browsers", _late_ms(dashboard), "ms", LATENCY_MS, 0.95)

    # Before the sliders: scans of other parameters are mapped again.
    back, sought = _mapped_ms(dashboard)
    row("a step back, to the page", back[0], "ms", MAPPED_MS, 0.95)
    row("a step back, to the 3D scene", back[1], "ms", MAPPED_MS, 0.95)
    row("a time that was mapped, to the page", sought[0], "ms", MAPPED_MS, 0.95)
    row("a time that was mapped, to the 3D scene", sought[1], "ms", MAPPED_MS, 0.95)

    dashboard.stand(FROM_S)
    page, scene = _slider_ms(dashboard)
    row("a slider's change, to the page", page, "ms", SLIDER_PAGE_MS, 0.95)
    row("a slider's change, to the 3D scene", scene, "ms", SLIDER_SCENE_MS, 0.95)
    row("the server while a run stands, five browsers", _idle(dashboard), "% of a core", IDLE_PERCENT)

    dashboard.browsers.ask({"do": "browsers", "count": 0})
    program = chromium.where()
    if program is not None:
        for what, values, asked in _pages(dashboard, program):
            row(what, values, "s", asked)
    per_scan = _messages_a_scan(dashboard)
    messages = dashboard.server.ask({"do": "age"})["messages"]
    late = [dashboard.browsers.ask({"do": "late"}) for _ in range(LATE)]
    row(f"one who comes after {messages:,} messages, to the map", [each["map"] for each in late], "s", LATE_S)
    row("the same, to the 3D scene", [each["scene"] for each in late], "s", LATE_S)
    if program is not None:
        row("the same, a page in Chromium ready", _ready(dashboard, program)[0], "s", LATE_S)
    return Table(
        f"Waiting, {returns:,.0f} returns a scan",
        ("for what", "times", "median", "p95", "unit", "asked for", "by it"),
        tuple(rows),
        (
            "Scans and sliders are judged by the p95, all else by the median. From the server: from the "
            "message of the mapping process to the browser's socket. A slider, a step, a time: from sending "
            "it to its answer.",
            f"A day of 10 Hz sends {864_000 * per_scan:,.0f} messages to the scene ({per_scan:.1f} a scan), "
            "which renews itself before one has to walk through more than 2,000,000: one comes right before "
            "that. The messages are real, and sent through the scene's server as fast as it can.",
            "A page is ready when its trees are listed; a warm server, a new browser profile each time, "
            "software rendering of the 3D scene on the same cores.",
        ),
    )


def _late_ms(dashboard: Dashboard) -> list[float]:
    """Delay of each scan at each browser since the last request [ms]."""
    heard = {index: at for index, at, _ in dashboard.server.ask({"do": "heard"})["heard"]}
    told = dashboard.browsers.ask({"do": "heard"})["browsers"]
    return [1e3 * (at - heard[index]) for maps, _ in told for index, at in maps if index in heard]


def _slider_ms(dashboard: Dashboard) -> tuple[list[float], list[float]]:
    """Time until the page and the scene have the answer to a slider [ms]."""
    page, scene = [], []
    for k in range(CHANGES + 1):
        told = dashboard.browsers.ask({"do": "change", "changes": {"clustering.eps": (0.2, 0.5)[k % 2]}})
        page.append(told["map"])
        scene.append(told["scene"])
        time.sleep(0.3)
    return page[1:], scene[1:]


def _mapped_ms(dashboard: Dashboard) -> list[tuple[list[float], list[float]]]:
    """Time until page and scene have a scan that was mapped before [ms]: for steps back in quick succession,
    and for times distributed over the run."""
    last = round(10 * (FROM_S + WINDOW_S))
    dashboard.stand(last / 10)
    at = dashboard.browsers.ask({"do": "status"})["scan_index"]
    answers: list[list[dict[str, float]]] = [[], []]
    for k in range(CHANGES):
        step = {"type": "advance", "scans": -1}
        answers[0].append(dashboard.browsers.ask({"do": "go", "command": step, "index": at - 1 - k}))
        time.sleep(0.1)
    for k in range(CHANGES):
        # A prime number of scans, so that the times are spread evenly over the run.
        index = (at + 71 * (k + 1)) % at
        sought = {"type": "seek", "time_s": 0.1 * index + 0.01}
        answers[1].append(dashboard.browsers.ask({"do": "go", "command": sought, "index": index}))
        time.sleep(0.3)
    return [([each["map"] for each in times], [each["scene"] for each in times]) for times in answers]


def _idle(dashboard: Dashboard) -> list[float]:
    """CPU use of web process and worker while nothing happens [% of a core]."""
    used = []
    for _ in range(3):
        before = sum(dashboard.server.ask({"do": "cpu"}).values())
        time.sleep(IDLE_S)
        used.append(100.0 * (sum(dashboard.server.ask({"do": "cpu"}).values()) - before) / IDLE_S)
    return used


def _pages(dashboard: Dashboard, program: Path) -> Iterator[tuple[str, list[float], float | None]]:
    """Real pages: time until they are ready and have points, and delay of a scan that plays."""
    ready, drawn = _ready(dashboard, program)
    yield "a page in Chromium, ready", ready, READY_S
    yield "the same, points in the 3D scene", drawn, None
    with chromium.chromium(program) as browser, chromium.page_of(browser, dashboard.link) as (page, _, _):
        page.evaluate("() => { window.__maps.length = 0; }")
        dashboard.play(WINDOW_S)
        heard = {index: at for index, _, at in dashboard.server.ask({"do": "heard"})["heard"]}
        maps = page.evaluate("() => window.__maps")
        yield (
            "a scan, from the server to Chromium on the same cores",
            [at - heard[index] for index, at in maps if index in heard],
            None,
        )


def _ready(dashboard: Dashboard, program: Path) -> tuple[list[float], list[float]]:
    """Seconds until pages are ready, and until points are in their scenes; the first page, of a newly started
    browser, is left out."""
    times = []
    with chromium.chromium(program) as browser:
        for _ in range(PAGES + 1):
            with chromium.page_of(browser, dashboard.link) as (_, ready_s, drawn_s):
                times.append((ready_s, drawn_s))
    return [ready for ready, _ in times[1:]], [drawn for _, drawn in times[1:]]


def _messages_a_scan(dashboard: Dashboard) -> float:
    """Number of messages that the scene sends per scan."""
    before = dashboard.server.ask({"do": "messages"})["messages"]
    dashboard.play(WINDOW_S)
    scans_shown = len(dashboard.server.ask({"do": "heard"})["heard"])
    return float(dashboard.server.ask({"do": "messages"})["messages"] - before) / max(scans_shown, 1)
