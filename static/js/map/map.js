// The live 2D map: pan, zoom, hover and select.

import { draft } from "../annotate/annotations.js";
import { clickAt, drag, drawAnnotations, drop, grab, hoverAt } from "../annotate/pointer.js";
import { byId, setText } from "../core/dom.js";
import { saveCanvas, saveCsv } from "../core/download.js";
import { figure, isAssumed, NONE } from "../core/format.js";
import { select, selectCluster } from "../core/live_feed.js";
import { on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { openStory } from "../explain/story.js";
import { drawMap, symbolRadius } from "./draw.js";
import { MapView } from "./map_view.js";
import { measureAt, measuredText, measureTowards, measuring } from "./measure.js";

const NAMES = ["tree", "pole", "person", "bush", "other", "uncertain", "truth", "path", "odometry", "robot", "selection", "text", "surface", "grid", "axis", "font", "set-a", "set-b"];
const canvas = byId("map");
const view = Object.assign(new MapView(), { top: 54 });
const pointers = new Map(); // fingers and mouse that are down
let colours = {}, planned = false, travelled = 0;

function redraw() {
  if (planned) return;
  planned = true;
  requestAnimationFrame(() => {
    planned = false;
    if (!view.moved) view.fit(bounds());
    const pen = canvas.getContext("2d");
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    drawMap(pen, view, state, colours);
    drawAnnotations(pen, view, colours);
    const measured = state.measure?.to ? ` Measured: ${measuredText(state.measure)}.` : "";
    canvas.setAttribute("aria-label", `Map: ${state.map?.trees.length ?? 0} trees and the robot's path. The table below lists the trees.${measured}`);
  });
}

function bounds() {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  const take = (x, y) => {
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
  };
  for (const [x, y] of state.path) take(x, y);
  for (const tree of state.map?.trees ?? []) take(tree.x, tree.y);
  if (!Number.isFinite(box[0])) for (const truth of state.truth ?? []) take(truth.x, truth.y); // nothing is mapped yet
  return Number.isFinite(box[0]) ? box : [-3, -3, 3, 3];
}

function resize() {
  const { clientWidth, clientHeight } = canvas.parentElement;
  Object.assign(view, { width: clientWidth, height: clientHeight });
  Object.assign(canvas, { width: clientWidth * devicePixelRatio, height: clientHeight * devicePixelRatio });
  if (!view.moved) view.fit(bounds(), true);
  redraw();
}

function nearest(px, py) {
  let best = null, least = 14;
  for (const tree of state.map?.trees ?? []) {
    const [x, y] = view.toScreen(tree.x, tree.y);
    const gap = Math.hypot(px - x, py - y) - symbolRadius(tree, view.scale);
    if (gap < least) [best, least] = [tree, gap];
  }
  return best;
}

// The cluster of this scan at a place on the canvas; trees lie above it.
function clusterAt(px, py) {
  const { x = [], y = [] } = state.map?.clusters ?? {};
  let best = null, least = 9;
  for (let k = 0; k < x.length; k += 1) {
    const [sx, sy] = view.toScreen(x[k], y[k]);
    const gap = Math.hypot(px - sx, py - sy);
    if (gap < least) [best, least] = [k, gap];
  }
  return best;
}

function truthAt(px, py) {
  return (state.truth ?? []).find((truth) => {
    const [x, y] = view.toScreen(truth.x, truth.y);
    return Math.hypot(px - x, py - y) < 9;
  });
}

function describe(tree, truth, cluster) {
  const lines = [];
  if (tree) {
    const dbh = tree.dbh_cm === null ? "DBH not measured" : `DBH ${figure(tree.dbh_cm)} cm${tree.sigma_dbh_cm === null ? "" : ` ± ${figure(tree.sigma_dbh_cm, 2)}`}`;
    lines.push(`Tree ${tree.number}, ${dbh}`, isAssumed(tree) ? "seen in no single scan, in all together; ± assumed" : `seen in ${tree.observations} scans, e ${figure(tree.eccentricity)}`);
  }
  if (cluster !== null && !tree) lines.push(`Cluster: ${state.map.clusters.verdict[cluster]}, ${state.map.clusters.size[cluster]} points`);
  if (truth) lines.push(`Truth: ${truth.kind}${truth.dbh_cm === null ? "" : `, ${figure(truth.dbh_cm)} cm`}`);
  return lines.join("\n") || NONE;
}

function drawnAsTable() {
  const trees = (state.map?.trees ?? []).map((tree) => ["tree", tree.number, tree.x, tree.y, tree.dbh_cm]);
  const truth = (state.truth ?? []).map(({ kind, x, y, dbh_cm: dbh }) => [`truth: ${kind}`, null, x, y, dbh]);
  return [["what", "number", "x_m", "y_m", "dbh_cm"], ...trees, ...truth, ...state.path.map(([x, y], scan) => ["path", scan, x, y, null])];
}

function hover(px, py) {
  const tip = byId("map-tip");
  const [tree, truth, cluster] = [nearest(px, py), truthAt(px, py), clusterAt(px, py)];
  tip.hidden = !(tree || truth || cluster !== null) || pointers.size > 0 || draft.adding;
  canvas.classList.toggle("hits", Boolean(tree) || cluster !== null);
  if (tip.hidden) return;
  setText(tip, describe(tree, truth, cluster));
  tip.style.left = `${Math.min(px + 14, view.width - tip.offsetWidth - 6)}px`;
  tip.style.top = `${Math.min(py + 14, view.height - tip.offsetHeight - 6)}px`;
}

const place = (event) => [event.offsetX, event.offsetY];

function down(event) {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, place(event));
  if (pointers.size === 1) {
    travelled = 0;
    if (!measuring()) grab(place(event), view);
  }
  canvas.classList.add("dragging");
}

function move(event) {
  const now = place(event);
  const before = pointers.get(event.pointerId);
  hover(...now);
  if (measuring()) measureTowards(snapped(now));
  else hoverAt(now, view);
  if (!before) return;
  travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
  if (drag(now, view, travelled)) return void pointers.set(event.pointerId, now);
  const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
  if (other) {
    const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    view.zoom(gap(now) / Math.max(gap(before), 1), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  } else if (travelled > 4) view.pan(now[0] - before[0], now[1] - before[1]);
  pointers.set(event.pointerId, now);
  redraw();
}

function up(event) {
  const held = drop();
  if (!held && event.type === "pointerup" && pointers.size === 1 && travelled <= 4) {
    if (measuring()) measureAt(snapped(place(event)));
    else if (!clickAt(place(event), view, nearest(...place(event)))) choose(nearest(...place(event)), clusterAt(...place(event)), place(event));
  }
  pointers.delete(event.pointerId);
  canvas.classList.toggle("dragging", pointers.size > 0);
}

// The middle of a tree where one is near, else the place itself [m].
function snapped([px, py]) {
  const tree = nearest(px, py);
  return tree ? { x: tree.x, y: tree.y, tree: tree.number } : (([x, y]) => ({ x, y }))(view.toMap(px, py));
}

// Whether a place is meant for the square of a cluster that is no tree, beside a tree's symbol.
function isNearer(cluster, tree, px, py) {
  const { x, y, verdict } = state.map.clusters;
  const gap = (at) => Math.hypot(px - at[0], py - at[1]);
  return verdict[cluster] !== "tree" && gap(view.toScreen(x[cluster], y[cluster])) < gap(view.toScreen(tree.x, tree.y));
}

function choose(tree, cluster, [px, py]) {
  if (tree && cluster !== null && isNearer(cluster, tree, px, py)) tree = null;
  if (tree && tree.number !== state.selected) {
    openStory("tree");
    select(tree.number);
  } else if (!tree && cluster !== null) {
    openStory("cluster");
    selectCluster(state.map.index, cluster);
  } else select(null);
}

// Where a place of the map [m] is seen, in pixels of the canvas.
export const screenOf = (x, y) => view.toScreen(x, y);

// The tree that is to be judged next is brought into sight.
function lookAtNext() {
  if (!draft.look) return;
  const [px, py] = view.toScreen(draft.look.x, draft.look.y);
  draft.look = null;
  if (px > 12 && py > 12 && px < view.width - 12 && py < view.height - 12) return;
  view.pan(view.width / 2 - px, view.height / 2 - py);
}

export function startMap() {
  const repaint = () => { colours = Object.fromEntries(NAMES.map((name) => [name, colour(name)])); redraw(); };
  repaint();
  new ResizeObserver(resize).observe(canvas.parentElement);
  for (const [name, listener] of [["pointerdown", down], ["pointermove", move], ["pointerup", up], ["pointercancel", up]]) {
    canvas.addEventListener(name, listener);
  }
  canvas.addEventListener("pointerleave", () => { byId("map-tip").hidden = true; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    view.zoom(Math.exp(-event.deltaY * 0.0015), ...place(event));
    redraw();
  }, { passive: false });
  byId("map-png").addEventListener("click", () => saveCanvas("map.png", canvas));
  byId("map-csv").addEventListener("click", () => saveCsv("map.csv", drawnAsTable()));
  byId("map-fit").addEventListener("click", () => { view.moved = false; view.fit(bounds(), true); redraw(); });
  on("annotating", lookAtNext);
  on("map truth selection measure tab annotations annotating compare ghost", redraw);
  on("theme", repaint);
}
