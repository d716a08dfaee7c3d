// Over which other runs of the list a search goes, which are held out, and how both were mapped.

import { el } from "./dom.js";
import { count, percent } from "./format.js";

const USES = [["", "not used"], ["also", "searched too"], ["held_out", "held out"]];
const chosen = new Map(); // by the record's number: "also" or "held_out"
const rows = el("ul", { id: "search-runs", "aria-label": "Other runs of the list" });
const note = el("p", { class: "note dim" });
export const otherRuns = el("fieldset", { class: "search-others", hidden: true },
  el("legend", { text: "Other runs", title: "Searched over beside this run, or only scored beside: what was not searched over tells whether the set suits other places" }), rows, note);

export function showRuns(runs = []) {
  const usable = runs.filter(({ why_not: why }) => !why);
  for (const record of chosen.keys()) if (!usable.some((run) => run.record === record)) chosen.delete(record);
  rows.replaceChildren(...usable.map(({ record, name, truth }) => {
    const use = el("select", { "aria-label": `What to do with ${name}`, onchange: () => (use.value ? chosen.set(record, use.value) : chosen.delete(record)) },
      ...USES.map(([value, text]) => el("option", { value, text })));
    use.value = chosen.get(record) ?? "";
    return el("li", { "data-run": String(record), title: name }, el("span", {}, name, el("small", { class: "dim", text: truth })), use);
  }));
  const reasons = new Map();
  for (const { name, why_not: why } of runs) if (why) reasons.set(why, [...(reasons.get(why) ?? []), name]);
  note.replaceChildren(...[...reasons].map(([why, names]) => el("span", { title: names.join("\n"), text: `${count(names.length, "run")} cannot be judged: ${why}. ` })));
  note.hidden = !reasons.size;
  rows.hidden = !usable.length;
  otherRuns.hidden = !runs.length;
}

export const runsWanted = () => ({ also: of("also"), held_out: of("held_out") });
const of = (use) => [...chosen].filter(([, value]) => value === use).map(([record]) => record);

// Before and with the best set so far: the runs searched over, and those held out.
export function scoresTable({ scores = [], label }) {
  if (!scores.length || (scores.length === 1 && scores[0].runs === 1)) return null;
  const third = { RMSE: ["RMSE [cm]", "rmse_cm", (v) => v.toFixed(1)], "pair error": ["pairs [%]", "pair_error_percent", (v) => v.toFixed(2)] }[label] ?? ["TA", "TA", percent];
  const columns = [["F1", "f1", (v) => v.toFixed(3)], third, ["false", "false_share", percent]];
  const cell = ({ start, best }, [, key, shown]) => el("td", {}, ...[start, best].flatMap((of, k) => [k ? " → " : "", of[key] === undefined || of[key] === null ? "–" : shown(of[key])]));
  return el("table", { id: "search-scores", title: "With the values it began with → with the best set so far" },
    el("tr", {}, el("th", { text: "" }), ...columns.map(([text]) => el("th", { scope: "col", text }))),
    ...scores.map((row) => el("tr", { "data-held-out": String(row.held_out) }, el("th", { scope: "row", text: `${row.held_out ? "held out" : "searched"}, ${count(row.runs, "run")}` }), ...columns.map((column) => cell(row, column)))));
}
