// Measuring a distance on the map between two places, which snap to the centres of trees.

import { byId } from "../core/dom.js";
import { changed, state } from "../core/store.js";

export const measuring = () => state.measure !== null;

export function toggleMeasure() {
  state.measure = measuring() ? null : { from: null, to: null, fixed: false };
  byId("map-measure").setAttribute("aria-pressed", String(measuring()));
  changed("measure");
}

export const stopMeasuring = () => measuring() && toggleMeasure();

// The first click sets the start, the second the end, a third starts again.
export function measureAt(place) {
  const { from, fixed } = state.measure;
  state.measure = from === null || fixed ? { from: place, to: null, fixed: false } : { from, to: place, fixed: true };
  changed("measure");
}

export function measureTowards(place) {
  if (state.measure.from === null || state.measure.fixed) return;
  state.measure.to = place;
  changed("measure");
}

export const measuredText = ({ from, to }) =>
  `${Math.hypot(to.x - from.x, to.y - from.y).toFixed(2)} m${from.tree && to.tree ? `, tree ${from.tree} to tree ${to.tree}` : ""}`;

export function startMeasure() {
  byId("map-measure").addEventListener("click", toggleMeasure);
}
