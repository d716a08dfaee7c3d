// Coordinates of the country: control points, GNSS fixes or values by hand, from which the server finds the reference system
// of the map. Files, plots and the report have it then.

import { draft, edit, news, remove, send } from "../../annotate/annotations.js";
import { post } from "../../core/api.js";
import { inFile, inMap, unitNode } from "../../core/coordinates.js";
import { button, byId, el, recall, remember, setText } from "../../core/dom.js";
import { count, fixed, NONE } from "../../core/format.js";
import { on, selectedTree, state, treeOf } from "../../core/store.js";
import { draw, plotting, sketch } from "./plots.js";

const HOW = { control: "control points", gnss: "GNSS fixes of the recording", hand: "values by hand", file: "coordinates of the file, already in the system" };
const HAND = [["east", "east m", "East of the map's origin, m"], ["north", "north m", "North of the map's origin, m"],
  ["turn_deg", "turn °", "Angle of the map's x axis from east to north, °"], ["z", "height m", "Height of the map's zero, m"]];
const COLUMNS = [["name", "point", "Name of the point"], ["tree", "tree", "Number of the tree at the point; empty for another mark"], ["x", "x", "x in the coordinates of the files"], ["y", "y", "y in the coordinates of the files"], ["east", "east m", "East in the reference system"],
  ["north", "north m", "North in the reference system"], ["z", "height m", "Height in the reference system; may be empty"]];
const PLACE = ["x", "y"];
const POINT_SIGMA = 0.125; // m, that of the command line

const MOST_FAULTS = 3; // in a message

// {name, tree, x, y, east, north, z, fault}: the place of a tree is that of its number in the map; `fault` is what the server could
// not read in a row of a file, until the row is changed.
let points = [];
let shown = ""; // what was loaded of the stored reference system
let dirty = false; // whether the fields differ from the stored ones

const stored = () => state.annotations?.frame ?? null;
const how = () => byId("coordinates-how").value;

// The control points that the map shows.
export const controlPoints = () => (plotting() && byId("coordinates").open && how() === "control" ? points : []);

export const titleOf = ({ name, tree }, row) => name || (tree === null ? String(row + 1) : `tree ${tree}`);

// --- edits ----------------------------------------------------------------------------------------------------------

function add(point) {
  const known = point.tree === undefined ? -1 : points.findIndex(({ tree }) => tree === point.tree);
  if (known < 0) points.push({ name: "", tree: null, east: "", north: "", z: "", ...point });
  byId("coordinates-how").value = "control";
  changed();
  // While points are picked, the focus stays on the map, where Esc ends.
  if (sketch.kind !== "point") byId("control-points").tBodies[0].rows[known < 0 ? points.length - 1 : known].querySelector("[name=east]").focus();
}

function addSelected() {
  const tree = selectedTree();
  if (tree) add({ tree: tree.number });
  else fail(UNSELECTED);
}

function changed() {
  dirty = true;
  draft.error = "";
  fillTable();
  news();
}

function fail(text) {
  draft.error = text;
  news();
}

const UNSELECTED = "Select a tree first: click it on the map or in the table.";

// The message is about the selection before.
function selected() {
  if (selectedTree() && draft.error === UNSELECTED) fail("");
}

const number = (text) => (String(text).trim() === "" ? null : Number(text));

function asked() {
  if (how() === "gnss") return { how: "gnss" };
  if (how() === "file") return { how: "hand", east: 0, north: 0, turn_deg: 0, z: 0 };
  if (how() === "hand") return { how: "hand", ...Object.fromEntries(HAND.map(([name]) => [name, number(byId(`coordinates-${name}`).value)])) };
  const list = points.map(({ name, tree, ...of }) => ({ name: name.trim(), tree, ...Object.fromEntries(["x", "y", "east", "north", "z"].map((each) => [each, number(of[each])])) }));
  return { how: "control", points: list, point_sigma: number(byId("coordinates-sigma").value) ?? POINT_SIGMA };
}

async function apply(by) {
  const crs = byId("coordinates-crs").value.trim();
  const faulty = points.flatMap((point, row) => (by.points && point.fault ? [`point ${titleOf(point, row)}, ${point.fault}`] : []));
  const open = (by.points ?? []).flatMap((point, row) => (point.east === null || point.north === null ? [titleOf(point, row)] : []));
  if (!crs) return fail("Name the reference system, such as EPSG:25832.");
  if (faulty.length) {
    const more = faulty.length - MOST_FAULTS;
    return fail(`${faulty.slice(0, MOST_FAULTS).join("; ")}${more > 0 ? `; and ${count(more, "more row")}` : ""}. Correct or delete ${faulty.length > 1 ? "them" : "it"} in the table, then press Apply.`);
  }
  if (open.length) return fail(`East or north is missing: ${open.join(", ")}.`);
  if (by.how === "hand" && (by.east === null || by.north === null)) return fail("Give east and north of the map's origin.");
  if (by.how === "hand") Object.assign(by, { turn_deg: by.turn_deg ?? 0, z: by.z ?? 0 });
  remember("crs", crs);
  byId("coordinates-apply").disabled = true;
  fail("");
  setText(byId("coordinates-result"), "Fitting …");
  if (await edit(() => send("PUT", "/api/georeference", { crs, by }))) dirty = false;
  byId("coordinates-apply").disabled = false;
  load();
}

// Empty texts in place of unknown numbers, and of a name that is only the number of the tree.
const typed = ({ tree, name, ...of }) => ({ ...Object.fromEntries(Object.entries(of).map(([each, value]) => [each, value ?? ""])), tree, name: name === String(tree) ? "" : name });

// Fills the table with the rows of a file, so that a wrong one can be mended here, and applies them if all could be read.
async function importTable(table) {
  const crs = byId("coordinates-crs").value.trim(), run = state.annotations?.run;
  if (!crs) return fail("Name the reference system, such as EPSG:25832.");
  let read;
  try {
    read = await post("/api/georeference/points", { crs, table });
  } catch (error) {
    return fail(error.message);
  }
  if (run !== state.annotations?.run) return fail("Another run was opened meanwhile: the file was not imported.");
  points = read.points.map(typed);
  for (const [row, text] of read.faults) points[row].fault = text;
  byId("coordinates-how").value = "control";
  changed();
  return apply(asked());
}

// --- the controls ---------------------------------------------------------------------------------------------------

function build() {
  const file = el("input", { type: "file", accept: ".csv,.txt", hidden: true, "aria-label": "File of control points", onchange: async () => {
    if (file.files.length) await importTable(await file.files[0].text());
    file.value = "";
  } });
  const input = (name, title, value = "") => el("input", { id: `coordinates-${name}`, type: "number", step: "any", value, title, "aria-label": title, oninput: changed });
  byId("coordinates").replaceChildren(
    el("summary", { id: "coordinates-now", text: "Coordinates: local" }),
    el("div", { class: "plot-form" },
      el("label", {}, "system", el("input", { id: "coordinates-crs", type: "text", value: recall("crs") ?? "", placeholder: "EPSG:25832", maxlength: "100", autocomplete: "off", title: "Projected reference system with metres, by its EPSG code", oninput: changed })),
      el("label", {}, "by", el("select", { id: "coordinates-how", onchange: changed }, ...Object.entries(HOW).map(([value, text]) => el("option", { value, text }))))),
    el("div", { id: "coordinates-control" },
      el("div", { class: "plot-form" }, button("coordinates-pick", "Pick on map", "Click trees or marks on the map", () => draw("point", (place) => add(place))),
        button("coordinates-selected", "Selected tree", "Add the selected tree", addSelected),
        button("coordinates-import", "Import …", "CSV with easting, northing (or lon, lat), and tree or x_m, y_m; optional name, elevation_m", () => file.click()), file,
        el("label", {}, "error of a point", input("sigma", "Expected standard deviation of a coordinate of a point, m; contradicting points are refused", POINT_SIGMA), "m")),
      el("div", { class: "plots-list" }, el("table", { id: "control-points", class: "plain" }, el("thead"), el("tbody")))),
    el("div", { id: "coordinates-hand", class: "plot-form" }, ...HAND.map(([name, label, title]) => el("label", {}, label, input(name, title)))),
    el("div", { class: "plot-form" }, button("coordinates-apply", "Apply", "Find the reference system of the map and keep it", () => apply(asked())),
      button("coordinates-remove", "Remove", "Make the map local again; Undo brings the coordinates back", () => remove(stored()))),
    el("p", { id: "coordinates-result", class: "note dim", role: "status" }));
  byId("coordinates").addEventListener("toggle", news);
}

// Known minus transformed position of each point as [east, north] of the best rigid motion of all points [m]; [] for fewer than
// two points, or while a place or a coordinate is missing. The server fits in the same way (`fit_rigid_pairs`).
function residualsOf(list) {
  const pairs = list.map((point) => {
    const place = point.tree === null ? point : treeOf(point.tree);
    return [place?.x, place?.y, point.east, point.north].map((value) => number(value ?? "") ?? NaN);
  });
  if (pairs.length < 2 || pairs.flat().some(Number.isNaN)) return [];
  const means = [0, 1, 2, 3].map((k) => pairs.reduce((sum, pair) => sum + pair[k], 0) / pairs.length);
  const centred = pairs.map((pair) => pair.map((value, k) => value - means[k]));
  const turn = Math.atan2(centred.reduce((sum, [x, y, e, n]) => sum + x * n - y * e, 0), centred.reduce((sum, [x, y, e, n]) => sum + x * e + y * n, 0));
  const [c, s] = [Math.cos(turn), Math.sin(turn)];
  return centred.map(([x, y, e, n]) => [e - (c * x - s * y), n - (s * x + c * y)]);
}

const residualText = (residual) => (residual ? residual.map((value) => fixed(100 * value, 1)).join(", ") : NONE);

function fillResiduals() {
  const found = dirty ? residualsOf(points) : (stored()?.frame.residuals_m ?? []).map((row) => row.slice(1));
  document.querySelectorAll("#control-points .residual").forEach((each, row) => setText(each, residualText(found[row])));
}

// Marks the fields of the rows that the server could not read.
function markFaults() {
  points.forEach(({ fault }, row) => {
    for (const input of byId("control-points").tBodies[0].rows[row].querySelectorAll("input")) {
      input.title = fault ?? COLUMNS.find(([name]) => name === input.name)[2];
      input.setAttribute("aria-invalid", String(Boolean(fault)));
    }
  });
}

function cell(point, row, name, title) {
  if (name === "tree") return el("td", {}, el("input", { name, type: "number", min: "1", step: "1", value: point.tree ?? "", "aria-label": `${title} of point ${row + 1}`,
    onchange: ({ target }) => { point.tree = number(target.value); delete point.fault; changed(); } })); // the place is then that of the tree
  const axis = PLACE.indexOf(name);
  const known = number((point.tree === null ? point : treeOf(point.tree))?.[name] ?? "");
  const written = axis < 0 || known === null ? null : inFile(known, known)[axis];
  if (point.tree !== null && axis >= 0) return el("td", { text: fixed(written, 3) });
  const value = axis < 0 ? point[name] : written === null ? "" : written.toFixed(3);
  return el("td", {}, el("input", { name, value: String(value ?? ""), type: name === "name" ? "text" : "number", step: "any", maxlength: "60", autocomplete: "off", "aria-label": `${title} of point ${row + 1}`,
    placeholder: name === "name" ? titleOf({ ...point, name: "" }, row) : null,
    oninput: (event) => {
      const given = number(event.target.value);
      point[name] = axis < 0 ? event.target.value : given === null ? "" : inMap(given, given)[axis];
      delete point.fault;
      dirty = true;
      markFaults();
      draft.error = ""; // it was about the fields before
      fillResiduals();
      news();
    } }));
}

function fillTable() {
  const table = byId("control-points");
  table.tHead.replaceChildren(el("tr", {}, ...COLUMNS.map(([name, text, title]) => el("th", { scope: "col", title }, text, ...(PLACE.includes(name) ? [" ", unitNode()] : []))), el("th", { scope: "col", text: "residual E, N cm", title: "Known position minus that of the map by the best fit of all points: east, north" }), el("td")));
  table.tBodies[0].replaceChildren(...points.map((point, row) => el("tr", {}, ...COLUMNS.map(([name, , title]) => cell(point, row, name, title)),
    el("td", { class: "residual" }),
    el("td", {}, el("button", { type: "button", class: "quiet small", text: "✕", title: "Delete", "aria-label": `Delete point ${row + 1}`, onclick: () => { points.splice(row, 1); changed(); } })))));
  table.hidden = !points.length;
  markFaults();
  fillResiduals();
}

function reset() {
  dirty = false;
  byId("coordinates-how").value = "control";
  byId("coordinates-crs").value = recall("crs") ?? "";
  byId("coordinates-sigma").value = POINT_SIGMA;
  for (const [name] of HAND) byId(`coordinates-${name}`).value = "";
}

// Shows the stored reference system, unless this person edits points.
function load() {
  const found = stored(), version = `${state.annotations?.run} ${found?.id} ${found?.version}`;
  if (version.split(" ")[0] !== shown.split(" ")[0]) reset(); // of another run
  if (!dirty && version !== shown) {
    shown = version;
    points = (found?.points ?? []).map(typed);
    if (found) {
      byId("coordinates-crs").value = found.crs;
      byId("coordinates-how").value = found.frame.method === "file" ? "file" : found.how;
      const { east_m, north_m, turn_rad, z_m } = found.frame;
      const hand = { east: east_m, north: north_m, turn_deg: (turn_rad * 180) / Math.PI, z: z_m };
      for (const [name, value] of Object.entries(hand)) byId(`coordinates-${name}`).value = String(Number(value.toFixed(name === "turn_deg" ? 6 : 3)));
      byId("coordinates-sigma").value = found.point_sigma ?? POINT_SIGMA;
    }
  }
  fillTable();
  fill();
}

// How a reference system was found.
function methodText({ method, numbers }) {
  const { points: used, fixes, rms_m: rms, sigma_point_m: sigma, sigma_turn_deg: turn } = numbers;
  if (method === "control") return `${count(used, "control point")}, ${fixed(rms, 3)} m (RMS), a coordinate of a point ± ${fixed(sigma, 3)} m, turn ± ${fixed(turn, 3)}°`;
  if (method === "gnss") return `${used} of ${fixes} GNSS fixes, ${fixed(rms, 2)} m (RMS) from the path, turn ± ${fixed(turn, 2)}°`;
  return { hand: "hand", file: "the coordinates of the file" }[method] ?? method;
}

function resultText() {
  const found = stored();
  const earlier = found ? ` The earlier fit is still in force (${found.crs}).` : "";
  if (dirty) return (how() === "control" ? `${count(points.length, "point")}, not applied yet. Two are enough; from three on the residuals check them.` : "Not applied yet.") + earlier;
  if (!found) return how() === "control" ? "Trees or marks whose coordinates are known place the map; two are enough, from three on the residuals check them." : "";
  const { sigma_m: sigma, place = "" } = found.frame;
  return `${place && `The map is at ${place}. `}By ${methodText(found.frame)}${sigma === null ? "" : `; a coordinate in the middle of the points ± ${fixed(sigma, 3)} m`}. Plots, files and the report are in ${found.crs}.`;
}

function fill() {
  if (!plotting()) return;
  const name = stored()?.crs ?? state.status?.one_step?.crs;
  setText(byId("coordinates-now"), `Coordinates: ${name ? name.match(/\["([^"]*)"/)?.[1] ?? name : "local"}`);
  byId("coordinates-control").hidden = how() !== "control";
  byId("coordinates-hand").hidden = how() !== "hand";
  byId("coordinates-remove").disabled = !stored();
  byId("coordinates-apply").disabled = !state.map;
  byId("coordinates-pick").setAttribute("aria-pressed", String(sketch.kind === "point"));
  setText(byId("coordinates-result"), resultText());
}

export function startCoordinates() {
  build();
  on("annotations", load);
  on("selection", selected);
  on("tab map annotating sketch status", fill);
}
