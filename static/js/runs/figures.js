// Texts of the figures of a run, for the list, the detail and the comparison.

import { figure, NONE, percent } from "../core/format.js";

const DAY = { year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit" };

export const when = (seconds) => (seconds ? new Date(1000 * seconds).toLocaleString("sv-SE", DAY) : NONE);
export const shortSource = (uri) => (uri ?? "").split("/").filter(Boolean).pop() ?? "";
export const scans = (run) => (run.all_scans && run.scans < run.all_scans ? `${run.scans} of ${run.all_scans}` : String(run.scans));
const centimetres = (metres) => (typeof metres === "number" ? `${figure(100 * metres)} cm` : NONE);
const rate = (of) => (of?.of ? `${percent(of.rate)} (${of.count} of ${of.of})` : NONE);

// lost: share of the scans in which the pose was lost.
export const FIGURES = [
  ["scans", scans],
  ["driven", (run) => `${figure(run.distance_m)} m`],
  ["pose lost", (run) => percent(run.lost)],
  ["trees", (run) => (run.rejected ? `${run.trees}, ${run.rejected} rejected` : String(run.trees))],
  ["F1", (run) => figure(run.scores?.f1)],
];

export const SCORES = [
  ["TA, trees found", (s) => rate(s.TA)],
  ["FR, trees missed", (s) => rate(s.FR)],
  ["TR, others rejected", (s) => rate(s.TR)],
  ["FA, others accepted", (s) => rate(s.FA)],
  ["completeness", (s) => percent(s.completeness)],
  ["correctness", (s) => percent(s.correctness)],
  ["F1", (s) => figure(s.f1)],
  ["position RMSE", (s) => centimetres(s.position_rmse_m)],
  ["DBH RMSE", (s) => (typeof s.dbh_rmse_cm === "number" ? `${figure(s.dbh_rmse_cm)} cm` : NONE)],
  ["mean error of pair distances", (s) => (typeof s.mean_pair_error_percent === "number" ? `${figure(s.mean_pair_error_percent)} %` : NONE)],
];
