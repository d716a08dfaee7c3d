// "Tune for me": a search for parameters over this run, against its true trees. It runs on the server, in a process of its own.

import { get, post } from "./api.js";
import { myName } from "./annotate.js";
import { byId, el, setText } from "./dom.js";
import { count } from "./format.js";
import { on, state } from "./state.js";
import { attempt, shown, specOf, tuning } from "./tune.js";
import { importanceBars, scoresPicture } from "./tune_search_draw.js";
import { otherRuns, runsWanted, scoresTable, showRuns } from "./tune_search_runs.js";

const AT_WORK = ["looking", "searching", "stopping"];
const NO_PART = ["evaluation.", "obstacles."]; // decide how a map is judged, or are no part of it
const SET_NAME = /^[\p{L}\p{N}_][\p{L}\p{N}_ .+-]{0,39}$/u;
const axes = new Map(); // by the parameter's name: {node, text()}
let goals = [], asked = false;

const button = (id, text, title, onclick, kind = "small") => el("button", { id, type: "button", class: kind, text, title, onclick });
const number = (id, label, value, max) => el("label", {}, `${label} `, el("input", { id, type: "number", min: "1", max: String(max), step: "1", value: String(value) }));
const opener = button("search-open", "Tune for me …", "Search for the values that map this run best, judged by its true trees", () => openForm(true));
const goal = el("select", { id: "search-goal", "aria-label": "What to search for" });
const list = el("ul", { id: "search-axes", "aria-label": "Searched over" });
const more = el("select", { id: "search-more", "aria-label": "Search over another parameter", onchange: () => { if (more.value) addAxis(more.value); more.value = ""; } });
const form = el("form", { id: "search-form", hidden: true, onsubmit: start },
  el("p", { class: "note dim", text: "The whole run is mapped again and again with other values, begun at those in force, and judged by its true trees." }),
  el("label", { class: "search-goal" }, "Goal ", goal), el("div", { class: "search-names dim", "aria-hidden": "true" }, ...["Searched over", "from", "to", ""].map((text) => el("span", { text }))), list, more, otherRuns,
  el("div", { class: "search-limits" }, number("search-trials", "Trials", 200, 5000), number("search-minutes", "Minutes at most", 10, 1440)),
  el("div", { class: "search-buttons" }, el("button", { id: "search-start", class: "small primary", text: "Search" }), button("search-cancel", "Cancel", "Close, and search for nothing", () => openForm(false))));
const told = el("p", { id: "search-told", class: "note", role: "status" });
const failed = el("p", { id: "search-error", class: "error", role: "alert", hidden: true });
const progress = el("progress", { id: "search-progress", max: "1", hidden: true, "aria-label": "Trials made" });
const warning = el("p", { id: "search-warning", class: "note", hidden: true });
const drawn = el("div", { id: "search-drawn" });
const stop = button("search-stop", "Stop", "End the search; the best set so far stays here", () => attempt(() => post("/api/search/stop", {})));
const goOn = button("search-go-on", "Go on", "Make the trials that are left, with the same choices", () => attempt(() => post("/api/search/go-on", {})));
const use = button("search-use", "Use these", "Take the values of the best set; Undo takes them back", () => attempt(() => post("/api/search/use", {})), "small primary");
const save = button("search-save", "Save as set …", "Keep the best set under a name, with where it comes from", () => { naming.hidden = false; name.focus(); });
const again = button("search-again", "Search again …", "Another search", () => openForm(true));
const name = el("input", { id: "search-name", type: "text", maxlength: "40", placeholder: "Name of the set", "aria-label": "Name of the set that was found", autocomplete: "off", onkeydown: (event) => event.key === "Escape" && (naming.hidden = true) });
const naming = el("form", { id: "search-name-form", class: "search-buttons", hidden: true, onsubmit: saveFound }, name, el("button", { class: "small primary", text: "Save" }));
const changes = el("ul", { id: "search-changes", "aria-label": "What was found" });
const outcome = el("div", { id: "search-outcome", hidden: true }, told, failed, progress, drawn, warning, changes, el("div", { class: "search-buttons" }, stop, use, save, goOn, again), naming);
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
  show();
  if (open) goal.focus();
  else opener.focus();
}

// A parameter to be searched over: its bounds, or which of its values.
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
  const left = tuning.specs.filter((spec) => spec.kind !== "name" && !axes.has(spec.name) && !NO_PART.some((part) => spec.name.startsWith(part)));
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
  if (begun) searchPart.scrollIntoView({ block: "center" }); // the form was long: what comes of it stands where it began
}

async function saveFound(event) {
  event.preventDefault();
  if (!SET_NAME.test(name.value.trim())) return name.setCustomValidity("A name begins with a letter or digit."), name.reportValidity(), name.setCustomValidity("");
  if (await attempt(() => post("/api/search/save", { name: name.value.trim(), who: myName() }))) naming.hidden = true;
}

function words({ state: stage, made, wanted, start: first, best, better, goal: aim, go_on: canGoOn }) {
  if (stage === "looking") return "Looking at the scans of the whole run once …";
  const now = first ? `, ${first.shown} with the values it began with` : "";
  if (stage === "searching") return `${made} of ${count(wanted, "trial")}: best ${best?.shown ?? "–"}${now}.`;
  if (stage === "stopping") return "Stopping …";
  if (!best) return "Stopped before anything was tried.";
  const left = canGoOn ? ` ${count(wanted - made, "trial")} left.` : "";
  return (better ? `Found after ${count(made, "trial")}: ${best.shown} in place of ${first.shown}. Goal: ${aim}.` : `No set of ${count(made, "trial")} was better than the values it began with (${first.shown}).`) + left;
}

function show() {
  const search = state.search?.state && state.search.state !== "none" ? state.search : null;
  const working = AT_WORK.includes(search?.state);
  opener.hidden = !state.truth || !form.hidden || Boolean(search);
  if (working) form.hidden = true;
  outcome.hidden = !search || !form.hidden;
  if (!search) return;
  failed.hidden = search.state !== "failed";
  told.hidden = search.state === "failed";
  setText(failed, search.error ?? "");
  setText(told, words(search));
  progress.hidden = !working;
  if (search.wanted && search.state !== "looking") progress.value = search.made / search.wanted;
  else progress.removeAttribute("value");
  drawn.replaceChildren(...[scoresPicture(search), scoresTable(search), importanceBars(search, specOf)].filter(Boolean));
  changes.replaceChildren(...(search.better ? search.changes : []).map(([parameter, before, value]) => el("li", {}, el("span", { text: specOf(parameter)?.title ?? parameter }), el("b", { text: `${shown(before, null)} → ${shown(value, specOf(parameter))}` }))));
  setText(warning, search.warning ? `Mind: ${search.warning}.` : "");
  warning.hidden = !search.warning || working;
  stop.hidden = !working;
  goOn.hidden = working || !search.go_on;
  stop.disabled = search.state === "stopping";
  use.hidden = save.hidden = working || !search.better;
  if (use.hidden) naming.hidden = true;
  again.hidden = working || !state.truth;
}

export function startSearch() {
  on("search truth specs", show);
  show();
}
