// The accumulated points around a tree from above and from the side, with the fitted circle at breast height.

import { el } from "../core/dom.js";
import { figure } from "../core/format.js";
import { circle, line, picture, scaleBar, svg, text } from "../core/svg.js";

const REACH = 0.75; // [m] around the tree in which the server sends points
const LEAST = 0.4, UNKNOWN = 0.5; // [m] least reach of the view from above, and that of a tree without DBH
const CROWN = 3; // [m] above the ground; higher points are not shown from above
const BREAST = 1.3, LOW = 1.0, HIGH = 1.6; // [m] above the ground
const LOWEST_TOP = 3; // [m] least height of the side view
const SIZE = 240, WIDTH = 130, LEFT = 34; // of the two pictures, and of the heights on the left of the second

const dots = (places, cls) => svg("path", { d: places.map(([x, y]) => `M${x.toFixed(1)} ${y.toFixed(1)}h0`).join(""), class: `cloud ${cls}` });

export function gatheredFigure({ points, dbh }, title = "Accumulated points", without = "the tree has no DBH yet, so no circle is fitted") {
  if (!points.length) return el("figure", {}, el("figcaption", { text: title }), el("p", { class: "dim note", text: "None at this place yet. Scans are accumulated at intervals (Tune, Classification); presets that do not classify, such as paper, accumulate none." }));
  const atBreast = ([, , z]) => z >= LOW && z < HIGH;
  const near = points.filter(atBreast), others = points.filter((point) => !atBreast(point));
  const found = dbh === null ? without : `green: the fitted circle at breast height, DBH ${figure(100 * dbh)} cm`;
  return el("figure", { class: "gathered" },
    el("figcaption", { text: title }),
    el("div", { class: "gathered-views" }, fromAbove(near, others, dbh), fromTheSide(near, others, dbh)),
    el("p", { class: "note dim", text: `Bright: ${LOW.toFixed(1)} to ${HIGH.toFixed(1)} m above the ground; ${found}.` }));
}

function fromAbove(near, others, dbh) {
  const reach = dbh === null ? UNKNOWN : Math.min(REACH, Math.max(LEAST, 1.5 * dbh));
  const middle = SIZE / 2, scale = middle / reach;
  const at = ([x, y]) => [middle + scale * x, middle - scale * y];
  return picture(SIZE, SIZE, "The accumulated points up to 3 m above the ground from above, x of the map to the right", dots(others.filter(([, , z]) => z < CROWN).map(at), ""), dots(near.map(at), "near"),
    dbh === null ? null : circle(middle, middle, (scale * dbh) / 2, "fit"),
    line(middle - 4, middle, middle + 4, middle, "axis"), line(middle, middle - 4, middle, middle + 4, "axis"),
    scaleBar(8, SIZE - 8, reach / 2, scale));
}

function fromTheSide(near, others, dbh) {
  const top = Math.max(LOWEST_TOP, ...near.map(([, , z]) => z), ...others.map(([, , z]) => z)) + 0.2;
  const scale = Math.min((SIZE - 24) / top, (WIDTH - LEFT) / 2 / REACH), middle = LEFT + (WIDTH - LEFT) / 2, ground = SIZE - 10;
  const at = ([x, , z]) => [middle + scale * x, ground - scale * z];
  const half = dbh === null ? 0 : (scale * dbh) / 2;
  const ticks = [0, BREAST, Math.floor(top)].map((height) => text(LEFT - 4, ground - scale * height + 3, height === BREAST ? "1.3 m" : `${height} m`, "small", "end"));
  return picture(WIDTH, SIZE, "The same points from the side, x of the map to the right", dots(others.map(at), ""), dots(near.map(at), "near"),
    line(LEFT, ground, WIDTH, ground, "zero"), ...ticks,
    dbh === null ? null : svg("rect", { x: middle - half, y: ground - scale * HIGH, width: 2 * half, height: scale * (HIGH - LOW), class: "fit" }));
}
