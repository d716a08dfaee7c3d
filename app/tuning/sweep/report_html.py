"""The web page of a comparison: one file without scripts or links, every text escaped."""

from __future__ import annotations

from html import escape

from app.common.text import count
from app.common.version import version
from app.tuning.sweep.comparison import SHOWN, Comparison, Row, figure_words
from app.tuning.sweep.grid import shown as value_words
from app.tuning.sweep.grid import words_of
from pipeline.config.model import Value

_STYLE = """
:root { color-scheme: light dark; --line: #8886; --good: #009e73; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.5rem auto; max-width: 84rem; padding: 0 1rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .5rem 0 1.5rem; }
th, td { padding: .2rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { position: sticky; top: 0; background: Canvas; }
th.words, td.words { text-align: left; }
td.best { font-weight: 700; box-shadow: inset 0 -3px var(--good); }
td.failed { text-align: left; white-space: normal; color: #d55e00; }
.wide { overflow-x: auto; }
svg { width: 22rem; max-width: 100%; height: auto; border: 1px solid var(--line); margin: 0 1rem 1rem 0; }
svg text { font: 11px system-ui, sans-serif; fill: CanvasText; }
"""
# Figures whose smallest value is best.
_LEAST = {"FR", "FA", "spurious", "position_rmse_m", "position_bias_m", "mean_pair_error_percent"}


def page(comparison: Comparison) -> str:
    """Return the page as HTML."""
    plan = comparison.plan
    title = f"{count(len(plan.sets), 'set')} of parameters on {count(len(plan.runs), 'run')}"
    parts = [f"<h1>{escape(title)}</h1>", _about(comparison), *_charts(comparison)]
    if len(plan.runs) > 1:
        parts.append(
            "<h2>Means over the runs</h2><p>Counts are summed; other figures are means of the runs.</p>"
        )
        parts.append(_table(comparison, list(comparison.means)))
    for r, run in enumerate(plan.runs):
        parts.append(f"<h2>{escape(run.name)}</h2>")
        parts.append(_table(comparison, [row for row in comparison.rows if row.run == r + 1]))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _about(comparison: Comparison) -> str:
    sets = comparison.plan.sets
    best = "".join(
        f"<li>{escape(goal)}: set {number}, <code>{escape(words_of(sets[number - 1]))}</code></li>"
        if number
        else f"<li>{escape(goal)}: none; all sets are equal or unknown</li>"
        for goal, number in comparison.best.items()
    )
    runs = "".join(
        f"<li>{escape(run.name)}, seed {run.run.source.seed}, "
        f"SHA-256 <code>{escape(run.run.digest[:16])}</code></li>"
        for run in comparison.plan.runs
    )
    failed = comparison.failed
    left = f"<p>{count(len(failed), 'result')} failed, see the tables.</p>" if failed else ""
    return f"<p>stemmap {escape(version())}</p><ul>{runs}</ul>{left}<h2>Best for</h2><ul>{best}</ul>"


def _table(comparison: Comparison, rows: list[Row]) -> str:
    axes = list(comparison.plan.sets[0]) if comparison.plan.sets else []
    heads = "".join(f'<th class="words">{escape(name)}</th>' for name in ["set", *axes])
    heads += "".join(f"<th>{escape(f'{heading} {unit}'.strip())}</th>" for _, heading, unit, _ in SHOWN)
    best = {name: _best(rows, name) for name, _, _, _ in SHOWN}
    body = []
    for row in rows:
        changes = comparison.plan.sets[row.set_number - 1]
        words = [str(row.set_number), *(value_words(changes[axis]) for axis in axes)]
        cells = "".join(f'<td class="words">{escape(word)}</td>' for word in words)
        if row.error:
            cells += f'<td class="failed" colspan="{len(SHOWN)}">{escape(row.error)}</td>'
        else:
            cells += "".join(
                f"<td{_class(row.figures[name] is not None and row.figures[name] == best[name])}>"
                f"{escape(figure_words(row.figures, name, scale))}</td>"
                for name, _, _, scale in SHOWN
            )
        body.append(f"<tr>{cells}</tr>")
    return f'<div class="wide"><table><tr>{heads}</tr>{"".join(body)}</table></div>'


def _class(is_best: bool) -> str:
    return ' class="best"' if is_best else ""


def _best(rows: list[Row], name: str) -> float | None:
    known = [value for row in rows if not row.error and (value := row.figures[name]) is not None]
    if len(rows) < 2 or not known:
        return None
    return min(known) if name in _LEAST else max(known)


def _charts(comparison: Comparison) -> list[str]:
    """F1 over each numeric parameter: the best and the mean of all sets with a value."""
    plan = comparison.plan
    charts = []
    for axis in plan.sets[0] if plan.sets else ():
        points: dict[float, list[float]] = {}
        for mean in comparison.means:
            value: Value = plan.sets[mean.set_number - 1][axis]
            f1 = mean.figures.get("f1")
            if isinstance(value, int | float) and not isinstance(value, bool) and f1 is not None:
                points.setdefault(float(value), []).append(100.0 * f1)
        if len(points) > 1:
            charts.append(_chart(axis, points))
    return ["<h2>F1 by parameter</h2>", *charts] if charts else []


def _chart(axis: str, points: dict[float, list[float]]) -> str:
    xs = sorted(points)
    best = [max(points[x]) for x in xs]
    mean = [sum(points[x]) / len(points[x]) for x in xs]
    low, high = min(mean), max(best)
    low, high = (low - 1.0, high + 1.0) if high - low < 1e-9 else (low, high)

    def at(x: float, y: float) -> str:
        return f"{50 + 280 * (x - xs[0]) / (xs[-1] - xs[0]):.1f},{125 - 100 * (y - low) / (high - low):.1f}"

    best_line = " ".join(at(x, y) for x, y in zip(xs, best, strict=True))
    mean_line = " ".join(at(x, y) for x, y in zip(xs, mean, strict=True))
    dots = "".join(
        '<circle cx="{}" cy="{}" r="3" fill="#009e73"/>'.format(*at(x, y).split(","))
        for x, y in zip(xs, best, strict=True)
    )
    label = escape(f"F1 in % over {axis}: best (line) and mean (dashed) of the sets with each value")
    return (
        f'<svg viewBox="0 0 350 170" role="img" aria-label="{label}"><title>{label}</title>'
        f'<polyline points="{mean_line}" fill="none" stroke="#e69f00" stroke-dasharray="4 3"/>'
        f'<polyline points="{best_line}" fill="none" stroke="#009e73" stroke-width="2"/>{dots}'
        f'<text x="4" y="29">{high:.1f}</text><text x="4" y="129">{low:.1f}</text>'
        f'<text x="50" y="145">{xs[0]:g}</text><text x="330" y="145" text-anchor="end">{xs[-1]:g}</text>'
        f'<text x="190" y="163" text-anchor="middle">{escape(axis)}</text></svg>'
    )
