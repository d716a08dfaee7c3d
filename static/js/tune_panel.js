// The tab Tune: sets, undo and redo, what a change did to the clusters, and every parameter by stage.

import { byId, el, setText } from "./dom.js";
import { countsBeforeAfter } from "./tune_counts.js";
import { on, state } from "./state.js";
import { forget, isChanged, isTuning, redo, refuse, reset, save, savedSets, specOf, takeFile, tuning, undo, use } from "./tune.js";
import { arrange, rankOf } from "./tune_find.js";
import { rowOf } from "./tune_row.js";
import { matterButton, startSensitivity } from "./tune_sensitivity.js";
import { openTab } from "./tabs.js";
import { searchPart, startSearch } from "./tune_search.js";
import { startWholeRun, wholeRun } from "./tune_whole.js";

const LARGEST_FILE = 100_000;
const SET_NAME = /^[\p{L}\p{N}_][\p{L}\p{N}_ .+-]{0,39}$/u;
const OPEN_FIRST = ["Clustering", "Detection"];
const rows = new Map(); // by the parameter's name
const groups = new Map(); // by the stage
let presetValues = {};

const button = (id, text, title, onclick) => el("button", { id, class: "small", text, title, onclick });
const counts = el("section", { id: "tune-counts", "aria-label": "What the last change did to the clusters of this scan" });

function build() {
  const file = el("input", { id: "tune-file", type: "file", accept: ".toml,application/toml,text/plain", hidden: true, "aria-label": "File of parameters", onchange: async () => {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    if (chosen.size > LARGEST_FILE) refuse(`${chosen.name} is larger than ${LARGEST_FILE / 1000} kB; a file of parameters is not.`);
    else await takeFile(chosen.name, await chosen.text());
  } });
  const find = el("input", { id: "tune-find", type: "search", placeholder: "Find a parameter", "aria-label": "Find a parameter by name, stage or meaning", autocomplete: "off", oninput: sift });
  const only = el("input", { id: "tune-only", type: "checkbox", onchange: sift });
  const stages = [...new Set(tuning.specs.map((spec) => spec.stage))].map(stageOf);
  byId("panel-tune").replaceChildren(
    el("div", { class: "tune-head" },
      el("select", { id: "tune-set", "aria-label": "Preset or saved set", onchange: (event) => use(event.target.value) }),
      button("tune-undo", "Undo", "Undo the last change of a parameter (Ctrl+Z in this tab)", undo), button("tune-redo", "Redo", "Do it again (Ctrl+Shift+Z)", redo),
      button("tune-compare", "A | B", "Compare two sets on this scan (c)", () => byId("compare-button").click())),
    el("div", { class: "tune-files" },
      button("tune-save", "Save as …", "Keep these values on the server under a name", askName), button("tune-delete", "Delete", "Delete the saved set", dropSet),
      el("a", { class: "small", id: "tune-download", href: "/api/parameters.toml", download: "parameters.toml", text: "Download", title: "These values as a TOML file; the command line takes it with --config" }),
      button("tune-upload", "Upload", "Take the values of a TOML file", () => file.click()), file, el("span", { class: "grow" }), button("tune-reset", "Reset all", "Back to the values of the preset", () => reset([]))),
    el("form", { id: "tune-name-form", class: "tune-files", hidden: true, onsubmit: saveSet },
      el("input", { id: "tune-name", type: "text", maxlength: "40", placeholder: "Name of the set", "aria-label": "Name of the set", autocomplete: "off", onkeydown: (event) => event.key === "Escape" && closeName() }),
      el("button", { class: "small primary", text: "Save" }), el("button", { class: "small", type: "button", text: "Cancel", onclick: closeName })),
    el("p", { id: "tune-error", class: "error", role: "alert", hidden: true }),
    counts, wholeRun, searchPart,
    el("p", { id: "tune-summary", class: "note dim" }),
    el("div", { class: "tune-files" }, find, el("label", { class: "tune-only" }, only, " changed only")),
    el("div", { id: "tune-rows" }, ...stages),
    el("p", { id: "tune-none", class: "empty", hidden: true }));
  show();
}

function stageOf(stage) {
  const specs = tuning.specs.filter((spec) => spec.stage === stage);
  for (const spec of specs) rows.set(spec.name, rowOf(spec, ...(spec.kind === "name" ? [] : [matterButton(spec)])));
  const told = el("small");
  const group = el("details", { "data-stage": stage }, el("summary", {}, stage, told), ...specs.map(({ name }) => rows.get(name).node));
  group.open = OPEN_FIRST.includes(stage);
  groups.set(stage, { group, told, specs, open: group.open });
  group.addEventListener("toggle", () => { if (!sifting()) groups.get(stage).open = group.open; });
  return group;
}

const sifting = () => Boolean(byId("tune-find").value.trim() || byId("tune-only").checked);

// Shows what is searched for, what begins with it first, and opens the stages where it is.
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
      node.hidden = !words.every((word) => node.dataset.words.includes(word)) || (only && !isChanged(spec.name));
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
  setText(byId("tune-none"), only && !words.length ? "Nothing differs from the preset. Move a slider, and it is listed here." : "No parameter has these words. Clear the search to see all.");
}

function show() {
  if (!rows.size || !state.parameters) return;
  const { changed, preset, undo: steps, redo: undone } = state.parameters;
  for (const [name, row] of rows) row.show(presetValues[name] ?? specOf(name)?.default);
  for (const { told, specs } of groups.values()) {
    const number = specs.filter(({ name }) => changed.includes(name)).length;
    setText(told, number ? ` ● ${number} changed` : "");
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
  const told = [...tuning.presets.map(({ name, doc }) => [name, doc]), ...savedSets().map(({ name, who }) => [name, who])];
  const key = JSON.stringify([told, state.parameters.preset]);
  if (list.dataset.shown !== key) {
    list.dataset.shown = key;
    const option = ([name, title]) => el("option", { value: name, text: name, title });
    list.replaceChildren(el("option", { value: "", text: `${state.parameters.preset}, changed`, hidden: true }),
      el("optgroup", { label: "Presets" }, ...told.slice(0, tuning.presets.length).map(option)),
      ...(savedSets().length ? [el("optgroup", { label: "Saved sets" }, ...told.slice(tuning.presets.length).map(option))] : []));
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
  if (!SET_NAME.test(name)) refuse("A name begins with a letter or digit; letters, digits, space and . + - _ follow.");
  else if (await save(name)) closeName();
}

// Deleted at once, because saving it again brings it back: its values stay in force.
async function dropSet() {
  if (await forget(state.parameters.set)) byId("tune-set").focus();
}

// From the palette: the row of a parameter, with the cursor in its value.
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
  startSensitivity();
  startSearch();
  on("specs", build);
  on("parameters sets", () => isTuning() && show());
  on("tuning", showError);
  on("tab", () => isTuning() && show());
  on("map status parameters", showCounts);
}
