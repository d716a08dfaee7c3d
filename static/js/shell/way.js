// The line about obstacles ahead of the robot, a silence of it or a lost pose. It is the same on the dashboard and on the page of runs.

import { byId, recall, setText } from "../core/dom.js";
import { capital, figure } from "../core/format.js";
import { refusedText } from "../core/permissions.js";
import { changed, on, state } from "../core/store.js";

export const NO_FIGURES = ["starting", "failed"];
export const TESTED = ["good", "weak", "lost"]; // the pose was tested by trees; else its sigma says nothing
const OLD_AFTER = 3000; // [ms] without a message while a run plays; longer silences of a robot are red
const COMPILED_FOR = 20_000; // [ms] after compiling in which the first scans take longer
const HELD_FOR = 2000; // [ms]
const NO_DATA = /^no data/; // of a silent robot
const WAY = { slow: "▲ Slow: obstacle", stop: "■ Stop: obstacle", unknown: "? Path ahead not visible to the sensor" };

let compiledAt = -Infinity; // when the server last reported compiling [ms]
let held = { state: "good", reason: "", source: "", at: -Infinity };

export const seconds = (since) => Math.floor((performance.now() - since) / 1000);
export const noData = (since) => `no data for ${seconds(since)} s`;

// Whether a run plays and no message came for a while.
export function isOld() {
  const now = performance.now(), patience = (now - compiledAt < COMPILED_FOR ? 4 : 1) * OLD_AFTER;
  return state.status?.state === "playing" && now - state.heardAt > patience;
}

// [s] since the newest scan of a robot came, or while paused since one was mapped; null before the first one, and after the run.
export function ageOf({ silence_s: silence, map_age_s: mapAge, state: phase }) {
  const age = phase === "paused" ? mapAge : silence;
  if (age === null || age === undefined || phase === "finished") return null;
  return age + (performance.now() - state.statusAt) / 1000;
}

// A silence of a live run that has mapped something: what is missing, since when [s], why, and whether a person chose it by a pause.
// Null if there is none.
export function silenceOf(s) {
  if (!s?.live || s.scan_index < 0 || [...NO_FIGURES, "finished"].includes(s.state)) return null;
  if (!state.connected && !state.lostAt) return null;
  if (!state.connected) return { what: state.refused ? "No access" : "No connection", for_s: seconds(state.lostAt), why: state.refused ? refusedText() : "The page reconnects by itself." };
  if (isOld()) return { what: "No data", for_s: seconds(state.heardAt), why: "The program sends nothing." };
  const isUnheard = NO_DATA.test(s.health);
  if (s.state === "paused") return { what: "Paused: not current", for_s: Math.floor(ageOf(s) ?? 0), why: isUnheard ? capital(s.detail) : "The robot may drive on; obstacles are not reported. Play returns to it.", isChosen: true };
  if (!isUnheard) return null;
  return { what: "No data", for_s: Math.floor(ageOf(s) ?? 0), why: capital(s.detail.replace(/^Nothing heard for \d+ s: /, "")) };
}

// Whether the line reports a silence as loudly as a stop.
const isLoud = (silence) => !silence.isChosen && silence.for_s > OLD_AFTER / 1000;
export const isSilent = () => {
  const silence = silenceOf(state.status);
  return silence !== null && isLoud(silence);
};
// Whether the line reports that a robot does not know where it is.
export const isPoseLost = () => byId("way").dataset.zone === "lost";

// How well the pose is known, {state, reason}, or {silence: "no data for 12 s"}. A state that is worse than that of the newest scan
// stays for a moment while the run plays, so that a doubt about a few scans can be read.
export function poseHealth({ health: word, state: phase, source }) {
  const silence = state.connected ? (isOld() ? noData(state.heardAt) : NO_DATA.test(word) && word) : state.lostAt && noData(state.lostAt);
  if (silence) return { silence };
  const known = state.map?.health, now = performance.now();
  // Status and map are not of the same scan: the reason of a state that goes on stays.
  const reason = known?.state === word ? known.reason : held.state === word && held.source === source ? held.reason : "";
  const isWorse = TESTED.includes(word) && TESTED.indexOf(held.state) > TESTED.indexOf(word);
  if (phase !== "playing" || held.source !== source || !isWorse || now - held.at > HELD_FOR) held = { state: word, reason, source, at: now };
  return held;
}

// It is below the strip so that nothing moves. A screen reader announces changes of the zone, not of the distance or the duration.
function showWay() {
  const status = state.status, clearance = state.map?.clearance, silence = silenceOf(status);
  if (status?.compiling_since_s) compiledAt = performance.now();
  // An obstacle is reported only from a current scan of a run that goes on.
  const quiet = [...NO_FIGURES, "finished", "waiting"].includes(status?.state) || !state.connected || isOld()
    || (status?.live && status.state === "paused"); // its last scan is old
  const obstacle = !silence && !quiet && WAY[clearance?.zone] ? clearance : null;
  const health = status ? poseHealth(status) : {};
  const poseLost = !silence && !quiet && status?.live && health.state === "lost" && obstacle?.zone !== "stop";
  const text = silence ? `■ ${silence.what}` : poseLost ? "■ Pose lost" : obstacle && WAY[obstacle.zone];
  const way = byId("way"), [zone, distance, why] = way.children;
  way.hidden = !text;
  way.dataset.zone = silence ? (isLoud(silence) ? "silent" : "slow") : poseLost ? "lost" : clearance?.zone ?? "";
  showObstacle(obstacle && state.map.obstacle ? { ...state.map.obstacle, zone: obstacle.zone } : null);
  if (text) setText(zone, text);
  setText(distance, silence ? ` for ${silence.for_s} s` : obstacle && !poseLost && obstacle.zone !== "unknown" ? ` ${figure(obstacle.ahead_m)} m ahead` : "");
  setText(why, silence ? silence.why : poseLost ? capital(health.reason) : "");
  // Until a person of this browser has seen the setting, which only the dashboard has.
  const sound = byId("way-sound");
  if (sound) sound.hidden = !status?.live || !["stop", "silent", "lost"].includes(way.dataset.zone) || byId("alarm-sound").checked || recall("alarm-sound") !== null;
  // An open dialog covers everything outside of it.
  const place = [...document.querySelectorAll("dialog:modal")].at(-1) ?? document.querySelector(".strip, .runs-strip");
  if (way.parentElement !== place) place.append(way);
}

// The map draws it as long as it is reported.
function showObstacle(obstacle) {
  const hasChanged = obstacle?.zone !== state.obstacle?.zone;
  state.obstacle = obstacle;
  if (hasChanged) changed("obstacle");
}

export function startWay() {
  on("status map connection", showWay);
  document.addEventListener("toggle", showWay, true); // of dialogs
  setInterval(showWay, 1000);
}
