// Annotating by pointer: on the 2D map a click adds or chooses and dragging moves; in the 3D scene Shift+click adds.

import { inFile, unitWord } from "../core/coordinates.js";
import { fixed } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { distance, nearest } from "../core/nearest.js";
import { clusters, trees } from "../core/store.js";
import { colours } from "../core/theme.js";
import { verdictOf } from "../core/verdicts.js";
import { drawCircle, drawText, treeAt } from "../map/draw.js";
import { onSceneLoad } from "../scene/scene.js";
import { viewOf } from "../scene/viser_client.js";
import { addAt, annotating, choose, draft, news, rowOf, rows, settle, showCard, treeNumberOf } from "./annotations.js";

const SNAP = 0.7; // [m]
const REACH = 11; // [px] around an annotation

const placeOf = (row) => (draft.moved?.id === row.id ? draft.moved : row);

const rowAt = ([px, py], view) => nearest(rows(), (row) => {
  const [x, y] = view.toScreen(placeOf(row).x, placeOf(row).y);
  return Math.hypot(px - x, py - y);
}, REACH);

// Whether the pointer is nearer to a tree to which the annotation does not belong.
function isBehindTree(row, [px, py], view) {
  const tree = treeAt(trees(), [px, py], view), pointer = { x: px, y: py };
  const gap = ({ x, y }) => { const [sx, sy] = view.toScreen(x, y); return distance(pointer, { x: sx, y: sy }); };
  return Boolean(tree) && treeNumberOf(row) !== tree.number && gap(tree) < gap(placeOf(row));
}

// {x, y, on}: the centre of the nearest tree or cluster within SNAP, else the place itself [m].
function snap(x, y) {
  const places = [...clusters().map((cluster) => ({ ...cluster, on: "cluster" })), ...trees().map((tree) => ({ x: tree.x, y: tree.y, on: `tree ${tree.number}` }))];
  return nearest(places, (place) => distance(place, { x, y }), SNAP) ?? { x, y, on: "" };
}

// --- on the map; the functions return true where the event belonged to an annotation -----------------

export function grab(at, view) {
  const row = annotating() && !draft.adding ? rowAt(at, view) : null;
  if (!row || isBehindTree(row, at, view)) return false;
  settle();
  draft.moves = draft.chosen === row.id;
  choose(row.id);
  draft.held = row;
  return true;
}

// Only an annotation that was chosen before moves: a drag that begins at another one pans the map.
export function drag(at, view, travelled) {
  if (!draft.held || !draft.moves) return false;
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
  if (draft.chosen !== null) showCard();
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
    addAt({ x, y });
  } else {
    choose(null);
    select(tree ? tree.number : null);
    if (tree) showCard();
  }
  return true;
}

export function drawAnnotations(pen, view) {
  if (!annotating()) return;
  for (const row of rows()) {
    const { x, y } = placeOf(row);
    Object.assign(pen, { fillStyle: colours.truth, strokeStyle: colours.surface, lineWidth: 1.5 });
    const [px, py] = view.toScreen(x, y);
    drawCircle(pen, px, py, 4);
    pen.fill();
    pen.stroke();
    if (row.kind !== "tree") drawText(pen, verdictOf(row.kind)[0], px, py + 3.5, { font: "700 10px", margin: 2 });
  }
  const chosen = rowOf(draft.chosen);
  if (chosen && treeNumberOf(chosen) === null) { // else the ring is that of its tree
    Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 3 });
    drawCircle(pen, ...view.toScreen(placeOf(chosen).x, placeOf(chosen).y), 10);
    pen.stroke();
  }
  if (draft.adding && draft.place) drawPlace(pen, view, draft.place);
}

// The ring where a new annotation would be placed, joined to the cursor.
function drawPlace(pen, view, { x, y, on, at }) {
  const [px, py] = view.toScreen(x, y);
  Object.assign(pen, { strokeStyle: colours.selection, lineWidth: on ? 2.5 : 1.5 });
  if (!on) pen.setLineDash([4, 3]);
  drawCircle(pen, px, py, 9);
  pen.stroke();
  pen.setLineDash([]);
  pen.beginPath();
  pen.moveTo(...at);
  pen.lineTo(px, py);
  pen.stroke();
  const left = px > view.width - 120;
  drawText(pen, on ? `snaps to ${on}` : `${inFile(x, y).map((value) => fixed(value, 2)).join(", ")} ${unitWord()}`, px + (left ? -14 : 14), py - 10, { font: "12px", align: left ? "right" : "left" });
}

// --- in the scene ------------------------------------------------------------------------------------

const AXIS_REACH = 0.35; // [m] between the ray of a click and the axis of a stem
const STEM_HEIGHT = 2.5; // [m] of a stem that takes clicks
const STILL = 5; // [px]; a longer way between press and release turns the camera

// The ray through a point of the window as two points in the frame of the map.
function rayAt(inner, x, y) {
  const view = viewOf(inner);
  if (!view) return null;
  const { camera, canvas, world } = view;
  const box = canvas.getBoundingClientRect();
  const toMap = world.matrixWorld.clone().invert();
  const from = camera.getWorldPosition(camera.position.clone());
  const to = camera.position.clone().set((2 * (x - box.x)) / box.width - 1, 1 - (2 * (y - box.y)) / box.height, 0.5).unproject(camera);
  return [from.applyMatrix4(toMap), to.applyMatrix4(toMap)];
}

// Where along the ray, in lengths of the ray, it passes an upright stem; Infinity if it misses the stem.
function passes([from, to], { x, y }) {
  const [dx, dy, dz] = [to.x - from.x, to.y - from.y, to.z - from.z];
  const flat = dx * dx + dy * dy;
  if (flat === 0) return Infinity;
  const t = ((x - from.x) * dx + (y - from.y) * dy) / flat;
  const gap = Math.hypot(from.x + t * dx - x, from.y + t * dy - y);
  const height = from.z + t * dz;
  return t > 0 && gap < AXIS_REACH && height > 0 && height < STEM_HEIGHT ? t : Infinity;
}

// The place that a click in the scene means: the first stem on its ray, else the ground.
function placeOnRay(ray) {
  const stem = nearest([...trees(), ...clusters()], (each) => passes(ray, each), Infinity);
  if (stem) return stem;
  const [from, to] = ray;
  const t = from.z / (from.z - to.z);
  return t > 0 && Number.isFinite(t) ? snap(from.x + t * (to.x - from.x), from.y + t * (to.y - from.y)) : null;
}

export function startSceneAnnotating() {
  onSceneLoad((inner) => {
    let down = null;
    inner.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; }, { capture: true });
    inner.addEventListener("pointerup", (event) => {
      if (!annotating() || !event.shiftKey || event.button !== 0 || event.target.tagName !== "CANVAS" || !down) return;
      if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) > STILL) return;
      const ray = rayAt(inner, event.clientX, event.clientY);
      const place = ray && placeOnRay(ray);
      if (place) addAt({ x: Math.round(place.x * 1e4) / 1e4, y: Math.round(place.y * 1e4) / 1e4 });
    }, { capture: true });
  });
}
