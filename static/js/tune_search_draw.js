// What a search found, drawn: the score of each trial with the best so far, and how much each parameter mattered.

import { el } from "./dom.js";
import { percent } from "./format.js";
import { line, picture, svg, text } from "./svg.js";

const WIDTH = 300, HEIGHT = 92, LEFT = 38, RIGHT = 6, TOP = 8, BOTTOM = 16;
const MOST_BARS = 8;

export function scoresPicture({ points = [], held_out: held = [], wanted, label, unit, goal }) {
  const known = points.filter(([, value]) => value !== null);
  if (known.length < 2) return null;
  const upwards = label === "F1" || label === "TA";
  const beside = held.filter(([, value]) => value !== null);
  const values = [...known, ...beside].map(([, value]) => value);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const span = high - low || 1;
  const last = Math.max(wanted - 1, ...known.map(([n]) => n), 1);
  const x = (n) => LEFT + (n / last) * (WIDTH - LEFT - RIGHT);
  const y = (value) => TOP + (1 - (value - low) / span) * (HEIGHT - TOP - BOTTOM);
  let best = null, path = "";
  for (const [n, value] of known) {
    if (best === null || (upwards ? value > best : value < best)) {
      path += best === null ? `M${x(n)} ${y(value)}` : `H${x(n)}V${y(value)}`;
      best = value;
    }
  }
  path += `H${x(known.at(-1)[0])}`;
  const end = x(known.at(-1)[0]);
  const heldPath = beside.length ? `${beside.map(([n, value], k) => (k ? `H${x(n)}V${y(value)}` : `M${x(n)} ${y(value)}`)).join("")}H${Math.max(end, x(beside.at(-1)[0]))}` : "";
  const tell = (value) => (span < 0.01 ? value.toFixed(4) : value.toFixed(2)) + (unit ? ` ${unit}` : "");
  return picture(WIDTH, HEIGHT, `${goal}: ${known.length} trials, from ${tell(low)} to ${tell(high)}`,
    line(LEFT, TOP, LEFT, HEIGHT - BOTTOM, "axis"), line(LEFT, HEIGHT - BOTTOM, WIDTH - RIGHT, HEIGHT - BOTTOM, "axis"),
    ...known.map(([n, value]) => svg("circle", { cx: x(n), cy: y(value), r: 1.6, class: "trial" })),
    svg("path", { d: path, class: "best" }),
    beside.length ? svg("path", { d: heldPath, class: "held" }) : null,
    beside.length ? text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 4, "— best   - - held out", "small", "middle") : null,
    high > low ? text(LEFT - 4, TOP + 5, tell(high), "small", "end") : null, text(LEFT - 4, HEIGHT - BOTTOM, tell(low), "small", "end"),
    text(LEFT, HEIGHT - 4, label, "small"), text(WIDTH - RIGHT, HEIGHT - 4, `trial ${last + 1}`, "small", "end"));
}

export function importanceBars({ importance = {} }, specOf) {
  const rows = Object.entries(importance).slice(0, MOST_BARS);
  if (!rows.length) return null;
  return el("div", { id: "search-importance" }, el("h3", { text: "What mattered" }), ...rows.map(([name, share]) => el("div", { class: "share-row" },
    el("span", { text: specOf(name)?.title ?? name, title: name }), el("span", { class: "share-bar" }, el("i", { style: { width: `${Math.max(100 * share, 0.5)}%` } })), el("small", { text: percent(share) }))));
}
