// The table of trees (Table 2 of the paper): sorted by any column, filtered by the text above it.

import { reviewOf, tapeOf } from "../annotate/annotations.js";
import { byId, el, setText } from "../core/dom.js";
import { fileName, saveCanvas } from "../core/download.js";
import { nothingYet } from "../core/empty_state.js";
import { placeTexts, unitNode } from "../core/coordinates.js";
import { count, dbhFigure, figure, fixed, heightFigure, isAssumed, NONE } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { attempted } from "../core/problem.js";
import { roving } from "../core/roving.js";
import { changed, isDrive, on, state, trees } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { colour } from "../core/theme.js";
import { saveWritten } from "../core/written_file.js";
import { openStory } from "../explain/story.js";
import { titleOf } from "../open/run_title.js";
import { ofExtensions } from "../shell/extensions.js";
import { openTab, visible } from "../shell/tabs.js";
import { countedDbh, filterOf, HELP, sigma } from "./filter.js";

const EVERY = 400; // [ms] between two updates

const MARKS = { open: "", confirmed: " ✓", rejected: " ✕", skipped: " ↷" };

// key, title, tooltip, text, value for sorting (null if unknown), and whether it is shown only without a drive (true) or with one (false)
const COLUMNS = [
  ["number", "tree", "Number of the tree; ✓ confirmed, ✕ rejected, ↷ skipped in the review", (t) => `${t.number}${MARKS[reviewOf(t)]}`, (t) => t.number],
  ["x", "x", "x as in the files: of a drive in the frame of the map, along the first heading", (t) => placeTexts([t.x, t.y])[0], (t) => t.x],
  ["y", "y", "y as in the files: of a drive in the frame of the map, to the left of the first heading", (t) => placeTexts([t.x, t.y])[1], (t) => t.y],
  ["sigma", "position ± cm", "Standard deviation of the position; ≈: assumed, because no single scan detected the tree", sigmaText, sigma],
  ["dbh", "DBH cm", "Diameter at breast height ± its standard deviation; by tape where a person measured it", countedText, countedDbh],
  ["height", "height m", "Height of the tree ± its standard deviation; – where another crown continues above its top, or it was not seen", (t) => heightFigure(t.height_m, t.sigma_height_m), (t) => t.height_m, true],
  ["lean", "lean °", "Angle of the stem from the vertical", (t) => fixed(t.lean_deg, 1), (t) => t.lean_deg, true],
  ["e", "e", "Eccentricity: ratio of the eigenvalues of the covariance of a cluster, the mean over its scans", (t) => figure(t.eccentricity), (t) => t.eccentricity, false],
  ["seen", "scans", "Number of scans that detected the tree; 0: found only in the accumulated scans, or placed by a person", (t) => String(t.observations), (t) => t.observations, false],
];
const [SIGMA, DBH] = ["sigma", "dbh"].map((wanted) => COLUMNS.findIndex(([key]) => key === wanted));
const rows = new Map();
const keepTabStop = roving(byId("trees").tBodies[0], "tr", "vertical");
let order = { key: "number", descending: false };

function sigmaText(tree) {
  return (isAssumed(tree) ? "≈ " : "") + figure(sigma(tree), 2);
}

const mappedText = (tree) => dbhFigure(tree.dbh_cm, tree.sigma_dbh_cm);

function countedText(tree) {
  const tape = tapeOf(tree);
  return tape === null ? mappedText(tree) : `${dbhFigure(tape)} by tape`;
}

function head() {
  const cells = COLUMNS.map(([key, title, hint]) => el("th", { scope: "col", "data-key": key },
    el("button", { title: hint, onclick: () => sortBy(key) }, title, ...(["x", "y"].includes(key) ? [" ", unitNode()] : []))));
  byId("trees").tHead.replaceChildren(el("tr", {}, ...cells));
  markOrder();
}

// Shows the columns of the kind of run that is open.
function suitColumns() {
  for (const row of byId("trees").rows) COLUMNS.forEach(([,,,,, only], place) => { row.cells[place].hidden = only !== undefined && only === isDrive(); });
}

function sortBy(key) {
  order = { key, descending: order.key === key && !order.descending };
  markOrder();
  fill();
}

function markOrder() {
  for (const cell of byId("trees").tHead.querySelectorAll("th")) {
    const mine = cell.dataset.key === order.key;
    cell.setAttribute("aria-sort", mine ? (order.descending ? "descending" : "ascending") : "none");
  }
}

// Unknown values are last in both directions.
function sorted(all) {
  const of = COLUMNS.find(([key]) => key === order.key)[4];
  const sign = order.descending ? -1 : 1;
  const unknown = (tree) => Number(of(tree) === null);
  return [...all].sort((a, b) => unknown(a) - unknown(b) || sign * (of(a) - of(b)) || a.number - b.number);
}

function rowOf(tree) {
  if (!rows.has(tree.number)) {
    const row = el("tr", { tabindex: "-1", "data-tree": tree.number, onclick: () => toggle(tree.number),
      onkeydown: (event) => event.key === "Enter" && toggle(tree.number) }, ...COLUMNS.map(() => el("td")));
    rows.set(tree.number, row);
  }
  const row = rows.get(tree.number);
  COLUMNS.forEach(([, , , text], place) => setText(row.cells[place], text(tree)));
  row.cells[SIGMA].title = isAssumed(tree) ? "Assumed, not measured: no single scan detected the tree here, only the accumulated scans did, or a person placed it" : "";
  row.cells[DBH].title = tapeOf(tree) === null ? "" : `In the map: ${mappedText(tree)}${tree.dbh_cm === null ? "" : " cm"}`;
  row.setAttribute("aria-selected", String(tree.number === state.selected));
  return row;
}

function toggle(number) {
  if (number !== state.selected) openStory("tree");
  select(number === state.selected ? null : number);
}

function fill() {
  if (!visible("trees")) return;
  const all = trees();
  const wanted = byId("find").value.trim();
  const { holds, refused } = filterOf(wanted);
  const listed = sorted(all.filter(holds));
  showFilter(wanted && !refused ? wanted : "", holds);
  const body = byId("trees").tBodies[0];
  listed.forEach((tree, place) => {
    const row = rowOf(tree);
    if (body.rows[place] !== row) body.insertBefore(row, body.rows[place] ?? null);
  });
  while (body.rows.length > listed.length) body.lastChild.remove();
  keepTabStop();
  byId("tree-count").title = `A diameter is reported once ${fixed(state.parameters?.values["tracking.dbh_arc_min"] ?? 0, 0)}° of a trunk were seen and its sigma is small enough; arcs on the map are the sides that were never seen`;
  setText(byId("tree-count"), wanted ? `${listed.length} of ${all.length}` : `${count(all.length, "tree")}${missing(all)}`);
  suitColumns();
  byId("trees").hidden = !listed.length;
  byId("trees-png").disabled = !listed.length;
  offerCsv(all.length);
  byId("find").setAttribute("aria-invalid", String(Boolean(refused)));
  setText(byId("trees-empty"), listed.length ? "" : emptyText(all.length, wanted, refused));
}

// Why trees have no diameter: the arc that was seen is too short, or the diameter is too uncertain.
function missing(all) {
  if (!isDrive()) return "";
  const arc = state.parameters?.values["tracking.dbh_arc_min"] ?? 0;
  const without = all.filter((tree) => countedDbh(tree) === null);
  const short = without.filter((tree) => (tree.coverage_deg ?? 0) < arc).length;
  return [[short, `need ${fixed(arc, 0)}° of view`], [without.length - short, "with uncertain DBH"]]
    .filter(([number]) => number).map(([number, words]) => `, ${number} ${number === 1 ? words.replace("need ", "needs ") : words}`).join("");
}

let dimmed = ""; // the filter of which the map knows

// The map dims what the filter leaves out and says so, in every tab.
function showFilter(wanted, holds) {
  if (wanted === dimmed) return;
  dimmed = wanted;
  byId("map-filter").hidden = !wanted;
  setText(byId("map-filter"), `Filter: ${wanted} ✕`);
  state.holds = wanted ? holds : null;
  changed("filter");
}

const csv = byId("trees-csv"), csvTitle = csv.title;

// A link has no "disabled" attribute; without an address it cannot be followed.
function offerCsv(any) {
  if (any) csv.setAttribute("href", "/api/trees.csv");
  else csv.removeAttribute("href");
  csv.setAttribute("aria-disabled", String(!any));
  byId("trees-export").disabled = !any;
  csv.title = any ? csvTitle : "No tree yet";
}

// The server writes the file, so that it is the same as that of `stemmap export`.
function exportAs(format) {
  const title = titleOf(state.status?.source);
  const own = ofExtensions("exportFiles").find(({ value }) => value === format);
  if (own) return own.save(title);
  return saveWritten("Writing the file …", fileName(title, `trees.${format}`), `/api/export/${format}`);
}

function emptyText(all, wanted, refused) {
  if (all && refused) return `“${refused}” is not a condition. ${HELP}`;
  if (all) return `No tree matches “${wanted}”.${isDrive() && /\b(height|lean)\b/i.test(wanted) ? " Heights and leans are not measured in a drive." : ""}`;
  if (state.map && !isDrive()) return "No tree in this map. The tab Clusters shows the verdict on each candidate.";
  return state.map ? "No tree yet. A tree is listed once enough scans have detected it. The tab Clusters shows the verdict on each cluster."
    : nothingYet();
}

// Lists the trees for which a condition holds, see `HELP`.
export function showTrees(condition) {
  openTab("trees");
  byId("find").value = condition;
  byId("find").focus();
  fill();
}

// A filter is of one run: another one would show few trees or none without a visible reason.
let source = null;

function forgetFilter() {
  const now = state.status?.source;
  if (source !== null && now !== source && byId("find").value) removeFilter();
  source = now ?? source;
}

function removeFilter() {
  byId("find").value = "";
  showFilter("", null);
  fill();
}

export function startTable() {
  head();
  on("status", forgetFilter);
  byId("find").addEventListener("input", fill);
  byId("find").title = HELP;
  byId("map-filter").addEventListener("click", removeFilter);
  const menu = byId("trees-export");
  const optionOf = (value) => [...menu.options].find((each) => each.value === value) ?? null;
  for (const { value, text, before, edits } of ofExtensions("exportFiles")) if (!optionOf(value)) menu.add(el("option", { value, text, "data-edit": edits }), before ? optionOf(before) : null);
  menu.addEventListener("change", () => { exportAs(menu.value); menu.value = ""; });
  byId("trees-png").addEventListener("click", () => saveCanvas(fileName(titleOf(state.status?.source), "trees.png"), pictureOf(byId("trees"))));
  csv.addEventListener("click", (event) => {
    event.preventDefault();
    if (csv.hasAttribute("href")) saveWritten("Writing the table …", fileName(titleOf(state.status?.source), "trees.csv"), "/api/trees.csv");
  });
  on("map truth annotations phase", throttled(fill, EVERY));
  on("tab", fill);
  on("selection", () => {
    for (const [number, row] of rows) row.setAttribute("aria-selected", String(number === state.selected));
    fill();
    if (visible("trees")) rows.get(state.selected)?.scrollIntoView({ block: "nearest" });
  });
  fill();
}

// --- the table as a picture ----------------------------------------------------------------------------

const ROW = 24, PAD = 12, SCALE = 2;
const MOST_ROWS = 600, TALLEST = 16_000; // [px]; some browsers cannot save a taller canvas

// A canvas with the heads and the rows of a table, in the colours of the page.
export function pictureOf(table) {
  const lines = [...table.rows].slice(0, MOST_ROWS).map((row) => [...row.cells].filter((cell) => !cell.hidden).map((cell) => cell.textContent));
  const more = table.rows.length - lines.length;
  if (more) lines.push(lines[0].map((_, k) => (k ? "" : `+ ${more} in the CSV`)));
  const scale = Math.min(SCALE, TALLEST / (ROW * lines.length));
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d");
  const font = `13px ${colour("font")}`;
  pen.font = font;
  const widths = lines[0].map((_, k) => Math.ceil(Math.max(...lines.map((cells) => pen.measureText(cells[k]).width))) + 2 * PAD);
  const width = widths.reduce((sum, each) => sum + each, 0);
  Object.assign(canvas, { width: Math.floor(scale * width), height: Math.floor(scale * ROW * lines.length) });
  pen.scale(scale, scale);
  pen.fillStyle = colour("surface");
  pen.fillRect(0, 0, width, ROW * lines.length);
  Object.assign(pen, { font, textAlign: "right", textBaseline: "middle" });
  lines.forEach((cells, row) => {
    pen.fillStyle = colour(row ? "text" : "dim");
    let right = 0;
    cells.forEach((text, k) => pen.fillText(text, (right += widths[k]) - PAD, ROW * (row + 0.5)));
    pen.fillStyle = colour("line");
    pen.fillRect(0, ROW * (row + 1) - 1, width, row ? 0.5 : 1);
  });
  return canvas;
}
