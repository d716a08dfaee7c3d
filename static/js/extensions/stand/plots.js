// Plots for stand figures: their edits, which are sent and undone like annotations, and drawing them on the map.

import { edit, send } from "../../annotate/annotations.js";
import { changed, state, trees } from "../../core/store.js";
import { treeAt } from "../../map/draw.js";
import { visible } from "../../shell/tabs.js";

export const SHAPES = { circle: "Circle", rectangle: "Rectangle", polygon: "Polygon" };
const CLOSING = 10; // [px] around the first corner, where a click closes a polygon

export const plots = () => state.annotations?.others.plot ?? [];
export const plotting = () => visible("plots");

export const sketch = {
  kind: null, // shape that is drawn now
  corners: [], // [x, y] of the places that were clicked [m]
  end: null, // [x, y] of the pointer [m]
  begun: false, // whether a click has set the first end
  dragged: false, // whether the pointer is dragged now
  pick: null, // called with each place that is clicked, {x, y} or the number of a `tree`, where the kind is "point"
};
const NOTHING = { corners: [], end: null, begun: false, dragged: false };
const news = () => changed("sketch");

export const addPlots = (list) => edit(() => send("POST", "/api/plots", { plots: list }));
export const addAlong = (every, radius) => edit(() => send("POST", "/api/plots/along", { every, radius }));
export const importPlots = (files, crs) => edit(() => send("POST", "/api/plots/import", { files, crs }));
export const changePlot = ({ id, version }, fields) => edit(() => send("PATCH", `/api/plots/${id}`, { version, ...fields }));

// --- drawing by pointer ---------------------------------------------------------------------------------------

export const drawing = () => sketch.kind !== null;

export function draw(kind, pick = null) {
  Object.assign(sketch, NOTHING, { kind: sketch.kind === kind ? null : kind, corners: [], pick });
  news();
}

export const stopDrawing = () => drawing() && draw(sketch.kind);

const to3 = (value) => Math.round(1000 * value) / 1000;

// The shape between the first place and the pointer, as it is sent to the server; null while it is no area.
export function shapeOf({ kind, corners: [first, ...others], end }) {
  if (!first) return null;
  if (kind === "polygon") {
    const ring = [first, ...others].map((corner) => corner.map(to3));
    return ring.length > 2 ? { kind, polygons: [[ring]] } : null;
  }
  if (!end) return null;
  const [dx, dy] = [Math.abs(end[0] - first[0]), Math.abs(end[1] - first[1])];
  if (kind === "circle") return dx + dy > 0 ? { kind, x: to3(first[0]), y: to3(first[1]), radius: to3(Math.hypot(dx, dy)) } : null;
  return dx > 0 && dy > 0 ? { kind, x: to3((first[0] + end[0]) / 2), y: to3((first[1] + end[1]) / 2), length: to3(dx), width: to3(dy), turn_deg: 0 } : null;
}

export function finish() {
  const shape = shapeOf(sketch);
  Object.assign(sketch, NOTHING, { kind: null, corners: [] });
  news();
  return shape && addPlots([{ name: "", shape }]);
}

// The functions return true where the event belonged to a drawing. Circles and rectangles are drawn by dragging or by two
// clicks, polygons by a click for each corner and one on the first corner. Points are picked by clicks.

const byClicks = ({ kind }) => kind === "polygon" || kind === "point";

export function pressAt(at, view) {
  if (!drawing()) return false;
  if (!byClicks(sketch) && !sketch.corners.length) sketch.corners = [view.toMap(...at)];
  return true;
}

export function dragTo(at, view, travelled) {
  if (!drawing() || byClicks(sketch)) return false;
  sketch.dragged = travelled > 4;
  sketch.end = view.toMap(...at);
  news();
  return true;
}

export function release() {
  if (!drawing() || !sketch.dragged) return false;
  sketch.dragged = false;
  finish();
  return true;
}

export function hoverTo(at, view) {
  if (!drawing()) return false;
  sketch.end = view.toMap(...at);
  news();
  return true;
}

export function clickOn(at, view) {
  if (!drawing()) return false;
  const place = view.toMap(...at);
  if (sketch.kind === "point") {
    const tree = treeAt(trees(), at, view);
    sketch.pick(tree ? { tree: tree.number } : { x: to3(place[0]), y: to3(place[1]) });
  } else if (sketch.kind === "polygon") {
    const [px, py] = sketch.corners.length ? view.toScreen(...sketch.corners[0]) : [Infinity, Infinity];
    if (sketch.corners.length > 2 && Math.hypot(at[0] - px, at[1] - py) < CLOSING) finish();
    else sketch.corners.push(place);
  } else if (sketch.begun) {
    sketch.end = place;
    finish();
    return true;
  } else sketch.begun = true;
  news();
  return true;
}

// --- the picture ------------------------------------------------------------------------------------------------

const corner = ({ x, y, length, width, turn_deg: turn }) => {
  const [c, s] = [Math.cos((turn * Math.PI) / 180), Math.sin((turn * Math.PI) / 180)];
  return ([u, v]) => [x + 0.5 * (u * length * c - v * width * s), y + 0.5 * (u * length * s + v * width * c)];
};

// The rings of a shape as [[x, y], ...] [m]; a circle has 72 corners.
export function ringsOf(shape) {
  if (shape.kind === "polygon") return shape.polygons.flat();
  if (shape.kind === "rectangle") return [[[-1, -1], [1, -1], [1, 1], [-1, 1]].map(corner(shape))];
  return [Array.from({ length: 72 }, (_, k) => [shape.x + shape.radius * Math.cos((k * Math.PI) / 36), shape.y + shape.radius * Math.sin((k * Math.PI) / 36)])];
}
