// Keyboard shortcuts, also while the scene has the focus.

import { ANNOTATE_KEYS, annotateKey } from "./annotate_keys.js";
import { byId, el } from "./dom.js";
import { toggleLayer } from "./layers.js";
import { select } from "./live.js";
import { setLoop } from "./marks.js";
import { onSceneLoad, pressInScene } from "./scene.js";
import { openTab } from "./tabs.js";
import { tuneKey } from "./tune.js";
import { stopMeasuring, toggleMeasure } from "./measure.js";
import { advance, togglePlay } from "./timeline.js";

const LIST = [
  ["space", "play or pause"], ["← →", "one scan back or forward"], ["shift ← →", "ten scans back or forward"],
  ["f", "follow the robot in the scene, or stop following"], ["t", "look at the robot from above"], ["b", "look at it from behind"],
  ["1 … 0", "show or hide a layer of the scene"], ["l", "begin, end and leave a loop"], ["m", "measure a distance on the map"], ["/", "find a tree"], ["esc", "select nothing"], ["?", "this list"],
  ...ANNOTATE_KEYS,
];
const TYPES = "input:not([type=range]), textarea, select, [contenteditable], [role=slider], [role=combobox], [role=option]";
const PRESSED = "button, a, summary, [role=tab], [role=checkbox], input[type=checkbox], input[type=range]";

const actions = {
  " ": togglePlay,
  ArrowLeft: (event) => advance(event.shiftKey ? -10 : -1),
  ArrowRight: (event) => advance(event.shiftKey ? 10 : 1),
  ...Object.fromEntries([..."1234567890"].map((key, place) => [key, () => toggleLayer(place)])),
  l: setLoop,
  m: toggleMeasure,
  "/": () => { openDrawer(); openTab("trees"); byId("find").focus(); },
  "?": () => byId("keys-dialog").showModal(),
  Escape: () => { stopMeasuring(); select(null); },
};

function openDrawer() {
  byId("side").classList.add("open");
}

function act(event, inScene) {
  if (!document.querySelector("dialog[open]") && !event.target.matches?.(TYPES) && (annotateKey(event, inScene) || tuneKey(event))) {
    event.preventDefault();
    event.stopImmediatePropagation();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  const target = event.target;
  if (target.matches?.(TYPES) || (event.key === " " && target.matches?.(PRESSED))) return;
  if (target.matches?.("input[type=range]") && event.key.startsWith("Arrow")) return;
  if (!inScene && ["f", "t", "b"].includes(event.key)) {
    pressInScene(event.key); // viser listens to these itself when it has the focus
    return;
  }
  const action = actions[event.key];
  if (!action) return;
  event.preventDefault();
  event.stopImmediatePropagation(); // or the arrows would turn the camera too
  action(event);
}

export function startKeys() {
  document.addEventListener("keydown", (event) => act(event, false));
  onSceneLoad((inner) => inner.addEventListener("keydown", (event) => act(event, true), { capture: true }));
  byId("keys-button").addEventListener("click", actions["?"]);
  byId("keys-list").replaceChildren(...LIST.flatMap(([keys, text]) =>
    [el("dt", {}, ...keys.split(" ").map((key) => el("kbd", { text: key }))), el("dd", { text })]));
}
