// The parameters: what they are, and the requests that change them. A refusal becomes `tuning.error`.

import { myName } from "../annotate/annotations.js";
import { get, patch, post } from "../core/api.js";
import { changed, on, state } from "../core/store.js";
import { visible } from "../shell/tabs.js";

export const tuning = {
  specs: [], // [{name, stage, title, unit, doc, kind, minimum, maximum, step, choices, default}]
  presets: [], // [{name, doc}]
  error: "",
};
let last = Promise.resolve(), waiting = {}, sending = false;
const page = Math.random().toString(36).slice(2); // tells the gestures of two pages apart
let gestures = 0;

export const isTuning = () => visible("tune");
export const valueOf = (name) => state.parameters?.values[name];
export const isChanged = (name) => state.parameters?.changed.includes(name) ?? false;
export const savedSets = () => state.sets?.sets ?? [];
export const specOf = (name) => tuning.specs.find((spec) => spec.name === name);

// Requests go one after the other, so that undo undoes what was done before it.
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

// A slider is taken: what it sends until it is let go is one step, compared with what was before.
export const newGesture = () => `${page} ${gestures += 1}`;

// While the server is busy with a value, only the newest of each slider is kept.
export async function setValue(name, value, gesture = "") {
  waiting[name] = { value, gesture };
  if (sending) return;
  sending = true;
  while (Object.keys(waiting).length) {
    const [[first, sent]] = Object.entries(waiting);
    delete waiting[first];
    await attempt(() => patch("/api/parameters", { changes: { [first]: sent.value }, gesture: sent.gesture }));
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

// Ctrl+Z, Ctrl+Shift+Z and Ctrl+Y while the tab is open and nobody types. Returns whether it was meant for it.
export function tuneKey(event) {
  if (!isTuning() || !(event.ctrlKey || event.metaKey) || event.altKey) return false;
  const key = event.key.toLowerCase();
  if (key === "y" || (key === "z" && event.shiftKey)) redo();
  else if (key === "z") undo();
  else return false;
  return true;
}

export function shown(value, spec) {
  if (typeof value === "boolean") return value ? "on" : "off";
  return spec?.unit ? `${value} ${spec.unit}` : String(value);
}

async function load() {
  const told = await get("/api/parameters").catch(() => null);
  if (!told) return;
  Object.assign(tuning, { specs: told.specs, presets: told.presets });
  changed("specs");
}

export function startTuning() {
  on("connection", () => state.connected && !tuning.specs.length && load());
}
