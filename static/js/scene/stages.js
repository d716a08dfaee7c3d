// The four stages of Fig. 3 of the paper side by side: raw scan, filtered, clusters, trunks.

import { block } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { count } from "../core/format.js";
import { on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { keepFresh, oncePerFrame } from "../core/timing.js";
import { verdictOf } from "../core/verdicts.js";
import { shownOver } from "./overlay.js";
import { newEye, pixel, PointPicture, unpack } from "./points.js";

const EVERY = 400; // [ms] between two pictures
const eye = newEye();
const HUES = ["#56B4E9", "#E69F00", "#009E73", "#F0E442", "#D55E00", "#CC79A7", "#7878E6", "#96D26E", "#F08C82", "#46C8C8", "#BE96F0", "#C8AA78"].map(pixel);
const STAGES = {
  raw: ["a", "Raw scan", (d) => `${(d.arrays.raw.length / 3).toLocaleString("en")} points`],
  filtered: ["b", "Filtered", (d) => `${(d.arrays.points.length / 3).toLocaleString("en")} points`],
  clusters: ["c", "Clusters", (d) => count(d.clusters.x.length, "cluster")],
  trunks: ["d", "Trunks", (d) => `${d.verdicts.tree ?? 0} of ${d.clusters.x.length}`],
};
const pictures = {};
let data = null;

function build() {
  byId("stages-grid").replaceChildren(...Object.entries(STAGES).map(([name, [letter, title]]) => {
    const canvas = el("canvas", { tabindex: "0", role: "img", "aria-label": title });
    const caption = el("b");
    pictures[name] = { picture: new PointPicture(canvas, eye, redraw), caption, canvas };
    return el("figure", { "data-stage": name }, canvas, el("figcaption", {}, el("i", { text: letter }), ` ${title} `, caption));
  }));
  new ResizeObserver(redraw).observe(byId("stages-grid"));
}

const redraw = oncePerFrame(() => { if (data && shownOver("stages")) draw(); });

function draw() {
  const { raw, points, labels, circles } = data.arrays;
  const plain = pixel(colour("path")), tree = pixel(colour("tree"));
  const trees = data.clusters.verdict.map((verdict) => verdict === "tree");
  const { raw: a, filtered: b, clusters: c, trunks: d } = pictures;
  a.picture.begin().points(raw, () => plain).end();
  b.picture.begin().points(points, () => HUES[0], 1.4).end();
  c.picture.begin().points(points, (k) => (labels[k] < 0 ? plain : HUES[labels[k] % HUES.length]), 1.8).end();
  d.picture.begin().points(points, (k) => (trees[labels[k]] ? tree : 0), 1.8).end();
  for (let k = 0; k < trees.length; k += 1) {
    const [x, y, r, z] = circles.subarray(4 * k, 4 * k + 4);
    if (trees[k] && Number.isFinite(r)) d.picture.ring(x, y, r, z, colour("text"));
    if (!trees[k]) c.picture.letter(x, y, z, verdictOf(data.clusters.verdict[k])[0], colour("text"), colour("ground"));
  }
  for (const { picture } of Object.values(pictures)) picture.robot(colour("robot"));
  for (const [name, { caption, canvas }] of Object.entries(pictures)) {
    const [, title, text] = STAGES[name];
    setText(caption, text(data));
    canvas.setAttribute("aria-label", `${title}: ${text(data)}`);
  }
}

const refresh = keepFresh(async () => {
  if (!shownOver("stages")) return;
  try {
    data = state.map ? unpack(await block("/api/stages")) : null;
    setText(byId("stages-lead"), data ? `Scan ${data.index}. Drag to turn, Shift+drag to move, wheel to zoom; all four pictures move together.` : nothingYet("No scan"));
    byId("over-stages").dataset.scan = data ? String(data.index) : "";
  } catch (error) {
    setText(byId("stages-lead"), error.message);
  }
  redraw();
}, EVERY);

export function startStages() {
  build();
  on("over map", () => shownOver("stages") && refresh());
  on("theme", redraw);
}
