// Repairs of the map: the tool that is in use, its clicks on the map, and what it sends.

import { edit, send } from "../annotate/annotations.js";
import { byId } from "../core/dom.js";
import { fixed, plusMinus } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { distance, nearest } from "../core/nearest.js";
import { showNews } from "../core/problem.js";
import { changed, on, selectedTree, state, treeOf, trees } from "../core/store.js";
import { colours } from "../core/theme.js";
import { drawCircle, drawLine, drawText, treeAt } from "../map/draw.js";
import { visible } from "../shell/tabs.js";

const LOOP_REACH = 12; // [px] around the line of a loop
export const CLASSES = ["tree", "pole", "person", "bush", "other"];

// The tool in use: its kind, the first tree, and the pointer [m]; kind "" is none.
export const tool = { kind: "", first: null, pointer: null };

export const repairing = () => visible("repair");
export const repairs = () => state.annotations?.others?.repair ?? [];
const loops = () => (state.map?.loops ?? []).filter(([a, b]) => state.path[a] && state.path[b]);

// Words of each tool: what a click does now.
const STEPS = {
  merge: [() => "Click the tree that stays.", (number) => `Click the tree that is the same as tree ${number}.`],
  split: [() => "Click the tree that is two stems.", (number) => `Click where the second stem of tree ${number} stands.`],
  move: [() => "Click the tree that stands elsewhere.", (number) => `Click where tree ${number} stands.`],
  tie: [() => "Same place: click a stem that the robot saw before …", (number) => `… and the stem that is tree ${number} seen again.`],
  forbid: [() => (loops().length ? "Click the wrong loop, a dashed line of the map." : "The path has no loop.")],
};

export function hint() {
  if (!tool.kind) return "";
  const [first, second] = STEPS[tool.kind];
  return `${tool.first ? second(tool.first.number) : first()} Esc ends.`;
}

// A tool that begins with a tree takes the selected one.
export function useTool(kind) {
  const tree = selectedTree();
  const again = tool.kind === kind;
  Object.assign(tool, { kind: again ? "" : kind, pointer: null, first: !again && tree && kind !== "forbid" ? placeOf(tree) : null });
  changed("repair tool");
  changed("annotating");
}

export function endTool() {
  if (!tool.kind) return false;
  useTool(tool.kind);
  return true;
}

const placeOf = ({ number, x, y }) => ({ number, x, y });
const point = ({ x, y }) => [x, y];

export const add = (fields) => edit(() => send("POST", "/api/repairs", fields));
export const removeRepair = (row) => edit(() => send("DELETE", `/api/annotations/${row.id}`, { version: row.version }));
export const importRepairs = (text) => edit(() => send("POST", "/api/repairs/import", { text }));

export function setClass(value) {
  const tree = selectedTree();
  return tree && add({ kind: "class", places: [point(tree)], value });
}

export function deleteTree() {
  const tree = selectedTree();
  return tree && add({ kind: "delete", places: [point(tree)] });
}

// --- on the map ----------------------------------------------------------------------------------------

// The pointer and its distance [px] to the line of a loop.
function gapTo([px, py], view, [a, b]) {
  const [ax, ay] = view.toScreen(...state.path[a]), [bx, by] = view.toScreen(...state.path[b]);
  const [dx, dy] = [bx - ax, by - ay], length = dx * dx + dy * dy;
  const t = length ? Math.min(1, Math.max(0, ((px - ax) * dx + (py - ay) * dy) / length)) : 0;
  return Math.hypot(px - ax - t * dx, py - ay - t * dy);
}

// Returns whether the click belonged to the tab; without a tool it selects.
export function repairClick(at, view) {
  if (!repairing()) return false;
  if (!tool.kind) {
    select(treeAt(trees(), at, view)?.number ?? null);
    return true;
  }
  if (tool.kind === "forbid") {
    const loop = nearest(loops(), (each) => gapTo(at, view, each), LOOP_REACH);
    if (loop) finish({ kind: "forbid", scans: loop });
    return true;
  }
  const tree = treeAt(trees(), at, view);
  if (!tool.first) {
    if (tree) {
      tool.first = placeOf(tree);
      select(tree.number);
      changed("repair tool");
      changed("annotating");
    }
    return true;
  }
  const isOfTwo = ["merge", "tie"].includes(tool.kind);
  if (isOfTwo && (!tree || tree.number === tool.first.number)) return true;
  const [x, y] = view.toMap(...at);
  if (tool.kind === "merge") sayIfDoubtful(treeOf(tool.first.number), tree);
  finish({ kind: tool.kind, places: [point(tool.first), isOfTwo ? point(tree) : [x, y]] });
  return true;
}

// Two trees that are farther apart than one thing can be, or whose diameters contradict each other, are merged as well: the path
// may have drifted between them, and each may have been seen from one side only.
function sayIfDoubtful(a, b) {
  const apart = distance(a, b), doubts = [];
  if (apart > (state.annotations?.same_thing_m ?? Infinity)) doubts.push(`were ${fixed(apart, 1)} m apart`);
  if (Math.abs(a.dbh_cm - b.dbh_cm) > Math.hypot(a.sigma_dbh_cm, b.sigma_dbh_cm) && a.dbh_cm !== null && b.dbh_cm !== null) {
    doubts.push(`have diameters that contradict each other (${plusMinus(a.dbh_cm, a.sigma_dbh_cm)} and ${plusMinus(b.dbh_cm, b.sigma_dbh_cm)} cm; the sigma of their mean covers both)`);
  }
  if (doubts.length) showNews(`Trees ${a.number} and ${b.number} ${doubts.join(" and ")}: Undo takes the merge back if they are two trees.`);
}

function finish(fields) {
  endTool();
  if (fields.kind !== "split") select(null); // else the next tool would begin with it; a split is mostly followed by a move
  add(fields);
}

export function repairHover(at, view) {
  if (!repairing() || !tool.first) return;
  tool.pointer = view.toMap(...at);
  changed("annotating");
}

// Loops, problems and the tool, while the tab Repair is open.
export function drawRepairs(pen, view) {
  if (!repairing()) return;
  pen.setLineDash([5, 4]);
  for (const [a, b] of loops()) {
    drawLine(pen, view, [state.path[a], state.path[b]], colours.selection, tool.kind === "forbid" ? 4 : 2);
  }
  pen.setLineDash([]);
  for (const [a, b] of loops()) {
    const [p, q] = [state.path[a], state.path[b]];
    const [x, y] = view.toScreen((p[0] + q[0]) / 2, (p[1] + q[1]) / 2);
    drawText(pen, "loop", x, y - 6, { font: "11px" });
  }
  if (!tool.first) return;
  const [x, y] = view.toScreen(tool.first.x, tool.first.y);
  Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 3 });
  drawCircle(pen, x, y, 12);
  pen.stroke();
  if (!tool.pointer) return;
  drawLine(pen, view, [point(tool.first), tool.pointer], colours.selection, 2);
}

export function startRepairs() {
  on("tab", () => repairing() || endTool());
  on("annotations", () => { if (tool.first && !trees().some(({ number }) => number === tool.first.number)) endTool(); });
  byId("map").addEventListener("pointerleave", () => { tool.pointer = null; });
}
