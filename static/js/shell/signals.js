// Sound and vibration while an obstacle is in the stop zone, a robot sends no data or its pose is lost.

import { byId, recall } from "../core/dom.js";
import { isPlaying, on, state } from "../core/store.js";
import { isPoseLost, isSilent } from "./way.js";

const TICK = 500; // [ms] between two looks for a silence
// A signal: frequency of its tones [Hz], duration of each and of the pause after it [ms], vibration and pauses [ms], and time
// between two signals while the reason stays [ms].
const STOP = { tone: 880, tone_ms: 180, tones: 2, vibration: [250, 120, 250], every: 1500 };
const SILENCE = { tone: 330, tone_ms: 700, tones: 1, vibration: [900], every: 4000 };
let audio = null, signalledAt = -Infinity;

// A browser plays no sound before a person has clicked or pressed a key.
function sound({ tone: hertz, tone_ms: length, tones }) {
  audio ??= new AudioContext();
  audio.resume();
  for (let k = 0; k < tones; k += 1) {
    const tone = audio.createOscillator(), start = audio.currentTime + (2 * k * length) / 1000;
    tone.frequency.value = hertz;
    tone.connect(audio.destination);
    tone.start(start);
    tone.stop(start + length / 1000);
  }
}

// By the name of the setting of this browser.
export const SIGNALS = { "alarm-sound": sound, "alarm-vibration": ({ vibration }) => navigator.vibrate?.(vibration) };
// By its box, where the page has one: a browser may keep nothing.
const isOn = (name) => byId(name)?.checked ?? recall(name) === "on";
// Gives the signal of the stop zone once, so that a person knows it.
export const tryOut = (name) => SIGNALS[name](STOP);

function signal() {
  const reason = isSilent() || isPoseLost() ? SILENCE : isPlaying() && state.obstacle?.zone === "stop" ? STOP : null;
  if (!reason || performance.now() - signalledAt < reason.every) return;
  signalledAt = performance.now();
  for (const [name, give] of Object.entries(SIGNALS)) if (isOn(name)) give(reason);
}

export function startSignals() {
  on("map", signal);
  setInterval(signal, TICK); // without data, no map comes
}
