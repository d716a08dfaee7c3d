// Annotations: what a person states about trees. Edits go to the server one at a time and come back to all browsers.

import { get, put, request } from "../core/api.js";
import { placeTexts } from "../core/coordinates.js";
import { byId, randomId, recall, remember } from "../core/dom.js";
import { capital, count, dbhFigure, figure, share } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { distance, nearest } from "../core/nearest.js";
import { attempted, showNews } from "../core/problem.js";
import { changed, on, selectedTree, state, treeOf, trees } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { visible } from "../shell/tabs.js";

const NUDGE_WAIT = 400; // [ms] of quiet after which nudges become one edit
const PATIENCE = 3000; // [ms] until an accepted edit must have come back
const VOTES_EVERY = 2000; // [ms] between two requests for the votes
export const KINDS = ["tree", "pole", "person", "bush", "other"];
const SKIPPED = "skipped"; // class of an annotation that states nothing
export const STATES = ["open", "confirmed", "rejected", "skipped"]; // of a found tree in the review
const LARGEST_DBH = 1000; // [cm]
const MOST_ANSWERED = 20; // answers to which the review returns
// [ms] for which a card must have been on the screen before it is answered: what takes less is no judgement of its picture. People
// need about 150 ms to recognise the content of a picture (Thorpe, Fize and Marlot, Nature 381, 1996). A choice between two answers
// takes about 300 ms from the picture to the key (Donders 1868, Hick 1952), but three answers per second leave 333 ms between two
// keys, of which the next card needs a part.
const LOOK = 150;
// [ms] the same where another page or a click in the scene selected the tree: the answer to the tree before may be on its way. A
// choice between up to ten answers takes less than a second (Hick 1952).
const LOOK_UNASKED = 1000;
// [ms] between two clicks on the answers that are one double click: the default of GTK (gtk-double-click-time).
const DOUBLE_CLICK = 400;
export const NAME = /^[\p{L}\p{N}_][\p{L}\p{N}_ .@-]{0,39}$/u;

export const draft = {
  chosen: null, // id of the annotation that the keys act on
  adding: false, // whether the next click on the map adds an annotation
  place: null, // {x, y, on} where it would be placed
  held: null, // the annotation on which the pointer is pressed
  moves: false, // whether it was chosen before, so that dragging moves it
  moved: null, // {id, row, x, y} while an annotation is dragged or nudged
  kind: null, // chosen class of a rejected tree, see `rejectedKind`
  shown: null, // number of the tree whose evidence is on the card; the review answers for it
  shownAt: Infinity, // [ms] time since which it is on the screen
  answer: null, // {number, kind, dbh, before, isStored}: what the last edit stated about a tree, and its annotation before
  answered: [], // ids of the annotations of the last answers, the newest last
  error: "",
  refused: "", // why the last answer did not count
  isRefusalShown: false, // for a while, over the picture
  refusals: 0, // answers in a row that did not count for that reason
  undo: {}, // numbers of edits that can be undone, by their subject
  redo: {},
};
const NO_VOTES = { needed: 0, of: new Map(), known: false };
let votes = NO_VOTES; // of the decision trees for each found tree, by its number
const versions = new Map(); // "id:version" of a row as it was shown, to the version that an own edit made of it
const answering = new Set(); // numbers of the trees whose answers are on their way
let last = Promise.resolve(), nudging = 0;

export const annotating = () => visible("annotate");
export const rows = () => state.annotations?.trees ?? [];
const skips = () => state.annotations?.skipped ?? [];
export const rowOf = (id) => rows().find((row) => row.id === id) ?? null;
export const news = () => changed("annotating");

function browser() {
  const known = recall("browser");
  if (/^[0-9a-f]{32}$/.test(known ?? "")) return known;
  const made = randomId();
  remember("browser", made);
  return made;
}
const me = browser();
export const givenName = () => recall("who") ?? ""; // "" if this person gave none
export const myName = () => givenName() || `browser ${me.slice(0, 4)}`;

// The server records with each change of a parameter who made it.
function signAs(name) {
  document.cookie = `stemmap_name=${encodeURIComponent(name)}; SameSite=Strict; Path=/`;
}

export function callMe(name) {
  if (!name || NAME.test(name)) remember("who", name);
  signAs(myName());
}

// Requests an edit of this browser.
export const send = (method, path, fields = {}) => request(path, { method, headers: { "Content-Type": "application/json" },
  body: JSON.stringify({ run: state.annotations?.run, browser: me, who: myName(), ...fields }) });
const call = (method, where, fields) => send(method, `/api/annotations${where}`, fields);

// Edits are sent one at a time; each has come back before the next one is sent. An error stays until the person makes another
// edit, and not only until the next one in the queue is stored. An edit belongs to the run that was open when it was made. `answer` is
// what it says about a tree, null for other edits: the line with Undo belongs to the last edit.
export function edit(work, answer = null) {
  const run = state.annotations?.run;
  Object.assign(draft, { error: "", answer });
  last = last.then(async () => {
    try {
      if (run !== state.annotations?.run) throw new Error("Another run was opened meanwhile: this edit belongs to the one before and was not made.");
      const done = await work();
      if (run !== state.annotations?.run) return done; // the counts are those of the run before
      Object.assign(draft, { undo: done.undo, redo: done.redo });
      await arrived(done.serial);
      return done;
    } catch (error) {
      draft.error = answer && answer.number !== null ? `Tree ${answer.number}: ${error.message}` : error.message; // another card may be shown now
      if (draft.answer === answer) draft.answer = null; // not that of a later edit
      return null;
    } finally {
      news();
    }
  });
  return last;
}

function arrived(serial) {
  return new Promise((resolve) => {
    const ends = performance.now() + PATIENCE;
    const look = () => ((state.annotations?.serial ?? 0) >= serial || performance.now() > ends ? resolve() : setTimeout(look, 20));
    look();
  });
}

// The new annotation is chosen unless another tree was selected meanwhile.
async function add(content) {
  const before = state.selected;
  const given = { kind: "tree", dbh_cm: null, ...content }, known = new Set(rows().map(({ id }) => id));
  const done = await edit(() => call("POST", "", given), { number: null, kind: given.kind, dbh: given.dbh_cm, before: null, place: given });
  if (known.has(done?.id)) draft.answer = null; // another person had added it, so that nothing was stored
  if (done && state.selected === before) choose(done.id);
  return done;
}

// An annotation, also that of a skipped tree.
const storedRow = (id) => [...rows(), ...skips()].find((row) => row.id === id) ?? null;

// Adds an annotation at a place {x, y}, unless there is one within the distance at which two annotations are one thing.
const placing = new Set();
export async function addAt(place) {
  const within = state.annotations?.same_thing_m ?? 0;
  const known = nearest(rows(), (row) => distance(row, place), within);
  if (known) {
    choose(known.id);
    showNews(`An annotation (${known.kind}) is less than ${within} m from there: it is selected, and no second one was added.`);
    return;
  }
  if (nearest(placing, (other) => distance(other, place), within)) return; // the second click of a double click
  placing.add(place);
  await add(place);
  placing.delete(place);
}

// The version of a row as the person saw it, or a later one if only their own edits came between.
function latest({ id, version }) {
  let now = version;
  while (versions.has(`${id}:${now}`)) now = versions.get(`${id}:${now}`);
  return now;
}

export function change(row, fields) {
  const tree = treeOf(treeNumberOf(row)), { x, y, kind, dbh_cm } = { ...row, ...fields };
  const isAnswer = tree && x === row.x && y === row.y;
  return edit(() => patched(row, fields), isAnswer ? { number: tree.number, kind, dbh: dbh_cm, before: row } : null);
}

async function patched(row, fields) {
  const version = latest(row);
  const { x, y, kind, dbh_cm } = { ...row, ...(version === row.version ? {} : storedRow(row.id)), ...fields };
  const done = await call("PATCH", `/${row.id}`, { version, x, y, kind, dbh_cm });
  await arrived(done.serial);
  const now = storedRow(row.id)?.version ?? version;
  if (now !== version) versions.set(`${row.id}:${version}`, now);
  return done;
}

export function remove(row) {
  if (draft.chosen === row.id) draft.chosen = null;
  return edit(() => call("DELETE", `/${row.id}`, { version: latest(row) }));
}

// Undo and redo of a tab: of the edits of its subjects only, so that it takes back nothing that another tab shows.
export function historyOf(...subjects) {
  const any = (edits) => subjects.some((subject) => edits[subject]);
  return {
    undo: () => turn("/undo", "Undone", subjects),
    redo: () => turn("/redo", "Redone", subjects),
    canUndo: () => any(draft.undo),
    canRedo: () => any(draft.redo),
  };
}
export const reviewHistory = historyOf("tree");

const edited = () => ({
  annotation: [...rows(), ...skips()],
  ...state.annotations?.others,
  "coordinate system": [state.annotations?.frame].filter(Boolean),
});

// Tells what the step changed, and selects the tree of a single annotation.
async function turn(where, word, subjects) {
  const run = state.annotations?.run;
  settle(); // queued before
  let before = null;
  const done = await edit(() => {
    before = edited();
    return call("POST", where, { subjects });
  });
  if (!done || run !== state.annotations?.run) return;
  const isUndo = where === "/undo", [older, newer] = isUndo ? [edited(), before] : [before, edited()];
  const changes = Object.keys({ ...older, ...newer }).flatMap((name) => changesOf(name, older[name] ?? [], newer[name] ?? []));
  const single = changes.length === 1 && changes[0].name === "annotation" ? changes[0] : null;
  if (!single) return showNews(`${word}: ${countsText(changes)}.`);
  const now = isUndo ? single.was ?? single.is : single.is ?? single.was;
  const tree = nearest(trees(), (each) => distance(each, now), now.reach_m ?? state.annotations.same_thing_m);
  showNews(`${word}: ${changeText(single, tree)}.`);
  if (tree) select(tree.number);
}

// {name, was, is} of each row that an edit has changed; `was` is undefined for an added row, `is` for a deleted one.
function changesOf(name, older, newer) {
  const [was, is] = [older, newer].map((list) => new Map(list.map((row) => [row.id, row])));
  return [...new Set([...was.keys(), ...is.keys()])].map((id) => ({ name, was: was.get(id), is: is.get(id) }))
    .filter((each) => each.was?.version !== each.is?.version);
}

// "2 annotations added, 1 annotation changed"
function countsText(changes) {
  const did = { added: ({ was }) => !was, changed: ({ was, is }) => was && is, deleted: ({ is }) => !is };
  const parts = [...new Set(changes.map(({ name }) => name))].flatMap((name) => Object.entries(did).map(([verb, holds]) =>
    [changes.filter((each) => each.name === name && holds(each)).length, name, verb]));
  return parts.filter(([number]) => number).map(([number, name, verb]) => `${count(number, name)} ${verb}`).join(", ") || "nothing changed";
}

// What an edit of one annotation did; `tree` is its tree in the map, null for none.
function changeText({ was, is }, tree) {
  const name = tree ? `tree ${tree.number}` : `the ${(was ?? is).kind}`;
  if (!is) return `${tree ? "annotation of " : ""}${name} deleted`;
  if (tree && is.kind === SKIPPED) return `${name} skipped`;
  if (tree && is.kind !== was?.kind && draft.answered.includes(is.id)) return `the answer ${statement(is.kind, is.dbh_cm)} of ${name}`;
  if (!was) return `${is.kind} added${tree ? ` at ${name}` : ""}`;
  if (is.kind !== was.kind) return `class of ${name} changed to ${is.kind}`;
  if (is.dbh_cm !== was.dbh_cm) return `DBH of ${name} ${is.dbh_cm === null ? "removed" : `set to ${is.dbh_cm} cm`}`;
  return `${name} moved`;
}
export const importTable = (table, file, unit, replaces) => edit(() => call("POST", "/import", { table, file: file.slice(0, 300), replaces, dbh_unit: unit || null }));

// --- review of the found trees -------------------------------------------------------------------------------

// {ofTree, treeOf}: the annotation of each found tree by its number, and the number of the tree of each annotation by its id.
// Of the annotations to which a found tree is the nearest one, the nearest that states something belongs to it; the others belong to none.
// A rejection reaches no tree that was another one when it was made (`reach_of` in app/batch/run_edits.py).
const pairs = { map: null, annotations: null, ofTree: new Map(), treeOf: new Map() };

function paired() {
  if (pairs.map === state.map && pairs.annotations === state.annotations) return pairs;
  Object.assign(pairs, { map: state.map, annotations: state.annotations, ofTree: new Map(), treeOf: new Map() });
  for (const row of [...skips(), ...rows()]) {
    const tree = nearest(trees(), (each) => distance(row, each), row.reach_m);
    if (!tree) continue;
    const other = pairs.ofTree.get(tree.number);
    if (!other || other.kind === SKIPPED || distance(row, tree) <= distance(other, tree)) pairs.ofTree.set(tree.number, row);
  }
  for (const [number, row] of pairs.ofTree) pairs.treeOf.set(row.id, number);
  return pairs;
}

export const annotationOf = (tree) => paired().ofTree.get(tree.number) ?? null;
export const treeNumberOf = (row) => paired().treeOf.get(row.id) ?? null;

// Answers that a thing is no tree, whose thing is not in this map: they decide nothing.
export const withoutTree = () => rows().filter((row) => row.kind !== "tree" && treeNumberOf(row) === null);

// Trees that were confirmed in this window, and are not in this map: they count as added ones.
export const confirmedWithoutTree = () => rows().filter((row) => row.kind === "tree" && draft.answered.includes(row.id) && treeNumberOf(row) === null);

// The answer nearest to an open tree that was given for another thing; null without one.
export const answerBeside = (tree) => nearest(withoutTree(), (row) => distance(row, tree), state.annotations.same_thing_m);

// One of STATES.
export function reviewOf(tree) {
  const row = annotationOf(tree);
  if (!row) return "open";
  return row.kind === SKIPPED ? SKIPPED : row.kind === "tree" ? "confirmed" : "rejected";
}

// The diameter by tape of a found tree [cm], which counts in place of that of the map; null without one.
export function tapeOf(tree) {
  const row = annotationOf(tree);
  return row?.kind === "tree" ? row.dbh_cm : null;
}

// The class that N stores: the chosen one, else that of what was rejected before.
export function rejectedKind() {
  const tree = selectedTree(), row = tree ? annotationOf(tree) : rowOf(draft.chosen);
  return draft.kind ?? (row && !["tree", SKIPPED].includes(row.kind) ? row.kind : "other");
}

// How far the votes for a tree are from the share that is needed; the smaller, the more doubtful is the tree.
function margin({ number }) {
  const share = votes.of.get(number)?.votes ?? null;
  return share === null ? Infinity : Math.abs(share - votes.needed);
}

const compared = (a, b) => (a < b ? -1 : a > b ? 1 : 0);

const skippedAt = (tree) => annotationOf(tree)?.at_s ?? 0; // 0: open

// Another person may be answering for it, or has answered a moment ago: the selection arrives before the answer.
const isSelectedByOther = ({ number }) => state.selectedByOthers.includes(number) || leftByOthers.has(number);
const leftByOthers = new Set(); // numbers of the trees that other pages had selected since the last message on annotations
let selectedBefore = [];

function noteOthers() {
  const now = state.selectedByOthers;
  for (const number of selectedBefore) if (!now.includes(number)) leftByOthers.add(number);
  selectedBefore = now;
}

// Found trees that are open or skipped. Open trees come first, sorted by doubt and then by the number of observations; skipped
// trees follow in the order in which they were skipped. Trees that other pages have selected come last.
export const unreviewed = () => trees().filter((tree) => !isReviewed(tree) && !answering.has(tree.number)).sort((a, b) =>
  isSelectedByOther(a) - isSelectedByOther(b) || skippedAt(a) - skippedAt(b) || compared(margin(a), margin(b)) || a.observations - b.observations || a.number - b.number);

export const isReviewed = (tree) => (annotationOf(tree)?.kind ?? SKIPPED) !== SKIPPED;

// Returns the progress of an incomplete review ("3 of 52 trees reviewed"), in which open trees have no verdict yet; else "".
export function reviewProgress() {
  const left = state.annotations?.used === "annotations" ? unreviewed().length : 0;
  return left ? `${trees().length - left} of ${count(trees().length, "tree")} reviewed` : "";
}

export function votesText({ number }) {
  const of = votes.of.get(number);
  if (!of || of.votes === null) return "";
  return `, votes: tree ${share(of.votes)} (${share(votes.needed)} needed), ${of.next} ${share(of.next_votes)}`;
}

const updateVotes = throttled(async () => {
  const answer = await attempted(() => get("/api/doubts"));
  if (!answer) return;
  votes = { needed: answer.needed, of: new Map(answer.trees.map((each) => [each.tree, each])), known: true };
  news();
}, VOTES_EVERY);

// Answers whether the tree on the card is a tree, and goes on to the next one at once. Nothing is answered while the card loads or
// has just come, because the person has not seen that tree yet, or while the answer before is on its way.
export async function review(kind) {
  const tree = selectedTree(), row = rowOf(draft.chosen);
  if (!tree && row) return change(row, { kind }); // an annotation without a tree
  if (!tree) return askForTree();
  await answerIfSeen(tree, kind);
}

export function askForTree() {
  draft.error = "Select a found tree first: click it on the map, or press S for the next one.";
  news();
}

async function answerIfSeen(tree, kind) {
  const { number } = tree;
  if (answering.has(number)) refuse(`the answer before on tree ${number} is being stored`);
  else if (draft.shown !== number) refuse(`tree ${number} was still loading`);
  else if (!isInView(byId("review-title")) || !isInView(byId("review-evidence"))) {
    showCard();
    draft.shownAt = performance.now();
    refuse(`the card of tree ${number} was out of view`);
  } else if (readyIn(tree)) refuse(`tree ${number} ${state.selectedElsewhere ? "was selected elsewhere a moment ago" : "had only just come into view"}`);
  else await answer(tree, kind);
}

// [ms] until the selected tree can be answered; Infinity while its card loads or the answer before is on its way.
export function readyIn({ number }) {
  if (answering.has(number) || draft.shown !== number) return Infinity;
  return Math.max(0, draft.shownAt + (state.selectedElsewhere ? LOOK_UNASKED : LOOK) - performance.now());
}

const REFUSED_FOR = 5000; // [ms] as long as a message of the page: the picture below is to be looked at
let uncovering = 0;

// A reason that is repeated is counted, so that each refused key changes the text.
function refuse(why) {
  draft.refusals = draft.refused.endsWith(`: ${why}.`) ? draft.refusals + 1 : 1;
  draft.refused = `Not counted${draft.refusals > 1 ? ` (${draft.refusals} times)` : ""}: ${why}.`;
  showNews(draft.refused);
  draft.isRefusalShown = true;
  clearTimeout(uncovering);
  uncovering = setTimeout(() => { draft.isRefusalShown = false; news(); }, REFUSED_FOR);
  news();
}

export const refusePlain = () => refuse("Shift+P answers “pole”; P alone has no action here");
export const refuseHeld = () => refuse("a key that is held down answers once");

// Whether the middle of a node is neither scrolled away nor covered, except by the line that tells why an answer did not count.
function isInView(node) {
  const { left, top, width, height } = node.getBoundingClientRect();
  const seen = document.elementsFromPoint(left + width / 2, top + height / 2).find((each) => !each.closest("#problem"));
  return Boolean(seen) && node.contains(seen);
}

// Answers by a click, unless it is the second one of a double click: that was meant for the tree before.
let clickedAt = -Infinity;
export const byClick = (answers) => (event) => {
  const isDouble = event.detail > 0 && event.timeStamp - clickedAt < DOUBLE_CLICK; // 0: by a key
  if (event.detail > 0) clickedAt = event.timeStamp;
  if (isDouble) refuse("the second click of a double click answers nothing");
  else answers();
};

async function answer(tree, kind, fields = {}, goesOn = true) {
  const { number } = tree, seen = annotationOf(tree), run = state.annotations?.run;
  const { dbh_cm = null } = { ...seen, ...fields }, given = { number, kind, dbh: dbh_cm, before: seen };
  Object.assign(draft, { kind: null, refused: "" });
  if (seen && Object.entries({ kind, ...fields }).every(([name, value]) => seen[name] === value)) {
    draft.answer = { ...given, isStored: true };
    if (goesOn && state.selected === number) await next();
    return news();
  }
  answering.add(number);
  const stored = edit(async () => {
    const row = annotationOf(tree); // after the edits before this one
    const isSeen = row && row.id === seen?.id && row.version === latest(seen);
    if (row && !isSeen && row.by !== myName()) throw new Error(`it was annotated by ${row.by} meanwhile; your answer was not stored.`);
    return row ? patched(row, row.kind === SKIPPED ? { x: tree.x, y: tree.y, kind, ...fields } : { kind, ...fields })
      : call("POST", "", { x: tree.x, y: tree.y, kind, dbh_cm: null, ...fields });
  }, given);
  try {
    if (goesOn && state.selected === number) await next();
    const done = await stored;
    if (done && run === state.annotations?.run) keepAnswered(done.id);
  } finally {
    answering.delete(number);
    news();
  }
}

// Returns a typed DBH [cm], null for an empty text, or undefined and shows an error.
export function typedDbh(typed) {
  const text = typed.trim().replace(/\s*cm$/i, "").replace(",", "."), value = text === "" ? null : Number(text);
  if (value === null || (value > 0 && value <= LARGEST_DBH)) return value;
  draft.error = `“${text.slice(0, 30)}” is not a DBH: enter centimetres above 0 and up to ${LARGEST_DBH}, or nothing if it was not measured.`;
  news();
  return undefined;
}

// Stores the DBH of a found tree [cm], which confirms it; without one, its class stays.
export function measureDbh(tree, dbh, goesOn) {
  const row = annotationOf(tree);
  if (row ? row.dbh_cm === dbh : dbh === null) return null;
  return answer(tree, dbh === null ? row.kind : "tree", { dbh_cm: dbh }, goesOn);
}

// Whether Next marks the tree as skipped: an open one that no other page has selected.
export const isSkippable = (tree) => reviewOf(tree) === "open" && !isSelectedByOther(tree);

// Marks the tree on the card as skipped if it is open, and goes on to the next one.
export async function skip() {
  const tree = selectedTree();
  draft.error = "";
  if (!tree || !isSkippable(tree) || answering.has(tree.number)) await next();
  else await answerIfSeen(tree, SKIPPED);
}

// Selects the most doubtful open tree that no page has selected; without one, the tree that follows the selected one.
// The order needs the votes: a key pressed before they have arrived waits for them.
async function next() {
  if (!votes.known) await updateVotes.now();
  const [tree] = following();
  lookAt(tree);
  offered = tree && !isSelectedByOther(tree) ? tree.number : null;
}

// Two people may come to one tree within the time of a message: it is left to whose selection came first.
let offered = null; // number of the tree to which the review came, until the server tells whose selection was the first
function giveWay() {
  if (state.isOtherFirst === null || state.selected !== offered) return;
  offered = null;
  if (state.isOtherFirst) next();
}

// Shows a tree in the review; none stays where the review is.
export function lookAt(tree) {
  draft.chosen = null;
  if (tree) select(tree.number);
  showCard();
  draft.look = tree;
  news();
}

// Brings title and pictures of the card into view; the title also where both do not fit.
export function showCard() {
  byId("panel-annotate").scrollTop = 0;
  for (const id of ["review-evidence", "review-title"]) byId(id).scrollIntoView({ block: "nearest" });
}

// The trees that the review shows after the selected one, the next one first.
export function following() {
  const left = unreviewed(), at = left.findIndex(({ number }) => number === state.selected);
  const open = left.filter((each) => each.number !== state.selected && reviewOf(each) === "open" && !isSelectedByOther(each));
  return open.length ? open : [...left.slice(at + 1), ...left.slice(0, at + 1)];
}

// Selects the tree that was answered before the selected one; the newest answer if the selected tree has none.
export function previous() {
  const numbers = answeredTrees().map(({ number }) => number), at = numbers.indexOf(state.selected);
  const tree = treeOf(numbers.at(at < 0 ? -1 : Math.max(0, at - 1)));
  if (tree) lookAt(tree);
}

// The last trees of the map that were answered in this window, the newest last; those whose answer was undone are open again. The ids
// of their annotations are kept until the window is closed: a rerun changes the numbers of trees, and `who` of an annotation changes
// when the person gives a name and may also be that of imported ones.
export function answeredTrees() {
  const stored = draft.answered.map((id) => treeNumberOf({ id })).filter((number) => !answering.has(number));
  return [...new Set([...stored, ...answering])].map(treeOf).filter(Boolean);
}

// Tells when another person has replaced an answer of this window.
let answers = new Map(); // of this window, by the id of the annotation
function tellReplaced() {
  const now = new Map(rows().filter((row) => draft.answered.includes(row.id)).map((row) => [row.id, row]));
  for (const [id, row] of now) {
    const was = answers.get(id), isOther = was && (was.kind !== row.kind || was.dbh_cm !== row.dbh_cm);
    if (isOther && row.by !== myName()) showNews(`${capital(treeNumberOf(row) === null ? "your annotation" : `tree ${treeNumberOf(row)}`)}: ${statement(row.kind, row.dbh_cm)} by ${row.by}, in place of ${statement(was.kind, was.dbh_cm)}.`);
  }
  answers = now;
}

const answeredIn = (run) => JSON.parse(recall(`answered.${run}`, "sessionStorage") ?? "[]");

function keepAnswered(id) {
  draft.answered = [...draft.answered.filter((each) => each !== id), id].slice(-MOST_ANSWERED);
  if (rowOf(id)) answers.set(id, rowOf(id)); // it has come before its number
  remember(`answered.${state.annotations.run}`, JSON.stringify(draft.answered), "sessionStorage");
}

const statement = (kind, dbh) => (dbh === null ? kind : `${kind}, ${dbh} cm`);

// What the last edit said about a tree ("Tree 40: tree, 31.5 cm"); "" if it said nothing about one.
export function answerText() {
  if (!draft.answer) return "";
  const { number, kind, dbh, isStored } = draft.answer;
  if (number === null) return `Added: ${statement(kind, dbh)} at ${placeTexts([draft.answer.place.x, draft.answer.place.y]).join(", ")}`;
  const mapped = kind === "tree" && dbh !== null ? treeOf(number)?.dbh_cm ?? null : null;
  return `Tree ${number}: ${statement(kind, dbh)}${mapped === null ? "" : ` (map ${dbhFigure(mapped, treeOf(number).sigma_dbh_cm)} cm)`}${isStored ? ", as before" : ""}${replacedText(draft.answer)}`;
}

// The answer that this one replaced, with the name of another person.
function replacedText({ before, kind, dbh, isStored }) {
  const isOther = before && (before.kind !== kind || (before.dbh_cm !== null && before.dbh_cm !== dbh));
  return isStored || !isOther || before.kind === SKIPPED ? "" : ` (before: ${statement(before.kind, before.dbh_cm)}${byOther(before)})`;
}

export const authorsText = ({ who, dbh_who: of }) => (!of || of === who ? who : `${who}, DBH ${of}`);
export const byOther = (row) => ([row.who, row.dbh_who || row.who].every((who) => who === myName()) ? "" : ` by ${authorsText(row)}`);

// Why a typed DBH [cm] is doubtful, see `is_doubtful_dbh` in app/dashboard/annotations.py; "" if it is not. `tree` is the found tree, null
// without one.
export function typedDoubt(tree, dbh) {
  if (dbh === null || !state.annotations) return "";
  const { sigmas, tape_sigma_cm: own } = state.annotations.doubt;
  const mapped = tree?.dbh_cm ?? null, sigma = tree?.sigma_dbh_cm ?? 0;
  if (mapped !== null) return Math.abs(dbh - mapped) <= sigmas * Math.hypot(sigma, own) ? "" : `The map has ${dbhFigure(mapped, sigma)} cm. Was it typed in cm?`;
  const { least, most, isOfMap } = usualDbh();
  if (dbh >= least && dbh <= most) return "";
  const [word, limit] = dbh < least ? ["thinner", least] : ["thicker", most];
  return `${isOfMap ? `No mapped stem is ${word} than ${figure(limit)}` : `Few stems are ${word} than ${limit}`} cm. Is it right, in cm?`;
}

// The range of diameters [cm] that are not asked about where the map has none, see `usual_dbh` in app/dashboard/annotations.py.
function usualDbh() {
  const { usual_cm: [least, most], fewest } = state.annotations.doubt;
  const mapped = trees().map((tree) => tree.dbh_cm).filter((dbh) => dbh !== null);
  return mapped.length < fewest ? { least, most, isOfMap: false } : { least: Math.min(...mapped), most: Math.max(...mapped), isOfMap: true };
}

// --- the chosen annotation -------------------------------------------------------------------------------------

// There is one selection: with an annotation its tree is selected, without a tree none is.
export function choose(id) {
  const row = rowOf(id);
  if (row) select(treeNumberOf(row));
  if (id !== draft.chosen) draft.kind = null;
  Object.assign(draft, { chosen: id, error: "" });
  keepOneSelection();
  news();
}

// What was chosen or said for one tree does not hold for the next one.
let asked = null; // number of the tree
function forgetTreeBefore() {
  if (state.selected !== asked) Object.assign(draft, { kind: null, refused: "" });
  asked = state.selected;
}

// An annotation that is being moved stays chosen.
function keepOneSelection() {
  const row = rowOf(draft.chosen);
  if (!row || (draft.moved?.id !== row.id && treeNumberOf(row) !== state.selected)) draft.chosen = null;
}

export function toggleAdding(wanted = !draft.adding) {
  Object.assign(draft, { adding: wanted, place: null, error: "" });
  news();
}

export function nudge(dx, dy) {
  const row = rowOf(draft.chosen);
  if (!row) return;
  const from = draft.moved ?? row;
  Object.assign(draft, { answer: null, moved: { id: row.id, row: draft.moved?.row ?? row, x: from.x + dx, y: from.y + dy } });
  clearTimeout(nudging);
  nudging = setTimeout(settle, NUDGE_WAIT);
  news();
}

// Sends the moved annotation.
export async function settle() {
  clearTimeout(nudging);
  const moved = draft.moved;
  if (!moved) return;
  const done = await change(moved.row, { x: Math.round(moved.x * 1e4) / 1e4, y: Math.round(moved.y * 1e4) / 1e4 });
  if (done && draft.chosen === moved.id) choose(moved.id); // it may belong to another tree now
  if (draft.moved === moved) draft.moved = null;
  news();
}

export function truthText() {
  const number = rows().length;
  return {
    source: `Scored against the ground truth of this run${number ? "; annotations do not count" : ""}.`,
    annotations: reviewProgress() ? `Scored against the annotations; ${reviewProgress()}. The other scores are shown once all found trees are reviewed.` : "Scored against the annotations.",
    both: `Scored against the ground truth of this run, corrected by ${count(number, "annotation")}.`,
  }[state.annotations?.used] ?? "";
}

// `end` comes after the text.
export function contradictionText(end) {
  const number = contradicting().length;
  return number ? `${count(number, "annotation")} ${number === 1 ? "contradicts" : "contradict"} the ground truth of this run and ${number === 1 ? "replaces" : "replace"} it there${end}` : "";
}

// The annotations that contradict the ground truth of the run where both are used.
export const contradicting = () => (state.annotations?.used === "both" ? state.annotations.contradicting.map(rowOf).filter(Boolean) : []);

export const scoreAgainst = (against) => attempted(() => put("/api/annotations/against", { against }));

async function updateUndo() {
  const answer = await attempted(() => get(`/api/annotations?browser=${me}`));
  if (answer) Object.assign(draft, { undo: answer.undo, redo: answer.redo });
  news();
}

export function startAnnotating() {
  signAs(myName());
  let run = null;
  on("annotations", () => {
    if (state.annotations.run !== run) {
      run = state.annotations.run;
      Object.assign(draft, { moved: null, error: "", answer: null, answered: answeredIn(run) });
      versions.clear();
      votes = NO_VOTES;
      updateUndo();
    }
    news();
  });
  on("annotations", tellReplaced);
  on("annotations map selection", keepOneSelection);
  on("selection", forgetTreeBefore);
  on("others", noteOthers);
  on("others", giveWay);
  on("annotations", () => leftByOthers.clear());
  on("tab", () => {
    state.keepsSelection = annotating() || visible("repair");
    if (annotating()) showCard();
  });
  on("remapped", () => { votes = NO_VOTES; }); // numbers may belong to other trees now
  on("map tab", () => { if (annotating()) updateVotes(); });
  on("tab", () => annotating() || !draft.adding || toggleAdding(false));
}
