// The dialog to open a run.

import { get, open } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { capital } from "../core/format.js";
import { on, state } from "../core/store.js";
import { parametersText } from "../playback/timeline.js";
import { chosenFor, startInside } from "./source_options.js";
import { startUpload } from "./upload.js";

const dialog = byId("source-dialog");
let requested = null; // address that the server checks; the open run is kept meanwhile
let asked = null; // address that is being opened
let left = null; // status before that

// `begin` is the beginning of an address that a person completes.
export async function openSources(begin = "") {
  say("");
  if (!dialog.open) dialog.showModal();
  const address = byId("source-uri");
  if (typeof begin === "string" && begin) address.value = begin;
  showChoice();
  const { changed: values = [] } = state.parameters ?? {};
  byId("source-parameters").hidden = !values.length;
  setText(byId("source-parameters"), values.length ? `The run opens with the parameters in force: ${parametersText()}. Reset all in Tune returns to the preset.` : "");
  address.focus();
  try {
    list(await get("/api/sources"));
  } catch (error) {
    say(error.message);
  }
}

function list({ scenarios = [], recordings = [] }) {
  const simulated = scenarios.map(({ uri, doc }) => entry(uri, uri, doc, () => withOptions(uri)));
  const recorded = recordings.map(({ uri, name, doc }) => entry(uri, name, doc));
  byId("source-list").replaceChildren(
    ...(recorded.length ? [el("h3", { text: "Recordings in the data folder" }), ...recorded] : []),
    ...(simulated.length ? [el("h3", { text: "Simulated, with ground truth" }),
      el("p", { class: "source-options" }, option("seed", "Seed of the stand (another seed is another stand)", "0", "1"), option("duration", "Duration s", "1", "0.1", "3600")), ...simulated] : []));
}

const option = (name, title, min, step, max) => el("label", {}, `${title} `, el("input", { id: `source-${name}`, type: "number", min, step, max, placeholder: "standard" }));

// The address of a scenario with the typed seed and duration.
function withOptions(uri) {
  const typed = ["seed", "duration"].map((name) => [name, byId(`source-${name}`).value]).filter(([, value]) => value);
  return typed.length ? `${uri}?${new URLSearchParams(typed)}` : uri;
}

const entry = (uri, title, doc, address = () => uri) =>
  el("button", { type: "button", onclick: () => (isWholeCloud(uri) ? offerChoice(uri) : ask(address())) }, el("b", { text: title }), el("span", { text: doc }));

// --- whole clouds: mapped as a whole, or driven through by a simulated robot ---------------------------

const isWholeCloud = (uri) => /\.(laz|las|e57|ply|npy|npz|pcd|xyz|asc|pts|txt|csv)$/i.test(uri);
const choice = () => byId("source-form").elements.namedItem("cloud-choice").value;
const path = () => byId("source-uri").value.trim();
const CHOICES = ["source-as", "source-unit", "source-up", "source-odometry"]; // of one source; topics and mounting are kept by address
let chosenAt = ""; // path for which they were chosen; "" if before a path was entered

function forget() {
  for (const id of CHOICES) byId(id).value = "auto";
  byId("source-form").elements.namedItem("cloud-choice").value = "map";
  chosenAt = "";
}

// A whole cloud that is mapped as it is has no odometry; a robot that drives through it has. Choices for another path do not count.
function showChoice() {
  if (chosenAt && chosenAt !== path()) forget();
  const cloud = isWholeCloud(path());
  byId("source-cloud").hidden = !cloud;
  byId("source-motion").hidden = cloud && choice() === "map";
}

// A cloud of the list is written into the field, above which the choice is.
function offerChoice(uri) {
  byId("source-uri").value = uri;
  showChoice();
  byId("source-open").focus();
}

// Form, unit and axis that were chosen for the file of points in the field; {} for other sources.
function chosenPoints(uri) {
  const typed = path();
  if (!isWholeCloud(typed) || uri !== chosenUri(typed)) return {};
  const chosen = { form: byId("source-as").value, unit: byId("source-unit").value, up: byId("source-up").value };
  return Object.fromEntries(Object.entries(chosen).filter(([, value]) => value !== "auto"));
}

const chosenUri = (uri) => (isWholeCloud(uri) && choice() === "drive" ? `sim:cloud?${new URLSearchParams({ file: uri })}` : uri);

export async function ask(uri) {
  if (!uri) {
    say("Enter a path or an address, for example sim:stand.");
    return;
  }
  requested = uri;
  left = state.status;
  say("");
  setText(byId("source-open"), "Opening…");
  try {
    await open({ uri, odometry: byId("source-odometry").value, ...chosenPoints(uri), ...chosenFor(uri) });
    if (requested !== uri) return;
    asked = uri;
    follow(state);
  } catch (error) {
    if (requested === uri) finish(error.message);
  }
}

function finish(message) {
  requested = asked = null;
  setText(byId("source-open"), "Open");
  if (message) say(message);
  else dialog.close();
}

function follow({ status }) {
  if (asked === null || status === left) return;
  if (status.state === "failed") finish(status.detail || `${asked} could not be opened.`);
  else if (status.source === asked && status.state !== "starting") finish(""); // a whole cloud takes minutes until its first map
}

function say(text) {
  const error = byId("source-error");
  setText(error, capital(text));
  error.hidden = !text;
}

export function startSources() {
  for (const id of ["source-button", "notice-open"]) byId(id).addEventListener("click", () => openSources());
  byId("source-close").addEventListener("click", () => finish(""));
  byId("source-form").addEventListener("submit", (event) => {
    event.preventDefault();
    ask(chosenUri(path()));
  });
  byId("source-uri").addEventListener("input", showChoice);
  for (const id of ["source-cloud", "source-motion"]) byId(id).addEventListener("change", () => {
    chosenAt = path();
    showChoice();
  });
  dialog.addEventListener("close", forget);
  startInside();
  on("status", follow);
  startUpload(async ({ uri }) => { if (!dialog.open) await openSources(); ask(uri); });
}
