// Two visits compared: overlaid maps, growth, new, missing and moved trees, scores and parameters.

import { get } from "../../core/api.js";
import { el } from "../../core/dom.js";
import { saveBytes, saveCanvas } from "../../core/download.js";
import { count, figure, fixed, NONE } from "../../core/format.js";
import { treeAt } from "../../map/draw.js";
import { boundsOf } from "../../map/map_canvas.js";
import { put, say, table } from "../../runs/detail.js";
import { mapPicture } from "../../runs/draw.js";
import { FIGURES, SCORES, when } from "../../runs/figures.js";
import { paintTwo } from "./draw_compared.js";

const ORDER = ["moved", "missing", "new", "same", "not seen in a", "not seen in b", "rejected in a", "rejected in b"];
const words = (status) => status.replace(/ [ab]$/, (name) => name.toUpperCase());

export async function showTwo(a, b) {
  say("Comparing the two visits …");
  let both;
  try {
    both = await get(`/api/runs/compare?a=${encodeURIComponent(a)}&b=${encodeURIComponent(b)}`);
  } catch (error) {
    say(error.message);
    return;
  }
  if (!both.aligned) {
    put(null, head(both), figures(both), more(both, null));
    return;
  }
  both.trees = both.rows.map((row) => ({ ...row, x: row.x_m, y: row.y_m, number: row.tree_a ?? row.tree_b, dbh_cm: row.dbh_a_cm ?? row.dbh_b_cm, ellipse: [0, 0, 0] }));
  const { counts } = both.record;
  const together = (status) => counts[`${status} in a`] + counts[`${status} in b`];
  const map = mapPicture({
    label: `Maps of ${both.a.name} and ${both.b.name}, overlaid`,
    legend: [["tree", "in both"], ["only-a", `missing in B (${counts.missing})`], ["only-b", `new in B (${counts.new})`], ["moved", `moved (${counts.moved})`],
      ["grown", `significant growth (${both.record.significant})`], ["outside", `not seen (${together("not seen")}) or rejected (${together("rejected")}) in A or B`], ["path", "path A"], ["path-b", "path B"]],
    paint: (pen, view) => paintTwo(pen, view, both),
    bounds: () => boundsOf(both.trees, both.a.map.path, both.b_path),
    describe: (at, view) => describe(treeAt(both.trees, at, view)),
  });
  put(map, head(both), figures(both), map.box, more(both, map));
}

// Without an alignment, trees are near each other only by chance, so no pairs are shown.
const UNALIGNED = "The two maps do not fit together: they show different places, or share too few trees. No trees are compared.";

const aboutRun = (run) => [when(run.begun_s ?? run.changed_s), run.preset, run.scores && `F1 ${figure(run.scores.f1)}`].filter(Boolean).join(", ");

function head({ a, b, how, aligned, record }) {
  return el("div", { class: "run-head" },
    el("h2", {}, el("span", { text: `A: ${a.name}` }), el("span", { text: `B: ${b.name}` })),
    el("p", { class: "dim", text: `A ${aboutRun(a)} · B ${aboutRun(b)}${aligned ? ` · frames: ${how}` : ""}` }),
    ...(aligned ? record.warnings : [UNALIGNED]).map((text) => el("p", { class: "error", role: "alert", text })));
}

const signed = (value, digits = 2) => `${value > 0 ? "+" : ""}${fixed(value, digits)}`;

function figures({ record, aligned }) {
  const { counts } = record;
  if (!aligned) return figureBoxes([["trees of A", record.trees_a], ["trees of B", record.trees_b]]);
  const growth = record.growth_mean_cm === null ? NONE : `${signed(record.growth_mean_cm)}${record.growth_se_cm === null ? "" : ` ± ${fixed(record.growth_se_cm, 2)}`} cm`;
  return figureBoxes([["in both", record.pairs], ["mean growth of DBH", growth], ["significant growth", record.significant], ["new in B", counts.new], ["missing in B", counts.missing],
    ["moved", counts.moved], ["RMS of the shifts", record.shift_rms_m === null ? NONE : `${figure(100 * record.shift_rms_m)} cm`]]);
}

function figureBoxes(boxes) {
  return el("dl", { class: "run-figures", id: "compare-figures" }, ...boxes.map(([name, text]) => el("div", {}, el("dt", { text: name }), el("dd", { text: String(text) }))));
}

const growthText = (row) => (row.growth_cm === null ? NONE : `${signed(row.growth_cm)} ± ${fixed(row.sigma_growth_cm, 2)}`);

function describe(row) {
  if (!row) return "";
  const numbers = [["A", row.tree_a], ["B", row.tree_b]].filter(([, number]) => number !== null).map(([name, number]) => `${name} ${number}`).join(", ");
  const growth = row.growth_cm === null ? "" : `\nDBH ${growthText(row)} cm${row.significant ? ", significant" : ""}`;
  return `${numbers}: ${words(row.status)}${row.shift_m === null ? "" : `, ${figure(100 * row.shift_m)} cm apart`}${growth}`;
}

const COLUMNS = [["A", (row) => String(row.tree_a ?? NONE)], ["B", (row) => String(row.tree_b ?? NONE)], ["status", (row) => words(row.status)],
  ["shift cm", (row) => (row.shift_m === null ? NONE : figure(100 * row.shift_m))], ["DBH A cm", (row) => fixed(row.dbh_a_cm, 1)], ["DBH B cm", (row) => fixed(row.dbh_b_cm, 1)],
  ["growth cm", growthText], ["", (row) => (row.significant ? "significant" : "")]];

function more(both, map) {
  const { a, b } = both;
  const scores = [...FIGURES.slice(0, -1).map(([name, text]) => [name, text(a), text(b)]),
    ...SCORES.map(([name, text]) => [name, a.scores ? text(a.scores) : NONE, b.scores ? text(b.scores) : NONE])];
  const rows = [...both.rows].sort((one, other) => ORDER.indexOf(one.status) - ORDER.indexOf(other.status) || (other.growth_cm ?? -Infinity) - (one.growth_cm ?? -Infinity));
  const trees = map ? [
    el("div", { class: "row" },
      el("button", { class: "small", text: "Map as PNG", onclick: () => saveCanvas("comparison.png", map.canvas) }),
      el("button", { class: "small", text: "Trees as CSV", onclick: () => saveBytes("comparison.csv", both.csv) })),
    el("details", { open: true }, el("summary", { text: `${count(rows.length, "tree")}: growth with its standard deviation, new, missing and moved trees` }),
      table(COLUMNS.map(([name]) => name), rows.map((row) => COLUMNS.map(([, text]) => text(row))), [0, 1, 3, 4, 5, 6])),
    el("p", { class: "note", text: "A tree is new or missing only where the other visit looked. Growth is marked so that at most 5 % of the marks are expected to be false." })] : [];
  return el("div", { class: "run-more" }, ...trees,
    el("div", {}, el("h3", { text: "Scores side by side" }), table(["", "A", "B"], scores, [1, 2])),
    el("div", {}, el("h3", { text: "Parameters that differ" }), both.parameters.length
      ? table(["parameter", "A", "B"], both.parameters.map(({ name, a: before, b: after }) => [name, String(before ?? NONE), String(after ?? NONE)]))
      : el("p", { class: "note", text: "None." })));
}
