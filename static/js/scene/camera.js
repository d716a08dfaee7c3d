// What the camera saw at the time of the standing scan, with the trees of the map and the scan's clusters in it.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { select, selectCluster } from "../core/live_feed.js";
import { on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { verdictOf } from "../core/verdicts.js";
import { openStory } from "../explain/story.js";
import { keepFresh, shownOver } from "./overlay.js";

const EVERY = 500; // [ms] between two pictures
const AGAIN = 3000; // [ms] after which a picture that could not be had is asked for once more
const LATE = 50; // [ms] beside the scan from which on it is said
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
    const address = `/api/camera/${seen.stamp_ns}.jpg?of=${seen.of}`; // another run may have a picture of the same time
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

// The marks belong to the picture: they are drawn when it is there.
function load(address) {
  return new Promise((resolve, reject) => {
    const next = new Image();
    next.onload = () => {
      image().src = address;
      byId("camera-frame").style.setProperty("--ratio", String(next.naturalWidth / next.naturalHeight));
      resolve();
    };
    next.onerror = () => reject(new Error("The picture did not arrive."));
    next.src = address;
  });
}

function empty(message) {
  seen = null;
  byId("camera-frame").hidden = true;
  byId("over-camera").dataset.scan = "";
  setText(byId("camera-lead"), "");
  setText(byId("camera-told"), "");
  setText(byId("camera-empty"), message.charAt(0).toUpperCase() + message.slice(1));
  byId("camera-empty").hidden = false;
}

function draw() {
  byId("camera-empty").hidden = true;
  byId("camera-frame").hidden = false;
  marks = seen.marks;
  byId("camera-marks").replaceChildren(...marks.map(button));
  const off = Math.abs(seen.later_ms);
  const late = off < LATE ? "" : `; its picture was taken ${(off / SECOND).toFixed(2)} s ${seen.later_ms > 0 ? "after" : "before"} it`;
  const trees = marks.filter(({ kind }) => kind === "tree").length;
  setText(byId("camera-lead"), seen.why ? `Scan ${seen.index}${late}. Nothing can be marked: ${seen.why}.`
    : `Scan ${seen.index}${late}. Trees of the map in view: ${trees}; clusters: ${marks.length - trees}. Click one to read why.`);
  setText(byId("camera-told"), seen.told && `Live: ${seen.told}.`);
  byId("over-camera").dataset.scan = String(seen.index);
  choose();
}

function button(mark) {
  const [letter, hue] = verdictOf(mark.verdict);
  const isTree = mark.kind === "tree";
  const name = isTree ? `Tree ${mark.number}` : `Cluster, ${mark.verdict}`;
  const place = Object.fromEntries(["left", "top", "width", "height"].map((side) => [side, `${100 * mark[side]}%`]));
  return el("button", { class: `seen ${mark.kind}`, "data-number": mark.number, "aria-label": `${name}, ${mark.distance_m.toFixed(1)} m`,
    title: `${name}, ${mark.distance_m.toFixed(1)} m`, style: { ...place, borderColor: colour(isTree ? "tree" : hue) }, onclick: () => tell(mark) },
  mark.verdict === "tree" && !isTree ? "" : el("span", { style: { background: colour(isTree ? "tree" : hue) }, text: isTree ? mark.number : letter }));
}

function tell({ kind, number }) {
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
