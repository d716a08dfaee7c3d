// Maps of the fleet on canvas: each robot's own, and one of all whose frames are known.

import { letterOf } from "./main.js";

// Okabe-Ito, without the green of trees; the letter stands beside.
const COLOURS = ["#56B4E9", "#E69F00", "#CC79A7", "#F0E442", "#D55E00", "#0072B2", "#999933", "#bbbbbb"];
export const colourOf = (place) => COLOURS[place % COLOURS.length];

const LEAST_M = 4; // a picture never shows less than this
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// x to the right, y up, in metres, so that all points are seen.
function view(canvas, points) {
  const ratio = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const edge = Math.min(28, width / 8);
  const scale = Math.min((width - 2 * edge) / Math.max(right - left, LEAST_M), (height - 2 * edge) / Math.max(high - low, LEAST_M));
  const paper = canvas.getContext("2d");
  paper.setTransform(ratio, 0, 0, ratio, 0, 0);
  paper.clearRect(0, 0, width, height);
  const at = ([x, y]) => [width / 2 + (x - (left + right) / 2) * scale, height / 2 - (y - (low + high) / 2) * scale];
  return { paper, at, scale, width, height };
}

function drawRobot({ paper, at, scale }, { trees, path, pose }, place, { big }) {
  const colour = colourOf(place);
  paper.fillStyle = style("--tree");
  paper.strokeStyle = big ? colour : "transparent";
  for (const [x, y, dbh] of trees) {
    const [px, py] = at([x, y]);
    paper.beginPath();
    paper.arc(px, py, Math.max(big ? 3 : 1.5, ((dbh ?? 20) / 200) * scale), 0, 2 * Math.PI);
    paper.fill();
    paper.stroke();
  }
  paper.strokeStyle = colour;
  paper.lineWidth = big ? 2 : 1;
  paper.beginPath();
  for (const point of path) paper.lineTo(...at(point));
  paper.stroke();
  const [px, py] = at(pose);
  const size = big ? 11 : 6;
  paper.save();
  paper.translate(px, py);
  paper.rotate(-pose[2]);
  paper.fillStyle = colour;
  paper.beginPath();
  for (const [x, y] of [[1, 0], [-0.7, 0.6], [-0.7, -0.6]]) paper.lineTo(x * size, y * size);
  paper.fill();
  paper.restore();
  if (!big) return;
  paper.fillStyle = style("--text");
  paper.font = `600 14px ${style("--font")}`;
  paper.fillText(letterOf(place), px + 13, py - 8);
}

const points = ({ trees, path, pose }) => [...trees, ...path, pose];

export function drawOwn(canvas, map, place) {
  if (canvas && map) drawRobot(view(canvas, points(map)), map, place, { big: false });
}

function moved(map) {
  const [x, y, yaw] = map.common;
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  const to = ([a, b, ...rest]) => [x + c * a - s * b, y + s * a + c * b, ...rest];
  const [px, py, turn] = to(map.pose);
  return { trees: map.trees.map(to), path: map.path.map(to), pose: [px, py, turn + yaw] };
}

export function drawCommon(canvas, shared) {
  const all = shared.map(({ k, map }) => ({ k, map: moved(map) }));
  const seen = view(canvas, all.length ? all.flatMap(({ map }) => points(map)) : [[0, 0]]);
  if (!all.length) return;
  drawScale(seen);
  for (const { k, map } of all) drawRobot(seen, map, k, { big: true });
}

function drawScale({ paper, scale, width }) {
  const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((step) => step * scale >= 60) ?? 1000;
  paper.fillStyle = paper.strokeStyle = style("--axis");
  paper.lineWidth = 2;
  paper.beginPath();
  paper.moveTo(width - 20 - metres * scale, 22);
  paper.lineTo(width - 20, 22);
  paper.stroke();
  paper.font = `12px ${style("--font")}`;
  paper.textAlign = "right";
  paper.fillText(`${metres} m`, width - 20, 16);
  paper.textAlign = "left";
}
