// "Learn" in the tab Annotate: how much there is to learn from, new decision trees beside the old ones, and which are used.

import { get, post, request } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { count } from "../core/format.js";
import { looksOnly } from "../core/permissions.js";
import { on, state } from "../core/store.js";
import { counted } from "../core/verdicts.js";
import { visible } from "../shell/tabs.js";

// In the order and words of the tab Scores; here it is what was annotated that is judged, and not a map.
const RATES = [
  ["TA", "TA  trees found. True acceptance: annotated trees that are taken for trees"],
  ["FR", "FR  trees missed. False rejection: annotated trees that are not taken for trees"],
  ["TR", "TR  others left out. True rejection: annotated poles, persons, bushes and other things that are not taken for trees"],
  ["FA", "FA  others taken for trees. False acceptance: annotated other things that are taken for trees"],
];
const PACKAGE = "package";
const ASK_AGAIN = 300; // [ms] after an edit until what there is to learn from is asked for
let known = null, asked = 0, error = "";

const inWords = (things) => Object.entries(things).map(([kind, n]) => counted(n, kind === "other" ? "other thing" : kind)).join(", ");
const inForce = () => state.parameters?.values["classification.forest"] ?? PACKAGE;
const button = (id, text, title, onclick) => el("button", { id, class: "small", type: "button", text, title, onclick });

async function doing(work) {
  try {
    await work();
    error = "";
  } catch (refused) {
    error = refused.message;
  }
  fill();
}

const grow = () => doing(() => post("/api/learning", {}));
const forget = () => doing(() => request("/api/learning", { method: "DELETE" }));
const use = () => doing(() => post("/api/learning/use", {}));
const backToPackage = () => doing(() => post("/api/parameters/reset", { names: ["classification.forest"] }));

export function learnSection() {
  return el("section", { class: "learn", "aria-label": "Learn" },
    el("h3", { text: "Learn" }), el("p", { id: "learn-known", class: "note dim" }), el("div", { id: "learn-now", role: "status" }),
    el("p", { id: "learn-error", class: "error", role: "alert", hidden: true }));
}

function knownInWords() {
  if (!known) return "";
  const { annotations, needed, runs } = known;
  const trees = annotations.tree ?? 0, others = Object.values(annotations).reduce((sum, n) => sum + n, 0) - trees;
  const lacking = trees < needed.trees || others < needed.others;
  const rest = lacking ? ` To learn from, ${needed.trees} trees and ${needed.others} other things are needed.` : "";
  const how = others < needed.others ? " Other things: press n on a found tree that is none, or add a pole or a bush with a and its class." : "";
  return `${runs ? `Annotated in ${count(runs, "run")}: ${inWords(annotations)}.` : "Nothing is annotated yet."}${rest}${how}`;
}

const enough = () => known && (known.annotations.tree ?? 0) >= known.needed.trees
  && Object.values(known.annotations).reduce((sum, n) => sum + n, 0) - (known.annotations.tree ?? 0) >= known.needed.others;

function fill() {
  if (!visible("annotate") || !byId("learn-now")) return;
  setText(byId("learn-known"), knownInWords());
  const learning = state.learning ?? known ?? { state: "idle" };
  byId("learn-now").replaceChildren(...(parts[learning.state] ?? parts.idle)(learning));
  const problem = error || (learning.state === "failed" ? learning.words : "");
  byId("learn-error").hidden = !problem;
  setText(byId("learn-error"), problem ? problem[0].toUpperCase() + problem.slice(1) : "");
}

const parts = {
  idle: () => [el("div", { class: "annotate-tools" }, growButton(), ...nowUsed())],
  failed: () => parts.idle(),
  working: ({ words }) => [el("div", { class: "annotate-tools" }, el("progress", { "aria-label": "Growing decision trees" }),
    el("span", { class: "note dim", text: words }), button("learn-stop", "Stop", "Stop it; nothing was changed", forget))],
  done: ({ learned }) => [...learned.tables.map(table),
    ...(learned.tables.every(noBetter) ? [el("p", { id: "learn-no-better", class: "note", text: noBetterInWords(learned) })] : []),
    el("p", { class: "note dim", text: saidOf(learned) }),
    ...learned.warnings.map((text) => el("p", { class: "note", text })),
    el("div", { class: "annotate-tools" }, ...choices(learned))],
};

function growButton() {
  const node = button("learn-grow", "Grow a new decision tree", "Learn from all annotations, and show what old and new are worth; nothing uses the new one before you say so", grow);
  node.disabled = !enough() || looksOnly();
  return node;
}

function nowUsed() {
  if (inForce() === PACKAGE) return [];
  return [inUse(inForce()), button("learn-package", "Back to the package's", "Let the decision trees of the package vote again", backToPackage)];
}

// When they were grown and from what; their name, which is a digest, only for who has to tell two of one day apart.
function inUse(name) {
  const from = known?.in_use?.name === name ? known.in_use : null;
  const words = from ? `In use: grown ${from.date.replace(/:\d\d UTC$/, " UTC")} from ${inWords(from.things)} in ${count(from.runs, "run")}` : "In use: learned decision trees";
  return el("p", { id: "learn-used", class: "learn-used" }, words, el("small", { class: "dim", text: name, title: "Name of these decision trees (classification.forest)" }));
}

function choices(learned) {
  if (inForce() === learned.name) return [inUse(learned.name), button("learn-package", "Back to the package's", "Let the decision trees of the package vote again", backToPackage), button("learn-forget", "Close", "Close the table; the new one stays in use", forget)];
  return [button("learn-use", "Use it", "Let the new decision trees vote; the whole run is mapped again", use), button("learn-forget", "Keep the old one", "Change nothing; the file of the new one stays in the data folder", forget)];
}

function saidOf({ things, tables, old_saw }) {
  const parted = tables.map(({ by, folds }) => `${folds} parts, no ${by} in two of them`).join("; ");
  return `Learned from ${inWords(things)}. Each part was judged by trees that learned from the others (${parted}).${old_saw ? " The old one has learned from these runs, so its figures flatter it." : ""}`;
}

const noBetter = ({ old, new: grown }) => grown.TA.count <= old.TA.count && grown.FA.count >= old.FA.count;

function noBetterInWords({ tables, old_saw }) {
  const same = tables.every(({ old, new: grown }) => grown.TA.count === old.TA.count && grown.FA.count === old.FA.count);
  const on = old_saw ? "on these things, from which the old ones have learned" : "on what neither learned from";
  return same ? `No better than the old ones ${on}: the same figures.` : `No better than the old ones ${on}.`;
}

function table({ kind, old, new: grown }) {
  const row = (name, rates) => el("tr", {}, el("th", { scope: "row", text: name }), ...RATES.map(([rate]) => cell(rates[rate])));
  return el("table", { class: "plain learn-table" }, el("caption", { text: `Sensors that see ${kind}` }),
    el("thead", {}, el("tr", {}, el("td"), ...RATES.map(([rate, title]) => el("th", { scope: "col", text: rate, title })))),
    el("tbody", {}, row("old", old), row("new", grown)));
}

const cell = ({ count: n, of }) => el("td", {}, `${n} of ${of}`, el("small", { class: "dim", text: of ? `${Math.round((1000 * n) / of) / 10} %` : "" }));

function askLater() {
  if (!visible("annotate")) return;
  clearTimeout(asked);
  asked = setTimeout(async () => {
    known = await get("/api/learning").catch(() => known);
    fill();
  }, ASK_AGAIN);
}

export function startLearning() {
  on("tab annotations", askLater);
  on("learning parameters tab", fill);
  on("parameters", () => inForce() !== PACKAGE && known?.in_use?.name !== inForce() && askLater());
}
