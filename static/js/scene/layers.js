// Layers of the 3D scene with switch, count and colour; choice of labels and colours; cameras.

import { patch } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { startPopover } from "../core/popover.js";
import { attempted } from "../core/problem.js";
import { on, state } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { pressInScene } from "./scene.js";

const EVERY = 500; // [ms] between two updates of the counts
const TITLES = { colour_by: "Colour by", label_by: "Labels", accumulated: "Accumulated" };
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
  count();
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
  on("map", () => Object.assign(newest, state.map?.layers));
  on("map truth", throttled(count, EVERY));
}
