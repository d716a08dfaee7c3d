// The map against the ground truth: rates never without their counts.

import { scoreAgainst, truthInWords, warnedInWords } from "../annotate/annotations.js";
import { byId, el } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { figure, NONE, percent } from "../core/format.js";
import { on, state } from "../core/store.js";
import { openSources } from "../open/dialog.js";
import { visible } from "../shell/tabs.js";

const RATES = {
  TA: ["TA  trees found", "True acceptance: trees of the ground truth that the map has too"],
  FR: ["FR  trees missed", "False rejection: trees of the ground truth that the map has not"],
  TR: ["TR  others left out", "True rejection: poles, persons, bushes and other things of the ground truth that the map has not"],
  FA: ["FA  others taken for trees", "False acceptance: other things of the ground truth that the map has as trees"],
};
const centimetres = (value) => (value === null ? NONE : `${figure(value)} cm`);
const inCentimetres = (metres) => (metres === null ? NONE : centimetres(100 * metres));
const percentOf = (value) => (value === null ? NONE : `${figure(value)} %`);

const LINES = [
  ["completeness", (s) => percent(s.completeness)],
  ["correctness", (s) => percent(s.correctness)],
  ["F1", (s) => figure(s.f1)],
  ["trees where nothing stands", (s) => String(s.spurious)],
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
  byId("panel-scores").replaceChildren(...(score ? [el("p", { class: "lead", id: "truth-used", text: [truthInWords(), warnedInWords()].filter(Boolean).join(" ") }), doubt(score), rates(score), lines(score)] : [nothing()]));
}

// So few trees match that the truth may be of another forest.
function doubt({ warning }) {
  return el("p", { class: "note", id: "truth-doubt", role: "status", hidden: !warning, text: warning ? `▲ ${warning.charAt(0).toUpperCase()}${warning.slice(1)}` : "" });
}

function rates(score) {
  return el("dl", { class: "rates" }, ...Object.entries(RATES).map(([name, [words, meaning]]) => {
    const { count, of, rate } = score[name];
    return el("div", { "data-rate": name, title: meaning }, el("dt", { text: words }),
      el("dd", {}, el("b", { text: of ? percent(rate ?? count / of) : NONE }), el("small", { text: `${count} of ${of}` })));
  }));
}

function lines(score) {
  return el("dl", { class: "list" }, ...LINES.flatMap(([title, text]) => [el("dt", { text: title }), el("dd", { text: text(score) })]));
}

function nothing() {
  if (!state.map) return el("p", { class: "empty", text: nothingYet() });
  return el("div", { class: "empty" },
    el("p", { text: state.annotations?.own == null
      ? "This run brings no ground truth, so there is nothing to score the map against. Annotate the trees, or open a simulated run."
      : "Nothing is annotated yet, and annotations alone were chosen to score against. Annotate the trees, or let the run's own truth count." }),
    state.annotations?.own == null ? el("button", { text: "Open a simulated run", onclick: openSources })
      : el("button", { text: "Score against its truth and annotations", onclick: () => scoreAgainst("both") }));
}

export function startScores() {
  on("evaluation truth annotations tab phase", show);
}
