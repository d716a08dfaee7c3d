// What all scans together say of a place: the votes, and the figures that told most.

import { el } from "../core/dom.js";
import { figure, percent } from "../core/format.js";
import { verdictOf } from "../core/verdicts.js";

const HINTS = {
  filled: "part of this height in which something was seen", "alone within": "part of the returns nearer than 0.45 m that lies at the axis itself",
  "alone beyond": "part of the returns nearer than 0.9 m that lies nearer than 0.45 m", alone: "part of the returns at this height that lies at the axis itself",
  "ring open": "part of the surroundings at this height that is free", "lowest return": "height of the lowest return, m",
  "clean from": "from this height on the stem stands alone, m", "clean to": "up to this height the stem stands alone, m",
  "clean slices": "slices of 0.2 m in which the stem stands alone", "highest return": "height of the highest return, m",
  headroom: "how far above its top the view was free, m", "looked at up to": "how high any scan looked there, m",
  tilt: "shift of the axis per metre of height", wobble: "how far the slices lie beside one straight axis, m",
  spread: "how wide the slices are, m", "voxels a slice": "filled voxels in a slice", "voxels to 3 m": "filled voxels at the axis up to 3 m", "returns a voxel": "logarithm of the returns in a voxel",
  "returns around": "part of the returns that lies around the axis", crown: "part of the returns above the stem",
  gone: "part of the scans with free view in which nothing stood there", "returns a slice": "logarithm of the returns in a slice",
  thick: "width across the long side, m", wide: "width along the long side, m", uneven: "how unevenly wide the slices are",
  "part of the view filled": "part of the height that was looked at which the stem fills",
  opaque: "part of the rays at this height that ended at it; the others passed and ended behind",
  "free above what is clean": "how much above the stem rays passed before the next return, m",
  "free above the highest return": "how much above its top rays passed, m", "rays up to": "up to this height rays tell what stands there, m",
  "nothing above what is clean": "from the stem up to the next return, m",
};
const hint = (name) => HINTS[name] ?? HINTS[Object.keys(HINTS).find((key) => name.startsWith(key))] ?? "";
const RULES = {
  tree: (g) => `single scans fitted a round trunk on more than half of its sides, so votes for what is not round count a tenth. With them a tree needs ${percent(g.tree_share)} of the votes.`,
  moving: (g) => `Nothing stood there in ${g.absent} of the ${g.absent + g.present} scans with free view, so it moved away.`,
  wall: () => "It goes on sideways and is wide but not thick: a rule takes that for part of a wall before the votes count.",
  "too low": () => "Of the rays between 2.2 and 3.2 m above the ground hardly any ended at it: it ends at a person's height, whatever hangs over it, so round fits from all sides do not make it a tree.",
  "too few points": () => "So few voxels can be piled up by chance; the votes do not count.",
};

export function gathered(story, title) {
  if (!story) return el("figure", {}, el("figcaption", { text: title }),
    el("p", { class: "dim note", text: "Nothing upright was gathered here yet; one scan of four is gathered, and the preset must do so." }));
  const votes = Object.entries(story.votes).filter(([, share]) => share >= 0.005).sort((a, b) => b[1] - a[1]);
  return el("figure", { "data-gathered": story.verdict },
    el("figcaption", { text: title }),
    el("div", { class: "votes", role: "img", "aria-label": votes.map(([name, share]) => `${name} ${percent(share)}`).join(", ") },
      ...votes.map(([name, share]) => el("i", { style: { background: `var(--${verdictOf(name)[1]})`, flexGrow: String(share) }, title: `${name} ${percent(share)}` }))),
    el("ul", { class: "vote-list" }, ...votes.map(([name, share]) => el("li", {},
      el("i", { style: { background: `var(--${verdictOf(name)[1]})` }, "aria-hidden": "true" }), `${name} ${percent(share)}`))),
    el("p", { class: "note", text: sentence(story) }),
    story.told.length ? told(story.told) : "");
}

function sentence(story) {
  const seen = `Something stood there in ${story.present} of ${story.present + story.absent} gathered scans with free view.`;
  const rule = RULES[story.verdict];
  if (!story.by_votes && rule) return `Taken for ${story.verdict}: ${rule(story)}`;
  const end = freeEnd(story.tree_in_free_air);
  return `Taken for ${story.verdict}; a tree needs ${percent(story.tree_share)} of the votes. ${end}${seen}`;
}

// Of what ends in free air other decision trees are asked whether it is a pole; the votes are those after that.
function freeEnd(share) {
  if (share === null) return "";
  const asked = `It ends in free air: of the decision trees that tell a tree there from a pole, ${percent(share)} say tree`;
  return share < 0.5 ? `${asked}, so the votes for a tree are a pole's. ` : `${asked}. `;
}

function told(figures) {
  const most = Math.max(...figures.map(({ effect }) => Math.abs(effect)), 0.01);
  return el("div", { class: "told" }, el("p", { class: "dim", text: "What told most: votes for a tree that each figure adds or takes" }),
    ...figures.map(({ figure: name, value, effect }) => el("div", { title: hint(name) },
      el("span", { text: name }), el("span", { class: "value", text: figure(value) }),
      el("span", { class: "effect" }, el("i", { class: effect < 0 ? "against" : "for", style: { width: `${(50 * Math.abs(effect)) / most}%` } })),
      el("span", { class: "value", text: `${effect < 0 ? "−" : "+"}${figure(100 * Math.abs(effect), 2)} %` }))));
}
