// The tab Story: fetched when it is looked at. A cluster is a picture of its scan and stands; a tree goes on.

import { get } from "../core/api.js";
import { byId, el } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { selectCluster } from "../core/live_feed.js";
import { on, state } from "../core/store.js";
import { onSceneLoad } from "../scene/scene.js";
import { openTab, visible } from "../shell/tabs.js";
import { clusterStory, clusterTitle } from "./cluster.js";
import { treeStory } from "./tree.js";

const EVERY = 1000; // [ms] between two tellings of a tree while the run plays
const AGAIN = 3000; // [ms] after which a story that could not be told is asked for once more
const CLICK = 6000; // [ms] after a click in the scene in which a selection is the answer to it
const panel = () => byId("panel-story");
let wants = "cluster"; // which of the two is read when both are selected
let shown = "", busy = false, again = false, askedAt = 0, clickedAt = -CLICK;

const wanted = () => (state.selectedCluster && (wants === "cluster" || state.selected === null) ? "cluster" : state.selected !== null ? "tree" : null);

async function show() {
  if (!visible("story")) return;
  const kind = wanted();
  head(kind);
  if (!kind) return empty();
  const { scan, cluster } = state.selectedCluster ?? {};
  const key = kind === "cluster" ? `cluster ${scan} ${cluster}` : `tree ${state.selected} ${state.map?.index} ${state.parameters?.revision}`;
  if (key === shown) return;
  if (busy) { again = true; return; }
  busy = true;
  askedAt = performance.now();
  try {
    const story = await get(kind === "cluster" ? `/api/story/cluster/${cluster}?scan=${scan}` : `/api/story/tree/${state.selected}`);
    if (kind === wanted()) fill(kind, story, key);
  } catch (error) {
    shown = "";
    body().replaceChildren(el("p", { class: "empty", text: capital(error.message) }));
    setTimeout(show, AGAIN);
  } finally {
    busy = false;
    if (again) { again = false; show(); }
  }
}

function fill(kind, story, key) {
  const before = panel().dataset.story, top = panel().scrollTop;
  shown = key;
  panel().dataset.story = kind === "cluster" ? `cluster ${story.scan} ${story.cluster}` : `tree ${story.tree}`;
  panel().dataset.scan = story.scan;
  body().replaceChildren(...(kind === "cluster" ? clusterStory(story) : treeStory(story, chooseCluster)).filter(Boolean));
  panel().scrollTop = before === panel().dataset.story ? top : 0;
}

const body = () => panel().querySelector(".story-body");
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

function chooseCluster(scan, cluster) {
  wants = "cluster";
  selectCluster(scan, cluster);
}

function head(kind) {
  const choices = [["cluster", state.selectedCluster && clusterTitle(state.selectedCluster)], ["tree", state.selected !== null && `Tree ${state.selected}`]];
  const buttons = choices.filter(([, title]) => title).map(([name, title]) =>
    el("button", { class: "small", "aria-pressed": String(name === kind), text: title, onclick: () => { wants = name; show(); } }));
  panel().querySelector(".story-head").replaceChildren(...buttons);
}

function empty() {
  shown = "";
  delete panel().dataset.story;
  body().replaceChildren(el("p", { class: "empty", text: state.map
    ? "Nothing is selected. Click a cluster or a tree in the 3D scene, on the map or in a table, and it tells why it was taken for what it is."
    : nothingYet() }));
}

// A person here has chosen something: read about it, wherever it was chosen.
export function openStory(kind) {
  wants = kind;
  openTab("story");
  byId("side").classList.add("open");
  byId("drawer-button").setAttribute("aria-expanded", "true");
}

function selected() {
  if (performance.now() - clickedAt < CLICK && (state.selected !== null || state.selectedCluster)) {
    clickedAt = -CLICK;
    openStory(state.selectedCluster ? "cluster" : "tree");
  }
  shown = "";
  show();
}

function later() {
  if (wanted() === "tree" && performance.now() - askedAt >= EVERY) show();
}

function missing({ missing: { detail, scan, cluster } = {} }) {
  if (detail && visible("story") && wants === "cluster") {
    body().replaceChildren(el("p", { class: "empty", text: `${capital(detail)}. (cluster ${cluster + 1} of scan ${scan})` }));
  }
}

export function startStory() {
  panel().append(el("div", { class: "story-head" }), el("div", { class: "story-body" }));
  on("selection", selected);
  on("map", later);
  on("status", () => state.status?.state !== "playing" && later());
  on("tab", () => show());
  on("missing", missing);
  onSceneLoad((inner) => inner.addEventListener("pointerdown", () => { clickedAt = performance.now(); }, { capture: true }));
}
