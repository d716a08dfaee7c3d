// Views of the scene that a person saves by name: position and target of the camera in the frame of the map, kept in this browser
// for each source.

import { byId, el, recall, remember } from "../core/dom.js";
import { startPopover } from "../core/popover.js";
import { on, state, trees } from "../core/store.js";
import { onSceneBuilt } from "./scene.js";
import { viewOf } from "./viser_client.js";

const MOST_VIEWS = 20, MOST_SOURCES = 30, LONGEST_NAME = 40;
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const FIT_TILT = (60 * Math.PI) / 180; // [rad] of the view of the whole map, above the horizon
const HOME_MS = 200; // between two looks whether the camera is there
let scene = null, home = null;

function stored() {
  try {
    const all = JSON.parse(recall("views") ?? "{}");
    return typeof all === "object" && all && !Array.isArray(all) ? all : {};
  } catch {
    return {};
  }
}

const isView = (view) => Array.isArray(view) && view.length === 6 && view.every(Number.isFinite);

// The saved views of the open source as [[name, view], ...].
const savedViews = () => Object.entries(stored()[state.status?.source] ?? {}).filter(([, view]) => isView(view));

function keep(views) {
  const source = state.status?.source ?? "", { [source]: _, ...others } = stored(); // this source comes last
  const all = Object.entries({ ...others, ...(views.length ? { [source]: Object.fromEntries(views) } : {}) });
  remember("views", JSON.stringify(Object.fromEntries(all.slice(-MOST_SOURCES))));
  show();
}

// The present view in the frame of the map; null before the scene is there.
function present() {
  const at = viewOf(scene);
  if (!at) return null;
  const toMap = at.world.matrixWorld.clone().invert(), point = () => at.camera.position.clone();
  return [at.control.getPosition(point()), at.control.getTarget(point())].flatMap((each) => each.applyMatrix4(toMap).toArray());
}

export function lookFrom(view) {
  const at = viewOf(scene);
  if (!at) return;
  const [from, to] = [view.slice(0, 3), view.slice(3)].map((xyz) => at.camera.position.clone().set(...xyz).applyMatrix4(at.world.matrixWorld));
  at.control.setLookAt(...from.toArray(), ...to.toArray(), !calm.matches);
}

// Where the camera stood when the scene was loaded, relative to the robot if it is followed.
function keepHome(inner) {
  const at = viewOf(scene);
  if (scene !== inner) return;
  if (!at) setTimeout(() => keepHome(inner), HOME_MS);
  else home = [at.control.getPosition(at.camera.position.clone()), at.control.getTarget(at.camera.position.clone())].flatMap((each) => each.toArray());
}

function goHome() {
  if (home) viewOf(scene)?.control.setLookAt(...home, !calm.matches);
}

// From above and behind, so that path and trees are in the picture.
function fit() {
  const places = [...state.path.map(([x, y]) => [x, y]), ...trees().map(({ x, y }) => [x, y])], at = viewOf(scene);
  if (!places.length || !at) return;
  const [xs, ys] = [0, 1].map((axis) => places.map((place) => place[axis]));
  const ends = [xs, ys].map((all) => [all.reduce((a, b) => Math.min(a, b)), all.reduce((a, b) => Math.max(a, b))]);
  const [x, y] = ends.map(([low, high]) => (low + high) / 2);
  const radius = Math.max(3, Math.hypot(...ends.map(([low, high]) => (high - low) / 2)));
  const narrow = Math.min(1, at.camera.aspect) * Math.tan((at.camera.fov * Math.PI) / 360);
  const away = radius / narrow;
  lookFrom([x, y - away * Math.cos(FIT_TILT), away * Math.sin(FIT_TILT), x, y, 0]);
}

function save(event) {
  event.preventDefault();
  const name = byId("view-name").value.trim(), view = present();
  if (!name || !view) return;
  keep([...savedViews().filter(([other]) => other !== name), [name, view]].slice(-MOST_VIEWS));
  byId("view-save").focus();
}

function show() {
  const list = byId("view-list"), views = savedViews();
  if (list.hidden) return;
  list.replaceChildren(
    ...views.map(([name, view]) => el("div", { class: "row" }, el("button", { class: "small grow", text: name, onclick: () => lookFrom(view) }),
      el("button", { class: "quiet small", text: "✕", title: "Delete", "aria-label": `Delete the view ${name}`, onclick: () => keep(savedViews().filter(([other]) => other !== name)) }))),
    views.length ? "" : el("p", { class: "dim note", text: "Save this view of the scene under a name to return to it later." }),
    el("form", { class: "row", onsubmit: save },
      el("input", { id: "view-name", type: "text", maxlength: String(LONGEST_NAME), placeholder: "name", "aria-label": "Name of the view", autocomplete: "off" }),
      el("button", { id: "view-save", class: "small", text: "Save", title: "Save the present view of the camera under this name" })));
}

export function startViews() {
  startPopover(byId("views-button"), byId("view-list"), show);
  on("source", show);
  byId("look-home").addEventListener("click", goHome);
  byId("look-fit").addEventListener("click", fit);
  onSceneBuilt((inner) => {
    scene = inner;
    keepHome(inner);
  });
}
