// Classification of the accumulated scans at a place: votes of the decision trees and the most influential features.

import { el } from "../core/dom.js";
import { figure, percent } from "../core/format.js";
import { verdictOf } from "../core/verdicts.js";

// Descriptions of the features.
const HINTS = {
  filled: "share of this height with returns", "alone within": "share of the returns nearer than 0.45 m that are at the axis",
  "alone beyond": "share of the returns nearer than 0.9 m that are nearer than 0.45 m", alone: "share of the returns at this height that are at the axis",
  "ring open": "share of the surroundings at this height that are free", "lowest return": "height of the lowest return [m]",
  "clean from": "height from which the stem is isolated [m]", "clean to": "height up to which the stem is isolated [m]",
  "clean slices": "number of slices of 0.2 m in which the stem is isolated", "highest return": "height of the highest return [m]",
  headroom: "free height observed above its top [m]", "looked at up to": "greatest height that any scan observed here [m]",
  tilt: "shift of the axis per metre of height", wobble: "deviation of the slices from a straight axis [m]",
  spread: "width of the slices [m]", "voxels a slice": "occupied voxels per slice", "voxels to 3 m": "occupied voxels at the axis up to 3 m", "returns a voxel": "logarithm of the returns per voxel",
  "returns around": "share of the returns around the axis", crown: "share of the returns above the stem",
  gone: "share of the scans with a clear view in which the place was empty", "returns a slice": "logarithm of the returns per slice",
  thick: "width across the long side [m]", wide: "width along the long side [m]", uneven: "variation of the width of the slices",
  "part of the view filled": "share of the observed height that the stem fills",
  opaque: "share of the rays at this height that ended at it; the others passed it",
  "free above what is clean": "height above the isolated stem that rays passed before the next return [m]",
  "free above the highest return": "height above its top that rays passed [m]", "rays up to": "height up to which rays observed the place [m]",
  "nothing above what is clean": "distance from the isolated stem up to the next return [m]",
};
const hint = (name) => HINTS[name] ?? HINTS[Object.keys(HINTS).find((key) => name.startsWith(key))] ?? "";

// Explanations of verdicts that a rule decided, not the votes.
const RULES = {
  tree: (g) => `Accepted as tree: single scans fitted a round trunk on more than half of its circumference, so votes against a round stem count a tenth. A tree needs ${percent(g.tree_share)} of the votes.`,
  moving: (g) => `Rejected as moving: empty in ${g.absent} of ${g.absent + g.present} clear views.`,
  "too low": () => "Rejected as too low: less than 30 % of the rays at breast height (1.2 to 2.2 m above the ground), or above a person's height (2.2 to 3.2 m), ended at it.",
  "too few points": () => "Rejected as too few points: so few voxels can be occupied by chance.",
};

// `story` is null where nothing was accumulated.
export function columnFigure(story, title) {
  if (!story) return el("figure", {}, el("figcaption", { text: title }),
    el("p", { class: "dim note", text: "Nothing upright was accumulated here yet. One scan per interval is accumulated (Tune, Classification), but none with a preset that does not classify, such as paper." }));
  const votes = Object.entries(story.votes).filter(([, share]) => share >= 0.005).sort((a, b) => b[1] - a[1]);
  return el("figure", { "data-gathered": story.verdict },
    el("figcaption", { text: title }),
    el("div", { class: "votes", role: "img", "aria-label": votes.map(([name, share]) => `${name} ${percent(share)}`).join(", ") },
      ...votes.map(([name, share]) => el("i", { style: { background: `var(--${verdictOf(name)[1]})`, flexGrow: String(share) }, title: `${name} ${percent(share)}` }))),
    el("ul", { class: "vote-list" }, ...votes.map(([name, share]) => el("li", {},
      el("i", { style: { background: `var(--${verdictOf(name)[1]})` }, "aria-hidden": "true" }), `${name} ${percent(share)}`))),
    el("p", { class: "note", text: reason(story) }),
    story.effects.length ? influence(story.effects) : "");
}

function reason(story) {
  const rule = RULES[story.verdict];
  if (!story.by_votes && rule) return rule(story);
  const verdict = story.verdict === "tree" ? "Accepted as tree" : `Rejected as ${story.verdict}`;
  return `${verdict} by the votes; a tree needs ${percent(story.tree_share)} of them. ${freeEndText(story.tree_in_free_air)}Occupied in ${story.present} of ${story.present + story.absent} clear views.`;
}

// Objects with a free upper end get additional votes on tree or pole.
function freeEndText(share) {
  if (share === null) return "";
  return `Its upper end is free: of the decision trees that separate trees from poles there, ${percent(share)} vote for a tree${share < 0.5 ? ", so the votes for a tree count for a pole" : ""}. `;
}

function influence(features) {
  const most = Math.max(...features.map(({ effect }) => Math.abs(effect)), 0.01);
  return el("div", { class: "influence" }, el("p", { class: "dim", text: "Most influential features: votes for a tree that each one adds or removes" }),
    ...features.map(({ figure: name, value, effect }) => el("div", { title: hint(name) },
      el("span", { text: name }), el("span", { class: "value", text: figure(value) }),
      el("span", { class: "effect" }, el("i", { class: effect < 0 ? "against" : "for", style: { width: `${(50 * Math.abs(effect)) / most}%` } })),
      el("span", { class: "value", text: `${effect < 0 ? "−" : "+"}${figure(100 * Math.abs(effect), 2)} %` }))));
}
