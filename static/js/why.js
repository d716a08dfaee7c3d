// Why: what became of the points and clusters of this scan.

import { byId, el } from "./dom.js";
import { count } from "./format.js";
import { on, state } from "./state.js";
import { visible } from "./tabs.js";
import { verdictOf } from "./verdicts.js";

const panel = () => byId("panel-why");

function show() {
  if (!visible("why")) return;
  if (!state.map) {
    panel().replaceChildren(el("p", { class: "empty", text: "No scan yet. Press play, or open a run." }));
    return;
  }
  const verdicts = Object.entries(state.map.verdicts ?? {}).sort((a, b) => (b[0] === "tree") - (a[0] === "tree") || b[1] - a[1]);
  const clusters = verdicts.reduce((sum, [, number]) => sum + number, 0);
  const lead = clusters
    ? `Scan ${state.map.index}: ${count(clusters, "cluster")}, and what each was taken for.`
    : `Scan ${state.map.index}: no cluster. Are the box and the height band where the stems are, and is Radius eps large enough?`;
  panel().replaceChildren(el("p", { class: "lead", "data-scan": state.map.index, "data-clusters": clusters, text: lead }), bars(verdicts), points());
}

function bars(verdicts) {
  const most = Math.max(1, ...verdicts.map(([, number]) => number));
  return el("ul", { class: "why" }, ...verdicts.map(([label, number]) => {
    const [letter, meaning, reason] = verdictOf(label);
    const colour = `var(--${meaning})`;
    return el("li", {},
      el("span", { class: "letter", text: letter, style: { background: colour }, "aria-hidden": "true" }),
      el("span", { text: label }),
      el("span", { class: "bar", style: { background: colour, width: `${(100 * number) / most}%` } }),
      el("span", { class: "count", text: String(number) }),
      el("span", { class: "reason", text: reason }));
  }));
}

function points() {
  const rows = Object.entries(state.map.counts ?? {}).flatMap(([name, number]) =>
    [el("dt", { text: name.replaceAll("_", " ") }), el("dd", { text: number.toLocaleString("en") })]);
  return rows.length ? el("dl", { class: "list" }, ...rows) : "";
}

export function startWhy() {
  on("map tab", show);
}
