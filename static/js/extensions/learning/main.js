// "Learn" in the tab Annotate: trains decision trees from the annotations, compares them with those in use, and switches.

import { get, post, remove } from "../../core/api.js";
import { button, byId, el, setText } from "../../core/dom.js";
import { capital, count, percent } from "../../core/format.js";
import { edits, looksOnly } from "../../core/permissions.js";
import { attempted } from "../../core/problem.js";
import { receive } from "../../core/live_feed.js";
import { on, state } from "../../core/store.js";
import { throttled } from "../../core/timing.js";
import { counted } from "../../core/verdicts.js";
import { exists, pressIn } from "../../shell/dynamic_actions.js";
import { extend } from "../../shell/extensions.js";
import { visible } from "../../shell/tabs.js";

// As in the tab Scores, but on the annotated objects instead of a map.
const RATES = [
  ["TA", "TA  trees found. True acceptance: annotated trees that are classified as trees"],
  ["FR", "FR  trees missed. False rejection: annotated trees that are not classified as trees"],
  ["TR", "TR  others rejected. True rejection: annotated poles, persons, bushes and other objects that are not classified as trees"],
  ["FA", "FA  others accepted. False acceptance: annotated other objects that are classified as trees"],
];
const PACKAGE = "package";
const EVERY = 300; // [ms] between two requests while annotations change
let now = null; // {state, words, learned}: decision trees being trained from annotations
let known = null, error = "";

const inWords = (things) => Object.entries(things).map(([kind, n]) => counted(n, kind === "other" ? "other object" : kind)).join(", ");
const inForce = () => state.parameters?.values["classification.forest"] ?? PACKAGE;

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
const forget = () => doing(() => remove("/api/learning"));
const use = () => doing(() => post("/api/learning/use", {}));
const backToPackage = () => doing(() => post("/api/parameters/reset", { names: ["classification.forest"] }));

function annotateSections() {
  return [el("section", { class: "learn", "aria-label": "Learn" },
    el("h2", { text: "Learn" }), el("p", { id: "learn-known", class: "note dim" }), el("div", { id: "learn-now", role: "status" }),
    el("p", { id: "learn-error", class: "error", role: "alert", hidden: true }))];
}

function knownInWords() {
  if (!known) return "";
  const { annotations, needed, runs } = known;
  const trees = annotations.tree ?? 0, others = Object.values(annotations).reduce((sum, n) => sum + n, 0) - trees;
  const lacking = trees < needed.trees || others < needed.others;
  const rest = lacking ? ` Learning needs ${needed.trees} trees and ${needed.others} other objects.` : "";
  const how = others < needed.others ? " Other objects: answer No (N) for a found tree that is not a tree, or add a pole or a bush with A and set its class." : "";
  return `${runs ? `Annotated in ${count(runs, "run")}: ${inWords(annotations)}.` : "Nothing annotated yet."}${rest}${how}`;
}

const enough = () => known && (known.annotations.tree ?? 0) >= known.needed.trees
  && Object.values(known.annotations).reduce((sum, n) => sum + n, 0) - (known.annotations.tree ?? 0) >= known.needed.others;

function fill() {
  if (!visible("annotate") || !byId("learn-now")) return;
  setText(byId("learn-known"), knownInWords());
  const learning = now ?? known ?? { state: "idle" };
  byId("learn-now").replaceChildren(...(parts[learning.state] ?? parts.idle)(learning));
  const problem = error || (learning.state === "failed" ? learning.words : "");
  byId("learn-error").hidden = !problem;
  setText(byId("learn-error"), capital(problem));
}

const parts = {
  idle: () => [el("div", { class: "annotate-tools" }, growButton(), ...nowUsed())],
  failed: () => parts.idle(),
  working: ({ words }) => [el("div", { class: "annotate-tools" }, el("progress", { "aria-label": "Training decision trees" }),
    el("span", { class: "note dim", text: words }), button("learn-stop", "Stop", "Stop the training; the decision trees in use stay", forget))],
  done: ({ learned }) => [...learned.tables.map(table),
    ...(learned.tables.every(noBetter) ? [el("p", { id: "learn-no-better", class: "note", text: noBetterText(learned) })] : []),
    el("p", { class: "note dim", text: methodText(learned) }),
    ...learned.warnings.map((text) => el("p", { class: "note", text })),
    el("div", { class: "annotate-tools" }, ...choices(learned))],
};

function growButton() {
  const node = button("learn-grow", "Train decision trees", "Train new decision trees from all annotations and compare them with those in use. Nothing changes until you choose to use them", grow);
  node.disabled = !enough() || looksOnly();
  return node;
}

function nowUsed() {
  if (inForce() === PACKAGE) return [];
  return [inUse(inForce()), button("learn-package", "Use the built-in ones", "Classify with the built-in decision trees again", backToPackage)];
}

// Date and training data of the decision trees. Their name, a digest, distinguishes two of the same day.
function inUse(name) {
  const from = known?.in_use?.name === name ? known.in_use : null;
  const words = from ? `In use: trained ${from.date.replace(/:\d\d UTC$/, " UTC")} from ${inWords(from.things)} in ${count(from.runs, "run")}` : "In use: trained decision trees";
  return el("p", { id: "learn-used", class: "learn-used" }, words, el("small", { class: "dim", text: name, title: "Name of these decision trees (classification.forest)" }));
}

function choices(learned) {
  if (inForce() === learned.name) return [inUse(learned.name), button("learn-package", "Use the built-in ones", "Classify with the built-in decision trees again", backToPackage), button("learn-forget", "Close", "Close the table; the new decision trees stay in use", forget)];
  return [button("learn-use", "Use the new ones", "Classify with the new decision trees; the whole run is mapped again", use), button("learn-forget", "Keep the old ones", "Change nothing; the file of the new decision trees stays in the data folder", forget)];
}

function methodText({ things, tables, old_saw: oldSaw }) {
  const parts = tables.map(({ by, folds }) => `${folds} parts, split by ${by}`).join("; ");
  return `Trained on ${inWords(things)}. Cross-validated: each part is classified by trees trained on the others (${parts}).${oldSaw ? " The scores of the old ones are optimistic: they were trained on these runs." : ""}`;
}

const noBetter = ({ old, new: grown }) => grown.TA.count <= old.TA.count && grown.FA.count >= old.FA.count;

function noBetterText({ tables, old_saw: oldSaw }) {
  const same = tables.every(({ old, new: grown }) => grown.TA.count === old.TA.count && grown.FA.count === old.FA.count);
  const on = oldSaw ? "on these objects, on which the old ones were trained" : "on objects that neither was trained on";
  return `No better than the old ones ${on}${same ? ": the same scores" : ""}.`;
}

function table({ kind, old, new: grown }) {
  const row = (name, rates) => el("tr", {}, el("th", { scope: "row", text: name }), ...RATES.map(([rate]) => cell(rates[rate])));
  return el("table", { class: "plain learn-table" }, el("caption", { text: `Sensors with ${kind}` }),
    el("thead", {}, el("tr", {}, el("td"), ...RATES.map(([rate, title]) => el("th", { scope: "col", text: rate, title })))),
    el("tbody", {}, row("old", old), row("new", grown)));
}

const cell = ({ count: n, of }) => el("td", {}, `${n} of ${of}`, el("small", { class: "dim", text: of ? percent(n / of) : "" }));

const update = throttled(async () => {
  if (!visible("annotate")) return;
  known = (await attempted(() => get("/api/learning"))) ?? known;
  fill();
}, EVERY);

// Title and id of the buttons; those that do not exist now are left out.
const BUTTONS = [
  ["Learn: use the new decision trees", "learn-use"], ["Learn: keep the old decision trees", "learn-forget"],
  ["Learn: stop the training", "learn-stop"], ["Learn: use the built-in decision trees", "learn-package"],
];

const presentActions = () => [
  ...BUTTONS.filter(([, id]) => exists(id)).map(([title, id]) => [title, "", edits(pressIn("annotate", id))]),
  ["Learn: train decision trees from the annotations", "", edits(pressIn("annotate", "learn-grow"))],
];

function start() {
  receive("learning", (message) => { now = message; });
  on("tab annotations", update);
  on("learning parameters tab", fill);
  on("parameters", () => inForce() !== PACKAGE && known?.in_use?.name !== inForce() && update());
}

extend(import.meta.url, { start, presentActions, annotateSections });
