// One run: figures, map, parameters and their changes.

import { dayOf, lasts, logRows, logTable } from "../charts/log_table.js";
import { check, get, open } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { fileName, saveCanvas, saveCsv } from "../core/download.js";
import { capital, clock, count, figure, NONE } from "../core/format.js";
import { confirmLeaving } from "../open/leaving.js";
import { treeAt } from "../map/draw.js";
import { boundsOf } from "../map/map_canvas.js";
import { ofExtensions } from "../shell/extensions.js";
import { isRejected, mapPicture, paintRun, treeText } from "./draw.js";
import { FIGURES, SCORES, shortSource, when } from "./figures.js";

let shown = null; // the picture on the screen
export const repaint = () => shown?.redraw();

export function say(text) {
  shown = null;
  byId("run-detail").replaceChildren(el("p", { class: "empty", text }));
}

export function put(newest, ...nodes) {
  shown = newest;
  byId("run-detail").replaceChildren(...nodes);
}

// A table of heads and rows of texts; `figures` are the places of columns with numbers.
export function table(heads, rows, figures = []) {
  const cls = (k) => (figures.includes(k) ? "figure" : "");
  return el("div", { class: "scroll" }, el("table", {},
    el("thead", {}, el("tr", {}, ...heads.map((text, k) => el("th", { scope: "col", class: cls(k), text })))),
    el("tbody", {}, ...rows.map((row) => el("tr", {}, ...row.map((text, k) => el("td", { class: cls(k), text })))))));
}

export async function showRun(key, actions) {
  say("Loading the run …");
  let run;
  try {
    run = await get(`/api/runs/${encodeURIComponent(key)}`);
  } catch (error) {
    say(error.message);
    return;
  }
  const { trees, path, truth } = run.map;
  const map = mapPicture({
    label: `Map of ${run.name}: ${count(run.trees, "tree")}`,
    legend: [["tree", "tree, size by DBH"], ...(trees.some(isRejected) ? [["rejected", "rejected by a person"]] : []), ["path", "path"], ...(truth ? [["truth", "ground truth"]] : [])],
    paint: (pen, view) => paintRun(pen, view, run.map),
    bounds: () => boundsOf(trees, path),
    describe: (at, view) => { const tree = treeAt(trees, at, view); return tree ? treeText(tree) : ""; },
  });
  put(map, head(run, actions), figures(run), map.box, more(run, map));
}

function head(run, { replay, rename, remove }) {
  const error = el("p", { class: "error-text dim", role: "alert", hidden: true });
  const guarded = (work) => async () => {
    try {
      await work();
    } catch (problem) {
      setText(error, problem.message);
      error.hidden = false;
    }
  };
  const title = el("h2", { text: run.name });
  const own = run.id !== undefined; // folders are renamed and deleted outside of stemmap
  return el("div", { class: "run-head" }, title,
    el("button", { class: "primary", id: "run-replay", hidden: run.live, "data-edit": true, text: "Replay", title: "Open the recording in the dashboard, where it is mapped again with the parameters of this run", onclick: guarded(() => replay(run)) }),
    ...(own ? [
      el("button", { id: "run-rename", "data-edit": true, text: "Rename", onclick: () => edit(title, run, guarded, rename) }),
      el("button", { id: "run-delete", "data-edit": true, text: "Delete", title: "Delete this run; it can be restored", onclick: guarded(() => remove(run)) })] : []),
    el("p", { class: "dim", text: `${run.uri} · ${run.kind}${run.begun_s ? ` · ${when(run.begun_s)}` : ""}` }),
    recordings(run, guarded), error);
}

// The files of a live run; a press opens one in the dashboard.
function recordings({ live, map: { recordings: files } }, guarded) {
  const show = (uri) => guarded(async () => { await confirmLeaving(() => check({ uri })); await open({ uri }); location.href = "/"; });
  return el("p", { class: "dim row", id: "run-recordings", hidden: !live || !files, text: files?.length ? "Recorded to" : "Not recorded" }, ...(files ?? []).map((file) =>
    el("button", { class: "small", "data-edit": true, text: file.split(/[/\\]/).pop(), title: `${file}\nOpen this recording in the dashboard`, onclick: show(file) })));
}

function edit(title, run, guarded, rename) {
  const box = el("input", { type: "text", value: run.name, maxlength: "200", "aria-label": "Name of the run" });
  const form = el("form", { onsubmit: (event) => { event.preventDefault(); guarded(() => rename(run, box.value))(); } },
    box, el("button", { class: "primary", text: "Save" }), el("button", { type: "button", text: "Cancel", onclick: () => form.replaceWith(title) }));
  title.replaceWith(form);
  box.select();
}

function figures(run) {
  const changed = Object.keys(run.differences).length;
  const all = [...FIGURES, ["preset", (each) => (each.preset || NONE) + (changed ? `, ${changed} changed` : "")]];
  return el("dl", { class: "run-figures" }, ...all.map(([name, text]) =>
    el("div", { "data-figure": name }, el("dt", { text: name }), el("dd", { text: text(run) }))));
}

function more(run, map) {
  const title = shortSource(run.name);
  return el("div", { class: "run-more" },
    el("div", { class: "row" },
      el("button", { class: "small", text: "Map as PNG", onclick: () => saveCanvas(fileName(title, "map.png"), map.canvas) }),
      ...ofExtensions("runButtons", run, title),
      el("button", { class: "small", text: "Trees as CSV", onclick: () => saveCsv(fileName(title, "trees.csv"), treeRows(run.map.trees)) })),
    ...(run.scores ? [el("div", {}, el("h3", { text: `Scores${typeof run.scores.reach_m === "number" ? ` (TA, FR, TR and FA within ${figure(run.scores.reach_m)} m of the path)` : ""}` }), table(["score", "value"], SCORES.map(([name, text]) => [name, text(run.scores)]), [1]))] : []),
    el("div", {}, el("h3", { text: "Differences from the preset" }), Object.keys(run.differences).length
      ? table(["parameter", "value"], Object.entries(run.differences).map(([name, value]) => [name, String(value)]))
      : el("p", { class: "note", text: `None: all parameters are those of the preset ${run.preset}.` })),
    el("div", {}, el("h3", { text: "Changes of parameters" }), ...changes(run)),
    ...(run.map.logs?.length ? [log(run.map.logs, title)] : []),
    ...(run.map.warnings?.length ? [el("div", { id: "run-warnings" }, el("h3", { text: "Warnings" }), el("ul", {}, ...run.map.warnings.map((text) => el("li", { text: capital(text) }))))] : []),
    el("details", {}, el("summary", { text: `All ${Object.keys(run.parameters).length} parameters` }),
      table(["parameter", "value"], Object.entries(run.parameters).map(([name, value]) => [name, String(value)]))));
}

// A live run cannot be replayed with the times of this computer's clock, so its logs are kept: one from each start of the mapper.
function log(logs, title) {
  const parts = logs.map(({ events, start_s: start }) => ({ start, events: events.filter((event) => !event.before) }));
  const tables = parts.map(({ start, events }) => ({ start, shown: events.filter(lasts) })).filter(({ shown }) => shown.length);
  const rows = parts.flatMap(({ start, events }, k) => logRows(events, start, true).slice(k ? 1 : 0)); // one header
  return el("div", { id: "run-log" }, el("h3", { text: "Log" }),
    ...(tables.length ? tables.map(({ start, shown }) => el("div", { class: "scroll" }, logTable(shown, start, true, clock, "until the end"))) : [el("p", { class: "note", text: "No obstacle ahead, no silence, and the pose was good." })]),
    el("button", { class: "small", text: "All events as CSV", onclick: () => saveCsv(fileName(title, `log${dayOf(parts[0].events, parts[0].start, true)}.csv`), rows) }));
}

function changes({ revisions }) {
  if (!revisions.length) return [el("p", { class: "note", text: "None: the parameters were not changed." })];
  const rows = revisions.map((each) => [each.who, when(each.at_s), clock(each.time_s),
    Object.entries(each.changes).slice(0, 4).map(([name, [before, after]]) => `${name}: ${before} → ${after}`).join(", ") + (Object.keys(each.changes).length > 4 ? `, ${count(Object.keys(each.changes).length - 4, "more", "more")}` : "")]);
  return [table(["by", "when", "time in the run", "change"], rows)];
}

const COLUMNS = ["tree", "x_m", "y_m", "sigma_m", "dbh_cm", "sigma_dbh_cm", "eccentricity", "observations", "review"];

function treeRows(trees) {
  return [COLUMNS, ...trees.map((t) => [t.number, t.x.toFixed(3), t.y.toFixed(3), t.ellipse[0].toFixed(4), t.dbh_cm, t.sigma_dbh_cm, t.eccentricity, t.observations, t.review ?? "open"])];
}
