// The frame with the 3D scene. It is of the same origin, so keys and reconnecting can be shared.

import { byId } from "../core/dom.js";
import { on } from "../core/store.js";
import { isDark } from "../core/theme.js";

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

// In light or dark without loading it anew, which would lose the camera: viser has its colours from this attribute, and
// sets its ground once.
function paint() {
  const inner = frame.contentDocument;
  if (!inner) return; // a page of an error, which is not ours to paint
  inner.documentElement.dataset.mantineColorScheme = isDark() ? "dark" : "light";
  let node = inner.querySelector("canvas");
  while (node && !node.style.backgroundColor) node = node.parentElement;
  if (node) node.style.backgroundColor = isDark() ? "var(--mantine-color-dark-9)" : "#fff";
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
    // It was loaded in the other theme, or loads itself anew as it was at first.
    if (frame.contentWindow.location.search.includes("darkMode") !== isDark()) return void load();
    keepReconnecting();
    for (const listener of loaders) listener(frame.contentWindow);
  });
  on("theme", () => frame.src && paint());
  byId("scene-show").addEventListener("click", () => {
    frame.closest(".scene").classList.add("on");
    load();
  });
  const narrow = matchMedia("(max-width: 700px)");
  if (!narrow.matches) load();
  narrow.addEventListener("change", () => !narrow.matches && !frame.src && load());
}
