// The frame with the 3D scene. It is of the same origin, so keys and reconnecting can be shared.

import { byId } from "./dom.js";
import { on } from "./state.js";
import { isDark } from "./theme.js";

const frame = byId("scene");
const loaders = [];

export const onSceneLoad = (listener) => loaders.push(listener);

function address() {
  const query = new URLSearchParams();
  if (isDark()) query.set("darkMode", "");
  const dpr = new URLSearchParams(location.search).get("fixedDpr");
  if (dpr) query.set("fixedDpr", dpr);
  return `/viser/?${query}`;
}

function load() {
  frame.src = address();
}

// viser's client reconnects only while it has the focus. Taking the focus from a person who types is
// worse than a lost scene, so the frame is told that it has it.
function keepReconnecting() {
  frame.contentDocument.hasFocus = () => true;
  frame.contentWindow.dispatchEvent(new Event("focus"));
}

export function pressInScene(key) {
  const inner = frame.contentWindow;
  if (!frame.src || !inner) return;
  inner.document.documentElement.dispatchEvent(
    new inner.KeyboardEvent("keydown", { key, code: `Key${key.toUpperCase()}`, bubbles: true }),
  );
}

export function startScene() {
  frame.addEventListener("load", () => {
    if (!frame.src || !frame.contentDocument) return;
    keepReconnecting();
    for (const listener of loaders) listener(frame.contentWindow);
  });
  on("theme", () => frame.src && load());
  byId("scene-show").addEventListener("click", () => {
    frame.closest(".scene").classList.add("on");
    load();
  });
  const narrow = matchMedia("(max-width: 700px)");
  if (!narrow.matches) load();
  narrow.addEventListener("change", () => !narrow.matches && !frame.src && load());
}
