// Sensitivity of a parameter: the score of the whole run over its range, below its row. The server computes one point after
// the other, coarse first; a click on the curve sets the value.

import { post, remove } from "../../core/api.js";
import { el, setText } from "../../core/dom.js";
import { roughly } from "../../core/format.js";
import { receive } from "../../core/live_feed.js";
import { on, state } from "../../core/store.js";
import { line, svg, text } from "../../core/svg.js";
import { attempt, setValue, shown, specOf, valueOf } from "../../tune/parameters.js";
import { FINE, fromPlace, toPlace } from "../../tune/slider.js";

const POINTS = 17;
const [WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [340, 154, 40, 12, 19, 28];
const NEAR = 64; // between two marks whose labels would overlap
const LAST = 5; // points for the estimate of the time left
let toShow = ""; // requested here and not yet scrolled into view
let asking = null, arrivals = []; // when points arrived: {done, at [ms]}
const MEASURES = {
  f1: { words: "F1, %", of: ({ f1 }) => f1 === null ? null : 100 * f1, most: true },
  TA: { words: "trees found", of: ({ TA }) => TA, most: true },
  false: { words: "false trees", of: (point) => point.false },
  rmse: { words: "position error, cm", of: (point) => point.position_rmse_m === null ? null : 100 * point.position_rmse_m },
  pairs: { words: "pair error, %", of: (point) => point.mean_pair_error_percent },
};
const note = el("p", { class: "note dim", role: "status" });
const plot = el("div", { class: "sensitivity-plot" });
const choice = el("select", { "aria-label": "Quantity of the curve", class: "small", onchange: draw }, ...Object.entries(MEASURES).map(([name, { words }]) => el("option", { value: name, text: words })));
const best = el("button", { class: "small", type: "button", hidden: true });
const again = el("button", { class: "small", type: "button", text: "Update", title: "Compute it again with the present values", onclick: () => requestSensitivity(specOf(state.sensitivity.name)) });
const close = el("button", { class: "small", type: "button", text: "Close", onclick: () => attempt(() => remove("/api/sensitivity")) });
const section = el("section", { class: "sensitivity below-row", "aria-label": "Sensitivity" },
  el("div", { class: "sensitivity-head" }, choice, best, el("span", { class: "grow" }), again, close), plot, note);

// Values in the order of computation: present value, default, both ends, then the middles of the largest gaps.
function valuesOf(spec, present) {
  if (spec.kind === "bool") return [present, !present];
  if (spec.kind === "choice") return [present, ...spec.choices.filter((value) => value !== present)];
  const places = [0, FINE];
  for (let step = 2; places.length < POINTS; step *= 2) for (let k = 1; k < step; k += 2) places.push((FINE * k) / step);
  return [...new Set([present, spec.default, ...places.map((place) => fromPlace(spec, place))])];
}

export function requestSensitivity(spec) {
  toShow = spec.name;
  return attempt(() => post("/api/sensitivity", { name: spec.name, values: valuesOf(spec, valueOf(spec.name)) }));
}

export const sensitivityButton = (spec) => el("button", { class: "quiet icon matter", type: "button", text: "∿", title: "Sensitivity: score over this parameter's range",
  "aria-label": `Sensitivity of ${spec.title}`, onclick: () => requestSensitivity(spec) });

const isNumber = (spec) => spec.kind === "int" || spec.kind === "float";
const choicesOf = (spec) => (spec.kind === "bool" ? [false, true] : spec.choices);

// Position along the plot, 0 to 1: like the slider for numbers, evenly spaced for choices.
function share(spec, value) {
  if (isNumber(spec)) return toPlace(spec, value) / FINE;
  const all = choicesOf(spec);
  return (all.indexOf(value) + 0.5) / all.length;
}

function valueAt(spec, part) {
  if (isNumber(spec)) return fromPlace(spec, FINE * part);
  const all = choicesOf(spec);
  return all[Math.min(all.length - 1, Math.floor(part * all.length))];
}

function draw() {
  const asked = state.sensitivity;
  const spec = asked && specOf(asked.name);
  const row = spec && document.querySelector(`[data-parameter="${CSS.escape(asked.name)}"]`);
  if (!row) return section.remove();
  if (row.nextElementSibling !== section) row.after(section);
  const measure = MEASURES[choice.value];
  const points = asked.points.filter((point) => !point.error).map((point) => ({ ...point, y: measure.of(point), x: share(spec, point.value) }))
    .filter(({ y }) => y !== null).sort((a, b) => a.x - b.x);
  if (points.length) plot.replaceChildren(curve(spec, points, measure));
  else if (asked.error || asked.points.length) plot.replaceChildren();
  else if (!plot.querySelector("progress")) plot.replaceChildren(el("progress", { "aria-label": "Mapping the run with the first value" }));
  tell(asked, spec, points, measure);
  if (toShow !== asked.name) return;
  toShow = "";
  section.scrollIntoView({ block: "nearest" });
}

function heard() {
  const asked = state.sensitivity, done = asked?.points.length ?? 0, before = arrivals.at(-1)?.done ?? 0;
  if (!asked || asked.name !== asking || done < before) arrivals = [];
  asking = asked?.name ?? null;
  if (done && done !== arrivals.at(-1)?.done) arrivals.push({ done, at: performance.now() });
  draw();
}

// Estimated from the last few points; the first one takes longer because it maps the run for all.
function timeLeft({ of }) {
  const [first, last] = [arrivals.slice(-LAST)[0], arrivals.at(-1)];
  if (!last || last.done === first.done) return "";
  const seconds = ((of - last.done) * (last.at - first.at)) / (last.done - first.done) / 1000;
  return `, about ${roughly(seconds)} left`;
}

function curve(spec, points, measure) {
  const ys = points.map(({ y }) => y);
  const [low, high] = spread(Math.min(...ys), Math.max(...ys));
  const px = (part) => LEFT + part * (WIDTH - LEFT - RIGHT);
  const py = (y) => TOP + (1 - (y - low) / (high - low)) * (HEIGHT - TOP - BOTTOM);
  const mark = (value, cls) => line(px(share(spec, value)), TOP, px(share(spec, value)), HEIGHT - BOTTOM, cls);
  const [now, usual] = [valueOf(spec.name), spec.default];
  const known = points.length > 1 && isNumber(spec) ? svg("polyline", { points: points.map(({ x, y }) => `${px(x)},${py(y)}`).join(" "), class: "score" }) : null;
  const ends = isNumber(spec) ? [text(px(0), HEIGHT - 8, shown(spec.minimum), "small"), text(px(1), HEIGHT - 8, shown(spec.maximum, spec), "small", "end")]
    : choicesOf(spec).map((value) => text(px(share(spec, value)), HEIGHT - 8, shown(value, spec), "small", "middle"));
  const node = svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", class: "picture", "aria-label": `${measure.words} from ${say(Math.min(...ys))} to ${say(Math.max(...ys))} over ${spec.title}` },
    line(px(0), HEIGHT - BOTTOM, px(1), HEIGHT - BOTTOM, "zero"), text(LEFT - 5, py(high) + 4, say(high), "small", "end"), text(LEFT - 5, py(low), say(low), "small", "end"), ...ends,
    usual === now ? null : mark(usual, "usual"), mark(now, "now"), ...namesOf(share(spec, now), share(spec, usual)).map(([part, words]) => text(px(part), TOP - 5, words, "small", anchor(part))), known,
    ...points.map((point) => svg("circle", { cx: px(point.x), cy: py(point.y), r: 3.5, class: "sample" }, svg("title", { text: `${shown(point.value, spec)}: ${measure.words} ${say(point.y)}` }))));
  node.addEventListener("click", (event) => {
    const { left, width } = node.getBoundingClientRect();
    const part = (((event.clientX - left) / width) * WIDTH - LEFT) / (WIDTH - LEFT - RIGHT);
    setValue(spec.name, valueAt(spec, Math.min(1, Math.max(0, part))));
  });
  return node;
}

// Labels of the marks; one label for both where two would overlap.
function namesOf(now, usual) {
  if (now === usual) return [[now, "now, default"]];
  if (Math.abs(now - usual) * (WIDTH - LEFT - RIGHT) >= NEAR) return [[usual, "default"], [now, "now"]];
  return [[(now + usual) / 2, now < usual ? "now, default" : "default, now"]];
}

const anchor = (part) => (part < 0.15 ? "start" : part > 0.85 ? "end" : "middle");
const spread = (low, high) => (high - low > 1e-9 ? [low, high] : [low - 1, high + 1]);
const say = (y) => shown(Number(y.toPrecision(3)));

function tell(asked, spec, points, measure) {
  const [done, failed] = [asked.points.length, asked.points.filter(({ error }) => error)];
  const stale = Object.entries(asked.asked_with).filter(([name, value]) => name !== asked.name && valueOf(name) !== value).map(([name]) => specOf(name)?.title ?? name);
  const top = points.length && points.reduce((a, b) => ((measure.most ? b.y > a.y : b.y < a.y) ? b : a));
  const flat = points.length > 1 && points.every(({ y }) => y === points[0].y);
  const now = points.find(({ value }) => value === valueOf(spec.name));
  best.hidden = !top || flat || now?.y === top.y;
  again.hidden = !stale.length && !asked.error;
  if (!best.hidden) {
    setText(best, `Best so far: ${shown(top.value, spec)}`);
    best.title = `${measure.words} ${say(top.y)}; click to use this value`;
    best.onclick = () => setValue(spec.name, top.value);
  }
  const parts = asked.error ? [asked.error] : done < asked.of ? [`${done ? "Mapping the whole run with other values" : "Mapping the run once; the other values are faster"}: ${done} of ${asked.of}${timeLeft(asked)}.`]
    : flat ? [`${measure.words} does not depend on this parameter.`] : ["Click on the curve to set the value."];
  if (failed.length) parts.push(`${shown(failed[0].value, spec)}: ${failed[0].error}${failed.length > 1 ? `, and ${failed.length - 1} more` : ""}.`);
  if (stale.length) parts.push(`${stale.slice(0, 2).join(", ")}${stale.length > 2 ? " …" : ""} changed since then.`);
  setText(note, parts.join(" "));
}

export function startSensitivity() {
  // {name, of, points: [{value, f1, TA, TA_of, false, …} or {value, error}], asked_with, error}
  receive("sensitivity", (message) => { state.sensitivity = message.name ? message : null; });
  on("sensitivity", heard);
  on("parameters specs", draw);
}
