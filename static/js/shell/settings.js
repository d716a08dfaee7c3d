// Settings of this browser: theme, large controls, and sound and vibration while an obstacle is in the stop zone, a robot sends no data
// or its pose is lost.

import { byId, recall, remember } from "../core/dom.js";
import { isPlaying, on, state } from "../core/store.js";
import { setTheme, themeName } from "../core/theme.js";
import { isPoseLost, isSilent } from "./status.js";

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

const SIGNALS = { "alarm-sound": sound, "alarm-vibration": ({ vibration }) => navigator.vibrate?.(vibration) };

function signal() {
  const reason = isSilent() || isPoseLost() ? SILENCE : isPlaying() && state.obstacle?.zone === "stop" ? STOP : null;
  if (!reason || performance.now() - signalledAt < reason.every) return;
  signalledAt = performance.now();
  for (const [id, give] of Object.entries(SIGNALS)) if (byId(id).checked) give(reason);
}

function startBox(id, isOn, act) {
  const box = byId(id);
  box.checked = isOn;
  box.addEventListener("change", () => act(box.checked));
}

// What the run keeps to go back and to map again without its source.
function showStorage() {
  const kept = state.status?.storage;
  byId("run-storage").hidden = !kept;
  if (!kept) return;
  const gb = (bytes) => (bytes / 1e9).toFixed(1), mb = (bytes) => Math.round(bytes / 1e6);
  byId("run-storage").textContent = `This run keeps ${gb(kept.files)} of ${gb(kept.most_files)} GB in temporary files and ${mb(kept.memory)} of ${mb(kept.most_memory)} MB in memory, to go back and to map again. Beyond that, it reads its source (STEMMAP_RUN_GB, STEMMAP_RUN_MEMORY_MB).`;
}

export function startSettings() {
  const theme = byId("theme-choice");
  const showTheme = () => { theme.value = themeName(); };
  theme.addEventListener("change", () => setTheme(theme.value));
  on("theme", showTheme);
  showTheme();
  startBox("large-controls", recall("large") === "on", (wanted) => {
    if (wanted) document.documentElement.dataset.controls = "large";
    else delete document.documentElement.dataset.controls;
    remember("large", wanted ? "on" : "off");
    dispatchEvent(new Event("resize")); // of the plots
  });
  for (const [id, give] of Object.entries(SIGNALS)) {
    startBox(id, recall(id) === "on", (wanted) => {
      remember(id, wanted ? "on" : "off");
      if (wanted) give(STOP); // so that a person knows it
    });
  }
  byId("way-sound").addEventListener("click", () => {
    remember("alarm-sound", "off"); // as long as the person does not switch it on
    if (!byId("keys-dialog").open) byId("keys-dialog").showModal();
    byId("alarm-sound").focus();
  });
  on("status", showStorage);
  byId("alarm-vibration").parentElement.hidden = !navigator.vibrate;
  on("map", signal);
  setInterval(signal, TICK); // without data, no map comes
}
