// Comparison of two parameter sets on the current scan. On the map trees are half discs: left half A, right half B.

import { blockFor } from "../core/api.js";
import { byId, el, letterOf, setText } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { distance, nearest } from "../core/nearest.js";
import { changed, on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { keepFresh, oncePerFrame } from "../core/timing.js";
import { verdictOf } from "../core/verdicts.js";
import { shownOver } from "../scene/overlay.js";
import { newEye, pixel, PointPicture, unpack } from "../scene/points.js";
import { savedSets, shown, specOf, tuning, use } from "./parameters.js";

const EVERY = 700; // [ms] between two comparisons
const IN_USE = "in use";
const eye = { ...newEye(), tilt: 0, scale: 9 };
const sides = {};
let data = null;

const nameOf = (side) => sides[side].list.value;
const asked = () => JSON.stringify([nameOf("a"), nameOf("b")]);

function build() {
  for (const [k, side] of ["a", "b"].entries()) {
    const list = el("select", { "aria-label": `Set ${side.toUpperCase()}`, "data-set": side, onchange: chosen });
    const canvas = el("canvas", { tabindex: "0", role: "img", "aria-label": `Clusters by set ${side.toUpperCase()}` });
    const take = el("button", { "data-edit": true, class: "small", text: "Use", title: "Use this set for the run", onclick: () => use(nameOf(side)) });
    sides[side] = { k, list, canvas, take, picture: new PointPicture(canvas, eye, redraw) };
    byId(`compare-${side}`).replaceChildren(el("div", { class: "compare-head" }, el("i", { class: `sign ${side}`, text: side.toUpperCase() }), list, take), canvas);
  }
  byId("compare-swap").addEventListener("click", () => {
    [sides.a.list.value, sides.b.list.value] = [nameOf("b"), nameOf("a")];
    chosen();
  });
  new ResizeObserver(redraw).observe(byId("compare-pictures"));
}

// Fills the lists with the values in use, presets and saved sets; the choices are kept.
function fillLists() {
  const option = ({ name, doc }) => el("option", { value: name, text: name, title: doc ?? "" });
  const names = JSON.stringify([tuning.presets, savedSets().map(({ name }) => name)]);
  for (const { list, k } of Object.values(sides)) {
    if (list.dataset.shown === names) continue;
    const before = list.dataset.shown ? list.value : k === 0 ? state.parameters?.preset ?? "" : "";
    list.dataset.shown = names;
    list.replaceChildren(el("option", { value: "", text: IN_USE }), el("optgroup", { label: "Presets" }, ...tuning.presets.map(option)),
      ...(savedSets().length ? [el("optgroup", { label: "Saved sets" }, ...savedSets().map(option))] : []));
    list.value = before;
    if (list.selectedIndex < 0) list.value = "";
  }
}

const redraw = oncePerFrame(() => {
  if (data && shownOver("compare")) for (const side of ["a", "b"]) draw(side);
});

function draw(side) {
  const { k, picture, canvas, list } = sides[side];
  const { arrays, pictures } = data;
  const { clusters, verdicts } = pictures[k];
  const plain = pixel(colour("path"));
  const colours = clusters.verdict.map((verdict) => pixel(colour(verdictOf(verdict)[1])));
  const labels = arrays[`labels${k}`], circles = arrays[`circles${k}`];
  picture.begin().points(arrays[`points${k}`], (n) => (labels[n] < 0 ? plain : colours[labels[n]]), 2).end();
  for (let n = 0; n < clusters.x.length; n += 1) {
    const [x, y, r, z] = circles.subarray(4 * n, 4 * n + 4);
    const [letter, meaning] = verdictOf(clusters.verdict[n]);
    if (meaning === "tree") picture.ring(x, y, Math.max(Number.isFinite(r) ? r : 0, 0.25), z, colour(`set-${side}`));
    else picture.letter(x, y, z, letter, colour("text"), colour("ground"));
  }
  picture.robot(colour("robot"));
  canvas.setAttribute("aria-label", `Set ${side.toUpperCase()}, ${list.selectedOptions[0]?.text}: ${verdicts.tree ?? 0} trees of ${clusters.x.length} clusters`);
}

// The pictures are dimmed until the answer for the new sets arrives.
function chosen() {
  byId("over-compare").classList.add("waits");
  setText(byId("compare-lead"), "Mapping this scan with both sets …");
  refresh();
}

const refresh = keepFresh(async () => {
  if (!shownOver("compare")) return;
  fillLists();
  const lead = byId("compare-lead");
  for (const { take, list } of Object.values(sides)) take.disabled = list.value === "";
  if (!state.map) {
    data = null;
    byId("over-compare").classList.remove("waits");
    setText(lead, nothingYet("No scan"));
    return;
  }
  try {
    const of = asked();
    const answer = unpack(await blockFor("/api/compare", { a: nameOf("a"), b: nameOf("b") }));
    if (of === asked()) { // else another set was chosen meanwhile
      data = { ...answer, asked: of };
      setText(lead, `Scan ${data.pictures[0].index}, mapped with both sets. On the map: left half A, right half B.`);
      byId("over-compare").dataset.scan = String(data.pictures[0].index);
      byId("over-compare").classList.remove("waits");
      fillComparison(data, sides.a.list.selectedOptions[0]?.text, sides.b.list.selectedOptions[0]?.text);
    }
  } catch (error) {
    if (data?.asked === asked()) byId("over-compare").classList.remove("waits"); // else the pictures are of other sets and stay dimmed
    setText(lead, error.message);
  }
  show();
}, EVERY);

function show() {
  state.compare = shownOver("compare") && data ? data.pictures.map(({ clusters }) => clusters) : null;
  changed("compare");
  redraw();
}

export function startCompare() {
  build();
  on("over", () => (shownOver("compare") ? refresh() : show()));
  on("map parameters sets specs", () => shownOver("compare") && refresh());
  on("theme", redraw);
}

// --- tables: clusters by verdict, trees that only one set finds, and the parameters that differ ----------

const SAME_PLACE = 0.5; // [m] between two detections of one tree

function fillComparison({ pictures, differences }, nameA, nameB) {
  const [a, b] = pictures;
  byId("compare-tables").replaceChildren(verdictTable(a, b), differenceTable(differences, nameA, nameB));
}

const row = (name, a, b, cls = "") => el("tr", { class: `${cls} ${a === b ? "" : "differs"}`.trim(), "data-row": name },
  el("th", { scope: "row", text: name }), el("td", { text: String(a) }), el("td", { text: String(b) }), el("td", { text: a === b ? "" : b > a ? `+${b - a}` : `−${a - b}` }));

const head = (...titles) => el("thead", {}, el("tr", {}, ...titles.map((text) => (text ? el("th", { scope: "col", text }) : el("td")))));

function verdictTable(a, b) {
  const names = [...new Set(["tree", ...Object.keys(a.verdicts), ...Object.keys(b.verdicts)])];
  const [onlyA, both, onlyB] = sharedTrees(a.clusters, b.clusters);
  const rows = names.map((name) => {
    const line = row(name, a.verdicts[name] ?? 0, b.verdicts[name] ?? 0);
    line.cells[0].prepend(letterOf(verdictOf(name)));
    return line;
  });
  if (a.right !== null) rows.push(row("at a true tree", a.right, b.right, "truth"), row("not at a tree", a.wrong, b.wrong, "truth"));
  return el("div", {}, el("table", { class: "plain", id: "compare-verdicts" }, head("clusters", "A", "B", ""), el("tbody", {}, ...rows)),
    el("p", { class: "note dim", id: "compare-shared", text: `Trees found by both: ${both}; only by A: ${onlyA}; only by B: ${onlyB}.` }));
}

function sharedTrees(a, b) {
  const trees = ({ x, y, verdict }) => x.map((_, k) => ({ x: x[k], y: y[k] })).filter((_, k) => verdict[k] === "tree");
  const [ofA, left] = [trees(a), new Set(trees(b))];
  let both = 0;
  for (const tree of ofA) {
    const match = nearest(left, (other) => distance(tree, other), SAME_PLACE);
    if (!match) continue;
    left.delete(match);
    both += 1;
  }
  return [ofA.length - both, both, left.size];
}

function differenceTable(differences, nameA, nameB) {
  if (!differences.length) return el("p", { class: "empty", text: "The two sets are equal. Choose another set for A or B, or change a parameter." });
  return el("table", { class: "plain", id: "compare-differences" }, head("parameter", nameA ?? "A", nameB ?? "B"), el("tbody", {}, ...differences.map(([name, a, b]) => {
    const spec = specOf(name);
    return el("tr", { "data-row": name }, el("th", { scope: "row", text: spec?.title ?? name, title: `${spec?.doc ?? ""} (${name})` }),
      ...[a, b].map((value) => el("td", { text: shown(value, spec) })));
  })));
}
