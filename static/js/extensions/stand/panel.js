// The tab Plots: draw, type, import and list plots, with the stand figures of each plot and of all.

import { draft, historyOf, remove, reviewOf, STATES } from "../../annotate/annotations.js";
import { get } from "../../core/api.js";
import { inFile, inMap, placeText, unitNode } from "../../core/coordinates.js";
import { button, byId, el, recall, remember, setText } from "../../core/dom.js";
import { nothingYet } from "../../core/empty_state.js";
import { count, figure, percent, plusMinus, withSigma } from "../../core/format.js";
import { looksOnly } from "../../core/permissions.js";
import { isDrive, on, state, trees } from "../../core/store.js";
import { keepFresh } from "../../core/timing.js";
import { historyKey } from "../../core/undo_keys.js";
import { titleOf } from "../../open/run_title.js";
import { startCoordinates } from "./coordinates.js";
import { fillHeading, headingFields, headingSaved, resetHeading } from "./heading.js";
import { addAlong, addPlots, changePlot, draw, drawing, finish, importPlots, plots, plotting, SHAPES, sketch, stopDrawing } from "./plots.js";
import { reportMenu } from "./report.js";

const pause = () => (state.status?.state === "playing" ? 3000 : 300); // [ms] between two requests
const { undo, redo, canUndo, canRedo } = historyOf("other");
const MOST_NAMED = 3; // added trees that do not count
const LARGEST_FILES = 700_000; // [bytes]
// name, label, value and bounds of the numbers of a shape; those of the server
const FIELDS = { circle: [["radius", "radius m", 5.64, 0.01, 600]],
  rectangle: [["length", "length m", 10, 0.01, 2000], ["width", "width m", 10, 0.01, 2000], ["turn_deg", "turn °", 0, -360, 360]] };
const HEADS = [["plot", ""], ["m²", "Area"], ["seen", "Observed part of the area"], ["trees", "Trees of at least the minimum diameter in the observed part"],
  ["stems/ha", "N/ha: stems per hectare"], ["basal area m²/ha", "G/ha: basal area per hectare"], ["Dq cm", "Dq: quadratic mean diameter"], ["mean DBH cm", "Arithmetic mean diameter"],
  ["dominant DBH cm", "Dominant diameter: quadratic mean of the 100 thickest trees per hectare"]];
const HEIGHTS = [["mean height m", "hm: arithmetic mean height of the trees with a height"], ["Lorey height m", "hL: mean height weighted by basal area (Lorey)"]];
const VOLUME = ["volume m³/ha", "Stem volume per hectare"];
let figures = { all: null, plots: null, problem: "" };
let shown = []; // edition and scan of the figures
let run = null; // run of the fields and the table
const lines = new Map(); // the row of each plot

// --- the settings of the figures, which this browser remembers ------------------------------------------------------

const threshold = () => Number(recall("dbh-min") ?? 7);
const formula = () => recall("volume") ?? "";
export const settings = () => new URLSearchParams({ dbh_min: threshold() / 100, volume: formula() });

// What the figures depend on apart from the scan; they are dimmed until those of the last edit are here.
const edition = () => `${state.annotations?.run} ${state.annotations?.serial} ${state.parameters?.revision} ${state.remapped?.revision} ${settings()}`;

const refresh = keepFresh(async () => {
  const version = [edition(), state.map?.index];
  if (!plotting() || !state.map || version.every((part, k) => part === shown[k])) return;
  try {
    figures = await get(`/api/plots?${settings()}`);
    shown = version;
  } catch (error) {
    figures = { all: null, plots: null, problem: error.message };
  }
  fill();
}, pause);

// --- the controls ---------------------------------------------------------------------------------------------------

const number = (name, value, title, min = null, max = null) => el("input", { type: "number", name, value, min, max, step: "any", required: true, "aria-label": title, title });
const numberOf = (form, name) => Number(form.elements.namedItem(name).value); // `elements.length` is their number

function typed() {
  const kind = el("select", { name: "kind", "aria-label": "Shape", onchange: () => fields.replaceChildren(...made(kind.value)) }, ...Object.keys(FIELDS).map((each) => el("option", { value: each, text: each })));
  const made = (each) => FIELDS[each].map(([name, title, ...values]) => el("label", {}, title, number(name, values[0], title, ...values.slice(1))));
  const fields = el("span", { class: "plot-fields" }, ...made("circle"));
  return el("form", { class: "plot-form", onreset: () => fields.replaceChildren(...made("circle")), onsubmit: (event) => {
    event.preventDefault();
    const form = event.target;
    const [x, y] = inMap(numberOf(form, "x"), numberOf(form, "y"));
    addPlots([{ name: form.elements.name.value.trim(), shape: { kind: kind.value, x, y, ...Object.fromEntries(FIELDS[kind.value].map(([name]) => [name, numberOf(form, name)])) } }]);
  } }, kind, el("label", {}, "x ", unitNode(), number("x", 0, "x of the centre in the coordinates of the files")), el("label", {}, "y ", unitNode(), number("y", 0, "y of the centre in the coordinates of the files")), fields,
  el("label", {}, "name", el("input", { type: "text", name: "name", maxlength: "60", placeholder: "next number", autocomplete: "off" })), el("button", { class: "small", text: "Add" }));
}

const alongPath = () => el("form", { id: "plots-along", class: "plot-form", onsubmit: (event) => {
  event.preventDefault();
  addAlong(numberOf(event.target, "every"), numberOf(event.target, "radius"));
} }, el("span", { class: "dim", text: "along the path:" }), el("label", {}, "a circle every", number("every", 20, "Distance along the path, m", 0.01, 10_000), "m"), el("label", {}, "radius", number("radius", 5.64, "Radius of the circles, m", 0.01, 500), "m"), el("button", { class: "small", text: "Add circles" }));

async function base64(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  return btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
}

function imported() {
  const crs = el("input", { id: "plot-crs", type: "text", "aria-label": "Coordinates of a file that does not state them", placeholder: "as in the file", title: "Coordinates of a file that does not state them: EPSG:25832, or local for those of the map", autocomplete: "off" });
  const file = el("input", { id: "plot-file", type: "file", multiple: true, accept: ".gpkg,.geojson,.json,.zip,.shp,.dbf,.shx,.prj,.cpg", hidden: true, "aria-label": "File of plots", onchange: async () => {
    const files = [...file.files];
    if (files.reduce((sum, { size }) => sum + size, 0) > LARGEST_FILES) {
      draft.error = `The file is larger than ${LARGEST_FILES / 1e6} MB. Simplify it, or use stemmap stand --plots FILE.`;
      fill();
    } else if (files.length) await importPlots(Object.fromEntries(await Promise.all(files.map(async (each) => [each.name, await base64(each)]))), crs.value);
    file.value = "";
  } });
  return el("div", { class: "plot-form" }, button("plot-import", "Import …", "Plots of a GeoPackage, GeoJSON or Shapefile (all its files, or a zip)", () => file.click()), el("label", {}, "coordinates", crs), file);
}

function setting(name, label, value, title, type, placeholder = "") {
  return el("label", { title }, label, el("input", { type, name, value, title, placeholder, step: "any", min: "0", max: "100", onchange: (event) => { remember(name, event.target.value.trim()); fill(); refresh(); } }));
}

function build() {
  byId("panel-plots").replaceChildren(
    el("div", { id: "plots-edit", "data-edits": true },
      el("div", { class: "annotate-head" }, el("span", { class: "dim", text: "Draw" }),
        ...Object.entries(SHAPES).map(([kind, text]) => button(`plot-${kind}`, text, `Draw a ${kind} on the map`, () => draw(kind))), el("span", { class: "grow" }),
        button("plot-undo", "Undo", "Undo your last edit of plots, coordinates or the heading (Ctrl+Z)", undo), button("plot-redo", "Redo", "Redo it (Ctrl+Shift+Z)", redo)),
      el("details", { class: "plot-more" }, el("summary", { id: "plots-more" }), typed(), alongPath(), imported()),
      el("details", { id: "coordinates", class: "plot-more" })),
    el("p", { id: "plots-hint", class: "note dim", role: "status" }), el("p", { id: "plots-error", class: "error", role: "alert", hidden: true }),
    el("p", { id: "plots-review", class: "note dim" }),
    el("div", { class: "plots-list" }, el("table", { id: "plots-table", class: "plain" }, el("thead"), el("tbody"))),
    el("p", { id: "plots-detection", class: "note dim" }),
    el("ul", { id: "plots-warnings", class: "plots-warnings", "aria-label": "Warnings about the figures" }),
    el("div", { class: "plot-form" }, setting("dbh-min", "count trees from", threshold(), "Minimum DBH, cm", "number"), "cm DBH",
      setting("volume", "volume m³ =", formula(), "Volume of a stem in m³ as a formula of dbh_cm and height_m, with + - * / ^ ( ) exp log sqrt; empty: no volume", "text", "0.00007 * dbh_cm^1.8 * height_m^0.95")),
    headingFields(),
    el("div", { class: "plot-form" }, reportMenu("plots-report", "open", () => titleOf(state.status?.source), async () => { await headingSaved(); return settings(); }), el("span", { text: "with map, plots, figures and list of trees" })));
}

// --- the table --------------------------------------------------------------------------------------------------------

const SMALL_ERROR = 0.001; // of the value; smaller errors are not shown as a number

function estimate([value, se] = [null, null]) {
  if (value === null) return el("td", { text: figure(value) });
  if (se === null) return el("td", {}, figure(value), el("small", { text: " ± not known" }));
  if (se < SMALL_ERROR * value) return el("td", {}, figure(value), el("small", { text: " ± < 0.1 %" }));
  const [text, error] = withSigma(value, se);
  return el("td", {}, text, el("small", { text: ` ± ${error}` }));
}

function cells(of, { withHeight, withVolume }) {
  const names = ["n_ha", "g_ha", "dg_cm", "mean_dbh_cm", "dominant_dbh_cm", ...(withHeight ? ["mean_height_m", "lorey_height_m"] : []), ...(withVolume ? ["v_ha"] : [])];
  const about = of.area_m2 === undefined ? ["", "", ""] : [figure(of.area_m2), percent(of.seen_m2 / of.area_m2), String(of.trees)];
  const values = names.map((name) => estimate(of[name]));
  if (withHeight && of.trees_with_height < of.trees) values[names.indexOf("mean_height_m")].append(el("small", { text: `, ${of.trees_with_height} of ${count(of.trees, "tree")}` }));
  return [...about.map((text) => el("td", { text })), ...values];
}

// The row of a plot stays while its figures change, so that what a person types and selects in it stays too.
function lineOf(plot) {
  const line = { plot, inputs: {} };
  const heading = el("th", { scope: "row" });
  if (looksOnly()) heading.append(line.text = el("span"));
  else {
    line.inputs.name = el("input", { type: "text", maxlength: "60", "aria-label": `Name of plot ${plot.name}`, onchange: ({ target }) => changePlot(line.plot, { name: target.value }) });
    heading.append(line.inputs.name);
    if (plot.shape.kind === "circle") {
      line.inputs.radius = el("input", { type: "number", min: "0.01", max: "600", step: "any", required: true, onchange: ({ target }) => target.reportValidity() && changePlot(line.plot, { radius: target.valueAsNumber }) });
      heading.append(el("label", { class: "plot-radius" }, " radius ", line.inputs.radius, " m"));
    }
  }
  line.gone = el("button", { class: "quiet small", "data-edit": true, text: "✕", title: "Delete", onclick: () => remove(line.plot) });
  line.node = el("tr", { "data-plot": plot.id }, heading, el("td", {}, line.gone));
  return line;
}

function showLine(line, plot, of, columns) {
  const { name, shape } = plot;
  line.plot = plot;
  if (line.text) setText(line.text, shape.kind === "circle" ? `${name} radius ${shape.radius} m` : name);
  for (const [which, input] of Object.entries(line.inputs)) {
    const value = String(which === "name" ? name : shape.radius), shownBefore = input.defaultValue;
    input.setAttribute("aria-label", which === "name" ? `Name of plot ${name}` : `Radius of plot ${name}, m`);
    if (shownBefore !== value) input.defaultValue = value;
    const typing = input === document.activeElement && input.value !== shownBefore;
    if (!typing && input.value !== value) input.value = value;
  }
  line.gone.setAttribute("aria-label", `Delete plot ${name}`);
  for (const cell of [...line.node.cells].slice(1, -1)) cell.remove();
  line.node.lastChild.before(...cells(of ?? {}, columns));
}

function fillTable() {
  const table = byId("plots-table"), body = table.tBodies[0];
  const found = figures.plots, withVolume = Boolean(formula());
  const withHeight = [figures.all, found].some((each) => Object.values(each?.plots ?? {}).some((of) => of.trees_with_height));
  const columns = { withHeight, withVolume };
  const heads = [...HEADS, ...(withHeight ? HEIGHTS : []), ...(withVolume ? [VOLUME] : [])];
  table.tHead.replaceChildren(el("tr", {}, ...heads.map(([text, title]) => el("th", { scope: "col", text, title })), el("td")));
  const sum = (text, of) => el("tr", { class: "sum" }, el("th", { scope: "row", text }), ...cells(of, columns), el("td"));
  for (const row of body.querySelectorAll(".sum")) row.remove();
  const known = new Set(plots().map(({ id }) => id));
  for (const [id, { node }] of lines) if (!known.has(id)) { node.remove(); lines.delete(id); } // first: a row that moves loses the focus
  plots().forEach((plot, place) => {
    if (!lines.has(plot.id)) lines.set(plot.id, lineOf(plot));
    const line = lines.get(plot.id);
    showLine(line, plot, found?.plots[plot.name], columns);
    if (body.rows[place] !== line.node) body.insertBefore(line.node, body.rows[place] ?? null);
  });
  body.append(...(found && plots().length > 1 ? [sum("mean", found.mean)] : []),
    ...(figures.all ? [sum("all observed", figures.all.plots.all)] : []));
  table.hidden = !body.rows.length;
}

const LEFT_OUT = { outside_of_plots: "outside the plots", outside_of_observed_area: "outside the observed area", below_minimum_dbh: "below the minimum DBH" };

function hint() {
  if (sketch.kind === "point") return "Click a tree or a mark on the map whose coordinates are known. Esc ends.";
  if (sketch.kind === "polygon") return "Click each corner on the map; click the first corner or press Enter to finish. Esc ends.";
  if (drawing()) return `Drag on the map from ${sketch.kind === "circle" ? "the centre outwards" : "corner to corner"}, or click both ends. Esc ends.${sketch.kind === "circle" ? " Then its radius can be typed in the list." : ""}`;
  if (!state.map) return nothingYet();
  const drawn = plots().length > 0;
  const { trees_in_map: found, trees_added: added, trees_left_out: leftOut = {}, added_out_of_sight: unseen = [], parameters } = (drawn ? figures.plots : figures.all) ?? {};
  const all = found + added;
  const reasons = Object.entries(leftOut).filter(([, number]) => number).map(([reason, number], k) => `${number}${k ? "" : ` of ${count(all, "tree")}`} ${number === 1 ? "is" : "are"} ${LEFT_OUT[reason] ?? reason.replaceAll("_", " ")}`);
  const trees = found === undefined ? "" : ` ${reasons.length ? `${reasons.join(", ")}, and not counted.` : `All ${count(all, "tree")} are counted.`}${outOfSightText(unseen)}`;
  if (!drawn) return `${looksOnly() ? "" : "Draw plots on the map for their stems and basal area per hectare. "}Without plots, the figures are those of the whole observed area.${trees}`;
  return `Trees of the map at the shown time.${trees} ± is the standard error${parameters ? `, with ${figure(100 * parameters.count_error)} % of the stems for false and missed trees, less for trees that people confirmed` : ""}. For the mean it is the variation between plots, at least the error of the plots, and the error of false and missed trees, which all plots share.`;
}

function outOfSightText(places) {
  if (!places.length) return "";
  const named = places.slice(0, MOST_NAMED).map(placeText), more = places.length - named.length;
  return ` Added by people outside the observed area: ${[...named, ...(more ? [`and ${more} more`] : [])].join("; ")}.`;
}

const UNKNOWN_ERROR = " The error of the stems is not known where no tree was found or where the observed part is not like the rest.";
const NO_DECREASE = { "": "Detection does not decrease with distance within reach: the figures are not corrected.",
  correction: "Detection is not estimated: every tree in view counts as found.",
  whole_cloud: "Detection is not estimated for a whole cloud: every tree counts as found.",
  few_trees: "Detection is not estimated, because it needs 20 trees in view: every tree in view counts as found." };

// Which of the figures with and without correction to use, as `stemmap stand` prints it, and why an error is not known.
function detectionText() {
  const { all, plots: own } = figures;
  const shownPlots = [all, own].flatMap((each) => Object.values(each?.plots ?? {}));
  return correctionText(own ?? all ?? {}, !own) + (shownPlots.some(({ n_ha: [stems, se] }) => stems !== null && se === null) ? UNKNOWN_ERROR : "");
}

export function correctionText({ detection_sigma_m: sigma, detection_not_estimated: reason, plots: of, mean }, isWhole) {
  if (!of) return "";
  if (sigma === null) return NO_DECREASE[reason];
  const { n_ha_corrected: stems, g_ha_corrected: basal } = mean;
  const words = (of, unit) => `${plusMinus(...of)} ${unit}`;
  const names = Object.keys(of).filter((name) => of[name].seen_m2 > 0);
  const place = isWhole ? "of the whole observed area" : names.length === 1 ? `of plot ${names[0]}` : `of the mean of ${names.length} plots`;
  return `Use the figures above. If trees far from the path were missed, use the corrected ones, ${place}: ${words(stems, "stems/ha")}, ${words(basal, "m²/ha")} `
    + `(detection decreases with distance: half-normal, sigma ${figure(sigma)} m). They are too large where the stand is thinner away from the path.`;
}

// What people changed in the figures, with the name of each plot where there are plots.
function byPeopleText() {
  const { plots: own, all } = figures;
  return Object.entries((own ?? all)?.plots ?? {}).map(([name, of]) => {
    const words = [[of.dbh_by_tape, "diameter", "by tape"], [of.trees_added, "tree", "added"], [of.trees_removed, "tree", "removed"]];
    const changes = words.filter(([number]) => number).map(([number, what, how]) => `${count(number, what)} ${how}`).join(", ");
    return changes && `By people${own ? `, plot ${name}` : ""}: ${changes}.`;
  }).filter(Boolean).join(" ");
}

// How many found trees a person has reviewed, and what people changed in the figures.
function reviewText() {
  const of = Object.fromEntries(STATES.map((name) => [name, 0]));
  for (const tree of trees()) of[reviewOf(tree)] += 1;
  const all = trees().length;
  if (!all) return byPeopleText();
  const states = STATES.slice(1).filter((name) => of[name]).map((name) => `${of[name]} ${name}`);
  return [`Review: ${of.confirmed + of.rejected} of ${count(all, "found tree")} reviewed${states.length ? ` (${states.join(", ")})` : ""}.`, byPeopleText()].filter(Boolean).join(" ");
}

// Another run begins with empty fields.
function resetFields() {
  const now = state.annotations?.run;
  if (!now || now === run) return;
  if (run) draft.error = "";
  run = now;
  inFile(0, 0).forEach((value, axis) => { document.querySelector(`#plots-edit [name=${["x", "y"][axis]}]`).defaultValue = value; });
  for (const form of document.querySelectorAll("#plots-edit form")) form.reset();
  byId("plot-crs").value = "";
  resetHeading();
  for (const { node } of lines.values()) node.remove();
  lines.clear();
}

function fill() {
  if (!plotting()) return;
  resetFields();
  for (const kind of Object.keys(SHAPES)) byId(`plot-${kind}`).setAttribute("aria-pressed", String(sketch.kind === kind));
  byId("plots-along").hidden = !isDrive();
  setText(byId("plots-more"), `Type a plot, ${isDrive() ? "place plots along the path, " : ""}or import a file`);
  byId("plot-undo").disabled = !canUndo();
  byId("plot-redo").disabled = !canRedo();
  setText(byId("plots-hint"), hint());
  const problem = state.annotations?.problem || draft.error || (state.map ? figures.problem : "");
  byId("plots-error").hidden = !problem;
  setText(byId("plots-error"), problem && problem.charAt(0).toUpperCase() + problem.slice(1));
  const { warnings = [] } = figures.plots ?? figures.all ?? {};
  byId("plots-warnings").replaceChildren(...warnings.map((text) => el("li", { text })));
  setText(byId("plots-detection"), detectionText());
  setText(byId("plots-review"), reviewText());
  fillHeading();
  fillTable();
  byId("plots-table").classList.toggle("old", figures.all !== null && shown[0] !== edition());
}

// Returns whether the key belonged to the tab.
export function plotKey(event) {
  if (!plotting()) return false;
  if (historyKey(event, { undo, redo })) return true;
  if (!drawing()) return false;
  if (event.key === "Escape") stopDrawing();
  else if (event.key === "Enter" && sketch.kind === "polygon") finish();
  else return false;
  return true;
}

export function startPlotsPanel() {
  build();
  startCoordinates();
  on("map", () => { if (!state.map) { figures = { all: null, plots: null, problem: "" }; shown = []; } });
  on("map", () => { if (plotting()) setText(byId("plots-hint"), hint()); });
  on("tab", () => { if (!plotting()) stopDrawing(); });
  on("tab annotations annotating sketch parameters remapped", fill);
  on("map tab annotations parameters remapped", refresh);
}
