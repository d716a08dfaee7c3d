// The frame with viser's 3D scene. It has the same origin as the page, which shares keys and reconnects it.

import { byId, recall, remember } from "../core/dom.js";
import { on } from "../core/store.js";
import { isDark } from "../core/theme.js";

const frame = byId("scene");
const loaders = [];
const builders = [drawWorldWithItsContent, boundPointSizes, closeRenderingNotice];
const POINT_PX = [1.5, 8]; // [px] smallest and largest diameter of a point
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

function load() {
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

// viser's client draws a new pose of a node one picture before new content that arrived with it. What follows the robot is the
// pose of the world, and everything in it is content: so the world is drawn one picture later, with the content of its scan.
function drawWorldWithItsContent({ __viserMutable: viser }) {
  const { scene, nodeRefFromName } = viser;
  if (scene.userData.isInStep) return; // the window of a frame is the same object after a reload
  scene.userData.isInStep = true;
  let node = null, set = null, drawn = null; // the last position set by viser, and the drawn one
  const then = scene.onBeforeRender;
  scene.onBeforeRender = (...args) => {
    then?.apply(scene, args);
    const world = nodeRefFromName["/world"];
    if (!world) return;
    if (world !== node) [node, set, drawn] = [world, world.position.clone(), world.position.clone()];
    const next = set;
    if (!world.position.equals(drawn)) set = world.position.clone();
    if (drawn.equals(next) && world.position.equals(drawn)) return;
    drawn = next;
    world.position.copy(drawn);
    world.updateMatrix();
    world.updateMatrixWorld(true);
  };
}

// viser draws a point by its size in metres only: near the camera it would be a disc, and far away it would vanish.
function boundPointSizes({ __viserMutable: { scene } }) {
  if (scene.userData.hasBounds) return; // the window of a frame is the same object after a reload
  scene.userData.hasBounds = true;
  const then = scene.onBeforeRender;
  scene.onBeforeRender = (...args) => {
    then?.apply(scene, args);
    const ends = POINT_PX.map((size) => (size * args[0].getPixelRatio()).toFixed(2)).join(", ");
    scene.traverse(({ isPoints, material }) => {
      if (!isPoints || material.userData.isBounded) return;
      material.userData.isBounded = true;
      material.vertexShader = material.vertexShader.replace("(scale / -world_pos.z)", `clamp(scale / -world_pos.z, ${ends})`);
      material.needsUpdate = true;
    });
  };
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
  if (frame.__viserMutable?.scene && frame.__viserMutable.nodeRefFromName) act(frame);
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
