// Sizes and places of map, scene and tabs in a wide window: dragged, collapsed, exchanged, remembered and saved by name.

import { byId, el, recall, remember } from "../core/dom.js";
import { startPopover } from "../core/popover.js";
import { on } from "../core/store.js";
import { openTab, visible } from "./tabs.js";

// left: width of the left part, top: height of the upper right part; lower: height of the lower left part while the tab Tune has the
// right one for its sliders, all in percent; exchanged: the scene is on the left.
const STANDARD = { left: 62, top: 55, lower: 40, exchanged: true, map: true, tabs: true, scene: true };
const LARGE_MAP = { left: 45, exchanged: false };
const BUILT_IN = {
  Monitor: STANDARD,
  Tune: STANDARD,
  Annotate: { ...STANDARD, ...LARGE_MAP, top: 30 },
  Results: { ...STANDARD, ...LARGE_MAP, top: 25 },
};
const TABS = { Monitor: "trees", Tune: "tune", Annotate: "annotate", Results: "scores" };
const LEAST = 15, MOST = 80; // [%]
const STEP = 2; // [%] by an arrow key
const LONGEST_NAME = 40, MOST_SAVED = 20;
const work = document.querySelector(".work");
let layout = { ...STANDARD };
let saved = {};

const stored = (key) => {
  try {
    return JSON.parse(recall(key)) ?? {};
  } catch {
    return {}; // not written by this page
  }
};
// A layout that an earlier version stored may lack a size, or have another one.
const completed = (one) => Object.fromEntries(Object.keys(STANDARD).map((key) => [key, one?.[key] ?? STANDARD[key]]));
const clipped = (percent) => Math.min(MOST, Math.max(LEAST, Number(percent) || LEAST));
const all = () => ({ ...BUILT_IN, ...saved });
const same = (one) => Object.keys(STANDARD).every((key) => one[key] === layout[key]);

function setLayout(changes) {
  layout = { ...layout, ...changes };
  layout.left = clipped(layout.left);
  layout.top = clipped(layout.top);
  layout.lower = clipped(layout.lower);
  layout.scene ||= !(layout.map || layout.tabs);
  remember("layout", JSON.stringify(layout));
  show();
}

const isTuning = () => visible("tune") && layout.map && layout.tabs && layout.scene;
// The height that the horizontal splitter changes now.
const height = () => (isTuning() ? "lower" : "top");

export const exchange = () => setLayout({ ...(layout.exchanged ? LARGE_MAP : { left: STANDARD.left, exchanged: true }), map: true });
export const toggleMap = () => setLayout({ map: !layout.map });
export const toggleScene = () => setLayout({ scene: !layout.scene });
export const toggleTabs = () => setLayout({ tabs: !layout.tabs });
export const showTabs = () => layout.tabs || toggleTabs();
const showScene = () => layout.scene || toggleScene();
export function useLayout(name) {
  setLayout(all()[name]);
  if (name in TABS) openTab(TABS[name]);
  fillNames();
}

function show() {
  work.style.setProperty("--left", `${layout.left}%`);
  work.style.setProperty("--top", `${layout.top}%`);
  work.style.setProperty("--lower", `${layout.lower}%`);
  work.classList.toggle("exchanged", layout.exchanged && layout.map && layout.scene);
  work.classList.toggle("no-map", !layout.map);
  work.classList.toggle("no-scene", !layout.scene);
  work.classList.toggle("no-tabs", !layout.tabs);
  work.classList.toggle("tuning", isTuning()); // the map below the scene, the sliders beside both
  for (const [id, value] of [["split-left", layout.left], ["split-top", layout[height()]]]) byId(id).setAttribute("aria-valuenow", String(Math.round(value)));
  byId("map-exchange").setAttribute("aria-pressed", String(layout.exchanged));
  byId("layout-map").checked = layout.map;
  byId("layout-scene").checked = layout.scene;
  byId("layout-tabs").checked = layout.tabs;
  fillNames();
  dispatchEvent(new Event("resize")); // of the plots
}

function fillNames() {
  const list = byId("layout-names"), names = Object.keys(all());
  const chosen = names.find((name) => same(all()[name]) && visible(TABS[name] ?? "")) ?? names.find((name) => same(all()[name]) && !(name in TABS)) ?? "";
  list.replaceChildren(el("option", { value: "", text: "Choose a layout …" }), ...names.map((name) => el("option", { value: name, text: name })));
  list.value = chosen;
  byId("layout-delete").disabled = !(chosen in saved);
}

function save() {
  const name = byId("layout-name").value.trim().slice(0, LONGEST_NAME);
  if (!name || name in BUILT_IN || Object.keys(saved).length >= MOST_SAVED) return;
  saved = { ...saved, [name]: { ...layout } };
  remember("layouts", JSON.stringify(saved));
  byId("layout-name").value = "";
  fillNames();
}

function drop() {
  delete saved[byId("layout-names").value];
  remember("layouts", JSON.stringify(saved));
  fillNames();
}

function startSplitter(id, side, keys, percentAt) {
  const splitter = byId(id);
  splitter.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    event.preventDefault();
    splitter.setPointerCapture(event.pointerId);
    document.body.classList.add("resizing"); // the frame of the scene would take the pointer
  });
  splitter.addEventListener("pointermove", (event) => {
    if (splitter.hasPointerCapture(event.pointerId)) setLayout({ [side()]: percentAt(event, work.getBoundingClientRect()) });
  });
  splitter.addEventListener("lostpointercapture", () => document.body.classList.remove("resizing"));
  splitter.addEventListener("dblclick", () => setLayout({ [side()]: STANDARD[side()] }));
  splitter.addEventListener("keydown", (event) => {
    const step = keys[event.key];
    if (!step || event.shiftKey) return;
    event.preventDefault();
    event.stopPropagation(); // the arrows would also step the run
    setLayout({ [side()]: layout[side()] + (side() === "lower" ? -step : step) * STEP });
  });
}

function menu() {
  return [
    el("label", {}, el("input", { id: "layout-map", type: "checkbox", onchange: toggleMap }), " 2D map"),
    el("label", {}, el("input", { id: "layout-scene", type: "checkbox", onchange: toggleScene }), " 3D scene"),
    el("label", {}, el("input", { id: "layout-tabs", type: "checkbox", onchange: toggleTabs }), " Tabs and table"),
    el("button", { class: "small", text: "Exchange map and scene", onclick: exchange }),
    el("div", { class: "row" }, el("select", { id: "layout-names", "aria-label": "Saved layouts", onchange: (event) => event.target.value && useLayout(event.target.value) }),
      el("button", { id: "layout-delete", class: "small", text: "Delete", title: "Delete the chosen layout", onclick: drop })),
    el("div", { class: "row" }, el("input", { id: "layout-name", type: "text", maxlength: String(LONGEST_NAME), placeholder: "name", "aria-label": "Name of the layout", autocomplete: "off" }),
      el("button", { id: "layout-save", class: "small", text: "Save", title: "Save this layout under the name", onclick: save })),
  ];
}

export function startLayout() {
  byId("layout-menu").replaceChildren(...menu());
  startPopover(byId("layout-button"), byId("layout-menu"));
  byId("map-exchange").addEventListener("click", exchange);
  startSplitter("split-left", () => "left", { ArrowLeft: -1, ArrowRight: 1 }, (event, box) => (100 * (event.clientX - box.left)) / box.width);
  startSplitter("split-top", height, { ArrowUp: -1, ArrowDown: 1 }, (event, box) => (100 * (isTuning() ? box.bottom - event.clientY : event.clientY - box.top)) / box.height);
  on("tab", show);
  on("over", () => { if (document.querySelector(".scene.covered")) showScene(); }); // stages, comparison and camera lie over it
  saved = Object.fromEntries(Object.entries(stored("layouts")).map(([name, one]) => [name, completed(one)]));
  setLayout(stored("layout"));
}
