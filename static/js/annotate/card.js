// The review card of the tab Annotate: what is known of the selected tree. The figures are those of its story.

import { get } from "../core/api.js";
import { button, byId, el, setText } from "../core/dom.js";
import { capital, figure } from "../core/format.js";
import { showNews } from "../core/problem.js";
import { on, selectedTree, state, treeOf } from "../core/store.js";
import { keepFresh, throttled } from "../core/timing.js";
import { columnFigure } from "../explain/columns.js";
import { gatheredFigure } from "../explain/gathered.js";
import { ofExtensions } from "../shell/extensions.js";
import { openTab } from "../shell/tabs.js";
import { annotating, annotationOf, askForTree, byOther, draft, following, isSkippable, measureDbh, news, readyIn, reviewOf, showCard, typedDbh, typedDoubt } from "./annotations.js";

const EVERY = 1000; // [ms] between two updates while the run plays
const PAUSE = 100; // [ms] between two requests
const AHEAD = 2; // trees whose stories are loaded ahead
const TO_READ = 500; // [ms] from a question to the earliest answer: two fixations of a reader, each about 250 ms (Rayner 1998)
const KEPT = 4; // trees whose stories are loaded ahead or shown
let shown = "", pictured = null; // version of the shown evidence; number of the tree of the camera picture
const stories = new Map(); // of each subject the newest story: {index of the scan, promise}

const evidence = () => byId("review-evidence");

// The card: picture, question and answers side by side, so that all are in view at once. `answers` and `hint` are visible without
// a selected tree, too.
export const card = (answers, hint) => el("article", { id: "review", class: "review", "aria-labelledby": "review-title" },
  el("div", { id: "review-evidence" }),
  el("p", { id: "review-refused", class: "review-refused", hidden: true }),
  el("div", { class: "review-side" },
    el("h2", {}, el("span", { id: "review-title" }), " ", el("span", { id: "review-state", class: "review-state" }),
      button("review-story", "Story", "Why the mapping decided so, with the figures behind it", () => openTab("story"), "quiet small")),
    answers),
  hint);

// What else is known of the tree.
export const moreEvidence = () => el("section", { id: "review-more", class: "review-more", "aria-label": "Further evidence on the tree" },
  el("label", { id: "review-tape", class: "review-dbh", title: "A reference for the scores, which confirms the tree; the diameter in the map does not change" }, el("span", { id: "review-dbh-title" }), " ", el("input", { id: "review-dbh", type: "text", inputmode: "decimal", autocomplete: "off", "aria-describedby": "review-dbh-error", onchange: takeDbh, onkeydown: endDbh }), el("span", { id: "review-dbh-error", class: "error" })),
  el("figure", { id: "review-camera", hidden: true }, el("figcaption", { text: "Camera" }), el("img", { alt: "" })),
  el("div", { id: "review-votes" }));

const subjectOf = (number) => `${state.annotations?.run} ${number} ${state.parameters?.revision} ${state.remapped?.revision}`;

// {index, promise, explanation}: the story of a tree at this scan, or, for `atAnyScan`, one that was loaded ahead while the run
// plays on; `explanation` is null until it has come.
function story(number, atAnyScan = false) {
  const subject = subjectOf(number), { index } = state.map;
  let kept = stories.get(subject);
  if (!kept || (!atAnyScan && kept.index !== index)) {
    kept = { index, promise: get(`/api/story/tree/${number}`), explanation: null };
    stories.delete(subject);
    stories.set(subject, kept);
    kept.promise.then((explanation) => { kept.explanation = explanation; }, () => stories.get(subject) === kept && stories.delete(subject));
    for (const old of [...stories.keys()].slice(0, -KEPT)) stories.delete(old);
  }
  return kept;
}

const refresh = keepFresh(async () => {
  const tree = annotating() ? selectedTree() : null;
  if (!tree) return;
  const { number } = tree, subject = subjectOf(number);
  if (`${subject} ${state.map.index}` === shown) return;
  try {
    const kept = story(number, evidence().dataset.tree !== String(number));
    await kept.promise;
    if (state.selected !== number) return; // another tree was selected meanwhile, or none
    showStory(number, kept);
  } catch (error) {
    if (state.selected === number) showEvidence(number, "", el("p", { class: "empty", text: capital(error.message) }));
  }
  if (shown && shown !== `${subject} ${state.map?.index}`) again(); // it was loaded ahead, at an earlier scan
  loadAhead();
}, PAUSE);

function loadAhead() {
  for (const { number } of following().slice(0, AHEAD)) story(number, true).promise.catch(() => undefined); // the card shows its error when it comes to it
}

function showStory(number, { index, explanation }) {
  const [figures] = ofExtensions("treeEvidence", explanation);
  const votes = figures ? "" : columnFigure(explanation.column, "Votes on the accumulated scans");
  showEvidence(number, `${subjectOf(number)} ${index}`, figures ?? gatheredFigure(explanation), votes);
}

function showEvidence(number, version, points, votes = "") {
  shown = version;
  evidence().replaceChildren(points);
  byId("review-votes").replaceChildren(votes);
  evidence().dataset.tree = String(number);
  fillCard();
}

// What was loaded ahead is shown at once.
function select() {
  const tree = annotating() ? selectedTree() : null;
  const kept = tree && evidence().dataset.tree !== String(tree.number) ? stories.get(subjectOf(tree.number)) : null;
  if (kept?.explanation) {
    showStory(tree.number, kept);
    loadAhead();
  }
  refresh();
}

const again = throttled(refresh, EVERY);

// The selection may have changed when a person leaves the field: its DBH belongs to the tree that the field shows.
function takeDbh({ target }) {
  const tree = treeOf(Number(target.dataset.tree)), dbh = checkedDbh(target);
  if (!tree || dbh === undefined) return;
  const doubt = isEntered ? "" : typedDoubt(tree, dbh); // Enter has asked
  if (doubt) {
    showDbh(tree);
    showNews(`The DBH ${dbh} cm of tree ${tree.number} was not stored. ${doubt} Type it again and press Enter twice to store it.`);
  } else {
    measureDbh(tree, dbh, isEntered);
  }
}

// Returns whether a doubtful DBH must be confirmed by a second Enter, which counts from TO_READ after the question on.
let askedAt = 0; // [ms] time of the question
function isQuestioned(input, tree) {
  const dbh = checkedDbh(input), doubt = tree && dbh !== undefined ? typedDoubt(tree, dbh) : "";
  if (!doubt || dbh === annotationOf(tree)?.dbh_cm) return false;
  const isAsked = input.dataset.asked === input.value;
  if (isAsked && performance.now() > askedAt + TO_READ) return false;
  if (!isAsked) askedAt = performance.now();
  draft.error = "";
  input.dataset.asked = input.value;
  input.setAttribute("aria-invalid", "true");
  setText(byId("review-dbh-error"), `${doubt} Press Enter again to store ${dbh} cm, Escape to restore it.`);
  byId("review-dbh-error").scrollIntoView({ block: "nearest" });
  return true;
}

// A text that cannot be read as a DBH stays in the field, with the error beside it.
function checkedDbh(input) {
  const dbh = typedDbh(input.value);
  input.setAttribute("aria-invalid", String(dbh === undefined));
  setText(byId("review-dbh-error"), dbh === undefined ? draft.error : "");
  if (dbh === undefined) byId("review-dbh-error").scrollIntoView({ block: "nearest" });
  return dbh;
}

// Enter stores the DBH as an answer, Escape restores it; both give the keys back to the review.
let isEntered = false;
function endDbh(event) {
  const { key, target } = event, tree = treeOf(Number(target.dataset.tree));
  if (key === "d" && event.repeat) event.preventDefault(); // the key that has opened the field is still held down
  if (key !== "Enter" && key !== "Escape") return;
  event.preventDefault();
  if (event.repeat) return; // a held key answers once
  draft.error = "";
  if (key === "Escape") showDbh(tree);
  else if (checkedDbh(target) === undefined || isQuestioned(target, tree)) return;
  isEntered = key === "Enter";
  target.blur(); // calls takeDbh if the text was changed
  isEntered = false;
  showCard();
  draft.shownAt = performance.now(); // the card may have been out of view
  news();
}

export function typeDbh() {
  if (!selectedTree()) return askForTree();
  byId("review-dbh").focus();
  byId("review-dbh").select();
}

function showDbh(tree) {
  const input = byId("review-dbh"), dbh = (tree && annotationOf(tree)?.dbh_cm) ?? null;
  input.value = dbh === null ? "" : String(dbh);
  input.setAttribute("aria-invalid", "false");
  input.dataset.asked = "";
  setText(byId("review-dbh-error"), "");
}

function fillDbh(tree) {
  const input = byId("review-dbh"), isOther = input.dataset.tree !== String(tree.number);
  if (!isOther && (input === document.activeElement || input.getAttribute("aria-invalid") === "true")) return; // a person types
  input.dataset.tree = String(tree.number);
  setText(byId("review-dbh-title"), `DBH by tape of tree ${tree.number} in cm (D)`);
  showDbh(tree);
  input.placeholder = tree.dbh_cm === null ? "" : `mapped ${figure(tree.dbh_cm)}`;
}

// The camera picture is requested once for each selection.
function requestPicture(number) {
  if (pictured === number) return;
  pictured = number;
  const box = byId("review-camera"), image = box.querySelector("img");
  box.hidden = true;
  if (!state.status?.camera) return;
  image.onload = () => { box.hidden = pictured !== number; };
  image.alt = `Tree ${number} in the camera picture`;
  image.src = `/api/camera/tree/${number}.jpg`;
}

// The answers are drawn as disabled while they do not count; a press tells why.
let readying = 0;
function showReady() {
  const tree = selectedTree(), wait = tree ? readyIn(tree) : 0;
  for (const id of ["yes", "no"]) byId(`annotate-${id}`).setAttribute("aria-disabled", String(wait > 0));
  byId("annotate-next").setAttribute("aria-disabled", String(wait > 0 && isSkippable(tree)));
  clearTimeout(readying);
  if (wait > 0 && wait < Infinity) readying = setTimeout(showReady, wait);
}

// Evidence of another tree stays visible but dimmed until that of the selected one arrives.
export function fillCard() {
  const tree = selectedTree();
  byId("review").classList.toggle("empty-card", !tree);
  for (const id of ["review-more", "review-tape"]) byId(id).hidden = !tree;
  byId("review-refused").hidden = !tree || !draft.refused || !draft.isRefusalShown;
  setText(byId("review-refused"), draft.refused);
  if (!tree) {
    shown = "";
    pictured = draft.shown = null;
    delete evidence().dataset.tree; // a tree of another run may have its number
    return showReady();
  }
  const old = evidence().dataset.tree !== String(tree.number), review = reviewOf(tree);
  const before = draft.shown;
  draft.shown = old ? null : tree.number;
  if (draft.shown !== before) {
    draft.shownAt = Infinity; // until it is drawn
    requestAnimationFrame(() => { draft.shownAt = performance.now(); showReady(); });
  }
  setText(byId("review-title"), `Tree ${tree.number}${old ? ": loading …" : ""}`);
  setText(byId("review-state"), `${review === "rejected" ? `rejected: ${annotationOf(tree).kind}` : review}${["open", "skipped"].includes(review) ? "" : byOther(annotationOf(tree))}`);
  Object.assign(byId("review-state"), { title: byId("review-state").textContent }).dataset.state = review;
  for (const id of ["review", "review-more"]) byId(id).classList.toggle("loading", old);
  byId("review").setAttribute("aria-busy", String(old));
  fillDbh(tree);
  requestPicture(tree.number);
  showReady();
}

// The DBH is beside the picture where that is high enough, else below the answers. It does not move while a person types.
const hasRoom = matchMedia("(min-width: 701px) and (min-height: 840px)");
function placeDbh() {
  const field = byId("review-tape");
  if (field.contains(document.activeElement)) return field.addEventListener("focusout", () => setTimeout(placeDbh), { once: true });
  return hasRoom.matches ? document.querySelector(".review-side").append(field) : byId("review-more").prepend(field);
}

export function startCard() {
  hasRoom.addEventListener("change", placeDbh);
  placeDbh();
  on("map", throttled(refresh, EVERY));
  on("tab selection", select);
  on("others", () => { if (annotating() && selectedTree()) loadAhead(); });
}
