// The story of a stem of a whole cloud: its height, cross-sections with the fitted circles, and the stem curve.

import { definitions, el, letterOf } from "../../core/dom.js";
import { placeText } from "../../core/coordinates.js";
import { count, dbhFigure, figure, fixed, heightFigure, NONE } from "../../core/format.js";
import { circle, line, picture, scaleBar, svg, text } from "../../core/svg.js";
import { verdictOf } from "../../core/verdicts.js";
import { checks, failureText, verdict } from "../../explain/cluster.js";
import { voteNodes } from "../../explain/columns.js";
import { gatheredFigure } from "../../explain/gathered.js";

const SIZE = 120; // of the picture of a section
const BREAST = 1.3; // [m]

export function treeStory(story) {
  const stem = story.extensions.clouds;
  if (!stem) return [];
  return [el("div", { class: "verdict", "data-verdict": "tree" }, letterOf(verdictOf("tree")),
    el("div", {}, el("b", { text: "tree" }), el("p", { text: `Circles in ${count(story.observations, "slice")} above one another, between ${figure(stem.sections[0].height)} and ${figure(stem.sections.at(-1).height)} m above the ground.` }))),
  figures(story, stem), sectionsFigure(stem.sections), stemCurve(stem, story)];
}

export function clusterStory(story) {
  const stem = story.extensions.clouds;
  if (!stem) return [];
  const known = circlesOf(stem), breast = known.length ? known.reduce((a, b) => (Math.abs(a.height - BREAST) < Math.abs(b.height - BREAST) ? a : b)) : null;
  return [verdict(story, why(story, known.length)),
    gatheredFigure({ points: stem.around, dbh: breast && Math.abs(breast.height - BREAST) < 0.3 ? 2 * breast.radius : null }, "Points of the cloud around it", "no circle is fitted there"),
    candidateFigures(stem, known), known.length ? sectionsFigure(stem.sections) : "", checks(story),
    el("figure", {}, el("figcaption", { text: "Votes of the decision trees" }), ...voteNodes(stem.votes))];
}

const circlesOf = ({ sections }) => sections.filter(({ radius }) => radius !== null);

function candidateFigures({ around }, known) {
  const middle = (values) => values.sort((a, b) => a - b)[values.length >> 1];
  const top = Math.max(...around.map(([, , z]) => z));
  return definitions([
    ["circles", known.length ? `in ${count(known.length, "slice")}, ${figure(known[0].height)} to ${figure(known.at(-1).height)} m above the ground` : "none"],
    ...(known.length ? [["roughness of the bark", `${figure(100 * middle(known.map(({ scatter }) => scatter)), 2)} cm`], ["covered", `${figure(middle(known.map(({ coverage_deg: covered }) => covered)))}° of 360°`]] : []),
    ["points around it", around.length ? `up to ${figure(top)} m above the ground` : "none"]]);
}

export function treeEvidence({ extensions }) {
  return extensions.clouds ? [sectionsFigure(extensions.clouds.sections, byBreast, (number) => count(number, "cross-section"))] : [];
}

function why(story, circles) {
  if (!story.checks.length) return `It stands upright like a stem, but ${circles ? "only one of its slices shows" : "none of its slices shows"} a circle: a stem needs two. ${story.verdict === "no arc" ? "The decision trees vote for a tree." : `The decision trees vote for ${story.verdict}.`}`;
  const failed = story.checks.find((check) => check.fails);
  if (failed) return failureText(failed);
  if (story.verdict === "tree") return `It passed all checks below. It is tree ${story.tree} of the map.`;
  return `It passed all checks below, but the decision trees classify its surroundings as ${story.verdict}.`;
}

function figures(story, stem) {
  const [major, minor] = story.ellipse;
  const measured = story.dbh !== null, seen = stem.height !== null;
  return el("div", { class: "stem-figures" }, definitions([
    ["DBH", measured ? `${dbhFigure(100 * story.dbh, 100 * story.dbh_sigma)} cm` : NONE],
    ["height", seen ? `${heightFigure(stem.height, stem.height_sigma)} m` : "not seen"],
    ["lean", `${fixed(stem.lean_deg, 1)}°`], ["covered", `${figure(story.coverage_deg)}° of 360°`],
    ["x, y", placeText(story.position)], ["position ±", `${figure(100 * major, 2)} × ${figure(100 * minor, 2)} cm`]]),
  measured ? "" : el("p", { class: "dim note", text: `The DBH needs ${figure(story.dbh_arc_deg)}° of the circumference.` }),
  seen ? "" : el("p", { class: "dim note", text: `Height not seen: ${stem.height_hidden}.` }));
}

const byHeight = (a, b) => b.height - a.height;
const byBreast = (a, b) => Math.abs(a.height - BREAST) - Math.abs(b.height - BREAST);

// Pictures of the sections with points, highest first unless another order is given, all at one scale; `caption` gets their number.
function sectionsFigure(sections, order = byHeight, caption = () => "Cross-sections with the fitted circles; x of the map to the right") {
  const shown = sections.filter(({ points }) => points.length).sort(order);
  if (!shown.length) return "";
  const reach = Math.max(0.05, ...shown.map(({ radius, points }) => Math.max(radius ?? 0, ...points.map(([x, y]) => Math.hypot(x, y)))));
  return el("figure", { "data-sections": String(shown.length) }, el("figcaption", { text: caption(shown.length) }),
    el("div", { class: "sections" }, ...shown.map((section) => sectionPicture(section, reach))));
}

function sectionPicture({ height, radius, points, coverage_deg: covered, scatter }, reach) {
  const middle = SIZE / 2, scale = (SIZE / 2 - 4) / reach;
  const dots = points.map(([x, y]) => circle(middle + scale * x, middle - scale * y, 1.1, "point"));
  const at = `${figure(height)} m`, wide = radius === null ? "no circle" : `⌀ ${figure(200 * radius)} cm`;
  const title = radius === null ? at : `${at}: ${wide}, ${figure(covered)}° covered, scatter ${figure(100 * scatter, 2)} cm`;
  return el("div", { class: Math.abs(height - BREAST) < 0.11 ? "section breast" : "section", title },
    picture(SIZE, SIZE, `Cross-section at ${title}`, ...dots, radius === null ? null : circle(middle, middle, scale * radius, "fitted"), scaleBar(5, SIZE - 5, reach / 2, scale)),
    el("span", { text: at }), el("span", { text: wide }));
}

// Diameter over height with sigma.
function stemCurve({ sections }, { dbh, dbh_sigma: sigma }) {
  const known = sections.filter(({ radius }) => radius !== null);
  if (known.length < 2) return "";
  const [width, tall, left, right, top, bottom] = [400, 200, 40, 388, 14, 168];
  const high = Math.max(...known.map(({ height }) => height)), most = 1.1 * Math.max(dbh ?? 0, ...known.map(({ radius, radius_sigma: s }) => 2 * (radius + s)));
  const x = (diameter) => left + (diameter / most) * (right - left), y = (height) => bottom - (height / high) * (bottom - top);
  const bars = known.map(({ height, radius, radius_sigma: s }) => line(x(2 * (radius - s)), y(height), x(2 * (radius + s)), y(height), "spread"));
  const curve = svg("polyline", { points: known.map(({ height, radius }) => `${x(2 * radius)},${y(height)}`).join(" "), class: "curve" });
  const breast = dbh === null ? [] : [line(x(dbh - sigma), y(BREAST), x(dbh + sigma), y(BREAST), "axis"), circle(x(dbh), y(BREAST), 4, "axis")];
  const step = [0.02, 0.05, 0.1, 0.2, 0.5].find((each) => most / each <= 8) ?? 1;
  const ticks = Array.from({ length: Math.floor(most / step) + 1 }, (_, k) => k * step);
  return el("figure", {}, el("figcaption", { text: `Stem curve: diameter over height${dbh === null ? "" : "; the ring is the DBH"}` }),
    picture(width, tall, "Diameter of the stem over the height above the ground", line(left, bottom, right, bottom, "zero"), line(left, top, left, bottom, "zero"),
      ...ticks.map((value) => text(x(value), bottom + 15, String(Math.round(100 * value)), "small", "middle")), text(right, bottom + 29, "diameter [cm]", "small", "end"),
      ...Array.from({ length: Math.floor(high) + 1 }, (_, k) => text(left - 6, y(k) + 4, String(k), "small", "end")), text(4, top - 2, "m", "small"),
      ...bars, curve, ...breast));
}
