// The tab Charts: figures 6 and 7 of the paper, and the course of the run. Plotly is loaded when it is first needed.

import { command, get } from "../core/api.js";
import { byId, el, recall, remember, setText } from "../core/dom.js";
import { saveCsv } from "../core/download.js";
import { select } from "../core/live_feed.js";
import { edits } from "../core/permissions.js";
import { attempted } from "../core/problem.js";
import { on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { keepFresh, throttled } from "../core/timing.js";
import { visible } from "../shell/tabs.js";
import { saveLog, showLog } from "./log.js";

const EVERY = 2000; // [ms] between two updates
const CURSOR_EVERY = 200; // [ms] between two moves of the cursor
const SILENT = 1; // [s] without a scan that are a silence
const LONGEST = 1200; // samples drawn of each curve
const MOST_APART = 24; // trees whose cells have a gap; the gaps of more are drawn unevenly
const ROW = 120; // [px] of height that a curve of its own needs
const HEAD = 0.2; // share of its height for its name
// A colour for each of up to 14 stages; Plotly repeats its own after ten.
const STAGES = ["#4e79a7", "#f28e2b", "#e15759", "#76b7b2", "#59a14f", "#edc948", "#b07aa1", "#ff9da7", "#9c755f", "#7f7f7f", "#1b9e77", "#d95f02", "#66a61e", "#7570b3"];
const FIXED = { n_eff: ["n_eff"], sigma: ["sigma", "yaw"] }; // charts of certain quantities
let chosen = (recall("quantities") ?? "trees,sigma").split(",").filter(Boolean);
let quantities = {}; // name -> {title, unit} of those that the run has
let plotly = null, busy = false;

function load() {
  plotly ??= new Promise((resolve, reject) => {
    document.head.append(el("script", { src: "/static/plotly.min.js", onload: () => resolve(window.Plotly),
      onerror: () => reject(new Error("The plotting library could not be loaded. Reload the page.")) }));
  });
  return plotly;
}

function layout(extra = {}) {
  const axis = { gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line"), ticks: "" };
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colour("text"), size: 11, family: colour("font") },
    margin: { l: 46, r: 14, t: 8, b: 40 }, uirevision: "keep", xaxis: { ...axis }, yaxis: { ...axis }, ...extra,
  };
}

const SCALES = {
  distance: { colorscale: "Viridis", unit: "m" },
  error: { colorscale: "Cividis", unit: "%" },
};

async function matrix(kind) {
  const pairs = await get("/api/pairs");
  const z = kind === "distance" ? pairs?.distance_m : pairs?.error_percent;
  if (!z || z.length < 2) {
    return kind === "distance" ? "Distances need at least two trees. Let the run play on."
      : "The error needs at least two trees that match the ground truth. Simulated runs have ground truth.";
  }
  const labels = pairs.numbers.map(String), gap = labels.length > MOST_APART ? 0 : 1;
  const { colorscale, unit } = SCALES[kind];
  const figure = layout();
  Object.assign(figure.xaxis, { type: "category", title: { text: "tree" } });
  Object.assign(figure.yaxis, { type: "category", title: { text: "tree" }, autorange: "reversed" });
  return [[{ type: "heatmap", x: labels, y: labels, z, colorscale, colorbar: { title: { text: unit }, thickness: 12 }, xgap: gap, ygap: gap,
    hovertemplate: `tree %{y} to tree %{x}<br>%{z:.3~r} ${unit}<extra></extra>` }], figure];
}

// The course of the run: {scans, time_s, values, stages, quantities}, by name one value for each of at most LONGEST scans.
async function course(names, times = false) {
  const answer = await get(`/api/course?most=${LONGEST}&names=${names.join(",")}&stages=${times}`);
  const isOther = Object.keys(answer.quantities).join() !== Object.keys(quantities).join();
  quantities = answer.quantities;
  if (isOther) showChosen();
  return answer;
}

// Times of the stages, one above the other.
async function stages() {
  const { time_s, stages: { total = [], ...times } } = await course([], true);
  const isMeasured = (_, k) => total[k] !== null && total[k] !== undefined, time = time_s.filter(isMeasured);
  if (time.length < 2) return "No times: they are measured while the run plays, and a re-mapping removes those of other parameters. Press play.";
  const figure = layout({ showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" }, shapes: [cursor()] });
  figure.margin.t = 74;
  figure.xaxis.title = { text: TIME };
  Object.assign(figure.yaxis, { rangemode: "tozero", title: { text: "ms per scan" } });
  figure.colorway = STAGES;
  return [Object.entries(times).map(([name, values]) => ({ ...line(time, values.filter(isMeasured), name), stackgroup: "one" })), figure];
}

const NOTHING = "Nothing to plot yet: curves need two mapped scans. Press play.";
const TIME = "time in the run, s";

// Curves of quantities below one another, with one axis of time.
async function curves(wanted) {
  const { time_s: time, values } = await course(wanted);
  const names = wanted.filter((name) => quantities[name]);
  if (time.length < 2) return NOTHING;
  if (!names.length) return "Add a quantity to see its curve.";
  const figure = layout({ hovermode: "x", hoversubplots: "axis", showlegend: false, shapes: [cursor()] });
  const { yaxis } = figure, height = 1 / names.length;
  figure.annotations = [];
  names.forEach((name, place) => {
    const { title, unit } = quantities[name];
    const top = 1 - (place + HEAD) * height;
    figure[`yaxis${place ? place + 1 : ""}`] = { ...yaxis, domain: [1 - (place + 1) * height, top], nticks: 5, automargin: true };
    figure.annotations.push({ text: `${title}${unit && `, ${unit}`}`, showarrow: false, xref: "paper", x: 0, xanchor: "left", yref: "paper", y: top, yanchor: "bottom" });
  });
  Object.assign(figure.xaxis, { title: { text: TIME }, anchor: names.length > 1 ? `y${names.length}` : "y", showspikes: true, spikemode: "across", spikethickness: 1, spikedash: "dot", spikecolor: colour("dim") });
  return [names.map((name, place) => ({ ...brokenAtSilences(line(time, values[name], quantities[name].title)), yaxis: place ? `y${place + 1}` : "y" })), figure];
}

// The current scan as a line over all curves.
const cursor = () => ({ type: "line", yref: "paper", y0: 0, y1: 1, x0: state.map?.time_s ?? 0, x1: state.map?.time_s ?? 0, line: { color: colour("selection"), width: 1.5 } });

const moveCursor = throttled(() => {
  const chart = byId("chart");
  if (!visible("charts") || busy || !chart.data || chart.hidden || !chart.layout.shapes?.length || !state.map) return;
  window.Plotly.relayout(chart, { "shapes[0].x0": state.map.time_s, "shapes[0].x1": state.map.time_s });
}, CURSOR_EVERY);

const line = (x, y, name) => ({ type: "scatter", mode: y.includes(null) ? "lines+markers" : "lines", marker: { size: 4 }, x, y, name, line: { width: 1.5 }, hovertemplate: `%{y:.3~r}<extra>${name}</extra>` });

// A curve is not drawn over a silence, see `_note_silences` in app/dashboard/events.py; of a long run not each scan is drawn.
function brokenAtSilences(curve) {
  const steps = curve.x.slice(1).map((time, k) => time - curve.x[k]), usual = steps.toSorted((a, b) => a - b)[Math.floor((steps.length - 1) / 4)];
  const ends = steps.flatMap((step, k) => (step > Math.max(SILENT, 2 * usual) ? [k + 1] : [])), parts = [0, ...ends].map((from, k) => [from, ends[k]]);
  const joined = (values, between) => parts.flatMap(([from, to]) => [...(from ? [between(from)] : []), ...values.slice(from, to)]);
  const isAlone = parts.some(([from, to = curve.x.length]) => to - from === 1); // a line does not show a single sample
  return { ...curve, ...(isAlone && { mode: "lines+markers" }), x: joined(curve.x, (from) => curve.x[from - 1]), y: joined(curve.y, () => null) };
}

// --- choice of the quantities ------------------------------------------------------------------

function choose(names) {
  chosen = names;
  remember("quantities", names.join(","));
  showChosen();
  draw();
}

function showChosen() {
  const box = byId("chart-quantities");
  box.hidden = byId("chart-choice").value !== "quantities";
  const add = el("select", { id: "chart-add", "aria-label": "Add a quantity", onchange: () => { if (add.value) choose([...chosen, add.value]); } },
    el("option", { value: "", text: "Add a quantity …" }),
    ...Object.keys(quantities).filter((name) => !chosen.includes(name)).map((name) => el("option", { value: name, text: quantities[name].title })));
  box.replaceChildren(...chosen.filter((name) => quantities[name]).map((name) => el("button", { class: "small", text: `${quantities[name].title} ✕`, "aria-label": `Remove ${quantities[name].title}`, onclick: () => choose(chosen.filter((each) => each !== name)) })), add);
}

const drawingOf = (kind) => (kind in SCALES ? matrix(kind) : kind === "time" ? stages() : curves(FIXED[kind] ?? chosen));

const draw = keepFresh(async () => {
  if (!visible("charts")) return;
  busy = true;
  try {
    const kind = byId("chart-choice").value, isLog = kind === "log";
    byId("log").hidden = !isLog;
    if (isLog) {
      byId("chart").hidden = byId("chart-empty").hidden = byId("chart-png").disabled = true;
      byId("chart-csv").disabled = false;
      return showLog();
    }
    if (!plotly) showText("Loading …");
    const [Plotly, drawing] = await Promise.all([load(), drawingOf(kind)]);
    const isText = typeof drawing === "string"; // why there is no plot
    showText(isText ? drawing : "");
    if (!isText) await show(Plotly, kind, ...drawing);
  } catch (error) {
    const isShown = !byId("chart").hidden && byId("chart").dataset.kind === byId("chart-choice").value;
    if (!isShown) showText(error.message); // else a busy server: the last chart stays until the next update
  } finally {
    busy = false;
  }
}, 0);

// Shows a text in place of the chart; the chart without one.
function showText(text) {
  byId("chart").hidden = text !== "";
  byId("chart-empty").hidden = text === "";
  setText(byId("chart-empty"), text);
  for (const id of ["chart-png", "chart-csv"]) byId(id).disabled = text !== "";
}

async function show(Plotly, kind, traces, figure) {
  const chart = byId("chart");
  if (chart.data && chart.dataset.kind !== kind) Plotly.purge(chart); // axes of another figure must not be reused
  chart.dataset.kind = kind;
  chart.style.minHeight = kind in SCALES ? "" : `${ROW * traces.length + 60}px`;
  if (kind === "time") chart.style.minHeight = "";
  const fresh = !chart.data;
  await Plotly.react(chart, traces, figure, { displayModeBar: false, responsive: true });
  if (fresh) chart.on("plotly_click", ({ points: [point] }) => (point.data.type === "heatmap" ? select(Number(point.y)) : goTo(point.x)));
}

const goTo = edits((time) => attempted(() => command("seek", { time_s: time + 0.01 })));

async function savePng() {
  const chart = byId("chart");
  if (chart.hidden || !chart.data) return;
  await (await load()).downloadImage(chart, { format: "png", scale: 2, width: 900, height: 700, filename: chart.dataset.kind });
}

// A matrix as a table with tree numbers in the first row and column; curves as rows of time, curve and value.
function saveTable() {
  if (byId("chart-choice").value === "log") return saveLog();
  const chart = byId("chart");
  if (chart.hidden || !chart.data) return;
  const [first] = chart.data;
  const rows = first.type === "heatmap" ? [["tree", ...first.x], ...first.z.map((row, k) => [first.y[k], ...row])]
    : [["time_s", "curve", "value"], ...chart.data.flatMap(({ x, y, name }) => x.flatMap((time, k) => (y[k] === null && time === x[k - 1] ? [] : [[time, name, y[k]]])))];
  saveCsv(`${chart.dataset.kind}.csv`, rows);
}

export function startCharts() {
  byId("chart-png").addEventListener("click", savePng);
  byId("chart-csv").addEventListener("click", saveTable);
  const list = byId("chart-choice");
  list.value = recall("chart") ?? list.value;
  if (!list.value) list.selectedIndex = 0; // a chart of another version
  list.addEventListener("change", () => {
    remember("chart", list.value);
    showChosen();
    draw();
  });
  on("tab", () => visible("charts") && showChosen());
  on("tab theme", draw);
  on("events", () => byId("chart-choice").value === "log" && draw());
  on("map", moveCursor);
  setInterval(() => state.status?.state !== "failed" && draw(), EVERY);
}
