// The tab Annotate: how much is judged, what can be done, and the list of annotations.

import { byId, el, setText } from "../core/dom.js";
import { count, figure, fixed, isAssumed } from "../core/format.js";
import { on, state } from "../core/store.js";
import { visible } from "../shell/tabs.js";
import { annotating, callMe, change, choose, doubtInWords, draft, importTable, judge, KINDS, myName, NAME, next, nudge, redo, remove, rowOf, rows, scoreAgainst, toggleAdding, truthInWords, undo, unjudged, warnedInWords } from "./annotations.js";
import { learnSection, startLearning } from "./learning.js";

const AGAINST = { both: "its truth and annotations", own: "its truth alone", annotations: "annotations alone" };
const EVERY = 300; // [ms] between two fillings
let planned = 0, filledAt = 0;
const lines = new Map(); // rows of the table by the annotation's id

const button = (id, text, title, onclick) => el("button", { id, class: "small", text, title, onclick });

function build() {
  const kind = el("select", { id: "annotate-kind", "aria-label": "What a refused tree is", onchange: () => { draft.kind = kind.value; } },
    ...KINDS.slice(1).map((each) => el("option", { value: each, text: each, selected: each === draft.kind })));
  const name = el("input", { id: "annotate-name", type: "text", value: myName(), maxlength: "40", autocomplete: "off", onchange: () => {
    const fits = NAME.test(name.value.trim());
    name.setCustomValidity(fits ? "" : "Begin with a letter or digit; letters, digits, space and . @ - _ follow.");
    name.reportValidity();
    if (fits) callMe(name.value.trim());
  } });
  const unit = el("select", { id: "annotate-unit", "aria-label": "Unit of a column dbh that does not say its unit" },
    ...[["", "DBH unit"], ["cm", "cm"], ["m", "m"], ["mm", "mm"]].map(([value, text]) => el("option", { value, text })));
  const file = el("input", { id: "annotate-file", type: "file", accept: ".csv,.txt,text/csv", hidden: true, "aria-label": "Table of trees", onchange: async () => {
    const [chosen] = file.files;
    file.value = "";
    if (chosen) await take(chosen, unit.value);
  } });
  byId("panel-annotate").replaceChildren(
    el("div", { class: "annotate-head" },
      el("p", { id: "annotate-count", class: "annotate-count" }),
      button("annotate-undo", "Undo", "Undo your last edit (Ctrl+Z)", thenByKeys(undo)), button("annotate-redo", "Redo", "Do it again (Ctrl+Shift+Z)", thenByKeys(redo))),
    el("div", { class: "annotate-tools" },
      button("annotate-add", "Add", "Add trees by clicks on the map (a)", thenByKeys(() => toggleAdding())),
      button("annotate-next", "Next", "The next found tree that nobody judged, the one that the decision trees doubt most first (Tab on the map)", thenByKeys(next)),
      button("annotate-yes", "Is a tree", "The selected found tree is one (y)", thenByKeys(() => judge("tree"))),
      button("annotate-no", "Is no tree", "The selected found tree is something else (n)", thenByKeys(() => judge(draft.kind))), el("label", { class: "annotate-as" }, "it is ", kind)),
    el("p", { id: "annotate-error", class: "error", role: "alert", hidden: true }),
    el("p", { id: "annotate-hint", class: "note dim" }),
    el("div", { id: "annotate-truth", class: "annotate-truth", hidden: true },
      el("label", { title: "This run brings its own truth, which annotations never change: what they agree with stays exact, what they say otherwise stands beside it" }, "Score against ",
        el("select", { id: "annotate-against", onchange: (event) => scoreAgainst(event.target.value) }, ...Object.entries(AGAINST).map(([value, text]) => el("option", { value, text })))),
      el("p", { id: "annotate-warned", class: "note warned", role: "status" })),
    el("div", { class: "annotate-list" },
      el("table", { id: "annotations", class: "plain" }, el("thead", {}, el("tr", {},
        ...[["class"], ["DBH cm"], ["x m"], ["y m"], ["by"], [""]].map(([text]) => el("th", { scope: "col", text })))), el("tbody"))),
    el("div", { class: "annotate-files" },
      el("label", {}, "Your name ", name),
      button("annotate-import", "Import CSV", "Columns x_m, y_m and optionally dbh_cm and class; the headers of other tools are known", () => file.click()), unit, file,
      el("a", { class: "small", href: "/api/annotations.csv", download: "truth.csv", text: "CSV" }),
      el("a", { class: "small", href: "/api/annotations.geojson", download: "truth.geojson", text: "GeoJSON" })),
    learnSection());
}

async function take(file, unit) {
  if (file.size > 900_000) {
    draft.error = "The table is larger than 0.9 MB.";
    return fill();
  }
  const done = await importTable(await file.text(), unit);
  if (done) draft.said = `${done.added} taken from ${file.name}${done.left_out ? `, ${done.left_out} stood here already` : ""}.`;
  fill();
}

function lineOf(row) {
  const kind = el("select", { "aria-label": `Class of annotation ${row.id}`, onchange: () => change(line.row, { kind: kind.value }) },
    ...KINDS.map((each) => el("option", { value: each, text: each })));
  const dbh = el("input", { type: "text", inputmode: "decimal", "aria-label": `DBH of annotation ${row.id} in cm`, placeholder: "–", onchange: () => takeDbh(line, dbh) });
  const gone = el("button", { class: "quiet small", text: "✕", title: "Delete", "aria-label": `Delete annotation ${row.id}`, onclick: (event) => { event.stopPropagation(); remove(line.row); } });
  const cells = [el("td", {}, kind), el("td", {}, dbh), el("td"), el("td"), el("td", { class: "annotate-who" }), el("td", {}, gone)];
  const line = { row, kind, dbh, node: el("tr", { "data-annotation": row.id, onclick: () => choose(row.id) }, ...cells) };
  return line;
}

function takeDbh(line, input) {
  const text = input.value.trim().replace(",", ".");
  const value = text === "" ? null : Number(text);
  if (value !== null && !(value > 0 && value <= 1000)) {
    draft.error = "A DBH is a number of centimetres above 0 and up to 1000; leave it empty where nobody measured it.";
    return fill();
  }
  return change(line.row, { dbh_cm: value });
}

function show(line, row) {
  const typing = line.node.contains(document.activeElement) && document.activeElement.matches("input");
  if (!typing) { // what a person edits stays as they saw it, and is refused if it was changed meanwhile
    line.row = row;
    line.kind.value = row.kind;
    line.dbh.value = row.dbh_cm === null ? "" : String(row.dbh_cm);
  }
  const [, , x, y, who] = line.node.cells;
  const place = draft.moved?.id === row.id ? draft.moved : row;
  setText(x, fixed(place.x, 2));
  setText(y, fixed(place.y, 2));
  setText(who, row.who);
  who.title = `${row.who}, ${new Date(1000 * row.at_s).toLocaleString()}`;
  line.node.setAttribute("aria-selected", String(row.id === draft.chosen));
}

function fill() {
  clearTimeout(planned);
  planned = 0;
  filledAt = performance.now();
  if (!visible("annotate")) return;
  const problem = state.annotations?.problem || "";
  const found = state.map?.trees.length ?? 0;
  const left = unjudged().length;
  setText(byId("annotate-count"), state.map ? `${found - left} of ${found} found trees judged, ${left} left` : "Nothing mapped yet");
  Object.assign(byId("annotate-undo"), { disabled: !draft.undo });
  Object.assign(byId("annotate-redo"), { disabled: !draft.redo });
  for (const id of ["add", "import"]) byId(`annotate-${id}`).disabled = Boolean(problem) || !state.annotations?.run;
  const judged = state.map?.trees.some(({ number }) => number === state.selected);
  for (const id of ["yes", "no"]) byId(`annotate-${id}`).disabled = Boolean(problem) || !judged;
  byId("annotate-next").disabled = !left;
  byId("annotate-add").setAttribute("aria-pressed", String(draft.adding));
  byId("annotate-error").hidden = !(draft.error || problem);
  setText(byId("annotate-error"), problem || draft.error);
  setText(byId("annotate-hint"), hint());
  byId("annotate-truth").hidden = state.annotations?.own == null;
  byId("annotate-against").value = state.annotations?.against ?? "both";
  setText(byId("annotate-warned"), warnedInWords());
  fillTable();
}

// Who clicks goes on by Tab, y and n, which act on the map; on a button Tab would go to the next button, and y or n
// would judge the tree before. Who came to the button by Tab (a click without a pointer) stays there.
function thenByKeys(act) {
  return (event) => {
    act();
    if (event.detail > 0) byId("map").focus({ preventScroll: true });
  };
}

function hint() {
  if (draft.adding) return "Click on the map where a tree stands; the ring shows where it will be. Esc ends.";
  if (draft.said) return draft.said;
  const tree = unjudged().find(({ number }) => number === state.selected);
  if (tree) return `Tree ${tree.number}, seen in ${isAssumed(tree) ? "no single scan, in all together" : count(tree.observations, "scan")}, ${tree.dbh_cm === null ? "DBH not measured" : `DBH ${figure(tree.dbh_cm)} cm`}${doubtInWords(tree)}: is it one? y or n; Tab leaves it and goes to the next.`;
  if (!rows().length) return "Say which trees really stand here: press Next and judge what was found, or Add and click on the map what was missed (or shift-click in the 3D scene).";
  return truthInWords();
}

function fillTable() {
  const body = byId("annotations").tBodies[0];
  const wanted = [...rows()].reverse(); // the newest first
  wanted.forEach((row, place) => {
    if (!lines.has(row.id)) lines.set(row.id, lineOf(row));
    const line = lines.get(row.id);
    show(line, row);
    if (body.rows[place] !== line.node) body.insertBefore(line.node, body.rows[place] ?? null);
  });
  while (body.rows.length > wanted.length) body.lastChild.remove();
  const known = new Set(wanted.map(({ id }) => id));
  for (const id of lines.keys()) if (!known.has(id)) lines.delete(id);
  byId("annotations").hidden = !wanted.length;
}

function later() {
  planned ||= setTimeout(fill, Math.max(0, EVERY - (performance.now() - filledAt)));
}

export function startAnnotatePanel() {
  build();
  startLearning();
  byId("tab-annotate").addEventListener("click", thenByKeys(() => {}));
  on("map", later);
  on("annotating", () => { if (draft.error || draft.adding) draft.said = ""; fill(); });
  on("tab annotations selection", fill);
}

// --- The keys of the tab Annotate. They act while it is open and nobody types.

const STEP = 0.01; // [m]
const ARROWS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };

export const ANNOTATE_KEYS = [
  ["a", "add trees by clicks on the map (in the tab Annotate, as those below)"], ["shift+click", "in the 3D scene: add a tree there"], ["y n", "the selected tree is one, or is none"], ["tab", "the next tree that nobody judged, the most doubted first"],
  ["← ↑ → ↓", "move the chosen annotation by 1 cm"], ["del", "delete it"], ["ctrl+z ctrl+shift+z", "undo, and do again"],
];

// Returns whether the key was meant for it.
export function annotateKey(event, inScene) {
  if (!annotating()) return false;
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
    if (event.shiftKey) redo();
    else undo();
    return true;
  }
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  return chosenKey(event) || plainKey(event, inScene);
}

function chosenKey(event) {
  const row = rowOf(draft.chosen);
  if (!row || event.target.matches?.("[role=tab]")) return false;
  if (event.key in ARROWS && !event.shiftKey) nudge(...ARROWS[event.key]);
  else if (event.key === "Delete" || event.key === "Backspace") remove(row);
  else if (event.key === "Escape" && !draft.adding) choose(null);
  else return false;
  return true;
}

function plainKey(event, inScene) {
  // Who walks through the buttons with Tab must not be caught on the map.
  const free = inScene || event.target === document.body || event.target.id === "map";
  if (event.key === "a") toggleAdding();
  else if (event.key === "y") judge("tree");
  else if (event.key === "n") judge(draft.kind);
  else if (event.key === "Tab" && !event.shiftKey && free) next();
  else if (event.key === "Escape" && draft.adding) toggleAdding(false);
  else return false;
  return true;
}
