// The story of a cluster: its verdict, the checks that led to it, and its fit seen from above.

import { definitions, el, letterOf } from "../core/dom.js";
import { clock, figure, NONE, plusMinus } from "../core/format.js";
import { arc, circle, ellipse, line, picture, scaleBar, svg, text } from "../core/svg.js";
import { isDrive } from "../core/store.js";
import { verdictOf } from "../core/verdicts.js";
import { ofExtensions } from "../shell/extensions.js";
import { openParameter } from "../tune/panel.js";
import { specOf } from "../tune/parameters.js";
import { columnFigure } from "./columns.js";

const SIZE = 250; // of the picture

function plain(value, unit) {
  if (value === null) return NONE;
  if (unit === "m" && Math.abs(value) < 3) return `${figure(100 * value)} cm`;
  return `${figure(value)}${unit === "deg" ? "°" : unit && ` ${unit}`}`;
}

export function clusterStory(story) {
  const own = ofExtensions("clusterStory", story);
  if (own.length) return own;
  return [verdict(story, why(story)), drawing(story), story.circle ? residuals(story) : "", checks(story),
    columnFigure(story.column, "Accumulated scans at this place")];
}

// Where the accumulated scans reject a stem of this scan, both verdicts are named and that of the map counts.
export function verdict(story, reason) {
  const ofMap = story.verdict === "tree" ? (story.column?.verdict ?? "tree") : story.verdict;
  const title = ofMap === story.verdict ? ofMap : `A stem in this scan; not a tree in the map: ${ofMap}`;
  return el("div", { class: "verdict", "data-verdict": ofMap }, letterOf(verdictOf(ofMap)),
    el("div", {}, el("b", { text: title }), el("p", { text: reason || verdictOf(story.verdict)[2] })));
}

function why(story) {
  if (!story.checks.length) return "It was found by another program and is used without checks.";
  const failed = story.checks.find((check) => check.fails);
  if (!failed) return "It passed all checks below, so it is a stem and is used by SLAM.";
  if (failed.verdict === "at border") return "It extends beyond the pass-through box, the range or the field of view, so a part of it is not visible.";
  if (!failed.relation) return "Its edge is occluded by a nearer object, so its centre is unknown.";
  return failureText(failed);
}

export function failureText(failed) {
  const side = failed.relation === "at most" ? "above" : "below";
  return `Its ${failed.figure} of ${plain(failed.value, failed.unit)} is ${side} ${limitOf(failed)}.`;
}

function limitOf({ limit, unit, title, parameter }) {
  return parameter ? `${title}, ${plain(limit, unit)} (${parameter})` : `the limit of ${plain(limit, unit)}`;
}

function drawing(story) {
  const fit = story.circle;
  const reach = 1.18 * Math.max(0.05, fit?.radius ?? 0, ...story.points.map(([x, y]) => Math.hypot(x, y)));
  const scale = SIZE / 2 / reach, middle = SIZE / 2;
  const at = ([x, y]) => [middle + scale * x, middle - scale * y];
  const points = story.points.map((point) => circle(...at(point), 1.4, "point"));
  const picturing = picture(SIZE, SIZE + 26, "The cluster seen from above, with the sensor below",
    ...(fit ? ticks(story, at) : []), ...points, ...(fit ? fitted(fit, middle, scale) : axes(story, at)),
    fit ? ellipse(middle, middle, scale * fit.ellipse[0], scale * fit.ellipse[1], fit.ellipse[2], "sigma") : null,
    fit ? leaning(fit, middle, scale) : null,
    scaleBar(8, SIZE - 6, reach / 2, scale),
    svg("path", { d: `M${middle} ${SIZE + 2} l-6 10 h12z`, class: "sensor" }),
    text(middle + 11, SIZE + 12, `sensor, ${figure(story.distance)} m`, "small"));
  return el("div", { class: "story-fit" }, picturing, figures(story));
}

function fitted(fit, middle, scale) {
  const radius = scale * fit.radius;
  return [circle(middle, middle, radius, "circle"), arc(middle, middle, radius, fit.arc_start, fit.arc_end, "seen")];
}

// From the circle to each point: its residual at the scale of the picture.
function ticks(story, at) {
  const radius = story.circle.radius;
  return story.points.map(([x, y]) => {
    const size = Math.max(Math.hypot(x, y), 1e-6);
    return line(...at([(radius * x) / size, (radius * y) / size]), ...at([x, y]), "tick");
  });
}

function leaning(fit, middle, scale) {
  const [dx, dy] = [scale * fit.lean[0], -scale * fit.lean[1]];
  if (Math.hypot(dx, dy) < 3) return circle(middle, middle, 2, "axis");
  return svg("g", {}, line(middle, middle, middle + dx, middle + dy, "axis"), circle(middle + dx, middle + dy, 3, "axis"));
}

function axes(story, at) {
  return story.axes.map(([x, y]) => line(...at([-2 * x, -2 * y]), ...at([2 * x, 2 * y]), "axis"));
}

function figures(story) {
  const fit = story.circle;
  const rows = [["points", String(story.size)], ["eccentricity e", story.eccentricity === null && story.size > 1 ? "∞" : figure(story.eccentricity)], ["from sensor", `${figure(story.distance)} m`]];
  if (fit) {
    rows.push(["radius", `${plusMinus(100 * fit.radius, 100 * fit.radius_sigma)} cm`], ["diameter", `${plusMinus(200 * fit.radius, 200 * fit.radius_sigma)} cm`], ["visible arc", `${figure(fit.arc_deg)}°`],
      ["tilt of the axis", `${figure(fit.lean_deg, 2)}°`], ["centre ±", `${figure(100 * fit.ellipse[0], 2)} × ${figure(100 * fit.ellipse[1], 2)} cm`]);
  } else rows.push(["circle", "none fitted"]);
  return definitions(rows);
}

// Residuals over the angle around the stem; 0 degrees faces the sensor.
function residuals(story) {
  const [width, height, left] = [400, 108, 34];
  const sigma = 1000 * story.sensor_sigma;
  const most = Math.max(3 * sigma, ...story.residual.map((r) => Math.min(1000 * Math.abs(r), 12 * sigma)));
  const x = (angle) => left + ((angle + Math.PI) / (2 * Math.PI)) * (width - left - 18);
  const y = (mm) => 48 - (40 * Math.max(-most, Math.min(most, mm))) / most;
  const dots = story.points.map(([px, py], k) => circle(x(Math.atan2(px, -py)), y(1000 * story.residual[k]), 1.7, "point"));
  const marks = [-180, -90, 0, 90, 180].map((degrees) => text(x((degrees * Math.PI) / 180), height - 3, `${degrees}°`, "small", "middle"));
  const band = svg("rect", { x: left, width: width - left - 18, y: y(sigma), height: y(-sigma) - y(sigma), class: "band" });
  return el("figure", {},
    el("figcaption", { text: `Residual of each point outside (+) or inside (−) the circle [mm] over the angle around the stem; 0° faces the sensor, the band is its range noise (1 sigma, ${figure(sigma, 2)} mm)` }),
    picture(width, height, "Residuals in millimetres over the angle around the stem", band, line(left, y(0), width - 18, y(0), "zero"),
      text(left - 5, y(most) + 8, `+${figure(most, 2)}`, "small", "end"), text(left - 5, y(0) + 4, "0", "small", "end"),
      text(left - 5, y(-most), `−${figure(most, 2)}`, "small", "end"), ...dots, ...marks));
}

// Without a fitted circle the radial deviation is 0 in the data, which is no measurement.
const noCircle = (story, check) => !story.circle && story.distance !== null && check.figure === "radial deviation" && check.value === 0;

export function checks(story) {
  if (!story.checks.length) return "";
  let decided = false;
  const rows = story.checks.map((check) => {
    const decides = check.fails && !decided;
    decided ||= check.fails;
    const limit = check.relation ? `${check.relation} ${plain(check.limit, check.unit)}` : "must be no";
    const given = noCircle(story, check) ? null : check.value;
    const value = check.relation ? plain(given, check.unit) : check.fails ? "yes" : "no";
    return el("tr", { class: `${check.fails ? "fails" : ""} ${decides ? "decides" : ""}`.trim(), title: check.parameter ? `Limit: ${check.title} (${check.parameter})` : "" },
      el("td", { text: check.fails ? "✕" : given === null ? "·" : "✓" }), el("td", { text: check.figure }), el("td", { text: value }),
      el("td", {}, check.parameter && specOf(check.parameter) ? el("button", { class: "link", type: "button", text: limit, title: `Go to the slider of ${check.title}`, onclick: () => openParameter(check.parameter) }) : limit), el("td", { text: check.fails ? check.verdict : "" }));
  });
  return el("figure", {}, el("figcaption", { text: "Checks; the first one that fails decides" }),
    el("table", { class: "checks" }, el("tbody", {}, ...rows)));
}

export const clusterTitle = ({ scan, cluster, time_s }) => !isDrive() ? `Candidate ${cluster + 1}` :
  `Cluster ${cluster + 1} of scan ${scan}${time_s === undefined ? "" : `, ${clock(time_s)}`}`;
