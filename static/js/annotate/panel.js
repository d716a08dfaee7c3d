// The tab Annotate: review of the found trees, the list of annotations, and the keys of the tab.

import { placeTexts, unitNode } from "../core/coordinates.js";
import { button, byId, el, setText } from "../core/dom.js";
import { fileName } from "../core/download.js";
import { count, dbhText, figure, fixed, NONE, seenText } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { distance } from "../core/nearest.js";
import { showDone, showProblem } from "../core/problem.js";
import { isDrive, on, selectedTree, state, treeOf, trees } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { historyKey } from "../core/undo_keys.js";
import { saveWritten } from "../core/written_file.js";
import { titleOf } from "../open/run_title.js";
import { ofExtensions } from "../shell/extensions.js";
import { visible } from "../shell/tabs.js";
import { showTrees } from "../trees/table.js";
import { annotating, annotationOf, answerBeside, answeredTrees, answerText, authorsText, byClick, byOther, callMe, change, choose, confirmedWithoutTree, contradicting, contradictionText, draft, givenName, importTable, isSkippable, KINDS, lookAt, NAME, nudge, previous, refuseHeld, refusePlain, rejectedKind, remove, review, reviewHistory, reviewOf, rowOf, rows, scoreAgainst, showCard, skip, STATES, toggleAdding, treeNumberOf, truthText, typedDbh, typedDoubt, unreviewed, votesText, withoutTree } from "./annotations.js";
import { card, fillCard, moreEvidence, startCard, typeDbh } from "./card.js";
import { startSection } from "./section.js";

const AGAINST = { both: "the ground truth of the run and annotations", own: "the ground truth of the run only", annotations: "annotations only" };
const EVERY = 300; // [ms] between two updates while a run plays
const SHOWN_ANSWERS = 5, MOST_LISTED = 12, MOST_NAMED = 3;
const LARGEST_TABLE = 900_000; // [bytes]
const lines = new Map(); // rows of the table by the id of the annotation
const { undo, redo, canUndo, canRedo } = reviewHistory;
let imported = ""; // result of the last import

function build() {
  const kind = el("select", { id: "annotate-kind", "aria-label": "Class of a rejected tree", onchange: () => { draft.kind = kind.value; } },
    ...KINDS.slice(1).map((each) => el("option", { value: each, text: each })));
  kind.title = "Answered at once with Shift: P pole, H person, B bush, O other";
  const unit = el("select", { id: "annotate-unit", "aria-label": "Unit of a DBH column whose header names none" },
    ...[["", "unit of DBH in the file"], ["cm", "cm"], ["m", "m"], ["mm", "mm"]].map(([value, text]) => el("option", { value, text })));
  const replaces = el("input", { id: "annotate-replaces", type: "checkbox" });
  const file = el("input", { id: "annotate-file", type: "file", accept: ".csv,.txt,text/csv", hidden: true, "aria-label": "Table of trees", onchange: async () => {
    const [chosen] = file.files;
    file.value = "";
    if (chosen) await take(chosen, unit.value, replaces.checked);
  } });
  const asked = el("div", { id: "annotate-ask", class: "annotate-ask", hidden: Boolean(givenName()) }, el("label", {}, "Your name, stored with each answer ", nameField("annotate-asked")),
    button("annotate-nameless", "Not now", "Answers are stored under the name of this browser", () => { asked.hidden = true; }, "quiet small"));
  const answers = el("div", { class: "review-buttons", role: "group", "aria-label": "Is the selected found tree a tree?" },
    button("annotate-yes", "Yes (Y)", "The selected found tree is a tree (Y)", byClick(() => review("tree")), ""),
    button("annotate-no", "No (N)", "The selected object is not a tree; the class beside it is stored (N)", byClick(() => review(rejectedKind())), ""), el("label", { class: "annotate-as" }, "it is a ", kind),
    button("annotate-next", "Next (S)", "Skip the selected tree, which comes last then, and select the next one, the most doubtful first (S)", skip, ""));
  byId("panel-annotate").replaceChildren(
    card(answers, el("p", { id: "annotate-hint", class: "note dim", role: "status" })),
    el("p", { id: "annotate-error", class: "error", role: "alert", hidden: true }),
    asked,
    el("div", { class: "review-said" },
      el("p", { id: "review-last", class: "review-last", hidden: true, role: "status" }, el("span"), " ", button("review-back", "Undo", "Undo this answer (Ctrl+Z)", undo, "quiet small")),
      el("div", { id: "review-history", class: "review-history", role: "group", "aria-label": "Last answers", hidden: true })),
    el("div", { class: "annotate-head" },
      el("p", { id: "annotate-count", class: "annotate-count" }),
      button("annotate-add", "Add (A)", "Add trees by clicks on the map (A)", () => toggleAdding()),
      button("annotate-undo", "Undo", "Undo your last annotation (Ctrl+Z)", undo), button("annotate-redo", "Redo", "Redo it (Ctrl+Shift+Z)", redo)),
    el("div", { id: "annotate-states", class: "annotate-tools", role: "group", "aria-label": "Found trees by review state" }, ...STATES.map((each) =>
      button(`annotate-${each}`, each, `List the ${each} trees`, () => showTrees(each), "quiet small"))),
    moreEvidence(),
    el("div", { id: "annotate-truth", class: "annotate-truth", hidden: true },
      el("label", { title: "The ground truth of this run is never changed: an annotation that contradicts it is kept next to it" }, "Score against ",
        el("select", { id: "annotate-against", onchange: (event) => scoreAgainst(event.target.value) }, ...Object.entries(AGAINST).map(([value, text]) => el("option", { value, text })))),
      el("p", { id: "annotate-warned", class: "note warned", role: "status" }),
      el("div", { id: "annotate-contradicting", class: "review-history", role: "group", "aria-label": "Annotations that contradict the ground truth" })),
    el("div", { id: "annotate-without", hidden: true }, el("p", { class: "note" }),
      el("div", { class: "review-history", role: "group", "aria-label": "Answers without a tree in this map" })),
    el("div", { class: "annotate-list" },
      el("table", { id: "annotations", class: "plain" }, el("thead", {}, el("tr", {},
        ...[["tree"], ["class"], ["DBH cm"], ["x ", unitNode()], ["y ", unitNode()], ["by"]].map((parts) => el("th", { scope: "col" }, ...parts)), el("td"))), el("tbody"))),
    el("div", { class: "annotate-files" },
      el("label", {}, "Name ", nameField("annotate-name")),
      button("annotate-import", "Import CSV", "Columns x_m, y_m and optionally dbh_cm and class; headers of other tools are recognised. A row is listed under the names in the columns who and dbh_who, as in saved tables, else as an import of the file", () => file.click()), unit,
      el("label", { title: "For a table that was saved here and corrected elsewhere: its class and DBH replace those of the annotation at the same place; an emptied DBH removes the one here. Otherwise rows that differ are left out and named" }, replaces, " replace what differs"), file,
      truthLink("csv", "CSV"), truthLink("geojson", "GeoJSON")),
    el("details", { id: "annotate-imported", class: "annotate-imported", hidden: true }),
    ...ofExtensions("annotateSections"));
}

// Both fields show the name; the one at the top asks for it until it is given.
function nameField(id) {
  const field = el("input", { id, type: "text", value: givenName(), placeholder: "your name", title: "Your edits are listed under this name, else under that of this browser", maxlength: "40", autocomplete: "name", onchange: () => {
    const name = field.value.trim(), fits = !name || NAME.test(name);
    field.setCustomValidity(fits ? "" : "Begin with a letter or digit, then letters, digits, spaces and . @ - _");
    field.reportValidity();
    if (!fits) return;
    callMe(name);
    for (const each of ["annotate-asked", "annotate-name"]) byId(each).value = name;
    byId("annotate-ask").hidden = Boolean(name);
  } });
  return field;
}

// A link to the annotations; the file is named after the run at the time of the click. The name that the server sends would be used otherwise.
function truthLink(suffix, format) {
  const address = `/api/annotations.${suffix}`;
  return el("a", { class: "small", href: address, text: `Save ${format}`, title: `Download the annotations as ${format}, with the tree numbers of the shown scan`, onclick: (event) => {
    event.preventDefault();
    saveWritten("Writing the annotations …", fileName(titleOf(state.status?.source), `truth.${suffix}`), address);
  } });
}

async function take(file, unit, replaces) {
  if (file.size > LARGEST_TABLE) {
    draft.error = `${file.name} is larger than ${LARGEST_TABLE / 1e6} MB.`;
    return fill();
  }
  byId("annotate-imported").hidden = true;
  const confirmed = () => trees().filter((tree) => reviewOf(tree) === "confirmed").length, before = confirmed();
  const done = await importTable(await file.text(), file.name, unit, replaces);
  const more = confirmed() - before;
  if (done) imported = `${count(done.added, "tree")} imported from ${file.name}${done.filled ? `; ${count(done.filled, "diameter")} added` : ""}${done.replaced ? `; ${count(done.replaced, "annotation")} replaced (${listed(done.replacements, done.replaced)})` : ""}${differingText(done)}${done.left_out ? `; ${done.left_out} left out because they were annotated already` : ""}${besideText(done)}${more > 0 ? `; ${count(more, "tree")} of the map ${more === 1 ? "is" : "are"} confirmed by them, as if answered with Yes` : ""}${done.doubtful ? `; check ${count(done.doubtful, "diameter")}: ${listed(done.doubts, done.doubtful)}` : ""}.`;
  if (!done) showProblem(draft.error); // the button is below the list, the error above it
  else {
    fillImported(done, file.name);
    showDone(imported);
  }
  fill();
}

// The first ones of a number of texts.
function listed(texts, number) {
  const named = texts.slice(0, MOST_NAMED);
  return `${named.join("; ")}${number > named.length ? `; and ${number - named.length} more` : ""}`;
}

// All that the last import has changed, left out or asks about.
function fillImported({ additions, added, fillings, filled, replacements, replaced, differences, differing, doubts, doubtful }, name) {
  const groups = [["Diameters to check", doubts, doubtful], ["Left out because they differ", differences, differing], ["Replaced", replacements, replaced], ["Diameters added", fillings, filled], ["Added", additions, added]].filter(([, texts]) => texts.length);
  const box = byId("annotate-imported");
  box.hidden = !groups.length;
  box.dataset.run = state.annotations?.run;
  box.replaceChildren(el("summary", { text: `Import of ${name}: ${groups.map(([title, , number]) => `${title.toLowerCase()}: ${number}`).join("; ")}` }),
    ...groups.flatMap(([title, texts, number]) => [el("p", { text: `${title}:` }), el("ul", {}, ...texts.map((text) => el("li", { text })), number > texts.length ? el("li", { text: `and ${number - texts.length} more` }) : "")]));
}

function differingText({ differing, differences }) {
  if (!differing) return "";
  return `; ${differing} ${differing === 1 ? "differs from its annotation and was" : "differ from their annotations and were"} left out: ${listed(differences, differing)}`;
}

function besideText({ beside, beside_m: [least, most] }) {
  if (!beside) return "";
  const gap = beside === 1 ? fixed(most, 3) : `${fixed(least, 3)} to ${fixed(most, 3)}`;
  return `; ${count(beside, "row")} ${beside === 1 ? "lies" : "lie"} ${gap} m beside an annotation and ${beside === 1 ? "counts" : "count"} as the same object`;
}

function lineOf(row) {
  const kind = el("select", { "aria-label": `Class of annotation ${row.id}`, onchange: () => change(line.row, { kind: kind.value }) },
    ...KINDS.map((each) => el("option", { value: each, text: each })));
  const dbh = el("input", { type: "text", inputmode: "decimal", "aria-label": `DBH of annotation ${row.id} in cm`, placeholder: "–", onchange: () => takeDbh(line, dbh), onkeydown: ({ key }) => { if (key === "Enter") dbh.blur(); } });
  const gone = el("button", { class: "quiet small", text: "✕", title: "Delete", "aria-label": `Delete annotation ${row.id}`, onclick: (event) => { event.stopPropagation(); remove(line.row); } });
  const cells = [el("td"), el("td", {}, kind), el("td", {}, dbh), el("td"), el("td"), el("td", { class: "annotate-who" }), el("td", {}, gone)];
  const line = { row, kind, dbh, node: el("tr", { "data-annotation": row.id, onclick: ({ target }) => openCard(row, target) }, ...cells) };
  return line;
}

// Goes to the DBH of the chosen annotation if it belongs to no found tree; returns whether it does not.
function typeChosenDbh() {
  const line = selectedTree() ? null : lines.get(draft.chosen);
  if (!line) return false;
  line.dbh.focus();
  line.dbh.select();
  return true;
}

// The row of an annotation opens the card of its tree; who edits in the row stays there.
function openCard(row, target) {
  choose(row.id);
  if (!target.matches("input, select")) showCard();
}

// A doubtful DBH is stored when it is typed a second time.
function takeDbh(line, input) {
  const dbh = typedDbh(input.value), tree = treeOf(treeNumberOf(line.row));
  if (dbh === undefined) return null;
  const doubt = input.dataset.asked !== String(dbh) ? typedDoubt(tree, dbh) : "";
  input.dataset.asked = doubt ? String(dbh) : "";
  if (!doubt) return change(line.row, { dbh_cm: dbh });
  input.value = line.row.dbh_cm === null ? "" : String(line.row.dbh_cm);
  draft.error = `The DBH ${dbh} cm ${tree ? `of tree ${tree.number} ` : ""}was not stored. ${doubt} Type it again to store it.`;
  return fill();
}

function show(line, row) {
  const typing = line.node.contains(document.activeElement) && document.activeElement.matches("input");
  if (!typing) { // an edit refers to the row as it was shown; the server refuses it if the row changed meanwhile
    line.row = row;
    line.kind.value = row.kind;
    line.dbh.value = row.dbh_cm === null ? "" : String(row.dbh_cm);
  }
  const [tree, , , x, y, who] = line.node.cells;
  const place = draft.moved?.id === row.id ? draft.moved : row;
  const mapped = treeOf(treeNumberOf(row))?.dbh_cm ?? null;
  line.dbh.placeholder = mapped === null ? NONE : `mapped ${figure(mapped)}`;
  setText(tree, String(treeNumberOf(row) ?? NONE));
  placeTexts([place.x, place.y]).forEach((text, axis) => setText([x, y][axis], text));
  setText(who, authorsText(row));
  who.title = `${authorsText(row)}, ${new Date(1000 * row.at_s).toLocaleString()}`;
  line.node.setAttribute("aria-selected", String(row.id === draft.chosen));
}

function fill() {
  if (!visible("annotate")) return;
  const problem = state.annotations?.problem || "";
  const found = trees().length, left = unreviewed();
  const selected = selectedTree(), chosen = rowOf(draft.chosen);
  setText(byId("annotate-count"), state.map ? `${found - left.length} of ${count(found, "tree")} reviewed` : "Nothing mapped yet");
  byId("annotate-undo").disabled = !canUndo();
  byId("annotate-redo").disabled = !canRedo();
  for (const id of ["add", "import"]) byId(`annotate-${id}`).disabled = Boolean(problem) || !state.annotations?.run;
  for (const id of ["yes", "no"]) byId(`annotate-${id}`).disabled = Boolean(problem) || !(selected ?? chosen);
  byId("annotate-next").disabled = !left.length;
  setText(byId("annotate-next"), selected && isSkippable(selected) ? "Skip (S)" : "Next (S)");
  const states = trees().map(reviewOf);
  for (const each of STATES) setText(byId(`annotate-${each}`), `${states.filter((one) => one === each).length} ${each}`);
  byId("annotate-add").setAttribute("aria-pressed", String(draft.adding));
  byId("annotate-error").hidden = !(draft.error || problem);
  setText(byId("annotate-error"), problem || draft.error);
  setText(byId("annotate-hint"), hint(selected && left.includes(selected) ? selected : null));
  fillCard();
  byId("annotate-kind").value = rejectedKind();
  byId("review-last").hidden = !answerText();
  setText(byId("review-last").firstChild, answerText());
  byId("review-back").hidden = Boolean(draft.answer?.isStored); // nothing to take back
  fillHistory();
  if (byId("annotate-imported").dataset.run !== String(state.annotations?.run)) byId("annotate-imported").hidden = true; // its numbers are those of another map
  byId("annotate-truth").hidden = state.annotations?.own == null;
  byId("annotate-against").value = state.annotations?.against ?? "both";
  setText(byId("annotate-warned"), contradictionText(":"));
  fillRows(byId("annotate-contradicting"), contradicting());
  const rejected = withoutTree(), confirmed = confirmedWithoutTree(), [said, list] = byId("annotate-without").children;
  byId("annotate-without").hidden = !rejected.length && !confirmed.length;
  setText(said, `${lostText(rejected, "it decides nothing", "they decide nothing")}${rejected.length && confirmed.length ? "; " : ""}${lostText(confirmed, "it counts as an added tree", "they count as added trees")}:`);
  fillRows(list, [...rejected, ...confirmed]);
  fillTable();
}

// What answers without a tree in this map do; "" without any.
function lostText({ length }, one, more) {
  if (!length) return "";
  return length === 1 ? `1 answer belongs to no tree of this map, so ${one}` : `${length} answers belong to no tree of this map, so ${more}`;
}

// The last answers, the newest first, in the words of what is stored now; a click shows the tree again.
function fillHistory() {
  const box = byId("review-history"), shown = answeredTrees().slice(-SHOWN_ANSWERS).reverse();
  const now = JSON.stringify([shown.map((tree) => [tree.number, classOf(tree)]), state.selected]);
  box.hidden = !shown.length;
  if (box.dataset.now === now) return; // the focus stays on a button
  box.dataset.now = now;
  box.replaceChildren(button("review-previous", "Previous (R)", "Show the tree of the answer before, to change it (R)", previous, "quiet small"),
    ...shown.map((tree) => el("button", { class: "quiet small", type: "button", "aria-pressed": String(tree.number === state.selected), text: `${tree.number} ${classOf(tree)}`, title: `Show tree ${tree.number} again`, onclick: () => lookAt(tree) })));
}

// Buttons that choose annotations, the first ones of many, and how many more there are.
function fillRows(box, annotations) {
  const shown = annotations.slice(0, MOST_LISTED), more = annotations.length - shown.length;
  const now = JSON.stringify([more, shown.map((row) => [row.id, row.kind, authorsText(row), treeNumberOf(row)]), draft.chosen]);
  box.hidden = !shown.length;
  if (box.dataset.now === now) return; // the focus stays on a button
  box.dataset.now = now;
  box.replaceChildren(...shown.map((row) => {
    const number = treeNumberOf(row), place = placeTexts([row.x, row.y]).join(", ");
    return el("button", { class: "quiet small", type: "button", "aria-pressed": String(row.id === draft.chosen), text: `${number === null ? `at ${place}` : number} ${row.kind}`, title: `Select it: ${row.kind} by ${authorsText(row)} at ${place}`, onclick: () => { choose(row.id); showCard(); } });
  }), more ? el("span", { text: `and ${more} more` }) : "");
}

const classOf = (tree) => annotationOf(tree)?.kind ?? "…"; // its answer is on its way

function hint(tree) {
  if (draft.adding) return "Click on the map where a tree is missing; the ring shows where it will be added. Scores count trees near the path only (Tune, Evaluation, Reach). Esc ends.";
  const chosen = rowOf(draft.chosen);
  if (chosen && treeNumberOf(chosen) === null) return `Your annotation (${chosen.kind}) belongs to no found tree: Y, N and the keys of the classes set its class, arrows move it, Del deletes it.`;
  if (imported) return imported;
  if (tree) return `Tree ${tree.number}, ${isDrive() ? seenText(tree) : `fitted in ${count(tree.observations, "slice")}`}, ${dbhText(tree)}${votesText(tree)}. Is this a tree?${besideHint(tree)}`;
  if (trees().length && !unreviewed().length) return `${trees().length === 1 ? "The tree is" : `All ${trees().length} trees are`} reviewed. ${truthText()}`;
  if (!rows().length) return "Press Next to review the trees one by one, or Add and click on the map where a tree was missed (Shift+click in the 3D scene).";
  return truthText();
}

// Another thing was there when an answer was given beside this tree.
function besideHint(tree) {
  const row = answerBeside(tree);
  return row ? ` The answer “${row.kind}”${byOther(row)}, ${fixed(distance(row, tree), 2)} m beside it, was given for another thing.` : "";
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

export function startAnnotatePanel() {
  build();
  startCard();
  startSection();
  on("map", throttled(fill, EVERY));
  on("annotating", () => { if (draft.error || draft.adding) imported = ""; fill(); });
  on("selection", () => { imported = ""; });
  on("tab annotations selection others", fill);
}

// --- keys of the tab; they act while it is open, unless a person types -----------------------------------

const STEP = 0.01; // [m]
const CLASS_KEYS = { P: "pole", H: "person", B: "bush", O: "other" }; // with Shift: p and b alone have other actions
const ARROWS = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };

export const ANNOTATE_KEYS = [
  ["a", "in the tab Annotate: add trees by clicks on the map"], ["y n", "in the tab Annotate: the selected tree is a tree, or is not"], ["shift P H B O", "in the tab Annotate: the selected tree is a pole, a person, a bush or another object"], ["s", "in the tab Annotate: skip to the next tree to review"], ["r", "in the tab Annotate: return to the tree of the answer before"],
  ["d", "in the tab Annotate: type the DBH by tape of the selected tree"],
  ["← ↑ → ↓", "move the chosen annotation by 1 cm"], ["del", "delete the chosen annotation"], ["ctrl+z ctrl+shift+z ctrl+y", "undo and redo an edit of the tab that is open"], ["shift+click", "in the 3D scene: add a tree there"],
];

// Returns whether the key belonged to the tab.
export function annotateKey(event) {
  if (!annotating()) return false;
  if (historyKey(event, reviewHistory)) return true;
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  return keyOfChosen(event) || (event.repeat ? isHeld(event) : keyOfTab(event));
}

// A key that is held down repeats itself about 30 times per second: it neither answers nor switches again.
function isHeld({ key, shiftKey }) {
  const answers = ["y", "n", "s"].includes(key) || (shiftKey && key in CLASS_KEYS);
  if (answers) refuseHeld();
  return answers || ["a", "r", "d"].includes(key);
}

function keyOfChosen(event) {
  const row = rowOf(draft.chosen);
  if (!row || event.target.matches?.("[role=tab]")) return false;
  if (event.key in ARROWS && !event.shiftKey) nudge(...ARROWS[event.key]);
  else if (event.key === "Delete" || event.key === "Backspace") remove(row);
  else if (event.key === "Escape" && !draft.adding) choose(null);
  else return false;
  return true;
}

function keyOfTab({ key, shiftKey }) {
  if (key === "a") toggleAdding();
  else if (key === "y") review("tree");
  else if (key === "n") review(rejectedKind());
  else if (shiftKey && key in CLASS_KEYS) review(CLASS_KEYS[key]);
  else if (key === "s") skip();
  else if (key === "r") previous();
  else if (key === "d") typeChosenDbh() || typeDbh();
  else if (key === "p" && draft.shown !== null) refusePlain(); // "Find a parameter" would leave the review
  else if (key === "Escape" && draft.adding) toggleAdding(false);
  else return false;
  return true;
}
