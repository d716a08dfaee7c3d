// The page of runs: a list, and next to it the chosen run or two runs compared.

import { check, get, open, patch, post, remove as removeAt } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { count, figure, NONE, percent } from "../core/format.js";
import { connect } from "../core/live_feed.js";
import { startAccess } from "../core/permissions.js";
import { on } from "../core/store.js";
import { startTheme } from "../core/theme.js";
import { confirmLeaving } from "../open/leaving.js";
import { startUpload } from "../open/upload.js";
import { ofExtensions, startExtensions } from "../shell/extensions.js";
import { startSignals } from "../shell/signals.js";
import { startWay } from "../shell/way.js";
import { repaint, say, showRun } from "./detail.js";
import { scans, shortSource, when } from "./figures.js";

const HEADS = [["", ""], ["name", ""], ["when", "medium"], ["scans", "minor"], ["driven m", "minor extra"], ["pose lost", "minor", "Share of the scans in which the pose was lost"], ["trees", ""], ["F1", ""], ["annotated", "minor"]];
const comparable = ofExtensions("pairViews").length > 0;
if (!comparable) HEADS.shift(); // no boxes to tick
const REFRESH_EVERY = 5000; // [ms]
let known = { runs: [], folders: [], open: null }, listed = ""; // the answer of the server, and its text
let requests = 0, waiting = 0; // requests that were sent, and those without an answer
const ticked = new Set();
let deleted = null; // the run that Undo brings back

async function load() {
  const request = requests += 1;
  waiting += 1;
  try {
    const answer = await get("/api/runs"), text = JSON.stringify(answer);
    if (request !== requests || text === listed) return; // a later request knows more
    [known, listed] = [answer, text];
  } catch (error) {
    showError(error.message);
  } finally {
    waiting -= 1;
  }
  for (const key of ticked) if (![...known.runs, ...known.folders].some((run) => run.key === key)) ticked.delete(key);
  fill();
}

function fill() {
  const wanted = byId("runs-find").value.trim().toLowerCase();
  const fits = ({ name, uri = "" }) => `${name} ${uri}`.toLowerCase().includes(wanted);
  const [runs, folders] = [known.runs.filter(fits), known.folders.filter(fits)];
  byId("runs").tBodies[0].replaceChildren(...runs.map(row), ...(folders.length ? [group("Finished maps in the data folder (stemmap map --out)"), ...folders.map(row)] : []));
  const all = known.runs.length + known.folders.length;
  setText(byId("runs-count"), count(all, "run"));
  byId("runs").hidden = !byId("runs").tBodies[0].rows.length;
  const empty = byId("runs-empty");
  empty.hidden = runs.length + folders.length > 0;
  setText(empty, all ? `No run matches “${wanted}”.` : "No run yet. A run is listed here after its first mapped scans: go to the dashboard and press play, or open a recording.");
  markTicked();
}

// Names of folders may hold any character.
const addressOf = ({ key }) => `run=${encodeURIComponent(key)}`;
const group = (text) => el("tr", { class: "group" }, el("td", { colspan: HEADS.length, text }));

function showError(words) {
  setText(byId("runs-error"), words);
  byId("runs-error").hidden = false;
}

function row(run) {
  const name = el("td", {}, el("button", { text: run.name, onclick: (event) => { event.stopPropagation(); go(addressOf(run)); } }),
    el("small", {}, ...(run.id === known.open && run.id !== undefined ? [el("span", { class: "badge", text: "open now" })] : []),
      [run.uri && shortSource(run.uri) !== run.name ? shortSource(run.uri) : run.kind, run.preset].filter(Boolean).join(" · ")));
  const texts = run.id === undefined ? [when(run.changed_s), "", "", "", "", "", ""]
    : [when(run.begun_s), scans(run), figure(run.distance_m), percent(run.lost), String(run.trees), figure(run.scores?.f1), run.annotated ? String(run.annotated) : NONE];
  return el("tr", { "data-run": run.key, onclick: () => go(addressOf(run)) },
    comparable ? el("td", { onclick: (event) => event.stopPropagation() }, el("input", { type: "checkbox", "aria-label": `Compare ${run.name}`, checked: ticked.has(run.key), onchange: (event) => tick(run.key, event.target.checked) })) : "",
    name, ...texts.map((text, k) => el("td", { class: HEADS[k + HEADS.length - texts.length][1], text })));
}

// At most two runs are ticked; a third one replaces the oldest.
function tick(key, yes) {
  if (yes) ticked.add(key);
  else ticked.delete(key);
  if (ticked.size > 2) ticked.delete(ticked.values().next().value);
  fill();
}

function markTicked() {
  byId("runs-compare").disabled = ticked.size !== 2;
  const { run } = chosen();
  for (const each of byId("runs").querySelectorAll("tr[data-run]")) each.setAttribute("aria-selected", String(each.dataset.run === run));
}

// The choice is part of the address, so that a link restores it.
function chosen() {
  const given = new URLSearchParams(location.hash.slice(1));
  return { run: given.get("run"), compare: given.getAll("compare") };
}

function go(hash) {
  if (location.hash === `#${hash}`) follow();
  else location.hash = hash;
}

function follow() {
  const { run, compare } = chosen();
  markTicked();
  const [showTwo] = ofExtensions("pairViews");
  if (compare.length === 2 && showTwo) showTwo(...compare);
  else if (run) showRun(run, { replay, rename, remove });
  else say(`Choose a run to see its map${showTwo ? ", or tick two runs to compare them: growth, new, missing and moved trees" : ""}.`);
}

async function replay(run) {
  const path = `/api/runs/${encodeURIComponent(run.key)}/replay`;
  await confirmLeaving(() => post(`${path}?check_only=true`, {}));
  await post(path, {});
  location.href = "/";
}

async function rename(run, name) {
  await patch(`/api/runs/${run.id}`, { name });
  await load();
  follow();
}

async function remove(run) {
  await removeAt(`/api/runs/${run.id}`);
  deleted = run;
  setText(byId("toast").querySelector("span"), `Deleted “${run.name}”.`);
  byId("toast").hidden = false;
  history.replaceState(null, "", location.pathname);
  ticked.delete(run.key);
  await load();
  follow();
}

async function undo() {
  const run = deleted;
  byId("toast").hidden = true;
  try {
    await post(`/api/runs/${run.id}/restore`, {});
  } catch (error) {
    showError(error.message);
    return;
  }
  await load();
  go(addressOf(run));
}

byId("runs").tHead.replaceChildren(el("tr", {}, ...HEADS.map(([text, cls, title = ""]) => (text ? el("th", { scope: "col", class: cls, title, text }) : el("td", { class: cls })))));
byId("runs-find").addEventListener("input", fill);
// The earlier run is A.
const begun = (key) => {
  const run = [...known.runs, ...known.folders].find((each) => each.key === key);
  return run?.begun_s ?? run?.changed_s ?? 0;
};
byId("runs-compare").addEventListener("click", () => go([...ticked].sort((a, b) => begun(a) - begun(b)).map((key) => `compare=${encodeURIComponent(key)}`).join("&")));
byId("toast-undo").addEventListener("click", undo);
addEventListener("hashchange", follow);
addEventListener("focus", load);
// The open run gets more scans and trees. The rows are not replaced while the keyboard focus is in one of them.
setInterval(() => { if (!waiting && !document.hidden && !byId("runs").contains(document.activeElement)) load(); }, REFRESH_EVERY);
on("theme", repaint);
startUpload(async ({ uri }) => {
  await confirmLeaving(() => check({ uri }));
  await open({ uri });
  location.href = "/";
});
startTheme();
startWay();
startSignals();
startExtensions();
byId("runs-compare").hidden = !comparable;
startAccess();
connect();
load();
follow();
