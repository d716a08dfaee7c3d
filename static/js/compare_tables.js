// The comparison in numbers: clusters by verdict, trees that only one set finds, and what the sets differ in.

import { byId, el } from "./dom.js";
import { shown, specOf } from "./tune.js";
import { verdictOf } from "./verdicts.js";

const SAME_PLACE = 0.5; // [m] between two detections of one tree

export function fillComparison({ pictures, differences }, nameA, nameB) {
  const [a, b] = pictures;
  byId("compare-tables").replaceChildren(verdictTable(a, b), differenceTable(differences, nameA, nameB));
}

const row = (name, a, b, cls = "") => el("tr", { class: `${cls} ${a === b ? "" : "differs"}`.trim(), "data-row": name },
  el("th", { scope: "row", text: name }), el("td", { text: String(a) }), el("td", { text: String(b) }), el("td", { text: a === b ? "" : b > a ? `+${b - a}` : `−${a - b}` }));

const head = (...titles) => el("thead", {}, el("tr", {}, ...titles.map((text) => el("th", { scope: "col", text }))));

function verdictTable(a, b) {
  const names = [...new Set(["tree", ...Object.keys(a.verdicts), ...Object.keys(b.verdicts)])];
  const [onlyA, both, onlyB] = sharedTrees(a.clusters, b.clusters);
  const rows = names.map((name) => {
    const line = row(name, a.verdicts[name] ?? 0, b.verdicts[name] ?? 0);
    const [letter, meaning] = verdictOf(name);
    line.cells[0].prepend(el("span", { class: "letter", text: letter, style: { background: `var(--${meaning})` }, "aria-hidden": "true" }));
    return line;
  });
  if (a.right !== null) rows.push(row("at a true tree", a.right, b.right, "truth"), row("elsewhere", a.wrong, b.wrong, "truth"));
  return el("div", {}, el("table", { class: "plain", id: "compare-verdicts" }, head("clusters", "A", "B", ""), el("tbody", {}, ...rows)),
    el("p", { class: "note dim", id: "compare-shared", text: `Trees that both find: ${both}; A alone: ${onlyA}; B alone: ${onlyB}.` }));
}

function sharedTrees(a, b) {
  const trees = ({ x, y, verdict }) => x.map((_, k) => k).filter((k) => verdict[k] === "tree").map((k) => [x[k], y[k]]);
  const [ofA, ofB] = [trees(a), trees(b)];
  const left = new Set(ofB.keys());
  let both = 0;
  for (const [x, y] of ofA) {
    const near = [...left].map((k) => [Math.hypot(ofB[k][0] - x, ofB[k][1] - y), k]).sort((one, other) => one[0] - other[0])[0];
    if (!near || near[0] > SAME_PLACE) continue;
    left.delete(near[1]);
    both += 1;
  }
  return [ofA.length - both, both, left.size];
}

function differenceTable(differences, nameA, nameB) {
  if (!differences.length) return el("p", { class: "empty", text: "Both sets are the same. Choose another one for A or B, or move a slider." });
  return el("table", { class: "plain", id: "compare-differences" }, head("parameter", nameA ?? "A", nameB ?? "B"), el("tbody", {}, ...differences.map(([name, a, b]) => {
    const spec = specOf(name);
    return el("tr", { "data-row": name }, el("th", { scope: "row", text: spec?.title ?? name, title: `${spec?.doc ?? ""} (${name})` }),
      ...[a, b].map((value) => el("td", { text: shown(value, spec) })));
  })));
}
