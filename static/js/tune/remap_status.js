// What a change acts on: the whole run, which is mapped again, or the scans from here on. And what that changed.

import { put } from "../core/api.js";
import { el, setText } from "../core/dom.js";
import { count } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { changed, on, state } from "../core/store.js";
import { attempt, isTuning } from "./parameters.js";

const MOST = 30;
const FOLDED_FROM = 9; // lines: so many would take the place of the sliders
const SIGNS = { appeared: "+", vanished: "−", moved: "→" };
let begun = null; // {share, at, left}: when the mapping was first heard of, and how long it took yet [s]
let known = 0; // lines of the list
const progress = el("progress", { id: "tune-progress", max: "1", hidden: true, "aria-label": "The run is mapped again" });
const told = el("p", { id: "tune-whole-told", class: "note dim", role: "status" });
const list = el("ul", { id: "tune-changes" });
const folded = el("summary");
const all = el("details", { id: "tune-changes-all" }, folded, list);
const box = el("input", { id: "tune-whole", type: "checkbox", onchange: () => attempt(() => put("/api/parameters/reach", { whole: box.checked })) });
export const wholeRun = el("section", { id: "tune-whole-run", "aria-label": "The whole run" },
  el("label", { title: "Each change maps the run again from its first scan, so that the whole map and its score follow; else it acts from the scan that stands here" }, box, " map the whole run again"),
  progress, told, all);

// Trees that stayed and are called otherwise now, as [before, now]: numbers are those of the new run, as its files have them.
const renumbered = ({ renamed }) => renamed.filter(([before, now]) => before !== now);

function lead(told) {
  const { before, after, scans, changes } = told;
  const number = (kind) => changes.filter((change) => change.kind === kind).length;
  const parts = Object.keys(SIGNS).map((kind) => number(kind) && `${number(kind)} ${kind}`).filter(Boolean);
  const others = renumbered(told).length;
  const numbers = others ? ` Numbers follow the new run: ${others === 1 ? "one tree that stayed has" : `${others} trees that stayed have`} another one.` : "";
  return `${count(scans, "scan")} mapped again: ${before} → ${count(after, "tree")}${parts.length ? `, ${parts.join(", ")}` : ", all where they were"}.${upTo(scans)}${numbers}`;
}

// The map is made anew up to where the run stands; what comes after it is mapped when the run gets there.
function upTo(scans) {
  const all = state.status?.scans ?? null;
  const stands = all === null ? state.status?.state !== "finished" : scans < all;
  return stands ? " That is up to the standing scan: the rest follows as the run goes on." : "";
}

const FIRST = 2; // [s] that tell nothing yet: kernels are loaded, and the standing scan is mapped
const SMOOTH = 0.15; // weight of the newest guess

// About how long it takes yet, in words, by how long it took so far; empty while that tells nothing.
function left(share) {
  const now = performance.now() / 1000;
  if (!begun || share < begun.share) begun = { share, at: now, left: null, told: now };
  const spent = now - begun.at;
  if (spent < FIRST || share - begun.share < 0.02) return "";
  const guess = (spent * (1 - share)) / (share - begun.share);
  const before = begun.left === null ? guess : Math.max(begun.left - (now - begun.told), 0);
  Object.assign(begun, { left: before + SMOOTH * (guess - before), told: now });
  return `, exact in about ${inWords(begun.left)}`;
}

// Minutes from 90 s on, and tens of seconds before: more would be a guess.
function inWords(seconds) {
  if (seconds >= 90) return `${Math.round(seconds / 60)} min`;
  return `${seconds > 10 ? 10 * Math.round(seconds / 10) : Math.max(1, Math.round(seconds))} s`;
}

function progressTold(share, rough) {
  const percent = `${Math.round(100 * share)} %${left(share)}`;
  if (!rough) return `Mapping the run again: ${percent}`;
  const f1 = rough.score?.f1 ?? null;
  return `Rough answer, dashed in the map: ${count(rough.places.length, "tree")}${f1 === null ? "" : `, F1 ${f1.toFixed(3)}`}. Mapping the run again: ${percent}`;
}

function show() {
  const share = state.status?.remapped ?? null;
  const rough = share !== null && state.rough?.revision === state.parameters?.revision ? state.rough : null;
  const newest = share === null && state.remapped?.revision !== state.parameters?.revision ? null : state.remapped; // else something was changed since
  if (share === null) begun = null;
  box.checked = state.parameters?.whole ?? true;
  progress.hidden = share === null;
  all.hidden = !newest || (!newest.changes.length && !renumbered(newest).length);
  if (share !== null) progress.value = share;
  const ghost = isTuning() ? rough ?? newest : null;
  if (state.ghost !== ghost) {
    state.ghost = ghost;
    changed("ghost");
  }
  if (share !== null) setText(told, progressTold(share, rough));
  else setText(told, newest ? lead(newest) : box.checked ? "Change something: the whole map, its trees and its score follow." : "A change acts from the scan that stands here on.");
}

const lineOf = (kind, sign, node, why) => el("li", { "data-kind": kind }, el("b", { text: sign, "aria-hidden": "true" }), node, el("small", { text: why }));
const treeLink = (number, words) => el("button", { class: "link", type: "button", text: `Tree ${number}${words}`, onclick: () => select(number) });

function showChanges() {
  const { changes = [], renamed = [] } = state.remapped ?? {};
  const was = new Map(renumbered({ renamed }).map(([before, now]) => [now, `was tree ${before}`]));
  const moved = new Set(changes.filter(({ kind }) => kind === "moved").map(({ number }) => number));
  const lines = [ // one a tree: one that moved and has another number says both in one
    ...changes.map(({ kind, number, why }) => lineOf(kind, SIGNS[kind], kind === "vanished" ? el("span", { text: `Tree ${number} vanished` }) : treeLink(number, ` ${kind}`),
      kind === "moved" && was.has(number) ? `${why}, ${was.get(number)}` : why)),
    ...[...was].filter(([now]) => !moved.has(now)).map(([now, before]) => lineOf("renumbered", "#", treeLink(now, ""), before))];
  setText(folded, `${count(lines.length, "tree")} not as before`);
  if (lines.length !== known) all.open = lines.length < FOLDED_FROM;
  known = lines.length;
  list.replaceChildren(...lines.slice(0, MOST), lines.length > MOST ? el("li", { text: `and ${lines.length - MOST} more` }) : "");
  show();
}

export function startWholeRun() {
  on("status parameters tab rough", show);
  on("remapped", showChanges);
}
