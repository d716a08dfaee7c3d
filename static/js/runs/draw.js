// Paints one finished map, or two laid upon one another.

import { figure, isAssumed } from "../core/format.js";
import { drawLine, drawNumbers, drawTree, drawTruth, symbolRadius } from "../map/draw.js";

export function paintRun(pen, view, { path, truth, trees }, colours) {
  drawLine(pen, view, path, colours.path, 2);
  for (const each of truth ?? []) drawTruth(pen, view, each, colours);
  for (const tree of trees) drawTree(pen, view, tree, false, colours);
  drawNumbers(pen, view, trees, null, colours, { radiusOf: symbolRadius });
}

export function paintTwo(pen, view, told, colours) {
  const { a, b_trees: trees, b_path: path, pairs } = told;
  drawLine(pen, view, a.map.path, colours.path, 2);
  pen.setLineDash([6, 5]);
  drawLine(pen, view, path, colours.selection, 1.4);
  pen.setLineDash([]);
  const [of_a, of_b] = [byNumber(a.map.trees), byNumber(trees)];
  for (const pair of pairs) {
    drawTree(pen, view, of_a.get(pair.a), false, colours);
    if (pair.moved) arrow(pen, view, of_a.get(pair.a), of_b.get(pair.b), colours.warn);
  }
  for (const number of told.only_a) sign(pen, view, of_a.get(number), "×", colours.pole, colours);
  for (const number of told.only_b) sign(pen, view, of_b.get(number), "+", colours.selection, colours);
  drawNumbers(pen, view, a.map.trees, null, colours, { radiusOf: symbolRadius });
}

const byNumber = (trees) => new Map(trees.map((tree) => [tree.number, tree]));

function sign(pen, view, tree, letter, ink, colours) {
  const [px, py] = view.toScreen(tree.x, tree.y);
  const reach = Math.max(5, symbolRadius(tree, view.scale) * 0.8);
  const ends = letter === "×" ? [[-1, -1, 1, 1], [-1, 1, 1, -1]] : [[-1, 0, 1, 0], [0, -1, 0, 1]];
  for (const [style, width] of [[colours.surface, 6], [ink, 3]]) {
    Object.assign(pen, { strokeStyle: style, lineWidth: width, lineCap: "round" });
    pen.beginPath();
    for (const [x0, y0, x1, y1] of ends) {
      pen.moveTo(px + reach * x0, py + reach * y0);
      pen.lineTo(px + reach * x1, py + reach * y1);
    }
    pen.stroke();
  }
  pen.lineCap = "butt";
}

// From where a tree stood to where it stands; short ways are drawn longer, so that the eye finds them.
function arrow(pen, view, from, to, ink) {
  const [x0, y0] = view.toScreen(from.x, from.y);
  const [x1, y1] = view.toScreen(to.x, to.y);
  const length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const seen = Math.max(length, 16);
  const [dx, dy] = [(x1 - x0) / length, (y1 - y0) / length];
  const tip = [x0 + seen * dx, y0 + seen * dy];
  Object.assign(pen, { strokeStyle: ink, lineWidth: 2.5 });
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(...tip);
  pen.lineTo(tip[0] - 6 * dx + 4 * dy, tip[1] - 6 * dy - 4 * dx);
  pen.moveTo(...tip);
  pen.lineTo(tip[0] - 6 * dx - 4 * dy, tip[1] - 6 * dy + 4 * dx);
  pen.stroke();
}

export function nearest(trees, px, py, view) {
  let best = null, least = 14;
  for (const tree of trees) {
    const [x, y] = view.toScreen(tree.x, tree.y);
    const gap = Math.hypot(px - x, py - y) - symbolRadius(tree, view.scale);
    if (gap < least) [best, least] = [tree, gap];
  }
  return best;
}

export function treeWords(tree) {
  const dbh = tree.dbh_cm === null ? "DBH not measured" : `DBH ${figure(tree.dbh_cm)} cm`;
  return `Tree ${tree.number}, ${dbh}\n${isAssumed(tree) ? "seen in no single scan, in all together" : `seen in ${tree.observations} scans`}`;
}
