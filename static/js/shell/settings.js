// Settings of this browser: theme, large controls, and sound and vibration while an obstacle is in the stop zone.

import { byId, recall, remember } from "../core/dom.js";
import { isPlaying, on, state } from "../core/store.js";
import { setTheme, themeName } from "../core/theme.js";

const REPEAT = 1500; // [ms] between two signals while the zone stays
const TONE = 880, TONE_MS = 180; // [Hz], [ms] of each of the two tones of a signal
const PATTERN = [250, 120, 250]; // [ms] vibration, pause, vibration
let audio = null, signalledAt = -REPEAT;

// A browser plays no sound before a person has clicked or pressed a key.
function sound() {
  audio ??= new AudioContext();
  audio.resume();
  for (const delay of [0, 2 * TONE_MS]) {
    const tone = audio.createOscillator(), start = audio.currentTime + delay / 1000;
    tone.frequency.value = TONE;
    tone.connect(audio.destination);
    tone.start(start);
    tone.stop(start + TONE_MS / 1000);
  }
}

const SIGNALS = { "alarm-sound": sound, "alarm-vibration": () => navigator.vibrate?.(PATTERN) };

function signal() {
  if (state.map?.clearance?.zone !== "stop" || !isPlaying() || performance.now() - signalledAt < REPEAT) return;
  signalledAt = performance.now();
  for (const [id, give] of Object.entries(SIGNALS)) if (byId(id).checked) give();
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
      if (wanted) give(); // so that a person knows it
    });
  }
  on("status", showStorage);
  byId("alarm-vibration").parentElement.hidden = !navigator.vibrate;
  on("map", signal);
}
