// The tab Scores: the map against the ground truth. Each rate is shown with its counts.

import { contradictionText, reviewProgress, scoreAgainst, truthText } from "../annotate/annotations.js";
import { byId, definitions, el } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { capital, count, figure, NONE, percent } from "../core/format.js";
import { isDrive, on, state } from "../core/store.js";
import { openSources } from "../open/dialog.js";
import { throttled } from "../core/timing.js";
import { visible } from "../shell/tabs.js";

const EVERY = 300; // [ms] between two updates

const RATES = {
  TA: ["TA  trees found", "True acceptance: of the trees of the ground truth near the path, those that are in the map"],
  FR: ["FR  trees missed", "False rejection: of the trees of the ground truth near the path, those that are missing in the map"],
  TR: ["TR  others rejected", "True rejection: poles, persons, bushes and other objects of the ground truth that are not in the map"],
  FA: ["FA  others accepted", "False acceptance: other objects of the ground truth that are in the map as trees"],
};
const centimetres = (value) => (value === null ? NONE : `${figure(value)} cm`);
const inCentimetres = (metres) => (metres === null ? NONE : centimetres(100 * metres));
const percentOf = (value) => (value === null ? NONE : `${figure(value)} %`);

const SPURIOUS = "mapped trees that match no object";
const BY_REVIEW = ["completeness", "correctness", "F1", SPURIOUS]; // of a complete review only
const LINES = [
  ["completeness", (s) => percent(s.completeness)],
  ["correctness", (s) => percent(s.correctness)],
  ["F1", (s) => figure(s.f1)],
  [SPURIOUS, (s) => String(s.spurious)],
  ["position RMSE", (s) => inCentimetres(s.position_rmse_m)],
  ["position bias", (s) => inCentimetres(s.position_bias_m)],
  ["DBH RMSE", (s) => centimetres(s.dbh_rmse_cm)],
  ["DBH bias", (s) => centimetres(s.dbh_bias_cm)],
  ["mean error of pair distances", (s) => percentOf(s.mean_pair_error_percent)],
  ["largest error of pair distances", (s) => percentOf(s.largest_pair_error_percent)],
];

function show() {
  if (!visible("scores")) return;
  const score = state.evaluation;
  byId("panel-scores").replaceChildren(...(score ? [el("p", { class: "lead", id: "truth-used", text: [truthText(), contradictionText("; the tab Annotate lists them.")].filter(Boolean).join(" ") }), doubt(score), rates(score), counted(score), lines(score)] : [nothing()]));
}

// A warning that so few trees match that the ground truth may belong to another place.
function doubt({ warning }) {
  return el("p", { class: "note", id: "truth-doubt", role: "status", hidden: !warning, text: warning ? `▲ ${capital(warning)}` : "" });
}

function rates(score) {
  return el("dl", { class: "rates" }, ...Object.entries(RATES).map(([name, [words, meaning]]) => {
    const { count, of, rate } = score[name];
    return el("div", { "data-rate": name, title: meaning }, el("dt", { text: words }),
      el("dd", {}, el("b", { text: of ? percent(rate ?? count / of) : NONE }), el("small", { text: `${count} of ${of}` })));
  }));
}

// A drive is scored near its path only, so the counts can be smaller than the numbers of true and mapped trees.
function counted({ reach_m: reach, beyond }) {
  const left = beyond ? ` ${count(beyond, "object of the ground truth is farther and does", "objects of the ground truth are farther and do")} not count.` : "";
  return !isDrive() ? "" : el("p", { class: "note dim", text: `Counted: what is within ${reach} m of the path (Tune, Evaluation, Reach).${left}` });
}

function lines(score) {
  const progress = reviewProgress();
  return definitions(LINES.map(([title, text]) => [title, progress && BY_REVIEW.includes(title) ? progress : text(score)]));
}

function nothing() {
  if (!state.map) return el("p", { class: "empty", text: nothingYet() });
  return el("div", { class: "empty" },
    el("p", { text: state.annotations?.own == null
      ? "This run has no ground truth to score the map against. Annotate trees or import measured ones (CSV) in Annotate, or open a simulated run."
      : "The map is to be scored against annotations only, and there are none. Annotate trees, or score against the ground truth of the run." }),
    state.annotations?.own == null ? el("button", { text: "Open a simulated run", onclick: openSources })
      : el("button", { text: "Score against ground truth and annotations", onclick: () => scoreAgainst("both") }));
}

export function startScores() {
  on("evaluation truth annotations tab phase map", throttled(show, EVERY));
}
