// What a person says of the trees: goes to the server one edit after the other, and comes back to all browsers.

import { get, put, request } from "../core/api.js";
import { recall, remember } from "../core/dom.js";
import { percent } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { changed, on, state } from "../core/store.js";
import { visible } from "../shell/tabs.js";

const NUDGE_WAIT = 400; // [ms] of quiet after which nudges become one edit
const PATIENCE = 3000; // [ms] until what was done must have come back
export const KINDS = ["tree", "pole", "person", "bush", "other"];
export const NAME = /^[\p{L}\p{N}_][\p{L}\p{N}_ .@-]{0,39}$/u;

export const draft = {
  chosen: null, // id of the annotation that keys act on
  adding: false, // the next click on the map adds one
  place: null, // {x, y, tree} where it would stand
  moved: null, // {id, x, y} while one is dragged or nudged
  kind: "other", // what `n` says that a found tree is
  error: "",
  undo: 0,
  redo: 0,
};
const DOUBTS_EVERY = 2000; // [ms]
const doubts = { of: new Map(), needed: 0, asking: false, again: 0 }; // what the decision trees are unsure of, by the tree's number
const versions = new Map(); // "id:version" of what was seen to the version that our own edit made of it
let last = Promise.resolve(), nudging = 0;

export const annotating = () => visible("annotate");
export const rows = () => state.annotations?.trees ?? [];
export const rowOf = (id) => rows().find((row) => row.id === id) ?? null;
export const news = () => changed("annotating");

function browser() {
  const known = recall("browser");
  if (/^[0-9a-f]{32}$/.test(known ?? "")) return known;
  const made = [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  remember("browser", made);
  return made;
}
const me = browser();
export const myName = () => recall("who") ?? `browser ${me.slice(0, 4)}`;

// The server writes beside each change of a parameter who made it.
function signAs(name) {
  document.cookie = `stemmap_name=${encodeURIComponent(name)}; SameSite=Strict; Path=/`;
}

export function callMe(name) {
  if (NAME.test(name)) remember("who", name);
  signAs(myName());
}

const call = (method, where, fields = {}) => request(`/api/annotations${where}`, { method, headers: { "Content-Type": "application/json" },
  body: JSON.stringify({ run: state.annotations?.run, browser: me, who: myName(), ...fields }) });

// Edits go one after the other; each has come back before the next one goes.
function edit(work) {
  last = last.then(async () => {
    try {
      const done = await work();
      Object.assign(draft, { undo: done.undo, redo: done.redo, error: "" });
      await seen(done.serial);
      return done;
    } catch (error) {
      draft.error = error.message;
      return null;
    } finally {
      news();
    }
  });
  return last;
}

function seen(serial) {
  return new Promise((resolve) => {
    const ends = performance.now() + PATIENCE;
    const look = () => ((state.annotations?.serial ?? 0) >= serial || performance.now() > ends ? resolve() : setTimeout(look, 20));
    look();
  });
}

export function add(content) {
  return edit(async () => {
    const done = await call("POST", "", { kind: "tree", dbh_cm: null, ...content });
    draft.chosen = done.id;
    return done;
  });
}

// The version is that of the row as the person saw it, unless it was their own edit that made it another.
function latest({ id, version }) {
  let now = version;
  while (versions.has(`${id}:${now}`)) now = versions.get(`${id}:${now}`);
  return now;
}

export function change(row, fields) {
  return edit(async () => {
    const version = latest(row);
    const { x, y, kind, dbh_cm } = { ...row, ...(version === row.version ? {} : rowOf(row.id)), ...fields };
    const done = await call("PATCH", `/${row.id}`, { version, x, y, kind, dbh_cm });
    await seen(done.serial);
    const now = rowOf(row.id)?.version ?? version;
    if (now !== version) versions.set(`${row.id}:${version}`, now);
    return done;
  });
}

export function remove(row) {
  if (draft.chosen === row.id) draft.chosen = null;
  return edit(() => call("DELETE", `/${row.id}`, { version: latest(row) }));
}

export const undo = () => settle().then(() => edit(() => call("POST", "/undo")));
export const redo = () => settle().then(() => edit(() => call("POST", "/redo")));
export const importTable = (table, unit) => edit(() => call("POST", "/import", { table, dbh_unit: unit || null }));

// --- found trees, and what was said of them -----------------------------------------------------------------

function nearestRow({ x, y }) {
  const near = state.annotations?.same_thing_m ?? 0.5;
  let best = null, least = near;
  for (const row of rows()) {
    const gap = Math.hypot(row.x - x, row.y - y);
    if (gap <= least) [best, least] = [row, gap];
  }
  return best;
}

// The one whose votes lie nearest to what makes a tree comes first; of those without votes the one seen least often.
export const unjudged = () => (state.map?.trees ?? []).filter((tree) => !nearestRow(tree))
  .sort((a, b) => margin(a) - margin(b) || a.observations - b.observations || a.number - b.number);

const NEVER = 9; // wider than any margin of votes
function margin({ number }) {
  const votes = doubts.of.get(number)?.votes ?? null;
  return votes === null ? NEVER : Math.abs(votes - doubts.needed);
}

export function doubtInWords({ number }) {
  const doubt = doubts.of.get(number);
  if (!doubt || doubt.votes === null) return "";
  return `, votes: tree ${percent(doubt.votes)} (${percent(doubts.needed)} are needed), ${doubt.next} ${percent(doubt.next_votes)}`;
}

async function askDoubts() {
  if (doubts.asking || performance.now() < doubts.again || !annotating()) return;
  doubts.asking = true;
  const told = await get("/api/doubts").catch(() => null);
  Object.assign(doubts, { asking: false, again: performance.now() + DOUBTS_EVERY });
  if (!told) return;
  doubts.needed = told.needed;
  doubts.of = new Map(told.trees.map((doubt) => [doubt.tree, doubt]));
  news();
}

// The selected tree is one, or is something else; then to the next, unless another was selected meanwhile.
export async function judge(kind) {
  const tree = state.map?.trees.find(({ number }) => number === state.selected);
  if (!tree) {
    draft.error = "Select a found tree first: click it on the map, or press Tab for the next one.";
    return news();
  }
  const row = nearestRow(tree);
  if (row) await change(row, { kind });
  else await add({ x: tree.x, y: tree.y, kind });
  if (!draft.error && state.selected === tree.number) next();
}

// The one that is doubted most first; after it the next.
export function next() {
  const left = unjudged();
  const place = left.findIndex(({ number }) => number === state.selected);
  const tree = left[(place + 1) % Math.max(left.length, 1)];
  draft.chosen = null;
  if (tree) select(tree.number);
  draft.look = tree ?? null;
  news();
}

// --- the chosen annotation -------------------------------------------------------------------------------------

export function choose(id) {
  draft.chosen = id;
  draft.error = "";
  news();
}

export function toggleAdding(wanted = !draft.adding) {
  Object.assign(draft, { adding: wanted, place: null, error: "" });
  news();
}

export function nudge(dx, dy) {
  const row = rowOf(draft.chosen);
  if (!row) return;
  const from = draft.moved ?? row;
  draft.moved = { id: row.id, row: draft.moved?.row ?? row, x: from.x + dx, y: from.y + dy };
  clearTimeout(nudging);
  nudging = setTimeout(settle, NUDGE_WAIT);
  news();
}

// What was moved stays there.
export async function settle() {
  clearTimeout(nudging);
  const moved = draft.moved;
  if (!moved) return;
  await change(moved.row, { x: Math.round(moved.x * 1e4) / 1e4, y: Math.round(moved.y * 1e4) / 1e4 });
  if (draft.moved === moved) draft.moved = null;
  news();
}

export function truthInWords() {
  const number = rows().length;
  return {
    source: `Scored against the truth that this run brings${number ? "; annotations do not count" : ""}.`,
    annotations: "Scored against what was annotated. A found tree that nobody has judged counts as wrong until somebody does.",
    both: `Scored against the truth that this run brings, with ${number} ${number === 1 ? "annotation" : "annotations"} laid over it.`,
  }[state.annotations?.used] ?? "";
}

// Where a run brings its own truth, annotations stand beside it: who says otherwise is told so, and chooses what counts.
export function warnedInWords() {
  const { contradicting = 0, used } = state.annotations ?? {};
  if (!contradicting || used !== "both") return "";
  return `${contradicting === 1 ? "One annotation says" : `${contradicting} annotations say`} otherwise than the truth that this run brings, and ${contradicting === 1 ? "counts" : "count"} in its place.`;
}

export const scoreAgainst = (against) => put("/api/annotations/against", { against }).catch((error) => { draft.error = error.message; news(); });

async function count() {
  const told = await request(`/api/annotations?browser=${me}`).catch(() => null);
  if (told) Object.assign(draft, { undo: told.undo, redo: told.redo });
  news();
}

export function startAnnotating() {
  signAs(myName());
  let run = null;
  on("annotations", () => {
    if (rowOf(draft.chosen) === null) draft.chosen = null;
    if (state.annotations.run !== run) {
      run = state.annotations.run;
      Object.assign(draft, { moved: null, error: "" });
      versions.clear();
      count();
    }
    news();
  });
  on("map tab", askDoubts);
  on("tab", () => annotating() || !draft.adding || toggleAdding(false));
}
