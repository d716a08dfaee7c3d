// The box above the table of trees: a number, what a column may hold, or what the ground truth says.

import { KINDS, rows } from "../annotate/annotations.js";
import { state } from "../core/store.js";

export const HELP = "A number, or: dbh 20..30, dbh none, seen > 50, ± < 5, e < 10, x -5..5; judged, unjudged; by the ground truth tree, pole, person, bush, other, none. Several are joined by spaces.";

export const sigma = (tree) => 100 * Math.max(...tree.ellipse.slice(0, 2)); // of the position [cm]

const COLUMNS = {
  tree: (t) => t.number, x: (t) => t.x, y: (t) => t.y, "±": sigma, sigma, dbh: (t) => t.dbh_cm,
  e: (t) => t.eccentricity, seen: (t) => t.observations,
};
const NAMES = Object.keys(COLUMNS).join("|");
const NUMBER = "[-+]?\\d+(?:\\.\\d+)?";
const RANGE = new RegExp(`^(${NAMES})\\s*(${NUMBER})?\\s*\\.\\.\\s*(${NUMBER})?`, "i");
const BOUND = new RegExp(`^(${NAMES})\\s*(<=|>=|<|>|=)\\s*(${NUMBER})`, "i");
const UNKNOWN = new RegExp(`^(${NAMES})\\s+none`, "i");
const TESTS = { "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b, "=": (a, b) => a === b };

const near = (tree, others, reach) => others.filter((other) => Math.hypot(other.x - tree.x, other.y - tree.y) <= reach)
  .sort((a, b) => Math.hypot(a.x - tree.x, a.y - tree.y) - Math.hypot(b.x - tree.x, b.y - tree.y))[0];

// What the ground truth has where the tree stands; "none" where it has nothing, "" where there is no truth.
function kindOf(tree) {
  if (!state.truth) return "";
  return near(tree, state.truth, state.parameters?.values["evaluation.match_distance"] ?? 0.5)?.kind ?? "none";
}

const isJudged = (tree) => Boolean(near(tree, rows(), state.annotations?.same_thing_m ?? 0.5));

// The first condition of a text, and what is left of it; null where none begins it.
function taken(text) {
  const column = (match) => COLUMNS[match[1].toLowerCase()];
  let match = RANGE.exec(text);
  if (match && (match[2] ?? match[3]) !== undefined) {
    const [of, low, high] = [column(match), Number(match[2] ?? -Infinity), Number(match[3] ?? Infinity)];
    return [match[0], (tree) => of(tree) !== null && of(tree) >= low && of(tree) <= high];
  }
  if ((match = BOUND.exec(text))) {
    const [of, test, bound] = [column(match), TESTS[match[2]], Number(match[3])];
    return [match[0], (tree) => of(tree) !== null && test(of(tree), bound)];
  }
  if ((match = UNKNOWN.exec(text))) {
    const of = column(match);
    return [match[0], (tree) => of(tree) === null];
  }
  if ((match = /^(un)?judged\b/i.exec(text))) {
    const wanted = !match[1];
    return [match[0], (tree) => isJudged(tree) === wanted];
  }
  if ((match = new RegExp(`^(${KINDS.join("|")}|none)\\b`, "i").exec(text))) {
    const kind = match[1].toLowerCase();
    return [match[0], (tree) => kindOf(tree) === kind];
  }
  if ((match = /^#?(\d+)(?=\s|$)/.exec(text))) {
    const [, digits] = match;
    return [match[0], (tree) => String(tree.number).startsWith(digits)];
  }
  return null;
}

// {holds, refused}: whether a tree is wanted, and the part that is not understood ("" if all is).
export function filterOf(text) {
  const conditions = [];
  let rest = text.trim().replace(/,(?=\s|$)/g, " ");
  while (rest) {
    const next = taken(rest);
    if (!next || !/^(\s|$)/.test(rest.slice(next[0].length))) return { holds: () => false, refused: rest };
    conditions.push(next[1]);
    rest = rest.slice(next[0].length).trim();
  }
  return { holds: (tree) => conditions.every((condition) => condition(tree)), refused: "" };
}
