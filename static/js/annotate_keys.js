// The keys of the tab Annotate. They act while it is open and nobody types.

import { annotating, choose, draft, judge, next, nudge, redo, remove, rowOf, toggleAdding, undo } from "./annotate.js";

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
