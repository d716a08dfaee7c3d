// The tab Repair: tools for trees and loops, and the list of repairs.

import { draft, historyOf } from "../annotate/annotations.js";
import { inFile, placeTexts, unitWord } from "../core/coordinates.js";
import { button, byId, el, setText } from "../core/dom.js";
import { count } from "../core/format.js";
import { on, selectedTree, state } from "../core/store.js";
import { historyKey } from "../core/undo_keys.js";
import { CLASSES, deleteTree, endTool, hint, importRepairs, removeRepair, repairing, repairs, setClass, startRepairs, tool, useTool } from "./repairs.js";

const TOOLS = [
  ["merge", "Merge", "Two trees of the map are one: it keeps the number of the first; its place is the mean of both, weighted by their sigmas"],
  ["split", "Split", "A tree of the map is two stems; their diameters are unknown then"],
  ["move", "Move", "A tree stands elsewhere"],
];
const LOOPS = [
  ["tie", "Same place", "The robot was at one place twice and the map does not know it: click a stem, and the same stem seen again. Path and map follow"],
  ["forbid", "Forbid loop", "A loop of the map is wrong: click its dashed line. Path and map follow"],
];
// What a repair asks for, also while it is not applied.
const WORDS = { merge: "merge two trees", split: "split a tree", move: "move a tree", class: "class", delete: "delete a tree", tie: "same place", forbid: "forbid a loop" };
const listed = (numbers) => (numbers.length > 1 ? `trees ${numbers.join(" and ")}` : `tree ${numbers[0]}`); // copies of one thing go together
// What an applied repair did to the trees with these numbers.
const DONE = {
  merge: ([a, b]) => b && `tree ${b} merged into tree ${a}`, split: ([a]) => `tree ${a} split`, move: ([a]) => `tree ${a} moved`, class: (all, value) => `${listed(all)}: class ${value}`,
  delete: (all) => `${listed(all)} deleted`, tie: ([a, b]) => b && (a === b ? `tree ${a} at the same place` : `same place: trees ${a} and ${b}`), forbid: () => "",
};
const { undo, redo, canUndo, canRedo } = historyOf("repair");
const LARGEST_FILE = 900_000; // [bytes]

function build() {
  const kind = el("select", { id: "repair-class", "aria-label": "Class of the selected tree", onchange: () => { setClass(kind.value); kind.value = ""; } },
    el("option", { value: "", text: "Class …" }), ...CLASSES.map((each) => el("option", { value: each, text: each })));
  const file = el("input", { id: "repair-file", type: "file", accept: ".json,application/json", hidden: true, "aria-label": "File of repairs", onchange: async () => {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    if (chosen.size > LARGEST_FILE) {
      draft.error = `${chosen.name} is larger than ${LARGEST_FILE / 1e6} MB.`;
      return fill();
    }
    await importRepairs(await chosen.text());
  } });
  const tools = (list) => list.map(([name, text, title]) => button(`repair-${name}`, text, title, () => useTool(name)));
  byId("panel-repair").replaceChildren(
    el("div", { class: "annotate-head" },
      el("p", { id: "repair-count", class: "annotate-count" }),
      button("repair-undo", "Undo", "Undo your last repair (Ctrl+Z)", undo), button("repair-redo", "Redo", "Redo it (Ctrl+Shift+Z)", redo)),
    el("div", { class: "annotate-tools", role: "group", "aria-label": "Repair trees" }, el("span", { class: "dim", text: "Trees" }), ...tools(TOOLS), kind,
      button("repair-delete", "Delete", "The selected tree is no tree of this map (Del)", deleteTree)),
    el("div", { class: "annotate-tools", role: "group", "aria-label": "Repair loops" }, el("span", { class: "dim", text: "Loops" }), ...tools(LOOPS)),
    el("p", { id: "repair-hint", class: "note", role: "status" }),
    el("p", { id: "repair-error", class: "error", role: "alert", hidden: true }),
    el("ol", { id: "repairs", class: "repairs" }),
    el("div", { class: "annotate-files" },
      button("repair-import", "Import", "Add the repairs of a file that was saved here", () => file.click()), file,
      el("a", { id: "repair-save", class: "small", href: "/api/repairs.json", download: "repairs.json", text: "Save repairs", title: "A file for Import and for `stemmap map --repairs`" })));
}

// In the words of the trees where it is applied, else of the place.
function wordsOf(row, numbers = []) {
  const done = numbers.length > 0 && DONE[row.kind](numbers, row.value);
  if (done) return done;
  const place = isOfLoop(row) ? "" : ` at ${placeText(row)}`;
  return `${WORDS[row.kind]}${row.value ? ` ${row.value}` : ""}${place}`;
}

const isOfLoop = ({ kind }) => ["tie", "forbid"].includes(kind); // its positions are in the frame of the robot
const placeText = (row) => inFile(...row.places[0]).map((v) => v.toFixed(1)).join(", ");

// How many stems around a tie confirm it; of a wrong one, few do.
// Share of the stems below which the line warns: around right ties of the broken ring at least 0.92 agree, around wrong ones at most 0.22.
const LEAST_AGREEING = 0.5;
function agreeingOf([agree, all] = []) {
  if (!all) return [];
  const warns = agree < LEAST_AGREEING * all;
  return [el("br"), el("span", { class: warns ? "warned" : "dim", text: `${agree} of ${count(all, "stem")} there agree${warns ? ": perhaps it is another place" : ""}.` })];
}

function lineOf(row, problem, numbers, agreeing) {
  const gone = el("button", { class: "quiet small", text: "✕", title: "Delete this repair", "aria-label": `Delete repair ${row.id}`, "data-edit": true, onclick: () => removeRepair(row) });
  return el("li", { "data-repair": row.id, class: problem ? "problem" : "", title: isOfLoop(row) ? "" : `at ${placeText(row)} ${unitWord()}` },
    el("span", { class: "grow" }, wordsOf(row, problem ? [] : numbers), ...agreeingOf(agreeing), ...(problem ? [el("br"), el("span", { class: "warned", text: `Not applied: ${problem}.` })] : [])),
    el("span", { class: "dim", text: row.who }), gone);
}

function fill() {
  if (!repairing()) return;
  const rows = [...repairs()].sort((a, b) => a.id - b.id), problems = state.map?.problems ?? [];
  const known = Boolean(state.map) && problems.length === rows.length && state.map.repairs === state.annotations?.repairs; // else the map does not have them yet
  const left = known ? problems.filter(Boolean).length : 0;
  setText(byId("repair-count"), rows.length ? `${count(rows.length, "repair")}${left ? `, ${left} not applied` : ""}` : "No repairs");
  byId("repair-undo").disabled = !canUndo();
  byId("repair-redo").disabled = !canRedo();
  const blocked = Boolean(state.annotations?.problem) || !state.map;
  for (const [name] of [...TOOLS, ...LOOPS]) {
    byId(`repair-${name}`).disabled = blocked;
    byId(`repair-${name}`).setAttribute("aria-pressed", String(tool.kind === name));
  }
  for (const id of ["repair-class", "repair-delete"]) byId(id).disabled = blocked || !selectedTree();
  const tree = selectedTree();
  setText(byId("repair-hint"), hint() || (tree ? `Tree ${tree.number} is selected, at ${placeTexts([tree.x, tree.y]).join(", ")} ${unitWord()}.` : "Select a tree on the map, or press a tool. The recording is unchanged; each repair can be undone."));
  setText(byId("repair-error"), state.annotations?.problem || draft.error);
  byId("repair-error").hidden = !byId("repair-error").textContent;
  const list = byId("repairs"), numbers = known ? state.map.repaired_numbers : [], agreeing = known ? state.map.agreeing : [];
  const now = JSON.stringify([rows.map(({ id, version }) => [id, version]), known && problems, numbers, agreeing]);
  if (list.dataset.now === now) return; // the focus stays in the list
  list.dataset.now = now;
  list.replaceChildren(...rows.map((row, k) => lineOf(row, known ? problems[k] : "", numbers[k], agreeing[k])).reverse());
}

export const REPAIR_KEYS = [["del", "in the tab Repair: delete the selected tree from the map"]];

// Returns whether the key belonged to the tab.
export function repairKey(event) {
  if (!repairing()) return false;
  if (historyKey(event, { undo, redo })) return true;
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  if (event.key === "Escape") return endTool();
  if (event.key !== "Delete" || !selectedTree()) return false;
  if (!event.repeat) deleteTree();
  return true;
}

export function startRepairPanel() {
  build();
  startRepairs();
  on("map annotations annotating selection tab", fill);
}
