// Layers of the 3D scene with switch, count and colour; choice of labels and colours; cameras.

import { patch } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { capital, fixed } from "../core/format.js";
import { startPopover } from "../core/popover.js";
import { attempted } from "../core/problem.js";
import { isDrive, on, state } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { pressInScene } from "./scene.js";

const EVERY = 500; // [ms] between two updates of the counts
const TITLES = { colour_by: "Colour by", label_by: "Labels", accumulated: "Accumulated" };
// What the colours of the scene mean where they are a ramp: title and ticks.
const BARS = {
  height: (drive) => (drive ? ["height of the scan relative to the sensor", ["−1 m", "+1 m", "+3 m"]]
    : ["height above the ground in the middle", (state.map?.height_range ?? []).map((height) => `${fixed(height, 1)} m`)]),
  intensity: (drive) => (!drive ? ["intensity is shown for drives only", []] : state.map?.intensity === false ? ["this source has no intensity", []] : ["intensity of the raw points", ["weak", "strong"]]),
  eccentricity: () => ["eccentricity e of a cluster", ["1 round", "10", "100 a line"]],
};
const counts = {};
const newest = {}; // newest counts by layer

export const chooseView = (name, value) => attempted(() => patch("/api/view", { name, value }));

// Switches a layer by its place in the list: keys 1 to 9 and 0.
export function toggleLayer(place) {
  const layer = state.view?.layers[place];
  if (layer) chooseView(layer.name, !layer.on);
}

export const toggleFollow = () => chooseView("follow", !state.view?.follow);

function show() {
  const view = state.view;
  if (!view) return;
  byId("follow").setAttribute("aria-pressed", String(view.follow));
  const rows = view.layers.map(({ name, title, on: seen, colour }, place) => {
    const box = el("input", { type: "checkbox", "data-layer": name, onchange: (event) => chooseView(name, event.target.checked) });
    box.checked = seen;
    counts[name] = el("span", { class: "count" });
    const key = place < 10 ? String((place + 1) % 10) : "";
    return el("label", { title: key && `Key ${key}` }, box,
      el("i", { style: { background: colour ?? "linear-gradient(90deg, var(--tree), var(--pole), var(--selection))" } }), el("span", { text: title }), counts[name]);
  });
  const choices = Object.entries(TITLES).map(([name, title]) => {
    const list = el("select", { "data-choice": name, onchange: (event) => chooseView(name, event.target.value) },
      ...view[name].of.map((text) => el("option", { value: text, text })));
    list.value = view[name].value;
    return el("label", { class: "choice" }, el("span", { text: title }), list);
  });
  byId("layer-list").replaceChildren(...rows, ...choices);
  showBar(view);
  count();
}

function showBar({ colour_by: { value }, ramp }) {
  const bar = byId("colour-bar"), words = BARS[value];
  bar.hidden = !words;
  if (!words) return;
  const [title, ticks] = words(isDrive());
  const now = [title, ...ticks].join();
  if (bar.dataset.shown === now) return;
  bar.dataset.shown = now;
  setText(bar.querySelector("figcaption"), capital(title));
  bar.querySelector("i").hidden = !ticks.length;
  bar.querySelector("i").style.background = `linear-gradient(90deg, ${ramp.join(", ")})`;
  bar.querySelector("ol").replaceChildren(...ticks.map((text) => el("li", { text })));
}

function count() {
  if (byId("layer-list").hidden) return;
  const known = { ...newest, labels: undefined, path: state.path.length, odometry: state.path.length, truth: state.truth?.length ?? 0 };
  for (const [name, cell] of Object.entries(counts)) setText(cell, known[name] === undefined ? "" : known[name].toLocaleString("en"));
}

export function startLayers() {
  startPopover(byId("layers-button"), byId("layer-list"), count);
  byId("look-top").addEventListener("click", () => pressInScene("t"));
  byId("look-behind").addEventListener("click", () => pressInScene("b"));
  byId("follow").addEventListener("click", toggleFollow);
  on("view", () => { Object.assign(newest, state.view?.counts); show(); });
  on("map", () => { Object.assign(newest, state.map?.layers); if (state.view) showBar(state.view); });
  on("map truth", throttled(count, EVERY));
}
