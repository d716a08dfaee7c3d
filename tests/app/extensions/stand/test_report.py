"""The report of a run."""

from __future__ import annotations

import datetime
import json
import math
import os
import re
import tomllib
from dataclasses import asdict
from html.parser import HTMLParser
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from app.batch.map_frame import METHODS
from app.batch.run_folder import recorded_time
from app.extensions.stand.figures import Estimate
from app.extensions.stand.parameters import Stand
from app.extensions.stand.report import Numbers, _digits, find_browser
from pipeline.config import Parameters
from pipeline.config.model import field_specs, stage_specs
from pipeline.evaluation import evaluate
from pipeline.types.records import TruthTrees, Verdict
from tests.app.batch.finished_runs import grid_run, write_run
from tests.app.cli.test_commands import stemmap
from tests.pipeline.strategies import trees


class Page(HTMLParser):
    """Tags, attributes and texts of a page."""

    def __init__(self, text) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str | None] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "action")]

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run."""
    return grid_run(tmp_path_factory.mktemp("report") / "run")


def page_of(capsys, run, file, words=()):
    """The text of a report."""
    result = stemmap(capsys, "report", run, "--out", file, *words)
    assert result.code == 0, result.err
    return file.read_text(encoding="utf-8")


def test_every_language_has_the_same_texts():
    catalogue = tomllib.loads(
        (files("app.extensions.stand.report") / "texts.toml").read_text(encoding="utf-8")
    )
    assert set(catalogue) == {"en", "de"}
    first, *others = catalogue.values()
    for other in others:
        assert list(other) == list(first)
    template = (files("app.extensions.stand.report") / "report.html.j2").read_text(encoding="utf-8")
    assert set(re.findall(r"\bt\.(\w+)", template)) <= set(first)


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_page_is_complete_and_needs_nothing_else(run, tmp_path, capsys, language):
    words = ["--circle", "10,10,5", "--along", "12", "--language", language]
    text = page_of(capsys, run, tmp_path / "r.html", words)
    page = Page(text)
    assert not {"script", "link", "img", "iframe"} & set(page.tags)
    assert page.links == []
    assert "http" not in text.replace("http-equiv", "")
    assert page.tags.count("circle") >= 100
    shown = " ".join(page.texts)
    texts = tomllib.loads((files("app.extensions.stand.report") / "texts.toml").read_text(encoding="utf-8"))[
        language
    ]
    for key in (
        "title",
        "map",
        "scale",
        "plots",
        "distribution",
        "tree_list",
        "method",
        "left_out",
        "health",
    ):
        assert texts[key] in shown
    assert ("2,500" if language == "en" else "2.500") in shown
    assert ("19.00" if language == "en" else "19,00") in shown
    assert f'<html lang="{language}">' in text
    assert not re.search(r"\b(None|nan|inf)\b", shown)


def catalogue_of(language):
    """The texts of a language."""
    text = (files("app.extensions.stand.report") / "texts.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)[language]


def test_every_verdict_and_parameter_of_the_figures_has_its_text():
    english = catalogue_of("en")
    assert {name for name in english if name.startswith("verdict_")} == {
        f"verdict_{verdict.label.replace(' ', '_')}" for verdict in Verdict
    }
    specs = stage_specs("stand", Stand)
    titles = {f"stand_{spec.name.partition('.')[2]}": spec.title for spec in specs}
    assert titles == {name: text for name, text in english.items() if name.startswith("stand_")}
    assert {f"value_{choice}" for spec in specs for choice in spec.choices} <= set(english)
    assert {f"by_{method}" for method in METHODS} <= set(english)


# Words that both languages have besides those of the catalogue: names of source, preset, plots and program.
SHARED = {"stand", "forest", "path", "stemmap", "epsg"}


def test_the_german_report_has_no_english_words(tmp_path, capsys):
    folder = grid_run(tmp_path / "run")
    stemmap(capsys, "georeference", folder, "--by-hand", "500000,5300000,0", "--crs", "EPSG:25832")
    words = ["--circle", "10,10,5", "--along", "12"]
    english, german = (
        Page(page_of(capsys, folder, tmp_path / f"{k}.html", [*words, "--language", k])) for k in ("en", "de")
    )
    texts = [
        {w for text in page.texts[1:] for w in re.findall(r"[^\W\d_]{4,}", text.lower()) if "{" not in text}
        for page in (english, german)
    ]
    known = {w for text in catalogue_of("de").values() for w in re.findall(r"[^\W\d_]{4,}", text.lower())}
    assert texts[0] & texts[1] - known - SHARED == set()


@pytest.mark.parametrize(
    ("dbh", "words", "german"),
    [
        ([0.2], [], "nur 1 Baum: die Kennwerte sind unsicher"),
        ([0.2, 0.3], [], "nur 2 Bäume: die Kennwerte sind unsicher"),
        ([0.2, math.nan], [], "ohne Durchmesser: 1 von 2 Bäumen"),
        ([0.2, 0.3], ["--volume", "dbh_cm*height_m"], "Volumen von 0 von 2 Bäumen: die anderen haben keine"),
        ([0.01] * 3, ["--dbh-min", "0"], "alle Durchmesser sind kleiner als 2 cm"),
        ([4.0], [], "ein Durchmesser ist größer als 3 m"),
        ([0.2], ["--circle", "20,20,5"], "Probefläche 1: nur 25 % der Fläche wurden eingesehen"),
        ([0.2], ["--circle", "1,1,1", "--circle", "9,9,1"], "Probefläche 2: die Fläche hat keine Bäume"),
        (
            [0.2],
            ["--circle", "1,1,1", "--circle", "99,9,1"],
            "Probefläche 2: kein Teil der Fläche wurde eingesehen",
        ),
        ([0.2], ["--circle", "1,1,1", "--circle", "9,9,1"], "weniger als zehn Bäume in allen Probeflächen"),
    ],
)
def test_warnings_are_in_german(tmp_path, capsys, dbh, words, german):
    folder = write_run(tmp_path / "run", [(1.0 + k, 1.0) for k in range(len(dbh))], dbh)
    shown = Page(page_of(capsys, folder, tmp_path / "r.html", [*words, "--language", "de"])).texts
    assert any(text.startswith(german) for text in shown)
    assert not any(re.search(r"\b(figures|trees(?!\.csv)|observed|plot)\b", text) for text in shown)
    assert "auf Englisch" not in " ".join(shown)


def test_parameters_have_titles_and_units(tmp_path, capsys):
    folder = grid_run(tmp_path / "run")
    file = folder / "run.json"
    changed = {"clustering.eps": 0.3, "shape.fit": True, "no.longer": 2}
    file.write_text(json.dumps(json.loads(file.read_text()) | {"changed": changed}))
    words = ["--volume", "0.001*dbh_cm^2", "--dbh-min", "0.075"]
    shown = " ".join(Page(page_of(capsys, folder, tmp_path / "d.html", [*words, "--language", "de"])).texts)
    assert "dbh_min" not in shown
    assert "Kluppschwelle: 7,5 cm" in shown
    assert (
        "Kluppschwelle: 0,075 m; Gemeinsamer BHD-Fehler: 0,005 m; Zählfehler: 0,06; Klassenbreite: 0,04 m; "
        in shown
    )
    assert "Stärkste Bäume: 100 1/ha" in shown
    assert "Korrektur: halbnormal; Volumenformel: 0.001*dbh_cm^2" in shown
    spec = next(spec for spec in field_specs() if spec.name == "clustering.eps")
    assert f"{spec.title} (clustering.eps): 0,3 m" in " ".join(shown.split())
    assert "(no.longer): 2" in shown


def test_dates_pages_units_and_zeros(run, tmp_path, capsys):
    os.utime(run / "run.json", (1714732872, 1714732872))  # noon in Europe
    text = page_of(capsys, run, tmp_path / "r.html", ["--date", "2024-06-01"])
    assert '<td>Mapped</td><td class="words">2024-05-03</td>' in text
    assert '<td>Report</td><td class="words">2024-06-01</td>' in text
    assert "Recorded" not in text
    german = page_of(capsys, run, tmp_path / "g.html", ["--language", "de"])
    assert '<td>Kartierung</td><td class="words">03.05.2024</td>' in german
    today = datetime.date.today().strftime("%d.%m.%Y")
    assert f'content: "Bestandesbericht, {today}"' in german
    assert 'content: "Seite " counter(page) " / " counter(pages)' in german
    for page in (text, german):
        assert "m²/ha" in page
        assert "m2/ha" not in page
        assert not re.search(r"-0[.,]0*\b(?![.,]?\d)", page)


def test_the_date_of_the_recording_is_that_of_its_first_scan(tmp_path, capsys):
    folder = grid_run(tmp_path / "run")
    file = folder / "run.json"
    record = json.loads(file.read_text())
    for recorded, shown in ((recorded_time("pcap", 1714732872 * 10**9)["recorded"], True), ("soon", False)):
        file.write_text(json.dumps(record | {"recorded": recorded}))
        row = '<td>Recorded</td><td class="words">2024-05-03</td>'
        assert (row in page_of(capsys, folder, tmp_path / "r.html")) == shown
    assert recorded_time("simulated run", 1714732872 * 10**9) == recorded_time("pcap", 5 * 10**9) == {}


def test_the_heading_has_names_and_not_the_path_of_the_file(run, tmp_path, capsys):
    uri = json.loads((run / "run.json").read_text())["source"]["uri"]
    words = ["--stand", "Hohe  Warte <3b>", "--client", "Stadt & Forst", "--date", "2026-05-31"]
    text = page_of(capsys, run, tmp_path / "r.html", [*words, "--language", "de"])
    assert "<title>Bestandesbericht: Hohe Warte &lt;3b&gt;</title>" in text
    rows = dict(re.findall(r'<tr><td>([^<]+)</td><td class="words">([^<]*)</td></tr>', text))
    expected = {
        "Bestand": "Hohe Warte &lt;3b&gt;",
        "Auftraggeber": "Stadt &amp; Forst",
        "Bericht": "31.05.2026",
    }
    assert expected.items() <= rows.items()
    assert "Verfasser" not in text, "an empty name is not printed"
    method = text.index("<h2>Verfahren")
    assert uri not in text[:method]
    assert uri in text[method:]
    assert text.index("Ort, Datum") > text.index("<h2>Bäume")
    assert "Unterschrift" in text
    bare = page_of(capsys, run, tmp_path / "b.html")
    assert "<title>Stand report</title>" in bare
    assert not {"Stand", "Client", "Author"} & set(re.findall(r"<td>(\w+)</td>", bare))
    assert "Signature" in bare


def test_a_small_error_is_not_rounded_to_0_and_one_that_is_not_known_is_explained(run, tmp_path, capsys):
    errors = {0.0: 0, 3.0: 0, 0.3: 1, 0.04: 2, 1e-9: 0, math.nan: 0}
    assert {se: _digits(Estimate(1365.6, se)) for se in errors} == errors
    assert _digits(Estimate(5.0, 0.2), 0) == 1
    nothing = page_of(capsys, run, tmp_path / "r.html", ["--dbh-min", "0.9"])
    assert catalogue_of("en")["unknown_error"] in nothing
    assert catalogue_of("en")["unknown_error"] not in page_of(capsys, run, tmp_path / "f.html")


def test_a_report_has_mean_heights_and_their_number_of_trees(run, tmp_path, capsys):
    assert "Loreysche" not in page_of(capsys, run, tmp_path / "none.html", ["--language", "de"])
    cloud = grid_run(tmp_path / "run")
    rows = [line.split(",") for line in (cloud / "trees.csv").read_text().splitlines()]
    columns = [rows[0].index(name) for name in ("height_m", "sigma_height_m")]
    for row in rows[1:91]:
        row[columns[0]], row[columns[1]] = "21.40", "0.30"
    (cloud / "trees.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    words = ["--rectangle", "10,10,10,10", "--language", "de"]
    text = page_of(capsys, cloud, tmp_path / "r.html", words)
    assert "Bäume mit Höhe: 90" in text
    assert "die mittleren Höhen sind die von 90 von 100 Bäumen" in text
    assert re.search(r"<td>Mittlere Höhe hm</td><td>21,4</td><td>0,03</td>", text.replace("21,40", "21,4"))
    head, row = re.findall(r"<tr>(<t[hd]>(?:Fläche|1)<.*)</tr>", text)[:2]
    titles, cells = (re.findall(r"<t[hd]>(.*?)</t[hd]>", line) for line in (head, row))
    assert len(titles) == len(cells)
    assert cells[titles.index("hL m")].startswith("21,4")


def test_plots_have_their_dominant_diameter(tmp_path, capsys):
    run = grid_run(tmp_path / "run")
    rows = (run / "trees.csv").read_text().splitlines()
    column = rows[0].split(",").index("dbh_cm")
    for number, dbh in ((45, "61.5"), (56, "52.5")):  # both in the plot
        cells = rows[number].split(",")
        rows[number] = ",".join((*cells[:column], dbh, *cells[column + 1 :]))
    (run / "trees.csv").write_text("\n".join(rows) + "\n")
    text = page_of(capsys, run, tmp_path / "r.html", ["--rectangle", "10,10,10,10", "--language", "de"])
    head, row = re.findall(r"<tr>(<t[hd]>(?:Fläche|1)<.*)</tr>", text)[:2]
    titles, cells = (re.findall(r"<t[hd]>(.*?)</t[hd]>", line) for line in (head, row))
    assert len(titles) == len(cells)
    assert cells[titles.index("do cm")] == "61,5"  # one tree on 100 m2


def test_the_same_run_gives_the_same_page(run, tmp_path, capsys):
    assert page_of(capsys, run, tmp_path / "a.html") == page_of(capsys, run, tmp_path / "b.html")


def test_the_map_is_drawn_to_scale(run, tmp_path, capsys):
    text = page_of(capsys, run, tmp_path / "r.html")
    circles = np.array(
        re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="([\d.]+)" fill="#1e5b24"/>', text)[:100]
    )
    x = np.unique(circles[:, 0].astype(float))
    per_metre = np.diff(x).mean() / 2.0
    bar = re.search(r"M0 0 V2 H([\d.]+) V0", text)
    length = re.search(r'text-anchor="middle">(\d+) m<', text)
    assert bar is not None
    assert length is not None
    assert float(bar[1]) / float(length[1]) == pytest.approx(per_metre, rel=1e-3)
    scale = re.search(r"1 : ([\d,]+)", text)
    assert scale is not None
    denominator = int(scale[1].replace(",", ""))
    assert denominator == pytest.approx(1000.0 / per_metre, rel=1e-3)
    assert denominator in {100, 125, 200, 250, 300, 400, 500, 750, 1000}, "a scale ruler has it"


def test_the_report_says_where_north_is_only_when_it_is_known(run, tmp_path, capsys):
    assert "the direction of north is unknown" in page_of(capsys, run, tmp_path / "r.html")
    placed = grid_run(tmp_path / "placed")
    stemmap(capsys, "georeference", placed, "--by-hand", "500000,5300000,90", "--crs", "EPSG:25832")
    text = page_of(capsys, placed, tmp_path / "p.html")
    assert "the direction of north is unknown" not in text
    assert "EPSG:25832: by hand" in text
    german = page_of(capsys, placed, tmp_path / "g.html", ["--language", "de"])
    assert "EPSG:25832: von Hand" in german
    assert "499,981.00" in text  # y 19 m of the map points west


def test_names_from_files_cannot_bring_markup(tmp_path, capsys):
    import geopandas
    import shapely

    run = grid_run(tmp_path / "run")
    stemmap(capsys, "georeference", run, "--by-hand", "500000,5300000,0", "--crs", "EPSG:25832")
    file = tmp_path / "plots.gpkg"
    shape = shapely.box(500005, 5300005, 500015, 5300015)
    geopandas.GeoDataFrame({"name": ["<script>x</script>"]}, geometry=[shape], crs=25832).to_file(file)
    text = page_of(capsys, run, tmp_path / "r.html", ["--plots", file])
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_a_run_without_trees_has_a_report(tmp_path, capsys):
    run = write_run(tmp_path / "run", np.zeros((0, 2)), [])
    assert "the plot has no trees" in page_of(capsys, run, tmp_path / "r.html")


def test_numbers_are_those_of_the_language():
    english, german = Numbers(".", ","), Numbers(",", ".")
    assert (english(1234.56, 1), german(1234.56, 1)) == ("1,234.6", "1.234,6")
    assert (english(-0.04, 1), german(-0.06, 1)) == ("0.0", "\N{MINUS SIGN}0,1")
    assert (english.short(7.0), german.short(7.5)) == ("7", "7,5")
    assert english(float("nan")) == english(None) == "\N{EN DASH}"


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--out", "r.txt"], 1, ".html or .pdf"),
        (["--out", "r.html", "--date", "tomorrow"], 2, "'tomorrow' is not a date"),
    ],
)
def test_what_cannot_be_written_is_refused(run, tmp_path, capsys, monkeypatch, words, code, message):
    monkeypatch.chdir(tmp_path)
    stemmap(capsys, "report", run, *words).refused(code, message)


def test_a_pdf_without_a_browser_says_what_to_do(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CHROMIUM", "/nowhere/chrome")
    result = stemmap(capsys, "report", run, "--out", tmp_path / "r.pdf")
    result.refused(1, "/nowhere/chrome is not there", "CHROMIUM=")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.browser
def test_a_pdf_has_pages_and_leaves_nothing_else(run, tmp_path, capsys):
    if not Path(os.environ.get("CHROMIUM", "/usr/bin/chromium")).exists():
        pytest.skip("no Chromium")
    assert find_browser()
    result = stemmap(capsys, "report", run, "--out", tmp_path / "r.pdf", "--language", "de")
    assert result.code == 0, result.err
    content = (tmp_path / "r.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", content)) >= 4
    assert [file.name for file in tmp_path.iterdir()] == ["r.pdf"]


def test_heights_and_residuals_are_listed_where_there_are_any(run, tmp_path, capsys):
    bare = Page(page_of(capsys, run, tmp_path / "bare.html")).texts
    assert not {"Height m", "Residuals of the control points (east, north; cm)"} & set(bare)
    trees = run / "trees.csv"
    header, first, *others = trees.read_text().splitlines()
    cells = dict(zip(header.split(","), first.split(","), strict=True))
    cells.update(height_m="21.40", sigma_height_m="0.30")
    trees.write_text("\n".join([header, ",".join(cells.values()), *others]))
    points = tmp_path / "points.csv"
    points.write_text("tree,x_m,y_m,easting,northing\n,0,0,500000,5300000\n,10,0,500010.02,5300000\n")
    stemmap(capsys, "georeference", run, "--control", points, "--crs", "EPSG:25832")
    shown = Page(page_of(capsys, run, tmp_path / "full.html")).texts
    assert {"Height m", "21.40", "0.30", "1: \N{MINUS SIGN}1.0, 0.0; 2: 1.0, 0.0"} <= set(shown)


def test_references_that_do_not_count_are_named(tmp_path, capsys):
    run = grid_run(tmp_path / "run")
    record = json.loads((run / "run.json").read_text())
    near = np.zeros((1, 2))
    truth = TruthTrees(np.array([1.0, 30.0]), np.zeros(2), np.full(2, 0.3), ("tree", "tree"))
    record["evaluation"] = asdict(evaluate(trees(np.zeros((1, 2))), truth, Parameters().evaluation, near))
    (run / "run.json").write_text(json.dumps(record))
    assert "that do not count, too far from the path (10 m)" in page_of(capsys, run, tmp_path / "a.html")
