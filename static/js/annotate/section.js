// The accumulated points at breast height under the 2D map, so that a person sees where a tree is missing.

import { block } from "../core/api.js";
import { changed, on, state } from "../core/store.js";
import { colours } from "../core/theme.js";
import { keepFresh } from "../core/timing.js";
import { unpack } from "../scene/points.js";
import { annotating } from "./annotations.js";

const EVERY = 3000; // [ms] between two requests while the run plays
const OPACITY = 0.55;
let section = null; // {side, origin, arrays: {cells}}
let shown = ""; // scan and revision of the section

const refresh = keepFresh(async () => {
  const version = `${state.annotations?.run} ${state.map?.index} ${state.parameters?.revision} ${state.remapped?.revision}`;
  if (!annotating() || !state.map || version === shown) return;
  try {
    section = unpack(await block("/api/section"));
    shown = version;
    changed("section");
  } catch { /* the worker is busy, or the run was left: it is requested again with the next scan */ }
}, EVERY);

export function drawSection(pen, view) {
  if (!section || !annotating()) return;
  const { side, origin: [x0, y0], arrays: { cells } } = section;
  const size = Math.max(1.5, side * view.scale);
  Object.assign(pen, { fillStyle: colours.path, globalAlpha: OPACITY });
  for (let k = 0; k < cells.length; k += 2) {
    const [px, py] = view.toScreen(x0 + side * cells[k], y0 + side * (cells[k + 1] + 1));
    if (px > -size && py > -size && px < view.width && py < view.height) pen.fillRect(px, py, size, size);
  }
  pen.globalAlpha = 1;
}

export function startSection() {
  on("map", () => { if (!state.map) { section = null; shown = ""; } });
  on("map tab parameters", refresh);
}
