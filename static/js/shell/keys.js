// Keyboard shortcuts, also while the scene has the focus.

import { ANNOTATE_KEYS, annotateKey } from "../annotate/panel.js";
import { byId, el, recall, remember } from "../core/dom.js";
import { capital } from "../core/format.js";
import { edits, looksOnly } from "../core/permissions.js";
import { REPAIR_KEYS, repairKey } from "../repair/panel.js";
import { advance } from "../playback/timeline.js";
import { toggleLayer } from "../scene/layers.js";
import { onSceneLoad, pressInScene } from "../scene/scene.js";
import { tuneKey, undoKey } from "../tune/parameters.js";
import { ACTIONS, showSheet } from "./actions.js";
import { ofExtensions } from "./extensions.js";
import { openPalette } from "./palette.js";

const TYPES = "input:not([type=range]), textarea, select, [contenteditable], [role=slider], [role=combobox], [role=option]";
const PRESSED = "button, a, summary, [role=tab], [role=checkbox], input[type=checkbox], input[type=range]";

const actions = {
  ...Object.fromEntries(ACTIONS.filter(([, , key]) => key).map(([, , key, run]) => [key, run])),
  ...Object.fromEntries([..."1234567890"].map((key, place) => [key, edits(() => toggleLayer(place))])),
  ArrowLeft: edits((event) => advance(event.shiftKey ? -10 : -1)),
  ArrowRight: edits((event) => advance(event.shiftKey ? 10 : 1)),
};

function act(event, inScene) {
  const take = () => {
    event.preventDefault();
    event.stopImmediatePropagation(); // the arrows would also turn the camera
  };
  if (document.querySelector("dialog[open]")) return;
  if ((event.ctrlKey || event.metaKey) && !event.altKey && event.key.toLowerCase() === "k") {
    take();
    openPalette();
    return;
  }
  const target = event.target;
  if (!byId("keys-letters").checked && event.key.length === 1 && event.key !== " " && !event.ctrlKey && !event.metaKey) {
    if (inScene && ["f", "t", "b"].includes(event.key)) take(); // keys of viser
    return;
  }
  if (!looksOnly() && !target.matches?.(TYPES) && (annotateKey(event) || repairKey(event) || ofExtensions("pressed", event).some(Boolean) || tuneKey(event))) {
    take();
    return;
  }
  if (inScene && !looksOnly() && !target.matches?.("input, textarea") && undoKey(event)) { // its sliders are parameters in every tab
    take();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (target.matches?.(TYPES) || (event.key === " " && target.matches?.(PRESSED))) return;
  if (target.matches?.("input[type=range]") && event.key.startsWith("Arrow")) return;
  if (!inScene && ["f", "t", "b"].includes(event.key)) {
    if (!looksOnly()) pressInScene(event.key); // viser handles these itself when it has the focus
    return;
  }
  const action = actions[event.key];
  if (!action) return;
  take();
  action(event);
}

function sheet() {
  const own = ACTIONS.filter(([, keys, , , text]) => keys && text !== "").map(([title, keys, , , text]) => [keys, text ?? title]);
  return [["ctrl+k", "search all actions"], ...own, ["1 … 0", "show or hide a layer of the scene"], ...ANNOTATE_KEYS, ...REPAIR_KEYS];
}

export function startKeys() {
  document.addEventListener("keydown", (event) => act(event, false));
  onSceneLoad((inner) => inner.addEventListener("keydown", (event) => act(event, true), { capture: true }));
  const letters = byId("keys-letters");
  letters.checked = recall("letters") !== "off"; // speech input types letters (WCAG 2.1.4)
  letters.addEventListener("change", () => remember("letters", letters.checked ? "on" : "off"));
  byId("keys-button").addEventListener("click", showSheet);
  byId("keys-list").replaceChildren(...sheet().map(([keys, text]) =>
    el("div", {}, el("dt", {}, ...keys.split(" ").map((key) => el("kbd", { text: key }))), el("dd", { text: capital(text) }))));
}
