// Parameters: their declarations, and the requests that change them. Why a value was refused is in `tuning.refused`, the failure of
// another request in `tuning.error`.

import { myName } from "../annotate/annotations.js";
import { get, patch, post } from "../core/api.js";
import { attempted } from "../core/problem.js";
import { changed, on, state } from "../core/store.js";
import { historyKey } from "../core/undo_keys.js";
import { visible } from "../shell/tabs.js";

export const tuning = {
  specs: [], // [{name, stage, title, unit, doc, kind, minimum, maximum, step, choices, default}]
  presets: [], // [{name, doc}]
  error: "",
  refused: {}, // by the name of a parameter: why its last value was refused; empty if it was not
};
const SET_NAME = /^[\p{L}\p{N}_][\p{L}\p{N}_ .+-]{0,39}$/u;
let last = Promise.resolve(), waiting = {}, sending = false;
const page = Math.random().toString(36).slice(2); // makes gestures of two pages differ
let gestures = 0;

export const isTuning = () => visible("tune");
export const valueOf = (name) => state.parameters?.values[name];
export const isChanged = (name) => state.parameters?.changed.includes(name) ?? false;
export const savedSets = () => state.sets?.sets ?? [];
export const specOf = (name) => tuning.specs.find((spec) => spec.name === name);

// Requests are sent one at a time, so that undo reverts the change before it.
export function attempt(work) {
  last = last.then(async () => {
    try {
      const done = await work();
      tuning.error = "";
      return done ?? true;
    } catch (error) {
      tuning.error = error.message;
      return null;
    } finally {
      changed("tuning");
    }
  });
  return last;
}

// Begins a drag of a slider: all values until its end are one undo step.
export const newGesture = () => `${page} ${gestures += 1}`;

// While the server is busy, only the newest value of each parameter waits.
export async function setValue(name, value, gesture = "") {
  waiting[name] = { value, gesture };
  if (sending) return;
  sending = true;
  while (Object.keys(waiting).length) {
    const [[first, sent]] = Object.entries(waiting);
    delete waiting[first];
    const change = { changes: { [first]: sent.value }, gesture: sent.gesture };
    await attempt(async () => { tuning.refused[first] = await patch("/api/parameters", change).then(() => "", ({ message }) => message); });
  }
  sending = false;
  changed("tuning");
}

export const isMoving = (name) => name in waiting;
export const undo = () => state.parameters?.undo && attempt(() => post("/api/parameters/undo", {}));
export const redo = () => state.parameters?.redo && attempt(() => post("/api/parameters/redo", {}));
export const reset = (names) => attempt(() => post("/api/parameters/reset", { names }));
export const use = (name) => attempt(() => post("/api/sets/use", { name }));
export const save = (name) => attempt(() => post("/api/sets", { name, who: myName() }));
export const forget = (name) => attempt(() => post("/api/sets/delete", { name }));
export const takeFile = (file, text) => attempt(() => post("/api/sets/upload", { file: file.slice(0, 100), text }));
export const refuse = (text) => { tuning.error = text; changed("tuning"); };

// While the tab is open. Returns whether the key was one of them.
export const tuneKey = (event) => isTuning() && undoKey(event);

export const undoKey = (event) => historyKey(event, { undo, redo });

// Why a name of a set is not accepted; empty if it is.
export const nameProblem = (name) => (SET_NAME.test(name) ? "" : "A name begins with a letter or digit, followed by letters, digits, spaces and . + - _ (40 characters at most).");

export function shown(value, spec) {
  if (typeof value === "boolean") return value ? "on" : "off";
  const text = typeof value === "number" ? String(value).replace(/^-/, "−") : String(value);
  return spec?.unit ? `${text} ${spec.unit}` : text;
}

async function load() {
  const answer = await attempted(() => get("/api/parameters"));
  if (!answer) return;
  Object.assign(tuning, { specs: answer.specs, presets: answer.presets });
  changed("specs");
}

export function startTuning() {
  on("connection", () => state.connected && !tuning.specs.length && load());
}
