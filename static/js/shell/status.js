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

const WORDS = {
  starting: "Starting", playing: "Playing", paused: "Paused", finished: "Finished", waiting: "Waiting", failed: "Failed",
};
const NO_FIGURES = ["starting", "failed"];
const TESTED = ["good", "weak", "lost"]; // the pose was tested by trees; else its sigma says nothing
const OLD_AFTER = 3000; // [ms] without a message while a run plays; longer silences of a robot are red
const LEFT_OUT = 0.1; // share of the scans above which the map is doubtful, as in app/batch/summary.py
const COMPILED_FOR = 20_000; // [ms] after compiling in which the first scans take longer

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

// [s] since the newest scan of a robot came, or while paused since one was mapped; null before the first one, and after the run.
function ageOf({ silence_s: silence, map_age_s: mapAge, state: phase }) {
  const age = phase === "paused" ? mapAge : silence;
  if (age === null || age === undefined || phase === "finished") return null;
  return age + (performance.now() - state.statusAt) / 1000;
}

// Explanations of the first states.
const SOON = { "no trees yet": "SLAM: odometry only", "just begun": "SLAM: first scans", static: "SLAM: the sensor has not moved" };

// A state that is worse than that of the newest scan stays for a moment while the run plays, so that a doubt about a few
// scans can be read.
const HELD_FOR = 2000; // [ms]
const NO_DATA = /^no data/; // of a silent robot
const noData = (since) => `no data for ${seconds(since)} s`;

// A silence of a live run that has mapped something: what is missing, since when [s], and why. Null if there is none.
function silenceOf(s) {
  if (!s?.live || s.scan_index < 0 || state.refused || [...NO_FIGURES, "finished"].includes(s.state)) return null;
  if (!state.connected) return state.lostAt ? { what: "No connection", for_s: seconds(state.lostAt), why: "The page reconnects by itself." } : null;
  if (isOld()) return { what: "No data", for_s: seconds(state.heardAt), why: "The program sends nothing." };
  const isUnheard = NO_DATA.test(s.health);
  if (s.state === "paused") return { what: "Paused: not current", for_s: Math.floor(ageOf(s) ?? 0), why: isUnheard ? capital(s.detail) : "The robot may drive on; obstacles are not reported. Play returns to it.", isChosen: true };
  if (!isUnheard) return null;
  return { what: "No data", for_s: Math.floor(ageOf(s) ?? 0), why: capital(s.detail.replace(/^Nothing heard for \d+ s: /, "")) };
}
// Whether the line below the strip reports a silence as loudly as a stop.
const isLoud = (silence) => !silence.isChosen && silence.for_s > OLD_AFTER / 1000;
export const isSilent = () => {
  const silence = silenceOf(state.status);
  return silence !== null && isLoud(silence);
};
let held = { state: "good", reason: "", source: "", at: -Infinity };
// Whether the line below the strip reports that a robot does not know where it is.
export const isPoseLost = () => byId("way").dataset.zone === "lost";

function health({ health: word, state: phase, source }) {
  const silence = state.connected ? (isOld() ? noData(state.heardAt) : NO_DATA.test(word) && word) : state.lostAt && noData(state.lostAt);
  if (silence) return ["no data", "warn", silence.replace("no data ", "")];
  const known = state.map?.health;
  const now = { state: word, reason: known?.state === word ? known.reason : "", source, at: performance.now() };
  const isWorse = TESTED.includes(word) && TESTED.indexOf(held.state) > TESTED.indexOf(word);
  if (phase !== "playing" || held.source !== source || !isWorse || now.at - held.at > HELD_FOR) held = now;
  return [held.state, { good: "good", weak: "warn", lost: "bad" }[held.state] ?? "soon", SOON[held.state] || held.reason || "SLAM health"];
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
  byId("figures").classList.toggle("old", quiet || silence !== null);
  document.body.classList.toggle("stale", silence !== null);
  showNotice(quiet, silence);
  showWay();
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

// Whether a run plays and no message came for a while.
function isOld() {
  const now = performance.now(), patience = (now - compiledAt < COMPILED_FOR ? 4 : 1) * OLD_AFTER;
  return state.status?.state === "playing" && now - state.heardAt > patience;
}

// Obstacles ahead of the robot, a silence of it or a lost pose, below the strip so that nothing moves. A screen reader announces changes of the
// zone, not of the distance or the duration.
const way = byId("way");
const WAY = { slow: "▲ Slow: obstacle", stop: "■ Stop: obstacle", unknown: "? Path ahead not visible to the sensor" };

function showWay() {
  const clearance = state.map?.clearance, silence = silenceOf(state.status);
  // Only a robot that drives on has something in its way, and only a scan of now shows it.
  const quiet = [...NO_FIGURES, "finished", "waiting"].includes(state.status?.state) || !state.connected || isOld()
    || (state.status?.live && state.status.state === "paused"); // the robot drives on
  const obstacle = !silence && !quiet && WAY[clearance?.zone] ? clearance : null;
  const poseLost = !silence && !quiet && state.status?.live && held.state === "lost" && obstacle?.zone !== "stop";
  const text = silence ? `■ ${silence.what}` : poseLost ? "■ Pose lost" : obstacle && WAY[obstacle.zone];
  way.hidden = !text;
  way.dataset.zone = silence ? (isLoud(silence) ? "silent" : "slow") : poseLost ? "lost" : clearance?.zone ?? "";
  showObstacle(obstacle && state.map.obstacle ? { ...state.map.obstacle, zone: obstacle.zone } : null);
  const [zone, distance, why] = way.children;
  if (text) setText(zone, text);
  setText(distance, silence ? ` for ${silence.for_s} s` : obstacle && !poseLost && obstacle.zone !== "unknown" ? ` ${figure(obstacle.ahead_m)} m ahead` : "");
  setText(why, silence ? silence.why : poseLost ? capital(held.reason) : "");
  // Until a person of this browser has seen the setting.
  byId("way-sound").hidden = !state.status?.live || !["stop", "silent", "lost"].includes(way.dataset.zone) || byId("alarm-sound").checked || recall("alarm-sound") !== null;
  // An open dialog covers everything outside of it.
  const place = [...document.querySelectorAll("dialog:modal")].at(-1) ?? document.querySelector(".strip");
  if (way.parentElement !== place) place.append(way);
}

// The map draws it as long as it is reported.
function showObstacle(obstacle) {
  const hasChanged = obstacle?.zone !== state.obstacle?.zone;
  state.obstacle = obstacle;
  if (hasChanged) changed("obstacle");
}

let ahead = null; // [ms] of the server's clock before that of this machine; null while unknown
let compiledAt = -Infinity; // when the server last reported compiling [ms]

function compilingFor({ compiling_since_s: since, compiled, kernels_left: left }) {
  if (!since) return "";
  compiledAt = performance.now();
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

const seconds = (since) => Math.floor((performance.now() - since) / 1000);

export function startStatus() {
  byId("recording").addEventListener("click", pressRecording);
  build();
  on("status map evaluation annotations truth", show);
  on("status map", showWay);
  document.addEventListener("toggle", showWay, true); // of dialogs
  on("status connection", showState);
  setInterval(() => { showState(); show(); }, 1000);
}
