// Whether a parameter change re-maps the whole run or applies from the current scan onwards, the progress, and the result.

import { put } from "../core/api.js";
import { el, setText } from "../core/dom.js";
import { clock, count, roughly } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { changed, on, state } from "../core/store.js";
import { attempt, isTuning } from "./parameters.js";

const MOST = 30; // lines of the list
const SIGNS = { appeared: "+", vanished: "−", moved: "→" };
let begun = null; // {share, at, left, estimatedAt}: start of the re-mapping, and the estimate of the time left [s]
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
  return `Re-mapped${endText(scans, end)}: ${count(after, "tree")}, ${parts.length ? parts.join(", ") : `the same as before. ${WHY_SAME[state.parameters?.values["classification.method"]] ?? ""}`}`;
}

// The re-mapping ends at the current scan; later scans are mapped when the run reaches them.
function endText(scans, end) {
  const all = state.status?.scans ?? null;
  const partial = all === null ? state.status?.state !== "finished" : scans < all;
  return partial ? ` to ${clock(end)}` : "";
}

const FIRST = 2; // [s] without an estimate: kernels are loaded and the current scan is mapped
const SMOOTH = 0.15; // weight of the newest estimate

// The estimated time left as text; empty while there is no estimate.
function left(share) {
  const now = performance.now() / 1000;
  if (!begun || share < begun.share) begun = { share, at: now, left: null, estimatedAt: now };
  const spent = now - begun.at;
  if (spent < FIRST || share - begun.share < 0.02) return "";
  const guess = (spent * (1 - share)) / (share - begun.share);
  const before = begun.left === null ? guess : Math.max(begun.left - (now - begun.estimatedAt), 0);
  Object.assign(begun, { left: before + SMOOTH * (guess - before), estimatedAt: now });
  return `, about ${roughly(begun.left)} left`;
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
  if (share === null) begun = null;
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
  else setText(note, newest ? resultText(newest) : box.checked ? "Each change re-maps the run from its start to the shown scan." : "Changes apply from the current scan onwards.");
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
