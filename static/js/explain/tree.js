// The story of a tree: verdict, diameter, observed sides, and the history of its position.

import { placeText } from "../core/coordinates.js";
import { definitions, el, letterOf } from "../core/dom.js";
import { clock, count, dbhFigure, figure, isAssumed, NONE } from "../core/format.js";
import { arc, circle, ellipse, line, picture, scaleBar, svg, text } from "../core/svg.js";
import { verdictOf } from "../core/verdicts.js";
import { timeLink } from "../playback/time_link.js";
import { ofExtensions } from "../shell/extensions.js";
import { columnFigure } from "./columns.js";
import { gatheredFigure } from "./gathered.js";

const TURN = 2 * Math.PI;

export function treeStory(story, showCluster) {
  const own = ofExtensions("treeStory", story);
  if (own.length) return own;
  return [verdict(story), overview(story, showCluster), gatheredFigure(story), positions(story), columnFigure(story.column, "Verdict on the accumulated scans")];
}

function verdict(story) {
  const label = story.column?.verdict ?? (story.confirmed ? "tree" : "other");
  return el("div", { class: "verdict", "data-verdict": label }, letterOf(verdictOf(label)),
    el("div", {}, el("b", { text: story.confirmed ? "tree" : `not in the map: ${label}` }),
      el("p", {}, ...seen(story))));
}

function seen(story) {
  if (isAssumed(story)) return ["No single scan detected it here: the position is that of the accumulated scans, or of a person who moved or split it, and the uncertainty is assumed, not measured."];
  // A little later, since the time of a scan may be rounded downwards.
  return [`Detected in ${count(story.observations, "scan")}, first at `, timeLink(story.first_seen_s + 0.005), ", last at ", timeLink(story.last_seen_s + 0.005), "."];
}

function overview(story, showCluster) {
  const dbh = story.dbh === null ? NONE : `${dbhFigure(100 * story.dbh, 100 * story.dbh_sigma)} cm`;
  const rows = [["DBH", dbh], ["covered", `${figure(story.coverage_deg)}° of 360°`], ["x, y", placeText(story.position)],
    ["position ±", isAssumed(story) ? `≈ ${figure(100 * story.ellipse[0], 2)} cm, assumed` : `${figure(100 * story.ellipse[0], 2)} × ${figure(100 * story.ellipse[1], 2)} cm`], ["eccentricity e", figure(story.eccentricity)]];
  return el("div", { class: "story-fit" }, covered(story), el("div", {},
    definitions(rows),
    story.dbh === null ? el("p", { class: "dim note", text: missingDbh(story) }) : "",
    story.cluster === null ? "" : el("button", { class: "small", text: `Its cluster in scan ${story.scan}`, onclick: () => showCluster(story.scan, story.cluster) })));
}

function missingDbh({ coverage_deg, dbh_arc_deg }) {
  if (coverage_deg < dbh_arc_deg) return `The DBH needs ${figure(dbh_arc_deg)}° of the circumference.`;
  return "The DBH is not measured: fewer than three fits, returns too far apart, or a standard deviation above the maximum.";
}

// The observed sides as arcs around the trunk; x of the map to the right.
function covered(story) {
  const size = 200, middle = size / 2, radius = 66;
  const step = TURN / Math.max(story.sides.length, 1);
  const seen = story.sides.flatMap((is, k) => (is ? [arc(middle, middle, radius, k * step, (k + 1) * step, "sector")] : []));
  return picture(size, size, `Covered ${figure(story.coverage_deg)} degrees of the trunk`, circle(middle, middle, radius, "circle"), ...seen,
    text(middle, middle + 2, story.dbh === null ? "no DBH yet" : `${figure(100 * story.dbh)} cm`, story.dbh === null ? "" : "big", "middle"),
    text(middle, middle + 20, `${figure(story.coverage_deg)}° covered`, "small", "middle"),
    ...[["x", middle + radius + 18, middle + 4], ["y", middle, middle - radius - 12]].map(([name, x, y]) => text(x, y, name, "small", "middle")));
}

function positions({ history, ellipse: now }) {
  const n = history.x.length;
  if (n < 2) return el("p", { class: "dim note", text: "No history of its position yet: fewer than two scans have detected it." });
  const [width, height] = [400, 190], scaleTo = 0.62 * 190;
  const last = [history.x.at(-1), history.y.at(-1)];
  const reach = Math.max(0.01, ...history.x.map((x, k) => Math.max(Math.abs(x - last[0]) + 0.7 * history.major[k], Math.abs(history.y[k] - last[1]) + 0.7 * history.major[k])));
  const scale = scaleTo / (1.25 * reach);
  const at = (k) => [width * 0.3 + scale * (history.x[k] - last[0]), height / 2 - scale * (history.y[k] - last[1])];
  const some = [...new Set([0, 1, 2, 4, 8, 16, 32, 64, 128].filter((k) => k < n - 1).concat(n - 1))];
  const rings = some.map((k) => {
    const ring = ellipse(...at(k), scale * history.major[k], scale * history.minor[k], history.angle[k], k === n - 1 ? "sigma now" : "sigma past");
    ring.append(svg("title", { text: `${clock(history.time_s[k])}: ± ${figure(100 * history.major[k], 2)} cm` }));
    return ring;
  });
  const path = svg("polyline", { points: history.x.map((_, k) => at(k).join(",")).join(" "), class: "track" });
  return el("figure", {},
    el("figcaption", { text: `Estimated positions with sigma ellipses from ${clock(history.time_s[0])} to ${clock(history.time_s[n - 1])}, ${figure(100 * history.major[0], 2)} cm down to ${figure(100 * now[0], 2)} cm` }),
    picture(width, height, "History of the position with its sigma ellipses, and sigma over time", path, ...rings, circle(...at(n - 1), 2.5, "axis"),
      scaleBar(8, height - 8, reach / 2, scale), ...shrinking(history, width, height)));
}

// Sigma over the observations, on the right of the picture.
function shrinking(history, width, height) {
  const [left, right, top, bottom] = [width * 0.64, width - 8, 22, height - 24];
  const most = Math.max(...history.major), n = history.major.length;
  const [first, end] = [history.time_s[0], history.time_s[n - 1]];
  const x = (k) => left + ((history.time_s[k] - first) / Math.max(end - first, 1e-6)) * (right - left);
  const y = (k) => bottom - (history.major[k] / most) * (bottom - top);
  return [line(left, bottom, right, bottom, "zero"), line(left, top, left, bottom, "zero"),
    svg("polyline", { points: history.major.map((_, k) => `${x(k)},${y(k)}`).join(" "), class: "curve" }),
    text(left, top - 8, `sigma, at most ${figure(100 * most, 2)} cm`, "small"), text(left, bottom + 14, clock(first), "small"), text(right, bottom + 14, clock(end), "small", "end")];
}
