// Paints 2D maps as in Fig. 5 of the paper: path grey, robot a red triangle, trees as circles with their numbers.

import { fixed, isAssumed } from "../core/format.js";
import { nearest } from "../core/nearest.js";
import { colours } from "../core/theme.js";
import { verdictOf } from "../core/verdicts.js";
import { measuredText } from "./measure.js";

const TURN = 2 * Math.PI;

export const symbolRadius = (tree, scale) =>
  Math.max(tree.dbh_cm === null ? 3.5 : 3 + 0.11 * tree.dbh_cm, tree.dbh_cm === null ? 0 : (tree.dbh_cm / 200) * scale);

const SECTORS = 36; // around a trunk
const LEFT_OUT = 0.2; // opacity of trees that the filter of the table leaves out
const DIAMOND = 8; // [px] from the centre of a diamond to its corners
const TREE_REACH = 14; // [px] around the symbol of a tree
const OBSTACLE = 0.3, LEAST_OBSTACLE = 12; // [m], [px] radius of the ring around the nearest obstacle, as in the scene

// The tree at a point of the canvas [px], or null.
export const treeAt = (trees, [px, py], view) => nearest(trees, (tree) => {
  const [x, y] = view.toScreen(tree.x, tree.y);
  return Math.hypot(px - x, py - y) - symbolRadius(tree, view.scale);
}, TREE_REACH);

// Grid, scale bar and coordinates around what `paint` draws. `frame` is that of the coordinates that are shown:
// offset of the map in it [m], and its unit in metres and as text.
export function drawFrame(pen, view, paint, frame = { offset: [0, 0], metres: 1, word: "m" }) {
  const labels = drawGrid(pen, view, frame);
  paint();
  for (const [text, x, y, align] of labels) drawText(pen, text, x, y, { font: "10.5px", align, colour: colours.axis });
  drawScaleBar(pen, view);
}

// `isRejected` tells whether a person rejected a found tree.
export const drawMap = (pen, view, state, isRejected, frame) => drawFrame(pen, view, () => drawContent(pen, view, state, isRejected), frame);

function drawContent(pen, view, state, isRejected) {
  drawLine(pen, view, alignedOdometry(state), colours.odometry, 1.2);
  drawLine(pen, view, state.path, colours.path, 2);
  for (const truth of state.truth ?? []) drawTruth(pen, view, truth);
  for (const thing of classedThings(state)) drawTruth(pen, view, thing);
  if (state.ghost) drawGhost(pen, view, state.ghost);
  const trees = state.map?.trees ?? [];
  drawClusters(pen, view, state.map?.clusters);
  const isLeftOut = (tree) => state.holds?.(tree) === false && tree.number !== state.selected;
  for (const tree of trees) {
    pen.globalAlpha = isLeftOut(tree) ? LEFT_OUT : 1;
    drawTree(pen, view, tree, tree.number === state.selected, isRejected(tree));
  }
  pen.globalAlpha = 1;
  state.compare?.forEach((clusters, k) => drawHalves(pen, view, clusters, k === 0));
  drawNumbers(pen, view, trees.filter((tree) => !isLeftOut(tree)), state.selected, { robot: state.map && !state.status?.one_step && view.toScreen(...state.map.pose) });
  if (state.selectedCluster) drawRing(pen, view, state.selectedCluster);
  if (state.obstacle) drawObstacle(pen, view, state.obstacle);
  if (state.map && !state.status?.one_step) drawRobot(pen, view, state.map);
  if (state.measure?.to) drawMeasure(pen, view, state.measure);
}

export function drawCircle(pen, x, y, radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, TURN);
}

// Text with a margin in the colour of the surface, readable on any ground.
export function drawText(pen, text, x, y, { font, align = "center", margin = 4, colour = colours.text }) {
  Object.assign(pen, { font: `${font} ${colours.font}`, textAlign: align, lineJoin: "round", strokeStyle: colours.surface, fillStyle: colour, lineWidth: margin });
  pen.strokeText(text, x, y);
  pen.fillText(text, x, y);
}

const FEW_DIGITS = 10_000; // [m]; labels of larger coordinates count from a whole kilometre, which is stated once
const originOf = (coordinate) => (Math.abs(coordinate) < FEW_DIGITS ? 0 : 1000 * Math.floor(coordinate / 1000));

// Returns the coordinates of the lines as [text, x, y, alignment], which are drawn above the content.
function drawGrid(pen, view, { offset, metres, word }) {
  const inFile = (value, axis) => (value + offset[axis]) / metres, inMap = (value, axis) => value * metres - offset[axis];
  const origin = [originOf(inFile(view.x, 0)), originOf(inFile(view.y, 1))];
  const lowest = view.height - (origin.some(Boolean) ? 34 : 22); // [px]
  const label = (value, axis) => fixed(value - origin[axis], decimals);
  const labels = [], step = view.step(metres), first = (value, axis) => Math.ceil(inFile(value, axis) / step) * step;
  const [x0, y0] = view.toMap(0, view.height);
  const [x1, y1] = view.toMap(view.width, 0);
  const decimals = Math.max(0, -Math.floor(Math.log10(step)));
  Object.assign(pen, { strokeStyle: colours.grid, lineWidth: 1 });
  pen.beginPath();
  for (let x = first(x0, 0); x <= inFile(x1, 0); x += step) {
    const px = Math.round(view.toScreen(inMap(x, 0), 0)[0]) + 0.5;
    pen.moveTo(px, 0);
    pen.lineTo(px, view.height);
    if (px > 30 && px < view.width - 120) labels.push([label(x, 0), px, view.height - 6, "center"]);
  }
  for (let y = first(y0, 1); y <= inFile(y1, 1); y += step) {
    const py = Math.round(view.toScreen(0, inMap(y, 1))[1]) + 0.5;
    pen.moveTo(0, py);
    pen.lineTo(view.width, py);
    if (py > 24 && py < lowest) labels.push([label(y, 1), 5, py - 3, "left"]);
  }
  pen.stroke();
  if (origin.some(Boolean)) labels.push([`+ ${origin.join(", ")} ${word}`, 5, view.height - 20, "left"]);
  return labels;
}

export function drawLine(pen, view, points, colour, width) {
  Object.assign(pen, { strokeStyle: colour, lineWidth: width, lineJoin: "round" });
  pen.beginPath();
  let last = null;
  for (const point of points) {
    const [px, py] = view.toScreen(point[0], point[1]);
    if (last === null) pen.moveTo(px, py);
    else if (Math.abs(px - last[0]) + Math.abs(py - last[1]) < 1.5) continue; // closer than a pixel and a half
    else pen.lineTo(px, py);
    last = [px, py];
  }
  pen.stroke();
}

// The odometry moved and turned to the start of the path, so that its drift since then is visible.
function alignedOdometry({ path }) {
  if (!path.length || path[0][2] === null) return [];
  const [x0, y0, ox, oy] = path[0], [x1, y1, lx, ly] = path[Math.min(10, path.length - 1)];
  const turn = Math.hypot(lx - ox, ly - oy) > 0.2 ? Math.atan2(y1 - y0, x1 - x0) - Math.atan2(ly - oy, lx - ox) : 0;
  const [c, s] = [Math.cos(turn), Math.sin(turn)];
  return path.map(([, , x, y]) => [x0 + c * (x - ox) - s * (y - oy), y0 + s * (x - ox) + c * (y - oy)]);
}

export function drawTruth(pen, view, truth) {
  const [px, py] = view.toScreen(truth.x, truth.y);
  const radius = symbolRadius(truth, view.scale) + 3;
  Object.assign(pen, { strokeStyle: colours.truth, lineWidth: 1.6 });
  pen.beginPath();
  if (truth.kind === "tree") pen.arc(px, py, radius, 0, TURN);
  else { // other things are diamonds with the letter of their class: never colour only
    pen.moveTo(px, py - DIAMOND);
    for (const [dx, dy] of [[DIAMOND, 0], [0, DIAMOND], [-DIAMOND, 0], [0, -DIAMOND]]) pen.lineTo(px + dx, py + dy);
  }
  pen.stroke();
  if (truth.kind !== "tree") drawText(pen, verdictOf(truth.kind)[0], px, py + 3.5, { font: "700 10px", margin: 2 });
}

// Things of the map to which a repair gave another class than tree: {x, y, kind}. Of several classes of one place the last holds.
export function classedThings({ annotations }) {
  const found = new Map();
  for (const { kind, places, value } of annotations?.others?.repair ?? []) {
    if (kind === "class") found.set(places[0].map((each) => each.toFixed(2)).join(), { x: places[0][0], y: places[0][1], kind: value, dbh_cm: null });
  }
  return [...found.values()].filter(({ kind }) => kind !== "tree");
}

// The previous map, or a preview of the next one: dashed circles for its trees, and a ring around each difference.
function drawGhost(pen, view, { ghost, changes }) {
  Object.assign(pen, { strokeStyle: colours.axis, lineWidth: 1.5 });
  pen.setLineDash([3, 3]);
  for (const [x, y, dbh] of ghost) {
    drawCircle(pen, ...view.toScreen(x, y), symbolRadius({ dbh_cm: dbh === null ? null : 100 * dbh }, view.scale) + 2);
    pen.stroke();
  }
  pen.setLineDash([]);
  pen.lineWidth = 2;
  for (const { kind, x, y } of changes) {
    const [px, py] = view.toScreen(x, y);
    pen.strokeStyle = kind === "vanished" ? colours.robot : colours.selection;
    drawCircle(pen, px, py, 13);
    if (kind === "vanished") { // crossed out
      pen.moveTo(px - 9, py - 9);
      pen.lineTo(px + 9, py + 9);
    }
    pen.stroke();
  }
}

// Small squares: clusters of the current scan that were rejected as trees.
function drawClusters(pen, view, clusters) {
  for (let k = 0; k < (clusters?.x.length ?? 0); k += 1) {
    if (clusters.verdict[k] === "tree") continue; // drawn as a tree of the map
    const [px, py] = view.toScreen(clusters.x[k], clusters.y[k]);
    pen.fillStyle = colours[verdictOf(clusters.verdict[k])[1]];
    pen.fillRect(px - 2.5, py - 2.5, 5, 5);
  }
}

// Trees of one of two compared parameter sets: half discs, left for A and right for B.
function drawHalves(pen, view, { x, y, verdict }, left) {
  Object.assign(pen, { fillStyle: colours[left ? "set-a" : "set-b"], strokeStyle: colours.surface, lineWidth: 1 });
  for (let k = 0; k < x.length; k += 1) {
    if (verdict[k] !== "tree") continue;
    const [px, py] = view.toScreen(x[k], y[k]);
    pen.beginPath();
    pen.arc(px, py, 6, Math.PI / 2, (3 * Math.PI) / 2, !left);
    pen.closePath();
    pen.fill();
    pen.stroke();
  }
}

function drawRing(pen, view, { x, y }) {
  const [px, py] = view.toScreen(x, y);
  Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 3 });
  pen.strokeRect(px - 8, py - 8, 16, 16);
}

export function drawTree(pen, view, tree, selected, rejected = false, colour = rejected ? colours.other : colours.tree) {
  const [px, py] = view.toScreen(tree.x, tree.y);
  drawCircle(pen, px, py, symbolRadius(tree, view.scale));
  if (tree.dbh_cm === null) { // DBH not measured: hollow
    Object.assign(pen, { strokeStyle: colour, lineWidth: 2 });
    pen.stroke();
  } else {
    pen.fillStyle = colour;
    pen.fill();
  }
  if (tree.sides !== null && tree.sides !== undefined) drawUnseen(pen, px, py, symbolRadius(tree, view.scale) + 4, tree.sides);
  if (rejected) drawCross(pen, px, py, symbolRadius(tree, view.scale) + 2);
  const [major, minor, angle] = tree.ellipse;
  if (major * view.scale > 2) {
    Object.assign(pen, { strokeStyle: colours.text, lineWidth: 1 });
    pen.beginPath();
    pen.ellipse(px, py, major * view.scale, Math.max(minor * view.scale, 0.5), -angle, 0, TURN);
    pen.setLineDash(isAssumed(tree) ? [2, 3] : []);
    pen.stroke();
    pen.setLineDash([]);
  }
  if (selected) {
    Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 3 });
    drawCircle(pen, px, py, symbolRadius(tree, view.scale) + 5);
    pen.stroke();
  }
}

// The sides from which a tree without a diameter was never seen, as arcs; bit k is sector k, from x to y of the map.
function drawUnseen(pen, px, py, radius, sides) {
  const step = TURN / SECTORS;
  Object.assign(pen, { strokeStyle: colours.warn, lineWidth: 2.5 });
  pen.beginPath();
  for (let k = 0; k < SECTORS; k += 1) {
    if (Math.floor(sides / 2 ** k) % 2) continue;
    pen.moveTo(px + radius * Math.cos(k * step), py - radius * Math.sin(k * step));
    pen.arc(px, py, radius, -k * step, -(k + 1) * step, true);
  }
  pen.stroke();
}

function drawCross(pen, px, py, reach) {
  Object.assign(pen, { strokeStyle: colours.text, lineWidth: 2 });
  pen.beginPath();
  for (const side of [-1, 1]) {
    pen.moveTo(px - reach, py - side * reach);
    pen.lineTo(px + reach, py + side * reach);
  }
  pen.stroke();
}

// The nearest obstacle in the way of the robot, and the outline of the path ahead.
function drawObstacle(pen, view, { x, y, outline, zone }) {
  const colour = zone === "stop" ? colours.pole : colours.warn, [px, py] = view.toScreen(x, y);
  for (const [edge, width] of [[colours.surface, 7], [colour, 4]]) { // readable on any ground
    Object.assign(pen, { strokeStyle: edge, lineWidth: width });
    drawCircle(pen, px, py, Math.max(LEAST_OBSTACLE, OBSTACLE * view.scale));
    pen.stroke();
  }
  drawLine(pen, view, [...outline, outline[0]], colour, 1.2);
}

function drawRobot(pen, view, { pose: [x, y, yaw], sigma_xy: sigma }) {
  const [px, py] = view.toScreen(x, y);
  if (sigma * view.scale > 4) {
    pen.strokeStyle = colours.robot;
    drawCircle(pen, px, py, sigma * view.scale);
    pen.stroke();
  }
  drawTriangle(pen, px, py, yaw, 12, colours.robot);
}

// A robot at a point of the canvas that looks along `yaw` [rad].
export function drawTriangle(pen, px, py, yaw, size, colour) {
  const corner = (turn, reach) => [px + reach * Math.cos(yaw + turn), py - reach * Math.sin(yaw + turn)];
  Object.assign(pen, { fillStyle: colour, strokeStyle: colours.surface, lineWidth: 1.5 });
  pen.beginPath();
  pen.moveTo(...corner(0, size));
  pen.lineTo(...corner(2.5, 0.75 * size));
  pen.lineTo(...corner(-2.5, 0.75 * size));
  pen.closePath();
  pen.stroke();
  pen.fill();
}

function drawMeasure(pen, view, measure) {
  const { from, to } = measure;
  const [a, b] = [view.toScreen(from.x, from.y), view.toScreen(to.x, to.y)];
  Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 2 });
  pen.beginPath();
  pen.moveTo(...a);
  pen.lineTo(...b);
  for (const [x, y] of [a, b]) {
    pen.moveTo(x + 4, y);
    pen.arc(x, y, 4, 0, TURN);
  }
  pen.stroke();
  drawText(pen, measuredText(measure), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 8, { font: "bold 13px" });
}

function drawScaleBar(pen, view) {
  const step = view.step();
  const [x, y, length] = [view.width - 14, view.height - 10, step * view.scale];
  Object.assign(pen, { strokeStyle: colours.text, fillStyle: colours.text, lineWidth: 2, textAlign: "right", font: `11px ${colours.font}` });
  pen.beginPath();
  pen.moveTo(x - length, y - 4);
  pen.lineTo(x - length, y);
  pen.lineTo(x, y);
  pen.lineTo(x, y - 4);
  pen.stroke();
  pen.fillText(`${Number(step.toPrecision(2))} m`, x, y - 8);
}

// --- numbers of the trees: drawn where they cover no other number and no symbol ------------------------

const CELL = 32; // [px]; a box is searched for in the cells that it touches
const GAP = 2; // [px]
const SMALL = 11, LARGE = 13; // [px] font size of a number and of the selected one

// Boxes [left, top, right, bottom] [px] in a hash grid.
class Boxes {
  cells = new Map();

  *keys([left, top, right, bottom]) {
    for (let x = Math.floor(left / CELL); x <= Math.floor(right / CELL); x += 1) {
      for (let y = Math.floor(top / CELL); y <= Math.floor(bottom / CELL); y += 1) yield x * 65536 + y;
    }
  }

  add(box) {
    for (const key of this.keys(box)) {
      if (!this.cells.has(key)) this.cells.set(key, []);
      this.cells.get(key).push(box);
    }
  }

  isFree([left, top, right, bottom]) {
    for (const key of this.keys([left, top, right, bottom])) {
      for (const other of this.cells.get(key) ?? []) if (left < other[2] && right > other[0] && top < other[3] && bottom > other[1]) return false;
    }
    return true;
  }
}

// Positions of a number in order of preference: right of the symbol, left, above, below.
function placesOf(x, y, radius, width, height) {
  const reach = radius + GAP + 1;
  return [[x + reach, y - height / 2], [x - reach - width, y - height / 2], [x - width / 2, y - reach - height], [x - width / 2, y + reach]];
}

// The selected tree has priority, then the trees with the most observations.
export function drawNumbers(pen, view, trees, selected, { radiusOf = symbolRadius, robot = null } = {}) {
  const taken = new Boxes();
  const seen = [];
  for (const tree of trees) {
    const [x, y] = view.toScreen(tree.x, tree.y);
    if (x < -40 || y < -40 || x > view.width + 40 || y > view.height + 40) continue;
    const radius = radiusOf(tree, view.scale);
    seen.push({ tree, x, y, radius });
    taken.add([x - radius, y - radius, x + radius, y + radius]);
  }
  if (robot) taken.add([robot[0] - 9, robot[1] - 9, robot[0] + 9, robot[1] + 9]);
  const rank = ({ number }) => (number === selected ? 0 : 1);
  seen.sort((a, b) => rank(a.tree) - rank(b.tree) || (b.tree.observations ?? 0) - (a.tree.observations ?? 0) || a.tree.number - b.tree.number);
  for (const { tree, x, y, radius } of seen) {
    const chosen = tree.number === selected;
    const size = chosen ? LARGE : SMALL;
    const font = `${chosen ? "bold " : ""}${size}px`;
    pen.font = `${font} ${colours.font}`; // for the width
    const text = String(tree.number);
    const [width, height] = [pen.measureText(text).width, size];
    const places = placesOf(x, y, radius + (chosen ? 5 : 0), width, height);
    const free = places.find(([left, top]) => taken.isFree([left, top, left + width, top + height]));
    const at = free ?? (chosen ? places[0] : null); // the selected tree always has its number
    if (!at) continue;
    taken.add([at[0] - GAP, at[1], at[0] + width + GAP, at[1] + height]);
    drawText(pen, text, at[0], at[1] + 0.86 * height, { font, align: "left", margin: 3 });
  }
}
