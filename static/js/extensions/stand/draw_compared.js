// Picture of two maps compared.

import { colours } from "../../core/theme.js";
import { drawCircle, drawLine, drawNumbers, drawTree, symbolRadius } from "../../map/draw.js";

export function paintTwo(pen, view, { a, b_path: path, places_b: places, trees }) {
  drawLine(pen, view, a.map.path, colours.path, 2);
  pen.setLineDash([6, 5]);
  drawLine(pen, view, path, colours.selection, 1.4);
  pen.setLineDash([]);
  for (const tree of trees) {
    if (tree.status === "missing") drawSign(pen, view, tree, [[-1, -1, 1, 1], [-1, 1, 1, -1]], colours.pole); // ×
    else if (tree.status === "new") drawSign(pen, view, tree, [[-1, 0, 1, 0], [0, -1, 0, 1]], colours.selection); // +
    else if (/^(not seen|rejected) in/.test(tree.status)) drawUnseen(pen, view, tree);
    else drawTree(pen, view, tree, false);
    if (tree.status === "moved") drawArrow(pen, view, tree, places[tree.tree_b]);
    if (tree.significant) drawGrowth(pen, view, tree);
  }
  drawNumbers(pen, view, trees, null);
}

function drawUnseen(pen, view, tree) {
  Object.assign(pen, { strokeStyle: colours.other, lineWidth: 1.5 });
  pen.setLineDash([3, 3]);
  drawCircle(pen, ...view.toScreen(tree.x, tree.y), symbolRadius(tree, view.scale));
  pen.stroke();
  pen.setLineDash([]);
}

// A ring around a tree whose growth is significant.
function drawGrowth(pen, view, tree) {
  Object.assign(pen, { strokeStyle: colours.plot, lineWidth: 2 });
  drawCircle(pen, ...view.toScreen(tree.x, tree.y), symbolRadius(tree, view.scale) + 4);
  pen.stroke();
}

function drawSign(pen, view, tree, strokes, colour) {
  const [px, py] = view.toScreen(tree.x, tree.y);
  const reach = Math.max(5, symbolRadius(tree, view.scale) * 0.8);
  for (const [style, width] of [[colours.surface, 6], [colour, 3]]) {
    Object.assign(pen, { strokeStyle: style, lineWidth: width, lineCap: "round" });
    pen.beginPath();
    for (const [x0, y0, x1, y1] of strokes) {
      pen.moveTo(px + reach * x0, py + reach * y0);
      pen.lineTo(px + reach * x1, py + reach * y1);
    }
    pen.stroke();
  }
  pen.lineCap = "butt";
}

// An arrow from a tree's former place to its present one, at least 16 pixels long so that it is visible.
function drawArrow(pen, view, from, to) {
  const [x0, y0] = view.toScreen(from.x, from.y);
  const [x1, y1] = view.toScreen(...to);
  const length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const drawn = Math.max(length, 16);
  const [dx, dy] = [(x1 - x0) / length, (y1 - y0) / length];
  const tip = [x0 + drawn * dx, y0 + drawn * dy];
  Object.assign(pen, { strokeStyle: colours.warn, lineWidth: 2.5 });
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(...tip);
  pen.lineTo(tip[0] - 6 * dx + 4 * dy, tip[1] - 6 * dy - 4 * dx);
  pen.moveTo(...tip);
  pen.lineTo(tip[0] - 6 * dx - 4 * dy, tip[1] - 6 * dy + 4 * dx);
  pen.stroke();
}
