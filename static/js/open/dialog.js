// The dialog to open a run.

import { check, open } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { capital } from "../core/format.js";
import { on, state } from "../core/store.js";
import { parametersText } from "../playback/timeline.js";
import { ofExtensions } from "../shell/extensions.js";
import { progressOf } from "../shell/status.js";
import { confirmLeaving, forgetQuestion } from "./leaving.js";
import { completion, isListed, listPlaces, nearMisses, sift } from "./places.js";
import { isLive, recordingOf, rememberRobot, showRobot, startRobotForm } from "./robot_form.js";
import { chosenFor, startInside } from "./source_options.js";
import { startUpload } from "./upload.js";

const dialog = byId("source-dialog");
let requested = null; // address that the server checks; the open run is kept meanwhile
let asked = null; // address that is being opened
let left = null; // status before that

export async function openSources() {
  say("");
  if (!dialog.open) dialog.showModal();
  const address = byId("source-uri");
  show();
  const { changed: values = [] } = state.parameters ?? {};
  byId("source-parameters").hidden = !values.length;
  setText(byId("source-parameters"), values.length ? `The run opens with the parameters in force: ${parametersText()}. Reset all in Tune returns to the preset.` : "");
  address.focus();
  try {
    await listPlaces(choose);
    sift(requested !== null);
  } catch (error) {
    say(error.message);
  }
}

// Opens the dialog with the form of a robot, filled with the address of the present or the last one.
export function connectRobot() {
  openSources();
  showRobot(state.status?.source);
}

// A place of the list is opened, or written into the field if something is chosen for it first.
function choose(uri) {
  if (!isLive(uri) && !ofExtensions("sourceChoice").some((each) => each.takes(uri))) return ask(uri);
  byId("source-uri").value = uri;
  for (const type of ["input", "change"]) byId("source-uri").dispatchEvent(new Event(type));
  return byId("source-open").focus();
}

const path = () => byId("source-uri").value.trim();
// What an extension lets a person choose for the typed path.
const choice = () => ofExtensions("sourceChoice").find((each) => each.takes(path()));
let chosenAt = ""; // path for which they were chosen; "" if before a path was entered

function forget() {
  byId("source-odometry").value = "auto"; // topics and mounting are kept by address
  for (const each of ofExtensions("sourceChoice")) each.forget();
  chosenAt = "";
}

// Choices for another path do not count.
function show() {
  if (chosenAt && chosenAt !== path()) forget();
  const chosen = choice();
  for (const { node } of ofExtensions("sourceChoice")) node.hidden = node !== chosen?.node;
  byId("source-motion").hidden = chosen !== undefined && !chosen.moves();
  sift();
}

export async function ask(uri) {
  if (!uri) {
    say("Enter a path or an address, for example sim:stand.");
    return;
  }
  say("");
  const request = { uri, odometry: byId("source-odometry").value, ...(uri === choice()?.address(path()) ? choice().fields() : {}), ...chosenFor(uri), ...recordingOf(uri) };
  try {
    await confirmLeaving(async () => {
      begin(uri);
      await check(request);
      if (requested !== uri) await new Promise(() => {}); // another one was requested meanwhile, or none any more
      end();
    });
    begin(uri);
    left = state.status;
    if (isLive(uri)) rememberRobot(uri);
    await open(request);
    if (requested !== uri) return;
    asked = uri;
    showWait(`Opening ${uri}.`);
    follow(state);
  } catch (error) {
    if (requested === uri) finish(error.message);
  }
}

function begin(uri) {
  requested = uri;
  setText(byId("source-open"), "Opening…");
  showWait(`Checking ${uri}.`);
}

function end() {
  requested = asked = null;
  setText(byId("source-open"), "Open");
  showWait("");
}

function finish(message) {
  end();
  if (message) say(message);
  else dialog.close();
}

// The next visit begins with the whole list, however the dialog was closed.
function clear() {
  if (requested !== null) finish("");
  byId("source-uri").value = "";
  byId("source-robot").open = false;
  byId("source-record").checked = true; // what was not recorded is lost
  byId("source-uri").dispatchEvent(new Event("input"));
  forget();
}

function follow({ status }) {
  if (asked === null || status === left) return;
  if (status.detail && (status.source === asked || status.compiling_since_s !== null)) showWait(status.detail, progressOf(status));
  if (status.state === "failed") finish(status.detail || `${asked} could not be opened.`);
  else if (status.source === asked && status.state !== "starting") finish(""); // a whole cloud takes minutes until its first map
}

// Why the opening takes long; a screen reader does not announce its progress.
function showWait(text, progress = "") {
  const line = byId("source-waits");
  line.hidden = !text;
  setText(line.firstElementChild, capital(text));
  setText(line.lastElementChild, progress);
  sift(requested !== null);
}

function say(text) {
  forgetQuestion();
  const error = byId("source-error");
  setText(error, capital(text));
  error.hidden = !text;
  const near = text && !isListed(path()) ? nearMisses(path()) : [];
  byId("source-near").hidden = !near.length;
  byId("source-near").replaceChildren("Did you mean ", ...near.flatMap((uri, k) => [k ? ", " : "", el("button", { class: "link", type: "button", text: uri, onclick: () => choose(uri) })]), "?");
}

export function startSources() {
  byId("source-button").addEventListener("click", () => openSources());
  byId("notice-open").addEventListener("click", () => (isLive(state.status.source) ? connectRobot() : openSources()));
  byId("source-close").addEventListener("click", () => finish(""));
  byId("source-form").addEventListener("submit", (event) => {
    event.preventDefault();
    ask(choice()?.address(path()) ?? path());
  });
  const field = byId("source-uri");
  field.addEventListener("input", () => {
    say("");
    show();
  });
  field.addEventListener("keydown", (event) => { // completes the path, as in a terminal
    const wanted = completion();
    if (event.key !== "Tab" || event.shiftKey || !wanted) return;
    event.preventDefault();
    field.value = wanted;
    show();
  });
  const choices = [...ofExtensions("sourceChoice").map(({ node }) => node), byId("source-motion")];
  byId("source-error").before(...choices.slice(0, -1));
  for (const node of choices) node.addEventListener("change", () => {
    chosenAt = path();
    show();
  });
  dialog.addEventListener("close", clear);
  startInside();
  startRobotForm();
  on("status", follow);
  startUpload(async ({ uri }) => { if (!dialog.open) await openSources(); ask(uri); });
}
