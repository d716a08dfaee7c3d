// Whether a parameter change re-maps the whole run or applies from the current scan onwards, the progress, and the result.

import { put } from "../core/api.js";
import { el, setText } from "../core/dom.js";
import { clock, count, roughly } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { changed, on, state } from "../core/store.js";
import { attempt, isTuning } from "./parameters.js";

const MOST = 30; // lines of the list
const SIGNS = { appeared: "+", vanished: "−", moved: "→" };
let reached = []; // [share, time [s]] of the re-mapping, the oldest first
const progress = el("progress", { id: "tune-progress", max: "1", hidden: true, "aria-label": "Progress of the re-mapping" });
const note = el("p", { id: "tune-whole-status", class: "note dim", role: "status" });
const list = el("ul", { id: "tune-changes" });
const folded = el("summary");
const all = el("details", { id: "tune-changes-all" }, folded, list);
const box = el("input", { id: "tune-whole", type: "checkbox", onchange: () => attempt(() => put("/api/parameters/reach", { whole: box.checked })) });
export const wholeRun = el("section", { id: "tune-whole-run", "aria-label": "The whole run" },
  el("label", { title: "On: each change re-maps the run from its first scan, so that the map and its scores follow. Off: changes apply from the current scan onwards" }, box, " whole run"),
  note, progress, all);

// Most changes of the clusters do not alter such a map.
const WHY_SAME = { columns: "This map is made of the accumulated scans (classification.method = columns), not of the clusters of each one." };

function resultText(remapped) {
  const { after, scans, time_s: end, changes } = remapped;
  const number = (kind) => changes.filter((change) => change.kind === kind).length;
  const parts = Object.keys(SIGNS).map((kind) => number(kind) && `${number(kind)} ${kind}`).filter(Boolean);
  const same = `the same as before. ${WHY_SAME[state.parameters?.values["classification.method"]] ?? ""}`;
  return `Re-mapped${endText(scans, end)}: ${count(after, "tree")}, ${parts.length ? `${parts.join(", ")}.` : same.trimEnd()}`;
}

// The re-mapping ends at the current scan; later scans are mapped when the run reaches them.
function endText(scans, end) {
  const all = state.status?.scans ?? null;
  const partial = all === null ? state.status?.state !== "finished" : scans < all;
  return partial ? ` to ${clock(end)}` : "";
}

const PACE = 6; // [s] of which the pace counts; at the beginning kernels are loaded and the current scan is mapped
const MEASURED = 0.02; // least share of the run from which the pace is computed

// The estimated time left as text; empty while the pace is not known.
function left(share) {
  const now = performance.now() / 1000;
  if (share < (reached.at(-1)?.[0] ?? 0)) reached = [];
  reached.push([share, now]);
  while (reached.length > 2 && reached[1][1] < now - PACE && share - reached[1][0] >= MEASURED) reached.shift();
  const [[before, then]] = reached;
  if (now - then < PACE / 2 || share - before < MEASURED) return "";
  return `, about ${roughly(((now - then) * (1 - share)) / (share - before))} left`;
}

// The preview has no score: it is only roughly right.
function progressText(share, preview) {
  const percent = `${Math.round(100 * share)} %${left(share)}`;
  return `Re-mapping: ${percent}${preview ? `. Preview (dashed in the map): about ${count(preview.places.length, "tree")}` : ""}`;
}

function show() {
  const share = state.status?.remapped ?? null;
  const preview = share !== null && state.rough?.revision === state.parameters?.revision ? state.rough : null;
  const newest = share === null && state.remapped?.revision !== state.parameters?.revision ? null : state.remapped; // else a parameter changed since then
  if (share === null) reached = [];
  box.checked = state.parameters?.whole ?? true;
  progress.hidden = share === null;
  all.hidden = !newest || !newest.changes.length;
  if (share !== null) progress.value = share;
  const ghost = isTuning() ? preview ?? newest : null;
  if (state.ghost !== ghost) {
    state.ghost = ghost;
    changed("ghost");
  }
  if (share !== null) setText(note, progressText(share, preview));
  else setText(note, newest ? resultText(newest) : !box.checked ? "Changes apply from the current scan onwards."
    : state.status?.live ? "Live: changes of SLAM, tracks and classes re-map the run. Other changes, their undo and all changes after them apply from now on: they need points that only the recording has." : "Each change re-maps the run up to the shown scan.");
}

const lineOf = (kind, sign, node, why) => el("li", { "data-kind": kind }, el("b", { text: sign, "aria-hidden": "true" }), node, el("small", { text: why }));
const treeLink = (number, words) => el("button", { class: "link", type: "button", text: `Tree ${number}${words}`, onclick: () => select(number) });

function showChanges() {
  const { changes = [] } = state.remapped ?? {};
  const lines = changes.map(({ kind, number, why }) => lineOf(kind, SIGNS[kind], kind === "vanished" ? el("span", { text: `Tree ${number} vanished` }) : treeLink(number, ` ${kind}`), why));
  setText(folded, `${count(lines.length, "change")}`);
  list.replaceChildren(...lines.slice(0, MOST), lines.length > MOST ? el("li", { text: `and ${lines.length - MOST} more` }) : "");
  show();
}

export function startWholeRun() {
  on("status parameters tab rough", show);
  on("remapped", showChanges);
}
