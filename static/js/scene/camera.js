// The camera picture at the time of the current scan, with the trees of the map and the clusters of the scan marked.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { capital } from "../core/format.js";
import { nothingYet } from "../core/empty_state.js";
import { select, selectCluster } from "../core/live_feed.js";
import { on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { keepFresh } from "../core/timing.js";
import { verdictOf } from "../core/verdicts.js";
import { openStory } from "../explain/story.js";
import { shownOver } from "./overlay.js";

const EVERY = 500; // [ms] between two pictures
const AGAIN = 3000; // [ms] until a failed request is repeated
const LATE = 50; // [ms] between picture and scan that are mentioned
const SECOND = 1000; // [ms]
let seen = null, marks = [], shown = "";

const image = () => byId("camera-image");

const refresh = keepFresh(async () => {
  if (!shownOver("camera")) return;
  if (!state.map) {
    empty(nothingYet("No scan"));
    return;
  }
  try {
    seen = await get("/api/camera");
    const address = `/api/camera/${seen.stamp_ns}.jpg?of=${seen.of}`; // another run may have a picture with the same time stamp
    if (address !== shown) {
      await load(address);
      shown = address;
    }
    draw();
  } catch (error) {
    empty(error.message);
    setTimeout(() => shownOver("camera") && refresh(), AGAIN);
  }
}, EVERY);

// Loads the picture before its marks are drawn.
function load(address) {
  return new Promise((resolve, reject) => {
    const next = new Image();
    next.onload = () => {
      image().src = address;
      byId("camera-frame").style.setProperty("--ratio", String(next.naturalWidth / next.naturalHeight));
      resolve();
    };
    next.onerror = () => reject(new Error("The camera picture could not be loaded. It is requested again."));
    next.src = address;
  });
}

function empty(message) {
  seen = null;
  byId("camera-frame").hidden = true;
  byId("over-camera").dataset.scan = "";
  setText(byId("camera-lead"), "");
  setText(byId("camera-received"), "");
  setText(byId("camera-empty"), capital(message));
  byId("camera-empty").hidden = false;
}

function draw() {
  byId("camera-empty").hidden = true;
  byId("camera-frame").hidden = false;
  marks = seen.marks;
  byId("camera-marks").replaceChildren(...marks.map(button));
  const off = Math.abs(seen.later_ms);
  const late = off < LATE ? "" : `; picture taken ${(off / SECOND).toFixed(2)} s ${seen.later_ms > 0 ? "later" : "earlier"}`;
  const trees = marks.filter(({ kind }) => kind === "tree").length;
  setText(byId("camera-lead"), seen.why ? `Scan ${seen.index}${late}. No marks: ${seen.why}.`
    : `Scan ${seen.index}${late}. Trees of the map in view: ${trees}; clusters: ${marks.length - trees}. Click one for its story.`);
  setText(byId("camera-received"), seen.received && `Live: ${seen.received}.`);
  byId("over-camera").dataset.scan = String(seen.index);
  choose();
}

function button(mark) {
  const [letter, hue] = verdictOf(mark.verdict);
  const isTree = mark.kind === "tree";
  const name = isTree ? `Tree ${mark.number}` : `Cluster, ${mark.verdict}`;
  const place = Object.fromEntries(["left", "top", "width", "height"].map((side) => [side, `${100 * mark[side]}%`]));
  return el("button", { class: `seen ${mark.kind}`, "data-number": mark.number, "aria-label": `${name}, ${mark.distance_m.toFixed(1)} m`,
    title: `${name}, ${mark.distance_m.toFixed(1)} m`, style: { ...place, borderColor: colour(isTree ? "tree" : hue) }, onclick: () => open(mark) },
  mark.verdict === "tree" && !isTree ? "" : el("span", { style: { background: colour(isTree ? "tree" : hue) }, text: isTree ? mark.number : letter }));
}

function open({ kind, number }) {
  openStory(kind);
  if (kind === "tree") select(number);
  else selectCluster(seen.index, number);
}

function choose() {
  for (const [k, node] of [...byId("camera-marks").children].entries()) {
    const { kind, number } = marks[k];
    const chosen = kind === "tree" ? number === state.selected
      : state.selectedCluster?.scan === seen?.index && state.selectedCluster?.cluster === number;
    node.classList.toggle("selected", chosen);
    node.setAttribute("aria-pressed", String(chosen));
  }
}

export function startCamera() {
  on("over map", () => shownOver("camera") && refresh());
  on("theme", () => seen && draw());
  on("selection", choose);
  on("status", () => { byId("camera-button").hidden = !state.status?.camera; });
}
