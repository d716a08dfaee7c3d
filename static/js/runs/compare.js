// Two runs compared: overlaid maps, trees that appeared, vanished or moved, scores and parameters.

import { get } from "../core/api.js";
import { el } from "../core/dom.js";
import { saveCanvas, saveCsv } from "../core/download.js";
import { count, figure, NONE } from "../core/format.js";
import { treeAt } from "../map/draw.js";
import { boundsOf } from "../map/map_canvas.js";
import { put, say, table } from "./detail.js";
import { mapPicture, paintTwo, treeText } from "./draw.js";
import { FIGURES, SCORES, when } from "./figures.js";

export async function showTwo(a, b) {
  say("Comparing the two runs …");
  let both;
  try {
    both = await get(`/api/runs/compare?a=${encodeURIComponent(a)}&b=${encodeURIComponent(b)}`);
  } catch (error) {
    say(error.message);
    return;
  }
  const trees = [...both.a.map.trees, ...both.b_trees];
  const map = mapPicture({
    label: `Maps of ${both.a.name} and ${both.b.name}, overlaid`,
    legend: [["tree", "in both"], ["only-a", `only in A (${both.only_a.length})`], ["only-b", `only in B (${both.only_b.length})`], ["moved", `moved (${both.moved})`], ["path", "path A"], ["path-b", "path B"]],
    paint: (pen, view) => paintTwo(pen, view, both),
    bounds: () => boundsOf(trees, both.a.map.path, both.b_path),
    describe: (at, view) => describe(both, at, view),
  });
  put(map, head(both), figures(both), map.box, more(both, map));
}

function head({ a, b, how }) {
  return el("div", { class: "run-head" },
    el("h2", {}, el("span", { text: `A: ${a.name}` }), el("span", { text: `B: ${b.name}` })),
    el("p", { class: "dim", text: `A ${when(a.begun_s ?? a.changed_s)} · B ${when(b.begun_s ?? b.changed_s)} · frames: ${how}` }));
}

function figures(both) {
  const boxes = [["in both", both.pairs.length], ["only in A (vanished)", both.only_a.length], ["only in B (appeared)", both.only_b.length],
    [`moved more than ${100 * both.moved_m} cm`, both.moved], ["RMS of the shifts", both.shift_rms_m === null ? NONE : `${figure(100 * both.shift_rms_m)} cm`]];
  return el("dl", { class: "run-figures", id: "compare-figures" }, ...boxes.map(([name, text]) => el("div", {}, el("dt", { text: name }), el("dd", { text: String(text) }))));
}

function describe(both, at, view) {
  const a = treeAt(both.a.map.trees, at, view), b = treeAt(both.b_trees, at, view);
  if (!a && !b) return "";
  const pair = both.pairs.find((each) => each.a === a?.number || (!a && each.b === b.number));
  if (!pair) return a ? `Only in A. ${treeText(a)}` : `Only in B. ${treeText(b)}`;
  return `A ${pair.a}, B ${pair.b}: ${figure(100 * pair.shift_m)} cm apart${pair.dbh_cm === null ? "" : `, DBH ${pair.dbh_cm > 0 ? "+" : ""}${figure(pair.dbh_cm)} cm`}`;
}

function more(both, map) {
  const { a, b } = both;
  const scores = [...FIGURES.slice(0, 3).map(([name, text]) => [name, text(a), text(b)]),
    ...SCORES.map(([name, text]) => [name, a.scores ? text(a.scores) : NONE, b.scores ? text(b.scores) : NONE])];
  const rows = pairRows(both);
  return el("div", { class: "run-more" },
    el("div", { class: "row" },
      el("button", { class: "small", text: "Map as PNG", onclick: () => saveCanvas("compared.png", map.canvas) }),
      el("button", { class: "small", text: "Trees as CSV", onclick: () => saveCsv("compared.csv", [["tree_a", "tree_b", "shift_m", "dbh_change_cm", "is"], ...rows]) })),
    el("div", {}, el("h3", { text: "Scores side by side" }), table(["", "A", "B"], scores, [1, 2])),
    el("div", {}, el("h3", { text: "Parameters that differ" }), both.parameters.length
      ? table(["parameter", "A", "B"], both.parameters.map(({ name, a: before, b: after }) => [name, String(before ?? NONE), String(after ?? NONE)]))
      : el("p", { class: "note", text: "None." })),
    el("details", { open: rows.length < 40 }, el("summary", { text: count(rows.length, "tree") }),
      table(["A", "B", "shift cm", "DBH change cm", ""], rows.map(([x, y, shift, dbh, is]) => [x ?? NONE, y ?? NONE, shift === null ? NONE : figure(100 * shift), dbh === null ? NONE : figure(dbh), is]), [0, 1, 2, 3])));
}

function pairRows({ pairs, only_a: gone, only_b: come }) {
  return [...gone.map((number) => [number, null, null, null, "vanished"]), ...come.map((number) => [null, number, null, null, "appeared"]),
    ...pairs.map((pair) => [pair.a, pair.b, pair.shift_m, pair.dbh_cm, pair.moved ? "moved" : "same"])];
}
