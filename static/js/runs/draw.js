// Picture of a finished map.

import { el } from "../core/dom.js";
import { dbhText, seenText } from "../core/format.js";
import { colours } from "../core/theme.js";
import { drawFrame, drawLine, drawNumbers, drawTree, drawTruth } from "../map/draw.js";
import { MapCanvas } from "../map/map_canvas.js";

// A map with its legend: {box, canvas, redraw}. `legend` is [[class, text]]; `paint`, `bounds` and `describe` are those of MapCanvas.
export function mapPicture({ label, legend, paint, bounds, describe }) {
  const canvas = el("canvas", { tabindex: "0", role: "img", "aria-label": label });
  const tip = el("div", { class: "tip", hidden: true });
  const frame = el("div", { class: "map-frame" }, canvas, tip,
    el("div", { class: "map-buttons" }, el("button", { class: "small", text: "Fit", title: "Show the whole map", onclick: () => map.fit() })));
  const map = new MapCanvas(canvas, { tip, bounds, describe, paint: (pen, view) => drawFrame(pen, view, () => paint(pen, view)) });
  const box = el("div", { class: "run-map" }, frame, el("ul", { class: "legend", "aria-label": "Legend" }, ...legend.map(([name, text]) => el("li", { class: name, text }))));
  return { box, canvas, redraw: map.redraw };
}

export function paintRun(pen, view, { path, truth, trees }) {
  drawLine(pen, view, path, colours.path, 2);
  for (const each of truth ?? []) drawTruth(pen, view, each);
  for (const tree of trees) drawTree(pen, view, tree, false, isRejected(tree));
  drawNumbers(pen, view, trees, null);
}

// Whether a person rejected a tree of a finished map.
export const isRejected = ({ review }) => review === "rejected";

export const treeText = (tree) => `Tree ${tree.number}, ${dbhText(tree)}\n${seenText(tree)}${isRejected(tree) ? "\nrejected by a person" : ""}`;
