// Annotating on the 2D map: click to add or choose, drag to move, a ring where the stem would stand.

import { select } from "../core/live_feed.js";
import { state } from "../core/store.js";
import { onSceneLoad } from "../scene/scene.js";
import { add, annotating, choose, draft, news, rowOf, rows, settle } from "./annotations.js";

const SNAP = 0.7; // [m]
const REACH = 11; // [pixels]
const TURN = 2 * Math.PI;

const placeOf = (row) => (draft.moved?.id === row.id ? draft.moved : row);

function rowAt([px, py], view) {
  let best = null, least = REACH;
  for (const row of rows()) {
    const [x, y] = view.toScreen(placeOf(row).x, placeOf(row).y);
    const gap = Math.hypot(px - x, py - y);
    if (gap < least) [best, least] = [row, gap];
  }
  return best;
}

// The middle of the tree or cluster that is nearest, if it is near; else the place itself [m].
export function snap(x, y) {
  let best = { x, y, on: "" }, least = SNAP;
  const offer = (cx, cy, on) => {
    const gap = Math.hypot(cx - x, cy - y);
    if (gap < least) [best, least] = [{ x: cx, y: cy, on }, gap];
  };
  const { x: xs = [], y: ys = [] } = state.map?.clusters ?? {};
  for (let k = 0; k < xs.length; k += 1) offer(xs[k], ys[k], "cluster");
  for (const tree of state.map?.trees ?? []) offer(tree.x, tree.y, `tree ${tree.number}`);
  return best;
}

// --- what the pointer does; true where it was meant for an annotation ------------------------------------------

export function grab(at, view) {
  const row = annotating() && !draft.adding ? rowAt(at, view) : null;
  if (!row) return false;
  settle();
  choose(row.id);
  draft.held = row;
  return true;
}

export function drag(at, view, travelled) {
  if (!draft.held) return false;
  if (travelled > 4) {
    const [x, y] = view.toMap(...at);
    draft.moved = { id: draft.held.id, row: draft.held, x, y };
    news();
  }
  return true;
}

export function drop() {
  if (!draft.held) return false;
  draft.held = null;
  settle();
  return true;
}

export function hoverAt(at, view) {
  if (!annotating() || !draft.adding) return;
  draft.place = { ...snap(...view.toMap(...at)), at };
  news();
}

export function clickAt(at, view, tree) {
  if (!annotating()) return false;
  if (draft.adding) {
    const { x, y } = snap(...view.toMap(...at));
    add({ x, y });
  } else {
    choose(null);
    select(tree ? tree.number : null);
  }
  return true;
}

// --- what is drawn over the map -------------------------------------------------------------------------------

export function drawAnnotations(pen, view, colours) {
  if (!annotating()) return;
  for (const row of rows()) {
    const { x, y } = placeOf(row);
    const [px, py] = view.toScreen(x, y);
    Object.assign(pen, { fillStyle: colours.truth, strokeStyle: colours.surface, lineWidth: 1.5 });
    circle(pen, px, py, 4);
    pen.fill();
    pen.stroke();
  }
  const chosen = rowOf(draft.chosen);
  if (chosen) {
    const [px, py] = view.toScreen(placeOf(chosen).x, placeOf(chosen).y);
    Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 3 });
    circle(pen, px, py, 10);
    pen.stroke();
  }
  if (draft.adding && draft.place) drawPlace(pen, view, draft.place, colours);
}

function drawPlace(pen, view, { x, y, on, at }, colours) {
  const [px, py] = view.toScreen(x, y);
  Object.assign(pen, { strokeStyle: colours.selection, lineWidth: on ? 2.5 : 1.5 });
  if (!on) pen.setLineDash([4, 3]);
  circle(pen, px, py, 9);
  pen.stroke();
  pen.setLineDash([]);
  pen.beginPath();
  pen.moveTo(...at);
  pen.lineTo(px, py);
  pen.stroke();
  const text = on ? `stands at ${on}` : `${x.toFixed(2)}, ${y.toFixed(2)} m`;
  Object.assign(pen, { font: `12px ${colours.font}`, textAlign: px > view.width - 120 ? "right" : "left", strokeStyle: colours.surface, fillStyle: colours.text, lineWidth: 4 });
  const shift = pen.textAlign === "right" ? -14 : 14;
  pen.strokeText(text, px + shift, py - 10);
  pen.fillText(text, px + shift, py - 10);
}

function circle(pen, x, y, radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, TURN);
}

// --- Shift-click in the 3D scene adds a tree: at the stem that was meant, else where the ground is.

const NEAR = 0.35; // [m] beside a stem's axis still means the stem
const HEIGHT = 2.5; // [m] of a stem that is seen
const STILL = 5; // [pixels]; farther is no click, but a turn of the camera

// The ray through a place of the window, in the frame of the map.
function rayAt(inner, x, y) {
  const { camera, canvas, nodeRefFromName } = inner.__viserMutable ?? {};
  const world = nodeRefFromName?.["/world"];
  if (!camera || !canvas || !world) return null;
  const box = canvas.getBoundingClientRect();
  const toMap = world.matrixWorld.clone().invert();
  const from = camera.getWorldPosition(camera.position.clone());
  const to = camera.position.clone().set((2 * (x - box.x)) / box.width - 1, 1 - (2 * (y - box.y)) / box.height, 0.5).unproject(camera);
  return [from.applyMatrix4(toMap), to.applyMatrix4(toMap)];
}

// How far along the ray it passes an upright stem, in lengths of the ray; null where it misses it.
function passes([from, to], { x, y }) {
  const [dx, dy, dz] = [to.x - from.x, to.y - from.y, to.z - from.z];
  const flat = dx * dx + dy * dy;
  if (flat === 0) return null;
  const t = ((x - from.x) * dx + (y - from.y) * dy) / flat;
  const beside = Math.hypot(from.x + t * dx - x, from.y + t * dy - y);
  const height = from.z + t * dz;
  return t > 0 && beside < NEAR && height > 0 && height < HEIGHT ? t : null;
}

export function meant(ray) {
  const { x = [], y = [] } = state.map?.clusters ?? {};
  let [best, least] = [null, Infinity];
  for (const stem of [...(state.map?.trees ?? []), ...x.map((_, k) => ({ x: x[k], y: y[k] }))]) {
    const t = passes(ray, stem);
    if (t !== null && t < least) [best, least] = [stem, t];
  }
  if (best) return { x: best.x, y: best.y };
  const [from, to] = ray;
  const t = from.z / (from.z - to.z);
  return t > 0 && Number.isFinite(t) ? snap(from.x + t * (to.x - from.x), from.y + t * (to.y - from.y)) : null;
}

export function startAnnotateScene() {
  onSceneLoad((inner) => {
    let down = null;
    inner.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; }, { capture: true });
    inner.addEventListener("pointerup", (event) => {
      if (!annotating() || !event.shiftKey || event.button !== 0 || event.target.tagName !== "CANVAS" || !down) return;
      if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) > STILL) return;
      const ray = rayAt(inner, event.clientX, event.clientY);
      const place = ray && meant(ray);
      if (place) add({ x: Math.round(place.x * 1e4) / 1e4, y: Math.round(place.y * 1e4) / 1e4 });
    }, { capture: true });
  });
}
