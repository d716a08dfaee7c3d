// The frame with viser's 3D scene. It has the same origin as the page, which shares keys and reconnects it.

import { byId, recall, remember } from "../core/dom.js";
import { on } from "../core/store.js";
import { isDark } from "../core/theme.js";
import { boundPointSizes, drawWorldWithItsContent, isBuilt } from "./viser_client.js";

const frame = byId("scene");
const loaders = [];
const builders = [drawWorldWithItsContent, boundPointSizes, closeRenderingNotice];
const NOTICE_MS = 8000, LOOK_MS = 250, LOOKS = 40;

export const onSceneLoad = (listener) => loaders.push(listener);
// A press in the picture of the scene, not in viser's panel.
export const onScenePress = (listener) => onSceneLoad((inner) => inner.addEventListener("pointerdown",
  ({ target }) => { if (target.tagName === "CANVAS") listener(); }, { capture: true }));
export const onSceneBuilt = (listener) => builders.push(listener); // once its nodes and camera are there

function address() {
  const query = new URLSearchParams();
  if (isDark()) query.set("darkMode", "");
  const dpr = new URLSearchParams(location.search).get("fixedDpr");
  if (dpr) query.set("fixedDpr", dpr);
  return `/viser/?${query}`;
}

// viser's client takes the focus once when it starts, without a person's wish: it is given back, to the button of an open dialog
// or where a person types.
let takesFocus = false, focused = document.body;

function giveFocusBack() {
  if (!takesFocus || document.activeElement !== frame) return;
  takesFocus = false;
  frame.blur();
  focused.focus({ preventScroll: true });
}

function load() {
  takesFocus = true;
  frame.src = address();
}

// Switches light and dark without a reload, which would lose the camera: viser reads its colours from this attribute and
// sets its background once.
function paint() {
  const inner = frame.contentDocument;
  if (!inner) return; // an error page of the browser
  inner.documentElement.dataset.mantineColorScheme = isDark() ? "dark" : "light";
  inner.body.style.setProperty("--mantine-color-dimmed", isDark() ? "#b3bec5" : "#55626a"); // viser's labels have a contrast of 3.3
  let node = inner.querySelector("canvas");
  while (node && !node.style.backgroundColor) node = node.parentElement;
  if (node) node.style.backgroundColor = isDark() ? "var(--mantine-color-dark-9)" : "#fff";
}

// viser's client reconnects only while it has the focus. Moving the focus would interrupt typing, so the frame reports that
// it has the focus.
function keepReconnecting() {
  frame.contentDocument.hasFocus = () => true;
  frame.contentWindow.dispatchEvent(new Event("focus"));
}

// viser's notice about rendering in software covers a part of the scene. It closes by itself, and at once where this browser has
// shown it before.
function closeRenderingNotice(inner, looks = LOOKS) {
  const notice = [...inner.document.querySelectorAll("[class*=mantine-Notification-root]")].find(({ textContent }) => textContent.includes("Software WebGL"));
  if (!notice) {
    if (looks) setTimeout(() => closeRenderingNotice(inner, looks - 1), LOOK_MS);
    return;
  }
  setTimeout(() => notice.querySelector("button")?.click(), recall("rendering-notice") ? 0 : NOTICE_MS);
  remember("rendering-notice", "shown");
}

function whenBuilt(frame, act) {
  if (isBuilt(frame)) act(frame);
  else if (frame === byId("scene").contentWindow) setTimeout(() => whenBuilt(frame, act), 200);
}

export function pressInScene(key) {
  const inner = frame.contentWindow;
  if (!frame.src || !inner) return;
  inner.document.documentElement.dispatchEvent(
    new inner.KeyboardEvent("keydown", { key, code: `Key${key.toUpperCase()}`, bubbles: true }),
  );
}

export function startScene() {
  document.addEventListener("focusin", ({ target }) => { if (target !== frame) focused = target; });
  addEventListener("blur", () => setTimeout(giveFocusBack)); // not within the call that takes it, which would have the last word
  onScenePress(() => { takesFocus = false; });
  frame.addEventListener("load", () => {
    if (!frame.src || !frame.contentDocument) return;
    // It was loaded with the other theme, or reloads itself with its first address.
    if (frame.contentWindow.location.search.includes("darkMode") !== isDark()) return void load();
    keepReconnecting();
    paint();
    for (const builder of builders) whenBuilt(frame.contentWindow, builder);
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
