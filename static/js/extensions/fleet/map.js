// Maps of the fleet: one of each robot, and one of all robots whose frames are known.

import { colours } from "../../core/theme.js";
import { drawCircle, drawFrame, drawLine, drawText, drawTriangle } from "../../map/draw.js";
import { boundsOf, MapCanvas } from "../../map/map_canvas.js";

// A robot is known by its colour (Okabe-Ito without the green of trees) and by its letter.
const COLOURS = ["#56B4E9", "#E69F00", "#CC79A7", "#F0E442", "#D55E00", "#0072B2", "#999933", "#bbbbbb"];
export const colourOf = (place) => COLOURS[place % COLOURS.length];

export const letterOf = (place) => String.fromCharCode(65 + (place % 26));

const USUAL_DBH = 20; // [cm], drawn where it is not measured

function drawRobot(pen, view, { trees, path, pose }, place, { large }) {
  const colour = colourOf(place);
  pen.lineWidth = 1;
  for (const [x, y, dbh] of trees) {
    drawCircle(pen, ...view.toScreen(x, y), Math.max(large ? 3 : 1.5, ((dbh ?? USUAL_DBH) / 200) * view.scale));
    Object.assign(pen, { fillStyle: colours.tree, strokeStyle: colour });
    pen.fill();
    if (large) pen.stroke();
  }
  drawLine(pen, view, path, colour, large ? 2 : 1);
  const [px, py] = view.toScreen(pose[0], pose[1]);
  drawTriangle(pen, px, py, pose[2], large ? 12 : 7, colour);
  if (large) drawText(pen, letterOf(place), px + 13, py - 8, { font: "600 14px", align: "left" });
}

const points = ({ trees, path, pose }) => [...trees, ...path, pose];

// The small map of a robot; `map()` returns its newest map or undefined.
export function ownMap(canvas, map, place) {
  return new MapCanvas(canvas, {
    fixed: true,
    bounds: () => boundsOf(map() ? points(map()) : []),
    paint: (pen, view) => map() && drawRobot(pen, view, map(), place, { large: false }),
  });
}

function inCommonFrame(map) {
  const [x, y, yaw] = map.common;
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  const to = ([a, b, ...rest]) => [x + c * a - s * b, y + s * a + c * b, ...rest];
  const [px, py, turn] = to(map.pose);
  return { trees: map.trees.map(to), path: map.path.map(to), pose: [px, py, turn + yaw] };
}

// The map of all robots; `shared()` returns [{k, map}] of those whose frames are known.
export function commonMap(canvas, shared) {
  const all = () => shared().map(({ k, map }) => ({ k, map: inCommonFrame(map) }));
  return new MapCanvas(canvas, {
    bounds: () => boundsOf(...all().map(({ map }) => points(map))),
    paint: (pen, view) => drawFrame(pen, view, () => { for (const { k, map } of all()) drawRobot(pen, view, map, k, { large: true }); }),
  });
}
