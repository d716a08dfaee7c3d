"""The core and the extensions are apart: only an extension knows its words, and each can be missing."""

from __future__ import annotations

import asyncio
import re
from functools import cache
from pathlib import Path

import httpx
import pytest

from app.cli import WRONG_USAGE, main
from app.common.settings import Settings
from app.dashboard.parameters import ParameterState
from app.extension import VARIABLE, all_extensions
from app.web.app import build
from app.web.auth import AccessTokens
from app.worker.protocol import Open
from app.worker.supervisor import WorkerProcess
from tests.app.fake_scene import FakeScene
from tests.app.server_for_tests import BEARER, HOST, PORT, TOKEN

ROOT = Path(__file__).resolve().parents[3]
#: Words by which only the files of an extension name what it does.
WORDS = {
    "clouds": r"(?<!stand )inventory|of_cloud|map_plot|PlotMap|stem curve|CloudSource|extensions.clouds",
    "cluster": r"\bdask|many_runs|map_runs",
    "dds": r"\bdds:|DdsLink|cyclone|plain DDS|fast_?dds",
    "fleet": r"fleet|robots-link|common.map",
    "formats": r"victoria|tree.?manager|extensions\.formats",
    "maps": r"--continue|ContinuedMap|continue_map|merge_runs|stemmap merge|merged_map|stemmap localise|"
    r"/api/localise|\"localise\"|Locate in",
    "search": r"sensitivity|TuneSearch|param.grid|/api/search|optuna|stemmap tune|\bsearch-(?!d)",
    # georeference.json has the reference system of a map, which the core reads for its files.
    "stand": r"sample.?plot|stand.figure|georeferenc(?!e\.json)|/api/plots|runs/compare|[a-z]-plots\b|"
    r"\bplots-|\"Plots\"|tab Plots|plot-form|report_page|stemmap (stand|report|compare)\b|shapefile|"
    r"\bdxf\b|xlsx|two visits",
    "learning": r"learning|\blearn-|stemmap train\b|\"train\"|Learn:",
}
NAMES = sorted(WORDS)
FOLDERS = ("app", "pipeline", "static", "tests/app", "tests/pipeline", "tests/browser")
SUFFIXES = {".py", ".js", ".html", ".css", ".j2", ".toml"}


@cache
def files() -> list[tuple[Path, str]]:
    """The files in which an extension may be named, with their texts."""
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*"))]
    return [
        (path, path.read_text(encoding="utf-8"))
        for path in paths
        if path.suffix in SUFFIXES and "vendor" not in path.parts
    ]


def test_each_extension_of_the_package_has_its_words():
    ours = [each.name for each in all_extensions() if each.package.startswith("stemmap ")]
    assert ours == NAMES
    assert not [each.problem for each in all_extensions() if each.problem]


@pytest.mark.parametrize("name", NAMES)
def test_only_its_own_files_name_an_extension(name):
    word = re.compile(WORDS[name], re.IGNORECASE)
    offenders = []
    for path, text in files():
        place = path.relative_to(ROOT).as_posix()
        is_own = f"extensions/{name}/" in place or f"extensions/survey_{name}" in place
        is_own |= place.startswith(f"tests/browser/extensions/test_{name}")
        is_own |= path == Path(__file__) or place == "tests/browser/extensions/test_loading.py"
        if not is_own:
            found = word.finditer(text)
            offenders += [f"{place}:{text.count(chr(10), 0, m.start()) + 1} {m[0]}" for m in found]
    assert offenders == []


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("map sim:stand --out out --jobs 2", "cluster"),
        ("tune sim:stand", "search"),
        ("train", "learning"),
        ("report DIR", "stand"),
        ("merge a b --out c", "maps"),
        ("map sim:stand --out a --continue b", "maps"),
        ("evaluate sim:stand --param-grid x=1", "search"),
    ],
)
def test_what_is_switched_off_is_named(words: str, name: str, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setenv(VARIABLE, "")
    assert main(words.split()) == WRONG_USAGE
    assert f"The extension {name} is switched off by {VARIABLE}." in capsys.readouterr().err


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("off", ["all", *NAMES])
async def test_the_core_needs_no_extension(off: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """A run is opened, played, tuned, annotated and exported, with a real worker process."""
    monkeypatch.setenv(VARIABLE, "" if off == "all" else ",".join(name for name in NAMES if name != off))
    app = build(
        Settings(folder=tmp_path),
        port=PORT,
        tokens=AccessTokens(TOKEN),
        source=Open("sim:paper?duration=2"),
        parameter_state=ParameterState(),
        make_scene=lambda _dashboard, _loop: FakeScene(),
        make_worker=WorkerProcess,
    )
    async with (
        asyncio.timeout(120),
        app.router.lifespan_context(app),
        httpx.AsyncClient(
            transport=httpx.ASGITransport(app), base_url=f"http://{HOST}", headers=BEARER, timeout=60
        ) as client,
    ):

        async def finished() -> dict[str, object]:
            while (status := (await client.get("/api/status")).json())["state"] != "finished":
                assert status["state"] != "failed", status["detail"]
                await asyncio.sleep(0.05)
            return dict(status)

        shown = (await client.get("/")).text
        modules = re.findall(r'data-extension="[^"]*" src="([^"]*)"', shown)
        assert not [each for each in modules if off in ("all", each.split("/")[4])]
        for page in ("/", "/static/js/shell/main.js", *modules):
            assert (await client.get(page)).status_code == 200
        await client.post("/api/command", json={"type": "set_speed", "factor": 0})
        before = await finished()
        assert before["trees"]
        answer = await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.3}})
        assert answer.json()["changed"] == ["clustering.eps"]
        await finished()
        tree = (await client.get("/api/trees")).json()["trees"][0]
        added = await client.post(
            "/api/annotations",
            json={
                "run": (await client.get("/api/annotations")).json()["run"],
                "x": tree["x"],
                "y": tree["y"],
                "kind": "tree",
                "who": "me",
                "browser": 16 * "a",
            },
        )
        assert added.status_code == 201, added.text
        assert "tree" in (await client.get("/api/annotations.csv")).text
        for file in ("/api/trees.csv", "/api/export/geojson", "/api/export/gpkg"):
            exported = await client.get(file)
            assert (exported.status_code, len(exported.content) > 100) == (200, True), exported.text


def test_what_needs_an_extension_that_is_switched_off_says_which(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv(VARIABLE, "")
    cloud = tmp_path / "plot.xyz"
    cloud.write_text("1 2 3\n4 5 6\n7 8 9\n")
    capture = tmp_path / "run.pcap"
    capture.write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(100))
    (tmp_path / "stems").mkdir()
    (tmp_path / "stems" / "TreeManagerState_0.csv").touch()
    for extension, words in (
        ("dds", ("serve", "dds:?domain=0", "--no-browser")),
        ("clouds", ("map", cloud, "--as", "cloud", "--out", tmp_path / "out")),
        ("formats", ("map", capture, "--out", tmp_path / "out")),
        ("formats", ("map", tmp_path / "stems", "--out", tmp_path / "out")),
        ("stand", ("stand", tmp_path)),
    ):
        assert main([str(word) for word in words]) in (1, WRONG_USAGE)
        assert f"extension {extension} is switched off by STEMMAP_EXTENSIONS" in capsys.readouterr().err
