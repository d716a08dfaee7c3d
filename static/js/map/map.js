// The 2D map of the dashboard: hover, select, measure and annotate.

import { annotating, draft, reviewOf, rows as annotations } from "../annotate/annotations.js";
import { clickAt, drag, drawAnnotations, drop, grab, hoverAt } from "../annotate/pointer.js";
import { drawSection } from "../annotate/section.js";
import { fileFrame, inFile, isMetric, placeText } from "../core/coordinates.js";
import { byId, setText } from "../core/dom.js";
import { saveCanvas, saveCsv } from "../core/download.js";
import { dbhText, heightText, NONE, seenText } from "../core/format.js";
import { select, selectCluster } from "../core/live_feed.js";
import { distance, nearest } from "../core/nearest.js";
import { clusters, isDrive, on, state, trees } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { verdictOf } from "../core/verdicts.js";
import { openStory } from "../explain/story.js";
import { drawRepairs, repairClick, repairHover, tool } from "../repair/repairs.js";
import { ofExtensions } from "../shell/extensions.js";
import { classedThings, drawMap, treeAt } from "./draw.js";
import { boundsOf, MapCanvas } from "./map_canvas.js";
import { measureAt, measuredText, measureTowards, measuring } from "./measure.js";

const BUTTONS_HEIGHT = 54; // [px] at the upper edge
const LEGEND_EVERY = 500; // [ms] between two updates
const POINT_REACH = 9; // [px] around clusters and ground truth
const canvas = byId("map");
// Whether a tool of an extension takes an event.
const byTool = (name, ...args) => ofExtensions("mapTools").some((tool) => tool[name]?.(...args));

const map = new MapCanvas(canvas, {
  top: BUTTONS_HEIGHT,
  tip: byId("map-tip"),
  bounds: () => (state.path.length + trees().length ? boundsOf(state.path, trees(), state.obstacle?.outline ?? []) : boundsOf(state.truth ?? [])),
  describe,
  paint(pen, view) {
    drawSection(pen, view);
    drawMap(pen, view, state, isRejected, fileFrame());
    ofExtensions("drawOnMap", pen, view);
    drawAnnotations(pen, view);
    drawRepairs(pen, view);
    const measured = state.measure?.to ? ` Measured: ${measuredText(state.measure)}.` : "";
    canvas.setAttribute("aria-label", `Map: ${trees().length} trees${isDrive() ? " and the robot's path" : ""}. The table below lists the trees.${measured}`);
  },
  gestures: {
    press: (at) => byTool("press", at, map.view) || measuring() || grab(at, map.view),
    drag: (at, travelled) => byTool("drag", at, map.view, travelled) || drag(at, map.view, travelled),
    release: () => byTool("release") || drop(),
    hover: (at) => byTool("hover", at, map.view) || repairHover(at, map.view) || (measuring() ? measureTowards(snapped(at)) : hoverAt(at, map.view)),
    click: (at) => {
      if (byTool("click", at, map.view) || repairClick(at, map.view)) return;
      if (measuring()) measureAt(snapped(at));
      else if (!clickAt(at, map.view, treeAt(trees(), at, map.view))) choose(at);
    },
  },
});

// Surveyed places are found by the coordinates under the pointer.
canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
  byId("map-place").hidden = false;
  setText(byId("map-place"), placeText(map.view.toMap(offsetX, offsetY)));
});
canvas.addEventListener("pointerleave", () => { byId("map-place").hidden = true; });

const gapTo = (at) => (place) => {
  const [x, y] = map.view.toScreen(place.x, place.y);
  return Math.hypot(at[0] - x, at[1] - y);
};
const clusterAt = (at) => nearest(clusters(), gapTo(at), POINT_REACH);
const truthAt = (at) => nearest(state.truth ?? [], gapTo(at), POINT_REACH);

// A confirmed tree without a DBH by tape has that of the ground truth.
function truthText({ kind, dbh_cm: dbh, annotated, taped }) {
  const dbhPart = dbh !== null ? dbhText({ dbh_cm: dbh }) : kind === "tree" ? "DBH unknown" : "";
  if (annotated && !taped && dbh !== null) return `Annotation: ${kind}\nGround truth: ${dbhPart}`;
  return `${annotated ? "Annotation" : "Ground truth"}: ${[kind, dbhPart].filter(Boolean).join(", ")}`;
}

function describe(at) {
  let [tree, truth] = [treeAt(trees(), at, map.view), truthAt(at)];
  const cluster = clusterAt(at);
  // An annotation beside a tree is not that tree: what is nearer to the pointer is meant.
  if (tree && truth && distance(tree, truth) > (state.parameters?.values["evaluation.match_distance"] ?? 0.5)) {
    if (gapTo(at)(truth) < gapTo(at)(tree)) tree = null;
    else truth = null;
  }
  canvas.classList.toggle("hits", Boolean(tree ?? cluster ?? truth));
  if (measuring()) return state.measure.from === null ? "Click where the distance begins" : "";
  if (draft.adding || tool.kind || byTool("busy") || !(tree ?? truth ?? cluster)) return "";
  const lines = [];
  if (tree) lines.push(`Tree ${tree.number}, ${dbhText(tree)}`, `at ${placeText([tree.x, tree.y])}`, isDrive() ? seenText(tree) : `height ${heightText(tree)}`);
  else if (cluster) lines.push(`${isDrive() ? "Cluster" : "Candidate"}: ${cluster.verdict === "tree" && isDrive() ? "tree in this scan, none in the map" : cluster.verdict}, ${state.map.clusters.size[cluster.row]} points`);
  if (truth) lines.push(truthText(truth));
  return lines.join("\n") || NONE;
}

function tableOfMap() {
  const found = trees().map((tree) => ["tree", tree.number, ...inFile(tree.x, tree.y), tree.dbh_cm]);
  const truth = (state.truth ?? []).map(({ kind, x, y, dbh_cm: dbh }) => [`truth: ${kind}`, null, ...inFile(x, y), dbh]);
  return [["what", "number", ...(isMetric() ? ["x_m", "y_m"] : ["x", "y"]), "dbh_cm"], ...found, ...truth, ...state.path.map(([x, y], scan) => ["path", scan, ...inFile(x, y), null])];
}

// The centre of the tree at a point of the canvas, else the point itself [m].
function snapped(at) {
  const tree = treeAt(trees(), at, map.view);
  if (tree) return { x: tree.x, y: tree.y, tree: tree.number };
  const [x, y] = map.view.toMap(...at);
  return { x, y };
}

const isRejected = (tree) => reviewOf(tree) === "rejected";

// The legend names what the map shows.
function showLegend() {
  const truth = state.truth ?? [], others = [...truth.filter(({ kind }) => kind !== "tree"), ...classedThings(state)];
  const isTree = ({ kind }) => kind === "tree", byPeople = truth.some((each) => isTree(each) && each.annotated), ofRun = truth.some((each) => isTree(each) && !each.annotated);
  const shown = { truth: byPeople || ofRun, other: others.length,
    hollow: trees().some((tree) => tree.dbh_cm === null), unseen: trees().some((tree) => tree.sides != null), odometry: isDrive() && state.path.length, obstacle: Boolean(state.obstacle), ghost: Boolean(state.ghost?.ghost.length), rejected: trees().some(isRejected), annotation: annotating() && annotations().length };
  for (const [name, is] of Object.entries(shown)) byId(`legend-${name}`).hidden = !is;
  byId("legend-obstacle").dataset.zone = state.obstacle?.zone ?? "";
  setText(byId("legend-truth"), !byPeople ? "true tree" : ofRun ? "reference tree" : "annotated tree");
  const kinds = [...new Set(others.map(({ kind }) => kind))].sort(), named = kinds.map((kind) => `${verdictOf(kind)[0]} ${kind}`).join(", ");
  setText(byId("legend-other"), kinds.length > 1 ? `other: ${kinds.map((kind) => verdictOf(kind)[0]).join(" ")}` : named);
  byId("legend-other").title = `No tree by the ground truth, an annotation or a repair: ${named}`;
  setText(byId("legend-ghost"), state.ghost && state.ghost === state.rough ? "preview" : "previous map");
}

function choose(at) {
  const cluster = clusterAt(at), truth = truthAt(at), gap = gapTo(at);
  let tree = treeAt(trees(), at, map.view);
  // A click on the symbol of a rejected cluster or of another object next to a tree means the cluster or the object.
  const others = [cluster?.verdict === "tree" ? null : cluster, truth?.kind === "tree" ? null : truth];
  if (tree && others.some((other) => other && gap(other) < gap(tree))) tree = null;
  if (tree && tree.number !== state.selected) {
    openStory("tree");
    select(tree.number);
  } else if (!tree && cluster) {
    openStory("cluster");
    selectCluster(state.map.index, cluster.row);
  } else {
    select(null);
    state.selectedTruth = truth;
    if (state.selectedTruth) openStory("truth");
  }
}

// Position on the canvas [px] of a place in the map [m].
export const screenOf = (x, y) => map.view.toScreen(x, y);

function showNextToReview() {
  if (!draft.look) return;
  const { x, y } = draft.look;
  draft.look = null;
  map.bringIntoView(x, y);
}

let mapped = ""; // source of the map that is shown

// What a person chose to see was a part of the run before.
function fitToRun({ status }) {
  const before = mapped;
  mapped = status?.source ?? before;
  if (before && mapped !== before) map.fit();
}

export function startMap() {
  on("status", fitToRun);
  byId("map-png").addEventListener("click", () => saveCanvas("map.png", canvas));
  byId("map-csv").addEventListener("click", () => saveCsv("map.csv", tableOfMap()));
  byId("map-fit").addEventListener("click", () => map.fit());
  on("annotating", showNextToReview);
  on("map truth annotations tab ghost obstacle", throttled(showLegend, LEGEND_EVERY));
  on("map truth filter selection measure tab annotations annotating sketch section compare ghost theme obstacle", map.redraw);
}
