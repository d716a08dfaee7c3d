// Plots on the 2D map: dashed outlines with their names, and the shape that is being drawn.

import { rows, treeNumberOf } from "../../annotate/annotations.js";
import { treeOf } from "../../core/store.js";
import { colours } from "../../core/theme.js";
import { drawCircle, drawText, drawTree, symbolRadius } from "../../map/draw.js";
import { controlPoints, titleOf } from "./coordinates.js";
import { drawing, plots, plotting, ringsOf, shapeOf, sketch } from "./plots.js";

function outline(pen, view, ring) {
  pen.beginPath();
  for (const [x, y] of ring) pen.lineTo(...view.toScreen(x, y));
  pen.closePath();
  pen.stroke();
}

export function drawPlots(pen, view) {
  Object.assign(pen, { strokeStyle: colours.plot, lineWidth: 2 });
  for (const { name, shape } of plots()) {
    pen.setLineDash([9, 5]);
    const rings = ringsOf(shape);
    for (const ring of rings) outline(pen, view, ring);
    pen.setLineDash([]);
    const top = rings[0].reduce((best, point) => (point[1] > best[1] ? point : best));
    const [px, py] = view.toScreen(...top);
    drawText(pen, name, px, py - 6, { font: "600 12px" });
    Object.assign(pen, { strokeStyle: colours.plot, lineWidth: 2 });
  }
  drawAdded(pen, view);
  drawControlPoints(pen, view);
  if (drawing()) drawSketch(pen, view);
}

// Trees that people added because the map lacks them, in the order of their names in files and reports.
export const addedTrees = () => (plotting() ? rows().filter((row) => row.kind === "tree" && treeNumberOf(row) === null) : []);

function drawAdded(pen, view) {
  for (const [place, { x, y, dbh_cm }] of addedTrees().entries()) {
    drawTree(pen, view, { x, y, dbh_cm, ellipse: [0, 0, 0] }, false, false, colours.truth);
    const [px, py] = view.toScreen(x, y);
    drawText(pen, `A${place + 1}`, px + symbolRadius({ dbh_cm }, view.scale) + 5, py + 4, { font: "600 11px", align: "left" });
  }
}

// A control point is a cross in a circle, with its name; one without a place, such as a tree that is not in the map, is left out.
function drawControlPoints(pen, view) {
  Object.assign(pen, { strokeStyle: colours.plot, lineWidth: 2 });
  for (const [row, point] of controlPoints().entries()) {
    const place = point.tree === null ? point : treeOf(point.tree);
    const [px, py] = view.toScreen(parseFloat(place?.x), parseFloat(place?.y));
    if (Number.isNaN(px + py)) continue;
    drawCircle(pen, px, py, 7);
    pen.moveTo(px - 11, py);
    pen.lineTo(px + 11, py);
    pen.moveTo(px, py - 11);
    pen.lineTo(px, py + 11);
    pen.stroke();
    drawText(pen, titleOf(point, row), px + 12, py - 9, { font: "600 12px", align: "left" });
    Object.assign(pen, { strokeStyle: colours.plot, lineWidth: 2 });
  }
}

function drawSketch(pen, view) {
  const { kind, corners, end } = sketch;
  Object.assign(pen, { strokeStyle: colours.selection, fillStyle: colours.selection, lineWidth: 2 });
  for (const place of corners) {
    drawCircle(pen, ...view.toScreen(...place), 4);
    pen.fill();
  }
  const shape = kind === "polygon" ? null : shapeOf(sketch);
  if (shape) for (const ring of ringsOf(shape)) outline(pen, view, ring);
  else if (corners.length && end) {
    pen.beginPath();
    for (const place of [...corners, end]) pen.lineTo(...view.toScreen(...place));
    pen.stroke();
  }
  if (!end || !shape) return;
  const size = shape.kind === "circle" ? `r ${shape.radius.toFixed(2)} m` : `${shape.length.toFixed(2)} × ${shape.width.toFixed(2)} m`;
  const [px, py] = view.toScreen(...end);
  drawText(pen, size, Math.min(px + 12, view.width - 60), py - 12, { font: "12px", align: "left" });
}
