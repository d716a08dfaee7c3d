// The tab Tune: sets, undo and redo, the effect of the last change on the clusters, and all parameters by stage.

import { button, byId, el, letterOf, setText } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { count } from "../core/format.js";
import { isDrive, on, state } from "../core/store.js";
import { counted, verdictOf } from "../core/verdicts.js";
import { ofExtensions } from "../shell/extensions.js";
import { openTab } from "../shell/tabs.js";
import { forget, isChanged, isTuning, nameProblem, redo, refuse, reset, save, savedSets, specOf, takeFile, tuning, undo, use } from "./parameters.js";
import { startWholeRun, wholeRun } from "./remap_status.js";
import { rowOf } from "./row.js";

const LARGEST_FILE = 100_000;
const MAIN = "Main parameters";
const rows = new Map(); // by the parameter's name
const groups = new Map(); // by the stage; the main parameters have their own group
let presetValues = {};

const counts = el("section", { id: "tune-counts", "aria-label": "Effect of the last change on the clusters of this scan" });

function build() {
  const file = el("input", { id: "tune-file", type: "file", accept: ".toml,application/toml,text/plain", hidden: true, "aria-label": "Parameter file", onchange: async () => {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    if (chosen.size > LARGEST_FILE) refuse(`${chosen.name} is larger than ${LARGEST_FILE / 1000} kB, so it is not a parameter file.`);
    else await takeFile(chosen.name, await chosen.text());
  } });
  const find = el("input", { id: "tune-find", type: "search", placeholder: "Find", "aria-label": "Find a parameter by name, stage or meaning", autocomplete: "off", oninput: sift });
  const only = el("input", { id: "tune-only", type: "checkbox", "aria-label": "Changed only", onchange: sift });
  const main = tuning.specs.filter((spec) => spec.main).sort((a, b) => (a.stage === "Filters") - (b.stage === "Filters")); // as in the panel of the scene
  const others = tuning.specs.filter((spec) => !spec.main);
  const parts = [groupOf(MAIN, main), ...[...new Set(others.map((spec) => spec.stage))].map((stage) => groupOf(stage, others.filter((spec) => spec.stage === stage)))];
  const sets = el("details", { class: "tune-part" }, el("summary", { text: "Sets and files" }),
    el("p", { id: "tune-summary", class: "note dim" }),
    el("div", { class: "tune-files" },
      button("tune-save", "Save as …", "Save these values on the server under a name", askName), button("tune-delete", "Delete", "Delete the saved set", dropSet),
      el("a", { class: "small", id: "tune-download", href: "/api/parameters.toml", download: "parameters.toml", text: "Download", title: "These values as a TOML file, for --config of the command line" }),
      button("tune-upload", "Upload", "Use the values of a TOML file", () => file.click()), file),
    el("form", { id: "tune-name-form", class: "tune-files", hidden: true, onsubmit: saveSet },
      el("input", { id: "tune-name", type: "text", maxlength: "40", placeholder: "Name of the set", "aria-label": "Name of the set", autocomplete: "off", onkeydown: (event) => event.key === "Escape" && closeName() }),
      el("button", { class: "small primary", text: "Save" }), el("button", { class: "small", type: "button", text: "Cancel", onclick: closeName })));
  byId("panel-tune").replaceChildren(
    el("div", { class: "tune-top" }, el("div", { class: "tune-head" },
      el("select", { id: "tune-set", "aria-label": "Preset or saved set", onchange: (event) => use(event.target.value) }),
      button("tune-undo", "Undo", "Undo the last parameter change (Ctrl+Z in this tab)", undo), button("tune-redo", "Redo", "Redo it (Ctrl+Shift+Z)", redo),
      button("tune-reset", "Reset all", "Reset all values to the preset", () => reset([])),
      find, el("label", { class: "tune-only", title: "Only the parameters whose values differ from the preset" }, only, " changed")),
    el("div", { class: "tune-effect" }, el("p", { id: "tune-error", class: "error", role: "alert", hidden: true }), counts, wholeRun)),
    el("div", { id: "tune-rows" }, ...parts),
    el("p", { id: "tune-none", class: "empty", hidden: true }),
    sets,
    ...ofExtensions("tuneParts"));
  show();
}

function groupOf(stage, specs) {
  for (const spec of specs) rows.set(spec.name, rowOf(spec, ...ofExtensions("parameterButtons", spec)));
  const changedCount = el("small");
  const group = el("details", { "data-stage": stage }, el("summary", {}, stage, changedCount), ...specs.map(({ name }) => rows.get(name).node));
  group.open = stage === MAIN;
  groups.set(stage, { group, changedCount, specs, open: group.open });
  group.addEventListener("toggle", () => { if (!sifting()) groups.get(stage).open = group.open; });
  return group;
}

const sifting = () => Boolean(byId("tune-find").value.trim() || byId("tune-only").checked || !isDrive());

// Whether the map of the open run depends on a parameter; that of a run of one step depends on few.
const matters = (name) => isDrive() || state.status.one_step.parameters.includes(name);
let siftedForDrive = true;

function siftForRun() {
  if (!rows.size || siftedForDrive === isDrive()) return;
  siftedForDrive = isDrive();
  sift();
}

// Filters the rows by the search, best matches first, and opens their stages.
function sift() {
  const words = byId("tune-find").value.trim().toLowerCase().split(/\s+/).filter(Boolean);
  const only = byId("tune-only").checked;
  let found = 0;
  const stages = [];
  for (const { group, specs, open } of groups.values()) {
    let here = 0;
    const ranked = [];
    for (const spec of specs) {
      const { node } = rows.get(spec.name);
      node.hidden = !words.every((word) => node.dataset.words.includes(word)) || (only && !isChanged(spec.name)) || !matters(spec.name);
      here += node.hidden ? 0 : 1;
      ranked.push({ node, rank: node.hidden || !words.length ? 0 : rankOf(spec, words) });
    }
    arrange(group, ranked);
    stages.push({ node: group, rank: here ? Math.min(...ranked.filter(({ node }) => !node.hidden).map(({ rank }) => rank)) : 0 });
    group.hidden = !here;
    group.open = sifting() ? here > 0 : open;
    found += here;
  }
  arrange(byId("tune-rows"), stages);
  byId("tune-none").hidden = found > 0;
  setText(byId("tune-none"), only && !words.length ? "No value differs from the preset." : "No parameter matches. Clear the search to see all.");
}

function show() {
  if (!rows.size || !state.parameters) return;
  const { changed, preset, undo: steps, redo: undone } = state.parameters;
  for (const [name, row] of rows) row.show(presetValues[name] ?? specOf(name)?.default);
  for (const { changedCount, specs } of groups.values()) {
    const number = specs.filter(({ name }) => changed.includes(name)).length;
    setText(changedCount, number ? ` ● ${number} changed` : "");
  }
  byId("tune-undo").disabled = !steps;
  byId("tune-redo").disabled = !undone;
  byId("tune-reset").disabled = !changed.length;
  setText(byId("tune-summary"), changed.length ? `● ${changed.length} of ${rows.size} values differ from ${preset}: ${changed.slice(0, 3).map((name) => specOf(name)?.title).join(", ")}${changed.length > 3 ? " …" : ""}.` : `All values as in ${preset}: ${tuning.presets.find(({ name }) => name === preset)?.doc ?? ""}.`);
  if (byId("tune-only").checked) sift();
  showSets();
  showCounts();
}

function showSets() {
  const list = byId("tune-set");
  const inForce = state.parameters.set || (state.parameters.changed.length ? "" : state.parameters.preset);
  const choices = [...tuning.presets.map(({ name, doc }) => [name, doc]), ...savedSets().map(({ name, who }) => [name, who])];
  const key = JSON.stringify([choices, state.parameters.preset]);
  if (list.dataset.shown !== key) {
    list.dataset.shown = key;
    const option = ([name, title]) => el("option", { value: name, text: name, title });
    list.replaceChildren(el("option", { value: "", text: `● ${state.parameters.preset}`, title: `Values differ from ${state.parameters.preset}`, hidden: true }),
      el("optgroup", { label: "Presets" }, ...choices.slice(0, tuning.presets.length).map(option)),
      ...(savedSets().length ? [el("optgroup", { label: "Saved sets" }, ...choices.slice(tuning.presets.length).map(option))] : []));
  }
  if (list.value !== inForce) list.value = inForce;
  byId("tune-delete").hidden = !state.parameters.set;
}

function showCounts() {
  if (isTuning()) counts.replaceChildren(...countsBeforeAfter());
}

function showError() {
  const line = byId("tune-error");
  if (!line) return;
  line.hidden = !tuning.error;
  setText(line, tuning.error);
  show(); // what was refused goes back
}

function askName() {
  byId("tune-save").closest("details").open = true;
  byId("tune-name-form").hidden = false;
  byId("tune-name").value = state.parameters.set;
  byId("tune-name").focus();
}

function closeName() {
  byId("tune-name-form").hidden = true;
  byId("tune-save").focus();
}

async function saveSet(event) {
  event.preventDefault();
  const name = byId("tune-name").value.trim();
  if (nameProblem(name)) refuse(nameProblem(name));
  else if (await save(name)) closeName();
}

// Deletes without a question: the values stay in use and can be saved again.
async function dropSet() {
  if (await forget(state.parameters.set)) byId("tune-set").focus();
}

// Shows the row of a parameter with the cursor in its value.
export function openParameter(name) {
  openTab("tune");
  byId("side").classList.add("open");
  byId("tune-find").value = "";
  byId("tune-only").checked = false;
  sift();
  const { node } = rows.get(name);
  node.closest("details").open = true;
  node.scrollIntoView({ block: "center" });
  byId(`tune-${name}`).focus();
}

export const openSearch = () => { openTab("tune"); byId("tune-find")?.focus(); };

export function startTunePanel() {
  startWholeRun();
  byId("undo").addEventListener("click", undo);
  on("specs", build);
  on("parameters sets", () => isTuning() && show());
  on("parameters", () => { byId("undo").disabled = !state.parameters?.undo; });
  on("tuning", showError);
  on("tab", () => isTuning() && show());
  on("map status parameters", showCounts);
  on("status specs", siftForRun);
}

// --- clusters of the current scan by verdict, before and after the last change ---------------------------

const signed = (number) => (number > 0 ? `+${number}` : number < 0 ? `−${-number}` : "=");

function countsBeforeAfter() {
  if (!state.map) return [el("p", { class: "empty", text: `${nothingYet("No scan")} The effect of each change is shown here.` })];
  const { verdicts: now = {}, before, index, right, wrong } = state.map;
  const then = before?.verdicts;
  const names = [...new Set(["tree", ...Object.keys(now), ...Object.keys(then ?? {})])].filter((name) => now[name] || then?.[name] || name === "tree");
  names.sort((a, b) => (b === "tree") - (a === "tree") || (now[b] ?? 0) - (now[a] ?? 0));
  const total = (of) => Object.values(of).reduce((sum, number) => sum + number, 0);
  const sum = (number) => count(number, isDrive() ? "cluster" : "candidate");
  const pending = state.status?.revision < state.parameters?.revision;
  const lead = pending ? isDrive() ? "Mapping this scan …" : "Mapping …" : then ? `${total(then)} → ${sum(total(now))}` : sum(total(now));
  const title = isDrive() ? `Scan ${index}${then ? ", before and after the last change" : state.status?.state === "playing" ? ". Pause to compare before and after a change." : ". Change a parameter to compare before and after."}` : "Candidates for stems";
  const same = names.filter((name) => then && name !== "tree" && (now[name] ?? 0) === (then[name] ?? 0));
  return [el("ul", { class: "chips", title, tabindex: "0", "aria-label": "Clusters by verdict" }, el("li", { class: "lead", text: lead }), ...names.filter((name) => !same.includes(name)).map((name) => chip(name, then ? then[name] ?? 0 : null, now[name] ?? 0)), ...truthChips(right, wrong, before),
      same.length ? el("li", { class: "same", text: `unchanged: ${same.map((name) => counted(now[name], name)).join(", ")}` }) : "")];
}

function chip(name, then, now) {
  return change(name, then, now, letterOf(verdictOf(name)));
}

function truthChips(right, wrong, before) {
  if (right === null || right === undefined) return [];
  const ring = (cls) => el("span", { class: `letter ring ${cls}`, "aria-hidden": "true" });
  return [change("true", before?.right ?? null, right, ring("on"), "at a true tree"), change("false", before?.wrong ?? null, wrong, ring("off"), "not at one")];
}

function change(name, then, now, sign, text = name) {
  const differs = then !== null && then !== now;
  return el("li", { "data-chip": name, class: differs ? "differs" : "" }, sign, el("span", { text }), el("b", { text: then === null ? String(now) : `${then} → ${now}` }),
    then === null ? "" : el("small", { text: signed(now - then) }));
}

// --- order of the matches of a search --------------------------------------------------------------------

// 0: name or title begins with the text; 1: words of name and title begin with the words; 2: words of description or stage
// do; 3: the words occur anywhere.
function rankOf({ name, title, doc, stage }, words) {
  const text = words.join(" ");
  const names = [title, name, name.split(".").pop()].map((each) => each.toLowerCase());
  if (names.some((each) => each.startsWith(text))) return 0;
  if (allBegin(names.join(" "), words)) return 1;
  return allBegin(`${names.join(" ")} ${doc} ${stage}`.toLowerCase(), words) ? 2 : 3;
}

function allBegin(text, words) {
  const parts = text.split(/[^\p{L}\p{N}]+/u);
  return words.every((word) => text.startsWith(word) || parts.some((part) => part.startsWith(word)) || text.includes(` ${word}`));
}

// Sorts nodes by rank. Nodes that are in order are not moved, which would close or scroll them.
function arrange(parent, entries) {
  const order = entries.map((entry, place) => ({ ...entry, place })).sort((a, b) => a.rank - b.rank || a.place - b.place);
  const now = entries.map(({ node }) => node).sort((a, b) => (a.compareDocumentPosition(b) & Node.DOCUMENT_POSITION_FOLLOWING ? -1 : 1));
  if (order.every(({ node }, k) => node === now[k])) return;
  for (const { node } of order) {
    const below = node.nextElementSibling?.matches(".below-row") ? [node.nextElementSibling] : [];
    parent.append(node, ...below);
  }
}
