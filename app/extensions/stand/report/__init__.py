"""The report of a finished run: one self-contained HTML page with print style, or PDF."""

from __future__ import annotations

import datetime
import functools
import math
import os
import re
import shutil
import subprocess
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from app.batch.map_frame import MapFrame
from app.common.text import version
from app.extensions.stand.figures import FIGURES, Estimate, PlotTrees
from app.extensions.stand.gis_files import PlottedRun, read_with_plots
from app.extensions.stand.heading import Heading
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plots import SamplePlot
from app.extensions.stand.run_figures import StandResult, stand_of
from pipeline.config.model import field_specs, stage_specs
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.atomic_files import write_beside

SUFFIXES = (".html", ".pdf")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_PDF_SECONDS = 120.0
_LABELS_MAX = 400  # trees with a number on the map
_PATH_POINTS = 2000


@functools.cache
def _catalogue() -> dict[str, dict[str, str]]:
    """Return the content of texts.toml: a dict from each language to a dict from keys to texts."""
    return tomllib.loads((files(__package__) / "texts.toml").read_text(encoding="utf-8"))


def texts_of(language: str) -> dict[str, str]:
    """Return a dict from the keys in texts.toml to the texts of a language.

    Raises:
        StemmapError: The language is unknown.
    """
    catalogue = _catalogue()
    if language not in catalogue:
        raise StemmapError(f"there is no language {language!r}", remedy=f"Languages: {', '.join(catalogue)}")
    return dict(catalogue[language])


def translated(message: str, texts: dict[str, str]) -> str:
    """Return a warning about stand parameters in a language; unchanged if it is not in the catalogue.

    Args:
        message: The warning, in English.
        texts: Dict from keys to texts of the language, see `texts_of`.
    """
    for key, english in texts_of("en").items():
        if not key.startswith("warning_"):
            continue
        pattern = re.sub(r"\\{(\w+)\\}", r"(?P<\1>.+?)", re.escape(english))
        if found := re.fullmatch(pattern, message):
            values = found.groupdict()
            if "text" in values:  # the warning about a plot, whose name may contain a colon
                words = f"{values['name']}: {values['text']}".split(": ")
                for k in range(1, len(words)):
                    rest = ": ".join(words[k:])
                    if (text := translated(rest, texts)) != rest:
                        values = {"name": ": ".join(words[:k]), "text": text}
                        break
            return texts[key].format(**values)
    return message


MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True, slots=True)
class Numbers:
    """Numbers as texts of a language, with a true minus sign: decimal point and group separator."""

    point: str
    group: str

    def __call__(self, value: float | None, digits: int = 1) -> str:
        """Return a number with `digits` decimals and group separators; a dash for None, NaN and infinity."""
        if value is None or not math.isfinite(value):
            return "\N{EN DASH}"
        text = f"{value:z,.{digits}f}"  # without a sign of zero
        text = text.replace(",", "\0").replace(".", self.point).replace("\0", self.group)
        return text.replace("-", MINUS)

    def short(self, value: float) -> str:
        """Return a finite number with at most six significant digits and no zeros at its end, without group
        separators; in exponent form from a million on and, except for 0, below 0.0001."""
        return f"{value:.6g}".replace(".", self.point).replace("-", MINUS)


def report_page(
    folder: FilePath,
    *,
    language: str = "en",
    plots: Sequence[SamplePlot] = (),
    parameters: Stand | None = None,
    heading: Heading | None = None,
    date: datetime.date | None = None,
) -> str:
    """Return the report of a run as the text of one HTML file without scripts or links. Nothing is written.

    Args:
        folder: Folder of the run.
        language: A language of texts.toml: "en" or "de".
        plots: Plots in the frame of the map; without any, only the whole observed area is reported.
        parameters: Parameters of the stand figures; None for the defaults.
        heading: Stand, client and author; None for none.
        date: Date of the report; None for today.

    Raises:
        StemmapError: The language is unknown, a file of the run is missing or damaged, or stand figures are
            not possible, see `stand_of`.
    """
    from jinja2 import Environment, PackageLoader

    texts = texts_of(language)
    parameters = parameters or Stand()
    whole = stand_of(folder, parameters)
    of_plots = stand_of(folder, parameters, plots) if plots else None
    run, record = read_with_plots(folder, of_plots), whole.run.record
    number = Numbers(texts["point"], texts["group"])
    environment = Environment(
        loader=PackageLoader("app.extensions.stand.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    figures = whole.figures["all"]
    warnings = [*whole.warnings]
    if of_plots is not None:
        warnings += [text for text in of_plots.warnings if text not in warnings]
    return environment.get_template("report.html.j2").render(
        t=texts,
        language=language,
        number=number,
        digits=_digits,
        version=version(),
        heading=heading or Heading(),
        date=(date or datetime.date.today()).strftime(texts["date"]),
        record=record,
        run=run,
        whole=whole,
        infinity=math.inf,
        figures=figures,
        trees_in_map=len(whole.run.trees.number) + len(whole.run.rejected.number),
        trees_added=len(run.added),
        no_error=any(
            math.isnan(f.values["n_ha"].se) and f.seen > 0.0
            for result in (whole, of_plots)
            for f in (result.figures.values() if result else ())
        ),
        figure_names=list(FIGURES),
        units={name: squared(unit) for name, (_, unit) in FIGURES.items()},
        of_plots=of_plots,
        map=stand_map(run, whole, plots, texts, number),
        histogram=histogram(whole, texts, number),
        trees=tree_rows(run, whole.trees, texts, number),
        with_heights=bool(np.isfinite(run.columns["height_m"]).any()),
        warnings=[translated(text, texts) for text in warnings],
        messages=record.get("warnings", []),
        verdicts={k: v for k, v in record.get("verdicts", {}).items() if k != "tree"},
        parameters=parameters,
        figure_parameters=figure_parameters(parameters, texts, number),
        changed=changed_parameters(record.get("changed") or {}, number),
        georeference=georeference_words(whole.frame, texts, number),
        frame_name=whole.frame.title if whole.frame.crs else texts["local_frame"],
        map_date=map_date(folder).strftime(texts["date"]),
        recorded=recorded_date(record, texts["date"]),
    )


def map_date(folder: FilePath) -> datetime.date:
    """Return the date, in local time, at which run.json of a run was modified last; OSError without this
    file. Copies by `reviewed_run` keep it."""
    return datetime.datetime.fromtimestamp((folder / "run.json").stat().st_mtime).astimezone().date()


def recorded_date(record: Mapping[str, Any], form: str) -> str:
    """Return the date of the first scan (UTC) as text; "" if run.json does not have a readable one.

    Args:
        record: The contents of run.json.
        form: Format of the date, for strftime.
    """
    try:
        return datetime.datetime.fromisoformat(str(record.get("recorded"))).strftime(form)
    except ValueError:
        return ""


def squared(unit: str) -> str:
    """Return a unit with superscript digits: "m²/ha" for "m2/ha"."""
    return unit.replace("m2", "m²").replace("m3", "m³")


def figure_parameters(parameters: Stand, texts: dict[str, str], number: Numbers) -> list[tuple[str, str]]:
    """Return title and value with its unit of each parameter of the stand figures, in the language of
    `texts`; a volume formula that is empty is left out."""
    rows = []
    for spec in stage_specs("stand", Stand):
        name = spec.name.partition(".")[2]
        value = getattr(parameters, name)
        if spec.kind == "choice":
            text = texts[f"value_{value}"]
        else:
            text = value if isinstance(value, str) else f"{number.short(value)} {spec.unit}".strip()
        if text:
            rows.append((texts[f"stand_{name}"], text))
    return rows


def changed_parameters(changed: Mapping[str, Any], number: Numbers) -> list[tuple[str, str, str]]:
    """Return title, dotted name and value with its unit of parameters of the mapping. The titles are in
    English, as they are declared; one that this version does not have has the title "".

    Args:
        changed: Dict from dotted names to values.
        number: Format of the language.
    """
    specs = {spec.name: spec for spec in field_specs()}
    rows = []
    for name, value in changed.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        spec = specs.get(name)
        text = number.short(value) if is_number else str(value)
        rows.append((spec.title if spec else "", name, f"{text} {spec.unit if spec else ''}".strip()))
    return rows


def georeference_words(frame: MapFrame, texts: dict[str, str], number: Numbers) -> str:
    """Return how a map was placed in its reference system, in the language of `texts`; a frame of an earlier
    version may have only an English text. Without a reference system it is the text "nothing".

    Args:
        frame: The frame of the map.
        texts: Texts of the language.
        number: Format of the language.
    """
    if not frame.crs:
        return texts["nothing"]
    values = {
        name: number(value, 0 if name in ("points", "fixes") else 3) for name, value in frame.numbers.items()
    }
    words = texts[f"by_{frame.method or 'source'}"].format(**values)
    sigma = f"; {texts['frame_sigma']} ± {number(frame.sigma, 3)} m" if math.isfinite(frame.sigma) else ""
    return f"{frame.title}: {words}{sigma}"


def _digits(estimate: Estimate, least: int | None = None) -> int:
    """Return the number of decimals of an estimate and its standard error. It is `least`, or more, up to 3,
    if the standard error would be rounded to 0. The default of `least` is 0 for values of 100 or more and
    values that are not finite, 1 for values of 10 or more, else 2."""
    size = abs(estimate.value)
    if least is None:
        least = 0 if not math.isfinite(size) or size >= 100 else 1 if size >= 10 else 2
    if not math.isfinite(size + estimate.se):
        return least
    return next((d for d in range(least, 4) if round(estimate.se, d) > 0.0), least)


def tree_rows(run: PlottedRun, trees: PlotTrees, texts: dict[str, str], number: Numbers) -> list[list[str]]:
    """Return the trees as cells: number or name, two coordinates [m], diameter and its sigma [cm], height and
    its sigma [m] if any height is known, observations, coverage [deg], state of the review; a dash for
    unknown values. Numbers have the decimals of trees.csv, as on the page. Trees that people added come last.

    Args:
        run: The run, in the coordinates of its files.
        trees: Its trees with the diameters of the figures, see `counted_trees`.
        texts: Texts of the language.
        number: Format of the language.
    """
    c = run.columns
    heights = ("height_m", "sigma_height_m") if np.isfinite(c["height_m"]).any() else ()
    places, names = np.concatenate([run.place, run.added]), run.added_columns["name"]
    rows = []
    for k, (x, y) in enumerate(places.tolist()):
        row = [number(x, 3), number(y, 3)]
        row += [number(100.0 * float(value), 1) for value in (trees.dbh[k], trees.dbh_sigma[k])]
        taped = trees.by_tape is not None and trees.by_tape[k]
        tape = f", {texts['by_tape']}" if taped else ""
        if k < len(run.place):
            row = [str(c["tree"][k]), *row, *(number(float(c[name][k]), 2) for name in heights)]
            row += [str(c["observations"][k]), number(float(c["coverage_deg"][k]), 0)]
            row.append(texts[str(c["review"][k])] + tape)
        else:
            name = str(names[k - len(run.place)])
            row = [name, *row, *[number(None)] * (len(heights) + 2), texts["added"] + tape]
        rows.append(row)
    return rows


def _step(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most a length above 0."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length * (1 + 1e-9))


def _map_scale(least: float) -> float:
    """Return the denominator of a map scale that scale rulers have: the smallest of 1, 1.25, 2, 2.5, 3, 4, 5
    and 7.5 times a power of ten that is at least `least` > 0."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(k * power for k in (1.0, 1.25, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5, 10.0) if k * power >= least)


def stand_map(
    run: PlottedRun, whole: StandResult, plots: Sequence[SamplePlot], texts: dict[str, str], number: Numbers
) -> dict[str, Any]:
    """Return the elements of the map as a dict for the template. Lengths are in millimetres of a page; north
    (or y) is at the top, and y coordinates count downwards.

    Args:
        run: The run, in the coordinates of its files.
        whole: Stand figures of the whole observed area.
        plots: Plots in the frame of the map.
        texts: Texts of the language.
        number: Format of the language.

    Returns:
        A dict with `width` and `height`; `seen` and `path`, SVG path data (`path` is "" for a whole cloud);
        `plots`, a list of (name, path data, x and y of the name); `trees`, a list of (x, y, radius, number or
        name, whether the diameter is known), where numbers are "" if there are more than 400 trees, and an
        unknown diameter is rendered as 15 cm; the scale bar, `bar` (length) and `bar_text`; `scale` as text,
        such as "1 : 200"; and `up`, the word at the axis that points up.
    """
    import shapely

    seen = shapely.transform(whole.plots[0].shape, run.frame.to_crs)
    shapes = [shapely.transform(plot.shape, run.frame.to_crs) for plot in plots]
    place = np.concatenate([run.place, run.added])
    points = [place, run.path, np.reshape(seen.bounds, (2, 2))]
    points += [np.reshape(shape.bounds, (2, 2)) for shape in shapes]
    every = np.concatenate([np.reshape(p, (-1, 2)) for p in points])
    low, high = every.min(axis=0) - 1.0, every.max(axis=0) + 1.0
    size = high - low
    scale = 1000.0 / _map_scale(max(size[0] / 0.18, size[1] / 0.19))  # mm per metre
    thin = run.path[:: max(1, len(run.path) // _PATH_POINTS)]

    def paper(xy: Float) -> Float:
        place: Float = (np.reshape(xy, (-1, 2)) - low) * [scale, -scale] + [0.0, size[1] * scale]
        return place

    def data(rings: Sequence[Float], *, close: bool) -> str:
        parts = []
        for ring in rings:
            place = " L".join(f"{x:.2f} {y:.2f}" for x, y in paper(ring).tolist())
            parts.append(f"M{place}{'Z' if close else ''}")
        return " ".join(parts)

    def rings(shape: Any) -> list[Float]:  # noqa: ANN401 - a shapely polygon
        return [
            np.array(ring.coords)
            for part in getattr(shape, "geoms", [shape])
            for ring in (part.exterior, *part.interiors)
        ]

    labels = [str(n) if len(run.place) <= _LABELS_MAX else "" for n in run.columns["tree"]]
    dbh = np.nan_to_num(whole.trees.dbh, nan=0.15)
    radius = np.maximum(0.7, 0.5 * dbh * scale)
    bar = _step(min(50.0 / scale, 0.3 * size[0]))
    return {
        "width": round(size[0] * scale, 2),
        "height": round(size[1] * scale, 2),
        "seen": data(rings(seen), close=True),
        "path": data([thin], close=False) if len(thin) > 1 else "",
        "plots": [
            (plot.name, data(rings(shape), close=True), *paper(np.array(shape.centroid.coords))[0].tolist())
            for plot, shape in zip(plots, shapes, strict=True)
        ],
        "trees": [
            (x, y, r, label, known)
            for (x, y), r, label, known in zip(
                paper(place).tolist(),
                radius.tolist(),
                [*labels, *run.added_columns["name"].tolist()],
                np.isfinite(whole.trees.dbh).tolist(),
                strict=True,
            )
        ],
        "bar": bar * scale,
        "bar_text": f"{number(bar, 0 if bar >= 1 else 1)} m",
        "scale": f"1 : {number(1000.0 / scale, 0 if scale <= 20.0 else 2)}",
        "up": texts["north"] if run.frame.crs else "y",
    }


def histogram(whole: StandResult, texts: dict[str, str], number: Numbers) -> dict[str, Any]:
    """Return the content of the histogram of the diameter classes as a dict for the template.

    Coordinates are in mm, y downwards. Keys: `width` and `height` of the drawing; `bars` (stems per hectare),
    a list of dicts, empty if there are no classes, with `x`, `y`, `width`, `height`, `middle` (x), `edge` (x
    of the lower limit of the class), `high` and `low` (y of plus and minus one standard error, at least 0)
    and `label`, the lower limit of the class [cm] as text; `last`, the upper limit of the last class, "" if
    there is none; `marks` of the axis, a list of (y, text); and `title`.

    Args:
        whole: Stand figures of the whole observed area.
        texts: Texts of the language.
        number: Format of the language.
    """
    classes = whole.figures["all"].classes
    width, height = 170.0, 60.0
    errors = np.nan_to_num([c.n_ha.se for c in classes]).tolist()  # no bar for an unknown one
    top = max((c.n_ha.value + se for c, se in zip(classes, errors, strict=True)), default=0.0)
    step = _step(max(top, 1e-9) / 3.0)
    top = max(math.ceil(top / step), 1) * step
    each = width / max(len(classes), 1)
    bars = [
        {
            "x": k * each + 0.1 * each,
            "middle": (k + 0.5) * each,
            "y": height * (1.0 - c.n_ha.value / top),
            "width": 0.8 * each,
            "height": height * c.n_ha.value / top,
            "high": height * (1.0 - (c.n_ha.value + se) / top),
            "low": height * (1.0 - max(c.n_ha.value - se, 0.0) / top),
            "label": number.short(c.low),
            "edge": k * each,
        }
        for k, (c, se) in enumerate(zip(classes, errors, strict=True))
    ]
    marks = [(height * (1.0 - v / top), number(v, 0)) for v in np.arange(0.0, top + 0.5 * step, step)]
    last = number.short(classes[-1].high) if classes else ""
    return {
        "bars": bars,
        "marks": marks,
        "width": width,
        "height": height,
        "last": last,
        "title": texts["n_ha"],
    }


def write_report(page: str, file: FilePath) -> None:
    """Write a report as HTML, or as PDF by a Chromium of this machine, in place of an existing file. A PDF
    takes at most two minutes.

    Args:
        page: HTML of the report.
        file: File .html or .pdf; its folder must exist.

    Raises:
        StemmapError: The suffix is another one, an HTML file cannot be written, there is no Chromium, or
            Chromium failed.
        OSError: A PDF cannot be written.
    """
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise StemmapError(f"{file.name!r} is no .html or .pdf file")
    if suffix == ".html":
        with write_beside(file) as partial:
            partial.write_text(page, encoding="utf-8", newline="")
        return
    browser = find_browser()
    with TemporaryDirectory(prefix=".report-", dir=file.parent) as folder:
        html, pdf = FilePath(folder) / "report.html", FilePath(folder) / "report.pdf"
        html.write_text(page, encoding="utf-8", newline="")
        words = [browser, "--headless=new", "--disable-gpu", "--no-first-run", "--disable-sync",
                 "--disable-background-networking", "--disable-component-update", "--no-pdf-header-footer",
                 "--disable-javascript", f"--user-data-dir={folder}/profile",
                 f"--print-to-pdf={pdf.resolve()}", html.resolve().as_uri()]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            words.insert(1, "--no-sandbox")  # Chromium refuses to start as root otherwise; the page is ours
        try:
            subprocess.run(words, capture_output=True, timeout=_PDF_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise StemmapError(
                f"the browser could not print the report: {error}", where=browser, remedy="Write .html"
            ) from None
        if not pdf.is_file():
            raise StemmapError(
                "the browser printed no PDF", where=browser, remedy="Write .html and print it yourself"
            )
        os.replace(pdf, file)  # noqa: PTH105


def find_browser() -> str:
    """Return the path of a Chromium or Chrome: the environment variable CHROMIUM, a path or a name on the
    PATH, else the first of `_BROWSERS` on the PATH. It is not started.

    Raises:
        StemmapError: There is none.
    """
    named = os.environ.get("CHROMIUM")
    for name in (named,) if named else _BROWSERS:
        found = shutil.which(name)
        if found:
            return found
    raise StemmapError(
        "a PDF needs Chromium or Chrome" + (f", and {named} is not there" if named else ""),
        remedy="Install one, name it with CHROMIUM=/path/to/chrome, or write .html and print it",
    )
