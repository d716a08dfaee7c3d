// Settings of this browser: theme, large controls, and sound and vibration as signals.

import { byId, recall, remember } from "../core/dom.js";
import { on, state } from "../core/store.js";
import { setTheme, themeName } from "../core/theme.js";
import { SIGNALS, startSignals, tryOut } from "./signals.js";

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
  for (const id of Object.keys(SIGNALS)) {
    startBox(id, recall(id) === "on", (wanted) => {
      remember(id, wanted ? "on" : "off");
      if (wanted) tryOut(id);
    });
  }
  byId("way-sound").addEventListener("click", () => {
    remember("alarm-sound", "off"); // as long as the person does not switch it on
    if (!byId("keys-dialog").open) byId("keys-dialog").showModal();
    byId("alarm-sound").focus();
  });
  on("status", showStorage);
  byId("alarm-vibration").parentElement.hidden = !navigator.vibrate;
  startSignals();
}
