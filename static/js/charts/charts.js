// The tab Charts: figures 6 and 7 of the paper, and the course of the run. Plotly is loaded when it is first needed.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { saveCsv } from "../core/download.js";
import { select } from "../core/live_feed.js";
import { on, state } from "../core/store.js";
import { colour } from "../core/theme.js";
import { visible } from "../shell/tabs.js";

const EVERY = 2000; // [ms] between two updates
const LONGEST = 1200; // samples kept of each curve
const none = () => ({ time: [], n_eff: [], sigma: [], yaw: [], stages: {}, stageTime: [] });
const history = none();
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
  const labels = pairs.numbers.map(String);
  const { colorscale, unit } = SCALES[kind];
  const figure = layout();
  Object.assign(figure.xaxis, { type: "category", title: { text: "tree" } });
  Object.assign(figure.yaxis, { type: "category", title: { text: "tree" }, autorange: "reversed" });
  return [[{ type: "heatmap", x: labels, y: labels, z, colorscale, colorbar: { title: { text: unit }, thickness: 12 }, xgap: 1, ygap: 1,
    hovertemplate: `tree %{y} to tree %{x}<br>%{z:.3~r} ${unit}<extra></extra>` }], figure];
}

function curve(kind) {
  if (history.time.length < 2) return "Nothing to plot yet. Press play.";
  const figure = layout({ showlegend: kind !== "n_eff", legend: { orientation: "h", y: 1.02, yanchor: "bottom" } });
  if (kind === "time") figure.margin.t = 74;
  if (kind === "sigma") return pose(figure);
  figure.xaxis.title = { text: "time in the run, s" };
  Object.assign(figure.yaxis, { rangemode: "tozero", title: { text: kind === "time" ? "ms per scan" : "effective particles" } });
  if (kind === "n_eff") return [[line(history.time, history.n_eff, "N_eff")], figure];
  return [Object.entries(history.stages).map(([name, values]) => ({ ...line(history.stageTime, values, name), stackgroup: "one" })), figure];
}

// Position on the left axis, heading on the right one.
function pose(figure) {
  const right = { ...figure.yaxis, overlaying: "y", side: "right", rangemode: "tozero", showgrid: false, title: { text: "heading, °" } };
  Object.assign(figure, { yaxis2: right });
  Object.assign(figure.margin, { t: 30, r: 46 });
  Object.assign(figure.xaxis, { title: { text: "time in the run, s" } });
  Object.assign(figure.yaxis, { rangemode: "tozero", title: { text: "position, cm" } });
  return [[line(history.time, history.sigma, "position, cm"), { ...line(history.time, history.yaw, "heading, °"), yaxis: "y2" }], figure];
}

const line = (x, y, name) => ({ type: "scatter", mode: "lines", x, y, name, line: { width: 1.5 }, hovertemplate: `%{y:.3~r}<extra>${name}</extra>` });

async function draw() {
  if (!visible("charts") || busy) return;
  busy = true;
  try {
    const kind = byId("chart-choice").value;
    if (!plotly) showText("Loading …");
    const [Plotly, drawing] = await Promise.all([load(), kind in SCALES ? matrix(kind) : curve(kind)]);
    const isText = typeof drawing === "string"; // why there is no plot
    showText(isText ? drawing : "");
    if (!isText) await show(Plotly, kind, ...drawing);
  } catch (error) {
    showText(error.message);
  } finally {
    busy = false;
  }
}

// Shows a text in place of the chart; the chart without one.
function showText(text) {
  byId("chart").hidden = text !== "";
  byId("chart-empty").hidden = text === "";
  setText(byId("chart-empty"), text);
}

async function show(Plotly, kind, traces, figure) {
  const chart = byId("chart");
  if (chart.data && chart.dataset.kind !== kind) Plotly.purge(chart); // axes of another figure must not be reused
  chart.dataset.kind = kind;
  const fresh = !chart.data;
  await Plotly.react(chart, traces, figure, { displayModeBar: false, responsive: true });
  if (fresh) chart.on("plotly_click", ({ points }) => points[0].data.type === "heatmap" && select(Number(points[0].y)));
}

function push(list, value) {
  list.push(value);
  if (list.length > LONGEST) list.shift();
}

function recordMap({ map }) {
  if (!map) return clearHistory();
  if (history.time.length && map.time_s < history.time.at(-1)) clearHistory();
  push(history.time, map.time_s);
  push(history.n_eff, map.n_eff);
  push(history.sigma, 100 * (map.health?.sigma_xy_m ?? map.sigma_xy));
  push(history.yaw, map.health?.sigma_yaw_deg ?? null);
}

function recordStatus({ status }) {
  if (status.scan_index < 0 || status.time_s === history.stageTime.at(-1)) return;
  push(history.stageTime, status.time_s);
  for (const [name, milliseconds] of Object.entries(status.stage_ms ?? {})) push((history.stages[name] ??= []), milliseconds);
}

function clearHistory() {
  Object.assign(history, none());
}

async function savePng() {
  const chart = byId("chart");
  if (chart.hidden || !chart.data) return;
  await (await load()).downloadImage(chart, { format: "png", scale: 2, width: 900, height: 700, filename: chart.dataset.kind });
}

// A matrix as a table with tree numbers in the first row and column; curves as rows of time, curve and value.
function saveTable() {
  const chart = byId("chart");
  if (chart.hidden || !chart.data) return;
  const [first] = chart.data;
  const rows = first.type === "heatmap" ? [["tree", ...first.x], ...first.z.map((row, k) => [first.y[k], ...row])]
    : [["time_s", "curve", "value"], ...chart.data.flatMap(({ x, y, name }) => x.map((time, k) => [time, name, y[k]]))];
  saveCsv(`${chart.dataset.kind}.csv`, rows);
}

export function startCharts() {
  byId("chart-png").addEventListener("click", savePng);
  byId("chart-csv").addEventListener("click", saveTable);
  on("map", recordMap);
  on("status", recordStatus);
  on("tab theme", draw);
  byId("chart-choice").addEventListener("change", draw);
  setInterval(() => state.status?.state !== "failed" && draw(), EVERY);
}
