// Two runs beside one another: maps overlaid, trees that appeared, vanished or moved, scores and parameters.

import { request } from "../core/api.js";
import { el } from "../core/dom.js";
import { saveCanvas, saveCsv } from "../core/download.js";
import { count, figure, NONE } from "../core/format.js";
import { put, say, table } from "./detail.js";
import { nearest, paintTwo, treeWords } from "./draw.js";
import { FIGURES, SCORES, when } from "./figures.js";
import { boundsOf, picture } from "./picture.js";

export async function showTwo(a, b) {
  say("Comparing the two runs …");
  let told;
  try {
    told = await request(`/api/runs/compare?a=${encodeURIComponent(a)}&b=${encodeURIComponent(b)}`);
  } catch (error) {
    say(error.message);
    return;
  }
  const trees = [...told.a.map.trees, ...told.b_trees];
  const map = picture({
    label: `Maps of ${told.a.name} and ${told.b.name}, one upon the other`,
    legend: [["tree", "in both"], ["only-a", `only in A (${told.only_a.length})`], ["only-b", `only in B (${told.only_b.length})`], ["moved", `moved (${told.moved})`], ["path", "path A"], ["path-b", "path B"]],
    paint: (pen, view, colours) => paintTwo(pen, view, told, colours),
    bounds: () => boundsOf(trees, told.a.map.path, told.b_path),
    describe: (px, py, view) => describe(told, px, py, view),
  });
  put(map, head(told), figures(told), map.box, more(told, map));
}

function head({ a, b, how }) {
  return el("div", { class: "run-head" },
    el("h2", {}, el("span", { text: `A: ${a.name}` }), el("span", { text: `B: ${b.name}` })),
    el("p", { class: "dim", text: `A ${when(a.begun_s ?? a.changed_s)} · B ${when(b.begun_s ?? b.changed_s)} · frames: ${how}` }));
}

function figures(told) {
  const boxes = [["in both", told.pairs.length], ["only in A (vanished)", told.only_a.length], ["only in B (appeared)", told.only_b.length],
    [`moved more than ${100 * told.moved_m} cm`, told.moved], ["RMS of the shifts", told.shift_rms_m === null ? NONE : `${figure(100 * told.shift_rms_m)} cm`]];
  return el("dl", { class: "run-figures", id: "compare-figures" }, ...boxes.map(([name, text]) => el("div", {}, el("dt", { text: name }), el("dd", { text: String(text) }))));
}

function describe(told, px, py, view) {
  const a = nearest(told.a.map.trees, px, py, view);
  const b = nearest(told.b_trees, px, py, view);
  if (!a && !b) return "";
  const pair = told.pairs.find((each) => each.a === a?.number || (!a && each.b === b.number));
  if (!pair) return a ? `Only in A. ${treeWords(a)}` : `Only in B. ${treeWords(b)}`;
  return `A ${pair.a}, B ${pair.b}: ${figure(100 * pair.shift_m)} cm apart${pair.dbh_cm === null ? "" : `, DBH ${pair.dbh_cm > 0 ? "+" : ""}${figure(pair.dbh_cm)} cm`}`;
}

function more(told, map) {
  const { a, b } = told;
  const scores = [...FIGURES.slice(0, 3).map(([name, text]) => [name, text(a), text(b)]),
    ...SCORES.map(([name, text]) => [name, a.scores ? text(a.scores) : NONE, b.scores ? text(b.scores) : NONE])];
  const rows = pairRows(told);
  return el("div", { class: "run-more" },
    el("div", { class: "row" },
      el("button", { class: "small", text: "Map as PNG", onclick: () => saveCanvas("compared.png", map.canvas) }),
      el("button", { class: "small", text: "Trees as CSV", onclick: () => saveCsv("compared.csv", [["tree_a", "tree_b", "shift_m", "dbh_change_cm", "is"], ...rows]) })),
    el("div", {}, el("h3", { text: "Scores side by side" }), table(["", "A", "B"], scores, [1, 2])),
    el("div", {}, el("h3", { text: "Parameters that differ" }), told.parameters.length
      ? table(["parameter", "A", "B"], told.parameters.map(({ name, a: before, b: after }) => [name, String(before ?? NONE), String(after ?? NONE)]))
      : el("p", { class: "note", text: "None." })),
    el("details", { open: rows.length < 40 }, el("summary", { text: count(rows.length, "tree") }),
      table(["A", "B", "shift cm", "DBH change cm", ""], rows.map(([x, y, shift, dbh, is]) => [x ?? NONE, y ?? NONE, shift === null ? NONE : figure(100 * shift), dbh === null ? NONE : figure(dbh), is]), [0, 1, 2, 3])));
}

function pairRows({ pairs, only_a: gone, only_b: come }) {
  return [...gone.map((number) => [number, null, null, null, "vanished"]), ...come.map((number) => [null, number, null, null, "appeared"]),
    ...pairs.map((pair) => [pair.a, pair.b, pair.shift_m, pair.dbh_cm, pair.moved ? "moved" : "same"])];
}
