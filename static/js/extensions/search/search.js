// "Tune for me": a search for the parameters with the best score against the ground truth. It runs on the server.

import { myName } from "../../annotate/annotations.js";
import { get, post } from "../../core/api.js";
import { button, byId, el, setText } from "../../core/dom.js";
import { count, NONE, percent } from "../../core/format.js";
import { receive } from "../../core/live_feed.js";
import { on, state } from "../../core/store.js";
import { line, picture, svg, text } from "../../core/svg.js";
import { attempt, nameProblem, refuse, shown, specOf, tuning } from "../../tune/parameters.js";

const AT_WORK = ["looking", "searching", "stopping"];
const NOT_SEARCHED = ["evaluation.", "obstacles."]; // they change how a map is scored, or nothing of it
// --- other runs that the search uses or holds out ------------------------------------------------------

const USES = [["", "not used"], ["also", "searched"], ["held_out", "held out"]];
const chosen = new Map(); // by the number of the run: "also" or "held_out"
const rows = el("ul", { id: "search-runs", "aria-label": "Other runs of the list" });
const note = el("p", { class: "note dim" });
const otherRuns = el("fieldset", { class: "search-others", hidden: true },
  el("legend", { text: "Other runs", title: "Searched: its score counts too. Held out: it is only scored, which shows whether the set suits other places" }), rows, note);

function showRuns(runs = []) {
  const usable = runs.filter(({ why_not: why }) => !why);
  for (const record of chosen.keys()) if (!usable.some((run) => run.record === record)) chosen.delete(record);
  rows.replaceChildren(...usable.map(({ record, name, truth }) => {
    const use = el("select", { "aria-label": `Use of ${name}`, onchange: () => (use.value ? chosen.set(record, use.value) : chosen.delete(record)) },
      ...USES.map(([value, text]) => el("option", { value, text })));
    use.value = chosen.get(record) ?? "";
    return el("li", { "data-run": String(record), title: name }, el("span", {}, name, el("small", { class: "dim", text: truth })), use);
  }));
  const reasons = new Map();
  for (const { name, why_not: why } of runs) if (why) reasons.set(why, [...(reasons.get(why) ?? []), name]);
  note.replaceChildren(...[...reasons].map(([why, names]) => el("span", { title: names.join("\n"), text: `${count(names.length, "run")} cannot be scored: ${why}. ` })));
  note.hidden = !reasons.size;
  rows.hidden = !usable.length;
  otherRuns.hidden = !runs.length;
}

const runsWanted = () => ({ also: of("also"), held_out: of("held_out") });
const of = (use) => [...chosen].filter(([, value]) => value === use).map(([record]) => record);

// Scores with the initial and the best values, of the searched and of the held-out runs.
function scoresTable({ scores = [], label }) {
  if (!scores.length || (scores.length === 1 && scores[0].runs === 1)) return null;
  const third = { RMSE: ["RMSE [cm]", "rmse_cm", (v) => v.toFixed(1)], "pair error": ["pairs [%]", "pair_error_percent", (v) => v.toFixed(2)] }[label] ?? ["TA", "TA", percent];
  const columns = [["F1", "f1", (v) => v.toFixed(3)], third, ["false", "false_share", percent]];
  const cell = ({ start, best }, [, key, shown]) => el("td", {}, ...[start, best].flatMap((of, k) => [k ? " → " : "", of[key] === undefined || of[key] === null ? "–" : shown(of[key])]));
  return el("table", { id: "search-scores", title: "Initial values → best set so far" },
    el("tr", {}, el("th", { text: "" }), ...columns.map(([text]) => el("th", { scope: "col", text }))),
    ...scores.map((row) => el("tr", { "data-held-out": String(row.held_out) }, el("th", { scope: "row", text: `${row.held_out ? "held out" : "searched"}, ${count(row.runs, "run")}` }), ...columns.map((column) => cell(row, column)))));
}

// --- form and outcome -----------------------------------------------------------------------------------

const axes = new Map(); // by the name of the parameter: {text()}
let goals = [], asked = false;

const number = (id, label, value, max) => el("label", {}, `${label} `, el("input", { id, type: "number", min: "1", max: String(max), step: "1", value: String(value) }));
const opener = button("search-open", "Tune for me …", "Search for the parameters with the best score of this run against its ground truth", () => openForm(true));
const goal = el("select", { id: "search-goal", "aria-label": "What to search for" });
const list = el("ul", { id: "search-axes", "aria-label": "Searched over" });
const more = el("select", { id: "search-more", "aria-label": "Search over another parameter", onchange: () => { if (more.value) addAxis(more.value); more.value = ""; } });
const form = el("form", { id: "search-form", hidden: true, onsubmit: start },
  el("p", { class: "note dim", text: "The whole run is mapped repeatedly with other values, starting from those in use, and scored against its ground truth." }),
  el("label", { class: "search-goal" }, "Goal ", goal), el("div", { class: "search-names dim", "aria-hidden": "true" }, ...["Searched over", "from", "to", ""].map((text) => el("span", { text }))), list, more, otherRuns,
  el("div", { class: "search-limits" }, number("search-trials", "Trials", 200, 5000), number("search-minutes", "Time limit [min]", 10, 1440)),
  el("div", { class: "search-buttons" }, el("button", { id: "search-start", class: "small primary", text: "Search" }), button("search-cancel", "Cancel", "Close without a search", () => openForm(false))));
const statusNote = el("p", { id: "search-status", class: "note", role: "status" });
const failed = el("p", { id: "search-error", class: "error", role: "alert", hidden: true });
const progress = el("progress", { id: "search-progress", max: "1", hidden: true, "aria-label": "Trials done" });
const warning = el("p", { id: "search-warning", class: "note", hidden: true });
const drawn = el("div", { id: "search-drawn" });
const stop = button("search-stop", "Stop", "End the search; the best set so far is kept here", () => attempt(() => post("/api/search/stop", {})));
const goOn = button("search-go-on", "Resume", "Run the remaining trials with the same settings", () => attempt(() => post("/api/search/go-on", {})));
const use = button("search-use", "Use these", "Use the values of the best set; Undo reverts it", () => attempt(() => post("/api/search/use", {})), "small primary");
const save = button("search-save", "Save as set …", "Save the best set under a name, with its origin", () => { naming.hidden = false; name.focus(); });
const again = button("search-again", "Search again …", "Another search", () => openForm(true));
const name = el("input", { id: "search-name", type: "text", maxlength: "40", placeholder: "Name of the set", "aria-label": "Name of the found set", autocomplete: "off", onkeydown: (event) => event.key === "Escape" && (naming.hidden = true) });
const naming = el("form", { id: "search-name-form", class: "search-buttons", hidden: true, onsubmit: saveFound }, name, el("button", { class: "small primary", text: "Save" }));
const changes = el("ul", { id: "search-changes", "aria-label": "Found values" });
const outcome = el("div", { id: "search-outcome", hidden: true }, statusNote, failed, progress, drawn, warning, changes, el("div", { class: "search-buttons" }, stop, use, save, goOn, again), naming);
export const searchPart = el("section", { id: "tune-search", "aria-label": "Search for parameters" }, opener, form, outcome);

async function openForm(open) {
  const known = open && (await attempt(() => get("/api/search")));
  if (open && !known) return;
  if (known) showRuns(known.runs);
  if (known && !asked) {
    asked = true;
    goals = known.goals;
    goal.replaceChildren(...goals.map(({ name: value, words }) => el("option", { value, text: words })));
    for (const text of known.sensible) addAxis(...text.split("="));
  }
  form.hidden = !open;
  if (open) searchPart.closest("details").open = true;
  show();
  if (open) goal.focus();
  else opener.focus();
}

// Adds a parameter to the search, between its bounds or over its choices.
function addAxis(parameter, bounds = "") {
  const spec = specOf(parameter);
  if (!spec || axes.has(parameter)) return;
  const numeric = spec.minimum !== null;
  const [low, high] = numeric ? (bounds ? bounds.split("..") : [spec.minimum, spec.maximum]) : [];
  const field = (value, end) => el("input", { type: "text", inputmode: "decimal", value: String(value), "aria-label": `${spec.title}, ${end}`, "data-end": end });
  const fields = numeric ? [field(low, "from"), field(high, "to")] : [el("span", { class: "dim", text: spec.kind === "bool" ? "on or off" : spec.choices.join(", ") })];
  const node = el("li", { "data-axis": parameter, title: spec.doc }, el("span", { text: spec.title }), ...fields,
    el("button", { type: "button", class: "quiet small", text: "×", title: `Do not search over ${spec.title}`, "aria-label": `Do not search over ${spec.title}`, onclick: () => { axes.delete(parameter); node.remove(); offer(); } }));
  const text = () => (numeric ? `${parameter}=${fields.map(({ value }) => value.trim()).join("..")}` : parameter);
  axes.set(parameter, { text });
  list.append(node);
  offer();
}

function offer() {
  const left = tuning.specs.filter((spec) => spec.kind !== "name" && !axes.has(spec.name) && !NOT_SEARCHED.some((part) => spec.name.startsWith(part)));
  more.replaceChildren(el("option", { value: "", text: "Add a parameter …" }), ...left.map((spec) => el("option", { value: spec.name, text: `${spec.stage}: ${spec.title}` })));
  byId("search-start")?.toggleAttribute("disabled", !axes.size);
}

async function start(event) {
  event.preventDefault();
  const limits = ["trials", "minutes"].map((key) => [key, Number(byId(`search-${key}`).value)]);
  const body = { over: [...axes.values()].map(({ text }) => text()), goal: goal.value, ...Object.fromEntries(limits), ...runsWanted() };
  const begun = await attempt(() => post("/api/search", body));
  if (begun) form.hidden = true;
  show();
  if (begun) searchPart.scrollIntoView({ block: "center" }); // the form was long; its place now holds the progress
}

async function saveFound(event) {
  event.preventDefault();
  const problem = nameProblem(name.value.trim());
  if (problem) {
    refuse(problem);
    return;
  }
  if (await attempt(() => post("/api/search/save", { name: name.value.trim(), who: myName() }))) naming.hidden = true;
}

function progressText({ state: stage, made, wanted, start: first, best, better, goal: aim, go_on: canGoOn }) {
  if (stage === "looking") return "Mapping the whole run once …";
  if (stage === "searching") return `${made} of ${count(wanted, "trial")}: best ${best?.shown ?? NONE}${first ? `, initial ${first.shown}` : ""}.`;
  if (stage === "stopping") return "Stopping …";
  if (!best) return "Stopped before the first trial.";
  const left = canGoOn ? ` ${count(wanted - made, "trial")} left.` : "";
  return (better ? `Best of ${count(made, "trial")}: ${best.shown}, initial ${first.shown}. Goal: ${aim}.` : `No set of ${count(made, "trial")} is better than the initial one (${first.shown}).`) + left;
}

function show() {
  const search = state.search?.state && state.search.state !== "none" ? state.search : null;
  const working = AT_WORK.includes(search?.state);
  opener.hidden = !state.truth || !form.hidden || Boolean(search);
  if (working) form.hidden = true;
  outcome.hidden = !search || !form.hidden;
  if (!search) return;
  failed.hidden = search.state !== "failed";
  statusNote.hidden = search.state === "failed";
  setText(failed, search.error ?? "");
  setText(statusNote, progressText(search));
  progress.hidden = !working;
  if (search.wanted && search.state !== "looking") progress.value = search.made / search.wanted;
  else progress.removeAttribute("value");
  drawn.replaceChildren(...[scoresPicture(search), scoresTable(search), importanceBars(search, specOf)].filter(Boolean));
  changes.replaceChildren(...(search.better ? search.changes : []).map(([parameter, before, value]) => el("li", {}, el("span", { text: specOf(parameter)?.title ?? parameter }), el("b", { text: `${shown(before, null)} → ${shown(value, specOf(parameter))}` }))));
  setText(warning, search.warning ? `Note: ${search.warning}.` : "");
  warning.hidden = !search.warning || working;
  stop.hidden = !working;
  goOn.hidden = working || !search.go_on;
  stop.disabled = search.state === "stopping";
  use.hidden = save.hidden = working || !search.better;
  if (use.hidden) naming.hidden = true;
  again.hidden = working || !state.truth;
}

export function startSearch() {
  receive("search", (message) => { state.search = message; }); // {state, goal, made, wanted, go_on, start, best, points, held_out, scores, importance, better, changes}
  on("search truth specs", show);
  show();
}

// --- pictures: score of each trial with the best so far, and importance of each parameter ----------------

const WIDTH = 300, HEIGHT = 92, LEFT = 38, RIGHT = 6, TOP = 8, BOTTOM = 16;
const MOST_BARS = 8;

function scoresPicture({ points = [], held_out: held = [], wanted, label, unit, goal }) {
  const known = points.filter(([, value]) => value !== null);
  if (known.length < 2) return null;
  const upwards = label === "F1" || label === "TA";
  const beside = held.filter(([, value]) => value !== null);
  const values = [...known, ...beside].map(([, value]) => value);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const span = high - low || 1;
  const last = Math.max(wanted - 1, ...known.map(([n]) => n), 1);
  const x = (n) => LEFT + (n / last) * (WIDTH - LEFT - RIGHT);
  const y = (value) => TOP + (1 - (value - low) / span) * (HEIGHT - TOP - BOTTOM);
  let best = null, path = "";
  for (const [n, value] of known) {
    if (best === null || (upwards ? value > best : value < best)) {
      path += best === null ? `M${x(n)} ${y(value)}` : `H${x(n)}V${y(value)}`;
      best = value;
    }
  }
  path += `H${x(known.at(-1)[0])}`;
  const end = x(known.at(-1)[0]);
  const heldPath = beside.length ? `${beside.map(([n, value], k) => (k ? `H${x(n)}V${y(value)}` : `M${x(n)} ${y(value)}`)).join("")}H${Math.max(end, x(beside.at(-1)[0]))}` : "";
  const tell = (value) => (span < 0.01 ? value.toFixed(4) : value.toFixed(2)) + (unit ? ` ${unit}` : "");
  return picture(WIDTH, HEIGHT, `${goal}: ${known.length} trials, from ${tell(low)} to ${tell(high)}`,
    line(LEFT, TOP, LEFT, HEIGHT - BOTTOM, "axis"), line(LEFT, HEIGHT - BOTTOM, WIDTH - RIGHT, HEIGHT - BOTTOM, "axis"),
    ...known.map(([n, value]) => svg("circle", { cx: x(n), cy: y(value), r: 1.6, class: "trial" })),
    svg("path", { d: path, class: "best" }),
    beside.length ? svg("path", { d: heldPath, class: "held" }) : null,
    beside.length ? text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 4, "— best   - - held out", "small", "middle") : null,
    high > low ? text(LEFT - 4, TOP + 5, tell(high), "small", "end") : null, text(LEFT - 4, HEIGHT - BOTTOM, tell(low), "small", "end"),
    text(LEFT, HEIGHT - 4, label, "small"), text(WIDTH - RIGHT, HEIGHT - 4, `trial ${last + 1}`, "small", "end"));
}

function importanceBars({ importance = {} }, specOf) {
  const rows = Object.entries(importance).slice(0, MOST_BARS);
  if (!rows.length) return null;
  return el("div", { id: "search-importance" }, el("h3", { text: "Importance" }), ...rows.map(([name, share]) => el("div", { class: "share-row" },
    el("span", { text: specOf(name)?.title ?? name, title: name }), el("span", { class: "share-bar" }, el("i", { style: { width: `${Math.max(100 * share, 0.5)}%` } })), el("small", { text: percent(share) }))));
}
