// Play, step, seek and speed.

import { command, post } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { clock, count } from "../core/format.js";
import { startPopover } from "../core/popover.js";
import { attempted } from "../core/problem.js";
import { atSecondPress } from "../core/second_press.js";
import { isDrive, on, state } from "../core/store.js";
import { newestFirst } from "../core/timing.js";
import { timeLink } from "./time_link.js";

const ICONS = { play: "M5 3l12 7-12 7z", pause: "M5 3h4v14H5zM12 3h4v14h-4z" };
const STEPS = new Map([["back10", -10], ["back1", -1], ["on1", 1], ["on10", 10]]); // scans of each button
let dragging = false;

// Whether the run is on its way to a scan that takes long to reach.
export const isGoing = (status) => Boolean(status?.going_far);
export const playing = () => ["playing", "waiting"].includes(state.status?.state);
const hasEnded = () => state.status?.live && state.status.state === "finished"; // of a live run, which cannot be played again
const ready = () => playing() || (["paused", "finished"].includes(state.status?.state) && !hasEnded());
export const togglePlay = () => ready() && send(playing() ? "pause" : "play");
export const advance = (scans) => ready() && send("advance", { scans });

// A live run of which something is mapped.
export const canEnd = () => Boolean(state.status?.live) && state.status.scan_index >= 0 && (playing() || state.status.state === "paused");

// Nothing brings an ended run back.
export const endRun = atSecondPress((asks) => setText(byId("end-run"), asks ? "End it now?" : "End run"), () => send("end_run"));

async function send(type, fields) {
  await attempted(() => command(type, fields));
}

// While the thumb is dragged only the newest position is sent.
const seek = newestFirst((time) => send("seek", { time_s: time }));

function show() {
  const status = state.status;
  if (!status) return;
  const button = byId("play");
  const name = playing() ? "pause" : "play";
  if (button.dataset.shows !== name) {
    button.dataset.shows = name;
    button.setAttribute("aria-label", name === "pause" ? "Pause" : "Play");
    button.querySelector("path").setAttribute("d", ICONS[name]);
  }
  for (const id of STEPS.keys()) byId(id).hidden = status.live;
  for (const each of [button, ...[...STEPS.keys()].map(byId)]) each.disabled = !ready();
  byId("end-run").hidden = !canEnd();
  const line = byId("timeline");
  line.disabled = !(status.end_s > 0);
  if (!dragging && !seek.isBusy()) {
    const end = status.end_s || 1;
    line.max = String(end);
    line.step = String(end / Math.max(1000, Math.ceil(10 * end))); // so that the last step is the end of the run
    line.value = String(status.going_to_s ?? status.time_s); // the thumb stays where it was put while the run seeks
    showTime(status.time_s);
  }
  line.setAttribute("aria-valuetext", clock(Number(line.value)));
  setText(byId("time-end"), status.live ? "live" : status.end_s === null && status.scan_index >= 0 ? "open end" : clock(status.end_s));
  showSeeking(status);
  const speed = byId("speed");
  if (document.activeElement !== speed) speed.value = String(status.speed);
  speed.disabled = status.live; // a robot has its own
  showWarnings(status.warnings ?? []);
}

function showTime(seconds) {
  const field = byId("time-now");
  if (document.activeElement !== field) field.value = clock(seconds);
  field.disabled = byId("timeline").disabled;
}

// Seconds of "10", "10.5" or "0:10"; NaN for other texts.
function secondsOf(text) {
  const [, minutes = "0", seconds] = /^(?:(\d+):)?(\d+(?:\.\d*)?)$/.exec(text.trim().replace(",", ".")) ?? [];
  return 60 * Number(minutes) + Number(seconds);
}

// The scan at the typed time is the last one that is not after it; half a tenth keeps a rounded time from being the one before.
function seekTyped(field) {
  const seconds = secondsOf(field.value);
  field.setCustomValidity(Number.isFinite(seconds) ? "" : "Enter seconds or minutes:seconds, for example 10 or 0:10");
  if (!field.reportValidity()) return;
  field.blur();
  seek(Math.min(seconds + 0.05, Number(byId("timeline").max)));
}

// How far the scans up to a distant target are mapped.
function showSeeking(status) {
  const line = byId("seeking");
  line.hidden = !isGoing(status);
  if (line.hidden) return;
  const percent = Math.floor(100 * Math.min(status.time_s / Math.max(status.going_to_s ?? status.end_s ?? 0, 1e-3), 1));
  line.setAttribute("aria-label", `Mapping up to ${status.going_to}`);
  line.setAttribute("aria-valuenow", String(percent));
  line.title = `Mapping up to ${status.going_to}: ${percent} %`;
  line.firstElementChild.style.width = `${percent}%`;
}

let closeWarnings = () => {};

function showWarnings(warnings) {
  const button = byId("warnings-button");
  button.hidden = !warnings.length;
  if (!warnings.length) closeWarnings();
  setText(button, `⚠ ${count(warnings.length, "warning")}`);
  const groups = grouped(warnings), list = byId("warnings"), canSeek = isDrive() && !state.status.live, shown = JSON.stringify([groups, canSeek]);
  if (list.dataset.shown === shown) return;
  list.dataset.shown = shown;
  list.replaceChildren(...groups.map(({ texts, at }) => el("li", { title: texts.length > 1 ? texts.join("\n") : "" }, texts.at(-1),
    texts.length > 1 ? ` (${texts.length} times)` : "", ...(at === undefined ? [] : [" ", canSeek ? timeLink(at) : `at ${clock(at)}`]))));
}

// Warnings that differ in numbers only are one, with all texts, and the time at which the newest text was given first.
function grouped(warnings) {
  const groups = new Map();
  for (const text of warnings) {
    const key = text.replace(/(?<![\w/.])\d+(\.\d+)?(?![\w/])/g, "0"); // not the number in a name, as /lidar1
    const at = state.events.findLast(({ kind, text: of }) => kind === "warning" && text.startsWith(of))?.t;
    groups.set(key, { texts: [...(groups.get(key)?.texts ?? []), text], at });
  }
  return [...groups.values()];
}

// The saved set in force, or the preset with the number of changed values.
export function parametersText() {
  const { preset, set, changed } = state.parameters;
  return set || (changed.length ? `● ${preset}, ${changed.length} changed` : preset);
}

function showPreset() {
  setText(byId("preset"), parametersText());
  const { unsuited } = state.parameters, fit = byId("preset-fit");
  fit.hidden = !unsuited;
  setText(fit, unsuited && `Use ${unsuited}`);
}

export function startTimeline() {
  byId("preset-fit").addEventListener("click", () => attempted(() => post("/api/parameters/preset", { name: state.parameters.unsuited })));
  byId("play").addEventListener("click", togglePlay);
  for (const [id, scans] of STEPS) byId(id).addEventListener("click", () => advance(scans));
  byId("end-run").addEventListener("click", endRun);
  const line = byId("timeline");
  line.addEventListener("input", () => {
    dragging = true;
    showTime(Number(line.value));
    seek(Number(line.value));
  });
  line.addEventListener("change", () => { dragging = false; });
  const field = byId("time-now");
  field.addEventListener("focus", () => field.select());
  field.addEventListener("keydown", (event) => { if (event.key === "Enter") seekTyped(field); else if (event.key === "Escape") field.blur(); });
  field.addEventListener("blur", () => { field.setCustomValidity(""); if (state.status) showTime(state.status.time_s); });
  byId("speed").addEventListener("change", (event) => {
    send("set_speed", { factor: Number(event.target.value) });
    event.target.blur();
  });
  closeWarnings = startPopover(byId("warnings-button"), byId("warnings"));
  on("status", show);
  on("parameters", showPreset);
}
