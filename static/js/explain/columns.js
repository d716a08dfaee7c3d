// Classification of the accumulated scans at a place: votes of the decision trees and the most influential features.

import { el, letterOf } from "../core/dom.js";
import { count, figure, share } from "../core/format.js";
import { verdictOf } from "../core/verdicts.js";
import { openParameter } from "../tune/panel.js";

// Name of a feature in the files of forests: what the page calls it, its unit ("%": a share), and an explanation. Those of a range of
// heights are followed by it: "filled 1.4-2.2 m".
const FEATURES = {
  filled: ["heights with returns", "%", "Share of these heights with returns at the axis"],
  "alone within 0.45 m": ["returns within 0.45 m that are at the axis", "%", "Of the returns nearer than 0.45 m, the share at the axis"],
  "alone beyond 0.45 m": ["returns within 0.9 m that are within 0.45 m", "%", "Of the returns nearer than 0.9 m, the share nearer than 0.45 m"],
  alone: ["returns at the axis", "%", "Share of the returns at and around the axis that are at the axis"],
  "ring open": ["free surroundings", "%", "Share of the directions around the axis without returns"],
  opaque: ["rays that ended here", "%", "Share of the rays at these heights that ended here; the others passed"],
  "lowest return": ["lowest return", "m", "Height of the lowest return"],
  "clean from": ["isolated stem from", "m", "Height from which the stem is isolated"],
  "clean to": ["isolated stem up to", "m", "Height up to which the stem is isolated"],
  "clean slices": ["slices with an isolated stem", "", "Number of slices of 0.2 m in which the stem is isolated"],
  "highest return": ["highest return", "m", "Height of the highest return"],
  headroom: ["observed height above the top", "m", "How far above its highest return any scan observed this place"],
  "looked at up to": ["observed up to", "m", "Greatest height that any scan observed here"],
  tilt: ["tilt", "", "Shift of the axis per metre of height"],
  wobble: ["deviation from a straight axis", "m", "Deviation of the slices from a straight axis"],
  spread: ["width of the slices", "m", "Width of the slices"],
  "voxels a slice": ["voxels per slice", "", "Occupied voxels per slice"],
  "voxels to 3 m": ["voxels up to 3 m", "", "Occupied voxels at the axis up to 3 m"],
  "returns a voxel": ["returns per voxel (log)", "", "Logarithm of the returns per voxel"],
  "returns a slice": ["returns per slice (log)", "", "Logarithm of the returns per slice"],
  "returns around": ["returns around the stem", "%", "Share of the returns that are around the axis, not at it"],
  crown: ["returns above the isolated stem", "%", "Share of the returns that are above the isolated stem"],
  gone: ["clear views without it", "%", "Share of the scans with a clear view in which the place was empty"],
  "thick above": ["thickness above the isolated stem", "m", "Standard deviation across the long side, above the isolated stem"],
  "wide above": ["width above the isolated stem", "m", "Standard deviation along the long side, above the isolated stem"],
  thick: ["thickness", "m", "Standard deviation across the long side"],
  wide: ["width", "m", "Standard deviation along the long side"],
  uneven: ["variation of the width", "", "Variation of the width of the slices"],
  "part of the view filled": ["observed height that the stem fills", "%", "Share of the observed height that the isolated stem fills"],
  "residual of the radius": ["residual / radius", "", "Deviation of the returns from the circle, relative to its radius"],
  residual: ["residual of the circle", "m", "Deviation of the returns of the isolated stem from a circle"],
  radius: ["radius of the circle", "m", "Radius of the circle through the returns of the isolated stem"],
  "free above what is clean": ["free height above the isolated stem", "m", "Height above the isolated stem that rays passed before the next return"],
  "free above the highest return": ["free height above the highest return", "m", "Height above the highest return that rays passed"],
  "rays up to": ["highest ray", "m", "Height up to which rays observed the place"],
  "nothing above what is clean": ["gap above the isolated stem", "m", "Distance from the isolated stem up to the next return"],
};
const UNSEEN = -1; // value of a feature without returns or rays

// [name, value, explanation] of a feature as texts.
function featureTexts(name, value) {
  const key = Object.keys(FEATURES).find((each) => name === each || name.startsWith(`${each} `) && /^[\d.]+-[\d.]+ m$/.test(name.slice(each.length + 1)));
  if (!key) return [name, figure(value), ""];
  const [title, unit, meaning] = FEATURES[key];
  const text = value === UNSEEN ? "not seen" : unit === "%" ? share(value) : `${figure(value)}${unit && ` ${unit}`}`;
  return [`${title}${name === key ? "" : `, ${name.slice(key.length + 1).replace("-", " to ")}`}`, text, meaning];
}

// Explanations of verdicts that a rule decided, not the votes.
const RULES = {
  tree: (g) => `Accepted as tree: single scans fitted a round trunk on more than half of its circumference, so votes against a round stem count a tenth. A tree needs ${share(g.tree_share)} of the votes.`,
  moving: (g) => `Rejected as moving: empty in ${g.absent} of ${count(g.absent + g.present, "scan")} with a clear view${g.absent_lately > 1 ? `, among them the last ${g.absent_lately}` : ""}.`,
  "too low": () => "Rejected as too low: less than 30 % of the rays at breast height (1.2 to 2.2 m above the ground), or above a person's height (2.2 to 3.2 m), ended at it.",
  "too few points": () => "Rejected as too few points: so few voxels can be occupied by chance.",
};

const voteText = ([name, part]) => `${name} ${share(part)}`;

// `story` is null where nothing was accumulated.
export function columnFigure(story, title) {
  if (!story) return el("figure", {}, el("figcaption", { text: title }),
    el("p", { class: "dim note", text: "Nothing upright in the accumulated scans of this place yet. Scans are accumulated at intervals (Tune, Classification); presets that do not classify, such as paper, accumulate none." }));
  return el("figure", { "data-gathered": story.verdict },
    el("figcaption", { text: title }),
    ...voteNodes(story.votes),
    el("p", { class: "note" }, ...reason(story)),
    story.effects.length ? influence(story.effects) : "");
}

// A bar and a list of the shares of the votes, largest first.
export function voteNodes(shares) {
  const votes = Object.entries(shares).filter(([, part]) => part >= 0.005).sort((a, b) => b[1] - a[1]);
  return [el("div", { class: "votes", role: "img", "aria-label": votes.map(voteText).join(", ") },
    ...votes.map((vote) => el("i", { style: { background: `var(--${verdictOf(vote[0])[1]})`, flexGrow: String(vote[1]) }, title: voteText(vote) }))),
  el("ul", { class: "vote-list" }, ...votes.map((vote) => el("li", {}, letterOf(verdictOf(vote[0])), voteText(vote))))];
}

function reason(story) {
  const rule = RULES[story.verdict];
  if (!story.by_votes && rule) return [rule(story)];
  const verdict = story.verdict === "tree" ? "A tree" : `Not a tree: ${story.verdict}`;
  const least = el("button", { class: "link", type: "button", text: share(story.tree_share), title: "Go to the slider Tree threshold", onclick: () => openParameter("classification.tree_share") });
  return [`${verdict}, by the votes of the decision trees; a tree needs `, least,
    ` of them. ${freeEndText(story.tree_in_free_air)}${clearViewText(story.present, story.present + story.absent)}`];
}

export const clearViewText = (present, all) => (all ? `In ${present} of ${count(all, "scan")} with a clear view of this place, something stood here.` : "");

// Objects with a free upper end get additional votes on tree or pole.
function freeEndText(part) {
  if (part === null) return "";
  return `Its upper end is free: of the decision trees that separate trees from poles there, ${share(part)} vote for a tree${part < 0.5 ? ", so the votes for a tree count for a pole" : ""}. `;
}

function influence(features) {
  const most = Math.max(...features.map(({ effect }) => Math.abs(effect)), 0.01);
  return el("div", { class: "influence" }, el("p", { class: "dim", text: "Most influential features: votes for a tree that each one adds or removes" }),
    ...features.map(({ figure: name, value, effect }) => ({ effect, texts: featureTexts(name, value) })).map(({ effect, texts: [title, text, meaning] }) => el("div", { title: meaning },
      el("span", { text: title }), el("span", { class: "value", text }),
      el("span", { class: "effect" }, el("i", { class: effect < 0 ? "against" : "for", style: { width: `${(50 * Math.abs(effect)) / most}%` } })),
      el("span", { class: "value", text: `${effect < 0 ? "−" : "+"}${figure(100 * Math.abs(effect), 2)} %` }))));
}
