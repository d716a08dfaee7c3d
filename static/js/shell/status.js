// The status strip and the notice below it.

import { reviewOf, reviewProgress } from "../annotate/annotations.js";
import { command } from "../core/api.js";
import { byId, el, recall, remember, setText } from "../core/dom.js";
import { capital, figure, NONE } from "../core/format.js";
import { edits, looksOnly, refusedText } from "../core/permissions.js";
import { attempted, showNews } from "../core/problem.js";
import { atSecondPress } from "../core/second_press.js";
import { changed, isDrive, on, state, trees } from "../core/store.js";
import { titleOf } from "../open/run_title.js";
import { isGoing } from "../playback/timeline.js";
import { ageOf, isOld, NO_FIGURES, noData, poseHealth, seconds, silenceOf, startWay, TESTED } from "./way.js";

const WORDS = {
  starting: "Starting", playing: "Playing", paused: "Paused", finished: "Finished", waiting: "Waiting", failed: "Failed",
};
const LEFT_OUT = 0.1; // share of the scans above which the map is doubtful, as in app/batch/summary.py

// title, unit, function of the status that returns [text, class, title, unit], all but the text may be left out; in the order in
// which they have the room of a narrow strip
const FIGURES = {
  trees: ["trees", "", (s) => [String(s.trees - rejected()), ...labelOfTrees(s)]],
  points: ["points", "", (s) => [s.one_step ? s.one_step.points.toLocaleString("en") : NONE]],
  health: ["SLAM", "", (s) => health(s)],
  f1: ["F1 of the map", "", () => [state.evaluation && !reviewProgress() ? figure(state.evaluation.f1) : NONE, state.evaluation?.warning ? "warn" : "", ofScan()]],
  data: ["age of the data", "s", (s) => dataOf(s)],
  driven: ["driven", "m", (s) => [figure(s.distance_m)]],
  behind: ["scans behind", "", (s) => [String(s.scans_behind), s.scans_behind > 20 ? "warn" : ""]],
  mapping: ["per scan", "ms", (s) => [s.mapping_ms ? figure(s.mapping_ms) : NONE, s.mapping_ms > budget(s) ? "warn" : "", `per scan (limit ${figure(budget(s))} ms)`]],
  rate: ["scans mapped", "Hz", (s) => [s.state === "playing" ? figure(s.scan_rate_hz) : NONE]],
  sigma: ["pose sigma", "", (s) => (state.map && TESTED.includes(s.health) ? sigma(state.map.sigma_xy) : [NONE])],
};
const OF_DRIVES = ["health", "data", "rate", "mapping", "behind", "driven", "sigma"];
const cells = {};

const rejected = () => trees().filter((tree) => reviewOf(tree) === "rejected").length;

// During a re-mapping the shown map is the one before.
function labelOfTrees({ remapped }) {
  if (remapped !== null && remapped !== undefined) return ["remapping", `re-mapping ${Math.floor(100 * remapped)} %`];
  return rejected() ? ["", `trees, ${rejected()} rejected`] : [];
}

// Time between two scans [ms]; slower mapping falls behind.
function budget({ scans, end_s: end }) {
  return scans > 1 && end > 0 ? (1000 * end) / (scans - 1) : 100;
}

// F1 of the map, and how many trees of the current scan are right: they follow a slider before the map does.
function ofScan() {
  if (reviewProgress()) return `F1: ${reviewProgress()}`;
  if (state.evaluation?.warning) return "F1 doubtful, see Scores";
  const { right, wrong } = state.map ?? {};
  return right === null || right === undefined ? "F1 of the map" : `F1 of the map; this scan: ${right} of ${right + wrong} true`;
}

// Age of the newest scan of a robot, what the link lost, and what mapping left out.
function dataOf(s) {
  const age = ageOf(s), lost = s.scans_lost, leftOut = s.scans_left_out - lost;
  const isDoubtful = age >= 1 || s.scans_left_out > LEFT_OUT * (s.scans_left_out + s.scan_index + 1);
  return [age === null ? NONE : age < 10 ? age.toFixed(1) : String(Math.floor(age)), isDoubtful ? "warn" : "", `link: ${lost} lost\nmapping: ${leftOut} left out`, age === null ? "" : "s old"];
}

// Explanations of the first states.
const SOON = { "no trees yet": "SLAM: odometry only", "just begun": "SLAM: first scans", static: "SLAM: the sensor has not moved" };

function health(s) {
  const { silence, state: word, reason } = poseHealth(s);
  if (silence) return ["no data", "warn", silence.replace("no data ", "")];
  return [word, { good: "good", weak: "warn", lost: "bad" }[word] ?? "soon", SOON[word] || reason || "SLAM health"];
}

const sigma = (metres) => (metres < 1 ? [figure(100 * metres), "", "pose sigma", "cm"] : [figure(metres), "", "pose sigma", "m"]);
const length = (metres) => `${sigma(metres)[0]} ${sigma(metres)[3]}`;

function healthFigures() {
  const h = state.map?.health;
  if (!h) return "";
  if (state.status.health === "static") return SOON.static;
  return [h.reason && `${h.state}: ${h.reason}`, `N_eff ${figure(h.n_eff)}, ${h.ancestors} ancestors`,
    `${h.detections} detections, ${figure(h.recognised)} associated, ${figure(h.ambiguous)} ambiguous`,
    `normalised innovation ${figure(h.innovation)} (1 expected)`, `pose sigma ${length(state.map.sigma_xy)} in the map, ${length(h.sigma_xy_m)} from the trees, ${figure(h.sigma_yaw_deg)}°`,
    `${figure(h.odometry_sigmas)} sigma from the odometry`].filter(Boolean).join("\n");
}

function build() {
  const list = byId("figures");
  for (const [name, [title, unit]] of Object.entries(FIGURES)) {
    const value = el("span", { text: NONE }), small = el("small", { text: unit });
    const label = el("dt", { text: title });
    const cell = el("div", { "data-figure": name }, label, el("dd", {}, value, small));
    cells[name] = { cell, value, label, title, small, unit };
    list.append(cell);
  }
}

function show() {
  const status = state.status;
  if (!status) return;
  for (const [name, [, , read]] of Object.entries(FIGURES)) {
    const [text, meaning, title, unit] = NO_FIGURES.includes(status.state) ? [NONE] : read(status);
    setText(cells[name].value, text);
    setText(cells[name].label, title ?? cells[name].title);
    setText(cells[name].small, unit ?? cells[name].unit);
    cells[name].cell.className = meaning ?? "";
  }
  for (const name of OF_DRIVES) cells[name].cell.hidden = !isDrive();
  cells.rate.cell.hidden ||= status.state === "finished";
  cells.data.cell.hidden ||= !status.live;
  cells.points.cell.hidden = isDrive();
  document.body.classList.toggle("one-step", !isDrive());
  cells.health.cell.title = healthFigures();
  cells.mapping.cell.title = "Median time of mapping a scan, over the last 50 scans that were mapped. Charts, “Time per stage”, has the times of the run.";
  cells.rate.cell.title = "Scans that were mapped in a second, over the last 20 of them";
  cells.data.cell.title = "Time since the newest scan of the robot came, while paused since one was mapped. Link: scans that the network lost. Mapping: scans that came and are not in the map, because mapping was behind or they could not be read";
  cells.behind.cell.title = "Scans that wait to be mapped";
  cells.driven.cell.title = status.odometry ? `odometry: ${status.odometry}` : "";
  cells.f1.cell.title = state.evaluation?.warning || "F1 score of the map against the ground truth; this scan: how many of its stems are at trees of the ground truth";
  cells.f1.cell.hidden = (!state.evaluation && !state.truth) || NO_FIGURES.includes(status.state); // a run with ground truth keeps its cell
  const title = titleOf(status.source, show);
  showName(title || NONE);
  byId("source-button").title = `${status.source} (${status.kind}). Open another run`;
  document.title = `${title} · stemmap`;
}

// Of "folder/number" the folder is cut if there is no room: the number identifies the run. The port of a robot has a line of its own.
function showName(title) {
  const isAddress = /:\d+$/.test(title);
  const name = byId("source-name"), cut = title.lastIndexOf(isAddress ? ":" : "/");
  byId("source-button").classList.toggle("address", isAddress);
  name.classList.toggle("numbered", cut > 0);
  if (cut <= 0) setText(name, title);
  else if (name.textContent !== title) name.replaceChildren(el("span", { text: title.slice(0, cut) }), el("i", { text: title.slice(cut) }));
}

// The state, with the name of the robot unless it failed: "Live robot1".
function stateWord(status) {
  if (isGoing(status)) return "Seeking";
  if (status.one_step && status.state === "finished") return "Mapped";
  const word = status.live && status.state === "playing" ? "Live" : (WORDS[status.state] ?? status.state);
  return status.live && status.robot && status.state !== "failed" ? `${word} ${status.robot}` : word;
}

function robotsTitle(status) {
  return status?.live && status.robots.length ? `Robots that send scans: ${status.robots.map((name) => name || "(no namespace)").join(", ")}` : "";
}

function showState() {
  const box = byId("state");
  const name = state.connected ? (state.status?.state ?? "starting") : "lost";
  if (box.dataset.state !== name) {
    box.dataset.state = name;
    changed("phase");
  }
  box.classList.toggle("going", state.connected && isGoing(state.status));
  setText(box.querySelector("b"), state.connected ? (state.status ? stateWord(state.status) : WORDS[name]) : state.refused ? "No access" : state.lostAt ? "No connection" : "Connecting");
  box.title = [box.querySelector("b").textContent, robotsTitle(state.status)].filter(Boolean).join("\n"); // a long name is cut
  showRecording(state.status?.recording ?? "", state.connected);
  document.body.classList.toggle("lost", !state.connected && state.lostAt > 0);
  const quiet = isOld(), silence = silenceOf(state.status);
  const isStale = silence !== null && !silence.isChosen; // a paused map can be read and annotated
  byId("figures").classList.toggle("old", quiet || isStale);
  document.body.classList.toggle("stale", isStale);
  showNotice(quiet, silence);
}

// The file and its size, or why there is none. A press on a recording ends it, another press begins the next one.
function showRecording(recording, isConnected) {
  if (/^(recording|finishing)/.test(recordingBefore) && recording.startsWith("recorded")) showNews(`${capital(recording)}: ${state.status.recorded_file}`);
  if (isConnected) recordingBefore = recording;
  showLeft(isConnected);
  const box = byId("recording"), isOn = isConnected && isRecording(), canBegin = isConnected && canRecord();
  box.hidden = !recording && !canBegin;
  box.disabled = !(isOn || canBegin) || looksOnly();
  box.classList.toggle("bad", recording.startsWith("not"));
  const [word] = recording.split(/[ :]/), size = recording.split(", ").find((part) => part.endsWith(" MB")) ?? "";
  setText(box, !isConnected && recording.startsWith("recording") ? "? recording: not known" : isAsking && isOn ? "End recording?"
    : recording.startsWith("not") ? `⚠ ${recording.split(":")[0]}` : canBegin ? `○ Record${recording ? " again" : ""}` : `${isOn ? "●" : "■"} ${word} ${size}`);
  const told = [recording, state.status?.recorded_file].filter(Boolean).join("\n");
  box.title = !isConnected ? `Before the connection was lost: ${told}`
    : [told, isOn ? "Press twice to end the recording, while the run goes on" : canBegin ? `Press to record the messages of the robot from now on${recording ? ", to a new file" : ""}` : ""].filter(Boolean).join("\n");
}

// The recording of the robot that was left for another run, see open/leaving.js; it is complete when that run has begun to open.
function showLeft(isConnected) {
  const file = recall("left", "sessionStorage");
  if (!file || !isConnected || !state.status || state.status.state === "starting" || state.status.recorded_file === file) return;
  remember("left", "", "sessionStorage");
  showNews(`Recorded: ${file}`);
}

let recordingBefore = "";
let isAsking = false; // whether the next press ends the recording
export const isRecording = () => (state.status?.recording ?? "").startsWith("recording");
// A live run that is not recorded now, and sends or may send again.
export const canRecord = () => Boolean(state.status?.live) && !/^(recording|finishing)/.test(state.status.recording) && ["playing", "waiting", "paused"].includes(state.status.state);
const askToEnd = atSecondPress((asks) => { isAsking = asks; showState(); }, () => attempted(async () => {
  const file = state.status.recorded_file;
  await command("end_recording");
  showNews(`The recording is being finished${file ? `: ${file}` : ""}. The run goes on.`);
}));
export const pressRecording = edits(() => (isRecording() ? askToEnd() : attempted(() => command("record"))));

let ahead = null; // [ms] of the server's clock before that of this machine; null while unknown

function compilingFor({ compiling_since_s: since, compiled, kernels_left: left }) {
  if (!since) return "";
  if (ahead === null) askClock();
  const passed = Math.floor((Date.now() + ahead) / 1000 - since);
  if (!(compiled < 1)) return passed < 10 ? "" : `. ${passed} s so far.`;
  const percent = Math.floor(100 * compiled), kernels = left ? `, ${left} ${left === 1 ? "kernel" : "kernels"} left` : "";
  if (passed < 10 || !percent) return `. ${percent} % done${kernels}.`;
  return `. ${percent} % done after ${passed} s${kernels}, about ${roughly((passed * (1 - compiled)) / compiled)}.`;
}

// A duration [s] as precisely as an estimate of it is: in tens of seconds, or in minutes.
const roughly = (s) => (s < 90 ? `${10 * Math.max(1, Math.round(s / 10))} s` : `${Math.round(s / 60)} min`);

// The changing part of the notice, which a screen reader does not announce.
export function progressOf(status) {
  if (!state.connected || !status?.detail) return "";
  return compilingFor(status);
}

// The clocks of server and browser may differ; the date of an answer is the server's.
async function askClock() {
  ahead = 0;
  try {
    const date = Date.parse((await fetch("/api/status")).headers.get("date"));
    if (Number.isFinite(date)) ahead = date - Date.now();
  } catch {
    ahead = null; // no answer: requested again while the server compiles
  }
}

function showNotice(quiet, silence) {
  const notice = byId("notice");
  const status = state.status;
  const text = silence ? "" : state.refused ? refusedText()
    : !state.connected && state.lostAt
    ? `No connection for ${seconds(state.lostAt)} s. The last state is shown; the page reconnects by itself.`
    : quiet ? `${capital(noData(state.heardAt))}. The last state is shown.`
    : isGoing(status) ? "" : status?.detail ?? ""; // the line above the timeline shows the progress of a seek
  notice.hidden = !text;
  const failed = state.connected && status?.state === "failed";
  notice.classList.toggle("failed", failed);
  notice.classList.toggle("wait", !failed);
  notice.classList.toggle("starting", status?.state === "starting");
  document.body.classList.toggle("failed", failed);
  setText(notice.querySelector("span"), capital(text));
  setText(byId("notice-progress"), text && text === status?.detail ? progressOf(status) : "");
  const isUnheard = Boolean(status?.live) && (failed || (status.state === "waiting" && status.scan_index < 0)); // its address may be wrong
  byId("notice-open").hidden = !state.connected || !(failed || isUnheard);
  setText(byId("notice-open"), isUnheard ? "Change address" : "Open another run");
}

export function startStatus() {
  startWay();
  byId("recording").addEventListener("click", pressRecording);
  build();
  on("status map evaluation annotations truth", show);
  on("status connection", showState);
  setInterval(() => { showState(); show(); }, 1000);
}
