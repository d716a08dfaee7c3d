// The tab Story: why a cluster or a tree has its verdict. The story of a cluster belongs to its scan; that of a tree is updated.

import { annotationOf, reviewOf } from "../annotate/annotations.js";
import { get } from "../core/api.js";
import { byId, el } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { capital } from "../core/format.js";
import { selectCluster } from "../core/live_feed.js";
import { on, selectedTree, state } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { onScenePress } from "../scene/scene.js";
import { openTab, visible } from "../shell/tabs.js";
import { clusterStory, clusterTitle } from "./cluster.js";
import { treeStory } from "./tree.js";
import { truthStory } from "./truth.js";

const EVERY = 1000; // [ms] between two updates of a tree while the run plays
const RETRY = 3000; // [ms] after a failed request
const CLICK = 6000; // [ms] after a click in the scene in which a selection counts as its result
const panel = () => byId("panel-story");
const body = () => panel().querySelector(".story-body");
let prefers = "cluster"; // which of the two is shown when both are selected
let shown = "", busy = false, again = false, clickedAt = -CLICK;

// {kind, title, name, version, path}: the story to show; null if nothing is selected. `name` identifies the subject.
function wanted() {
  const { scan, cluster } = state.selectedCluster ?? {};
  if (state.selectedCluster && (prefers === "cluster" || state.selected === null)) {
    return { kind: "cluster", title: clusterTitle(state.selectedCluster), name: `cluster ${scan} ${cluster}`, version: "", path: `/api/story/cluster/${cluster}?scan=${scan}` };
  }
  if (state.selected === null) return null;
  return { kind: "tree", title: `Tree ${state.selected}`, name: `tree ${state.selected}`, version: `${state.map?.index} ${state.parameters?.revision} ${rejectedAs()}`, path: `/api/story/tree/${state.selected}` };
}

// Class that a person gave the selected tree, which is none by it; "" for other trees.
function rejectedAs() {
  const tree = selectedTree();
  return tree && reviewOf(tree) === "rejected" ? annotationOf(tree).kind : "";
}

function rejection() {
  const kind = rejectedAs();
  return kind && el("p", { class: "note", "data-rejected": kind, text: `A person rejected this tree in the review (class: ${kind}), so it does not count as a tree. The verdict below is that of the mapping.` });
}

async function show() {
  if (!visible("story")) return;
  const subject = wanted();
  showHead(subject?.kind);
  if (!subject) return state.selectedTruth ? showTruth(state.selectedTruth) : showEmpty();
  markOld(subject);
  if (`${subject.name} ${subject.version}` === shown) return;
  if (busy) { again = true; return; }
  busy = true;
  try {
    const story = await get(subject.path);
    if (subject.name === wanted()?.name) fill(subject, story);
  } catch (error) {
    if (subject.name === wanted()?.name) showFailure(subject, error.message);
    setTimeout(show, RETRY);
  } finally {
    busy = false;
    if (again) { again = false; show(); }
  }
}

// The story of another subject stays visible but dimmed, under a line that names the new one, until its story arrives.
function markOld({ name, title }) {
  const old = panel().dataset.story !== name;
  body().classList.toggle("old", old);
  body().setAttribute("aria-busy", String(old));
  const line = panel().querySelector(".story-wait");
  line.hidden = !old;
  line.textContent = old ? `Loading the story of ${title[0].toLowerCase()}${title.slice(1)} …` : "";
}

function fill(subject, story) {
  const sameSubject = panel().dataset.story === subject.name, top = panel().scrollTop;
  shown = `${subject.name} ${subject.version}`;
  Object.assign(panel().dataset, { story: subject.name, scan: story.scan });
  body().replaceChildren(...(subject.kind === "cluster" ? clusterStory(story) : [rejection(), ...treeStory(story, chooseCluster)]).filter(Boolean));
  markOld(subject);
  panel().scrollTop = sameSubject ? top : 0;
}

function showFailure(subject, message) {
  shown = "";
  panel().dataset.story = subject.name;
  body().replaceChildren(el("p", { class: "empty", text: capital(message) }));
  markOld(subject);
}

function showEmpty() {
  shown = "";
  delete panel().dataset.story;
  body().classList.remove("old");
  panel().querySelector(".story-wait").hidden = true;
  body().replaceChildren(el("p", { class: "empty", text: state.map
    ? "Nothing selected. Click a cluster or a tree in the 3D scene, on the map or in a table to see why it has its verdict."
    : nothingYet() }));
}

// An object of the ground truth without a cluster: there is no verdict in this scan, but other scans may have one.
function showTruth(truth) {
  const name = `truth ${truth.x} ${truth.y} ${state.map?.index}`;
  if (shown === name) return;
  shown = name;
  panel().dataset.story = "truth";
  body().classList.remove("old");
  panel().querySelector(".story-wait").hidden = true;
  body().replaceChildren(...truthStory(truth));
}

function chooseCluster(scan, cluster) {
  prefers = "cluster";
  selectCluster(scan, cluster);
}

function showHead(kind) {
  const choices = [["cluster", state.selectedCluster && clusterTitle(state.selectedCluster)], ["tree", state.selected !== null && `Tree ${state.selected}`]];
  const buttons = choices.filter(([, title]) => title).map(([name, title]) =>
    el("button", { class: "small", "aria-pressed": String(name === kind), text: title, onclick: () => { prefers = name; show(); } }));
  panel().querySelector(".story-head").replaceChildren(...buttons);
}

// Opens the tab after a person has selected something, wherever that was.
export function openStory(kind) {
  prefers = kind;
  openTab("story");
  byId("side").classList.add("open");
  byId("drawer-button").setAttribute("aria-expanded", "true");
}

// Who annotates or repairs stays in that tab after a click in the scene, as after one on the map.
function onSelection() {
  if (performance.now() - clickedAt < CLICK && (state.selected !== null || state.selectedCluster)) {
    clickedAt = -CLICK;
    if (!["annotate", "repair"].some(visible)) openStory(state.selectedCluster ? "cluster" : "tree");
  }
  shown = "";
  show();
}

const update = throttled(() => { if (wanted()?.kind === "tree") show(); }, EVERY);

// The cluster of a click is not known any more.
function onMissing({ missing: { detail, scan, cluster } = {} }) {
  if (detail && visible("story") && prefers === "cluster") {
    body().replaceChildren(el("p", { class: "empty", text: `${capital(detail)} (cluster ${cluster + 1} of scan ${scan}).` }));
  }
}

export function startStory() {
  panel().append(el("div", { class: "story-head" }), el("p", { class: "story-wait note dim", role: "status", hidden: true }), el("div", { class: "story-body" }));
  on("selection", onSelection);
  on("map", update);
  on("annotations", update);
  on("status", () => {
    if (state.status?.state === "playing") return;
    update();
    if (state.selectedTruth) show();
  });
  on("tab", () => show());
  on("missing", onMissing);
  onScenePress(() => { clickedAt = performance.now(); });
}
