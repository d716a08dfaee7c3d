// The filter above the table of trees: a number, ranges of columns, or the class in the ground truth.

import { isReviewed, KINDS, reviewOf, STATES, tapeOf } from "../annotate/annotations.js";
import { inFile } from "../core/coordinates.js";
import { distance, nearest } from "../core/nearest.js";
import { state } from "../core/store.js";

export const HELP = "A tree number, or conditions separated by spaces: dbh 20..30, dbh none, scans > 50, ± < 5, e < 10, x -5..5, height > 20 and lean < 5 where they are measured; review state: open, confirmed, rejected, skipped, reviewed, unreviewed; class in the ground truth: tree, pole, person, bush, other, none.";

export const sigma = (tree) => 100 * Math.max(...tree.ellipse.slice(0, 2)); // of the position [cm]

export const countedDbh = (tree) => tapeOf(tree) ?? tree.dbh_cm; // [cm]

const COLUMNS = {
  tree: (t) => t.number, x: (t) => inFile(t.x, t.y)[0], y: (t) => inFile(t.x, t.y)[1], "±": sigma, sigma, dbh: countedDbh,
  eccentricity: (t) => t.eccentricity, e: (t) => t.eccentricity, scans: (t) => t.observations, seen: (t) => t.observations, slices: (t) => t.observations, height: (t) => t.height_m, lean: (t) => t.lean_deg,
};
const NAMES = Object.keys(COLUMNS).join("|");
const NUMBER = "[-+]?\\d+(?:\\.\\d+)?";
const RANGE = new RegExp(`^(${NAMES})\\s*(${NUMBER})?\\s*\\.\\.\\s*(${NUMBER})?`, "i");
const BOUND = new RegExp(`^(${NAMES})\\s*(<=|>=|<|>|=)\\s*(${NUMBER})`, "i");
const UNKNOWN = new RegExp(`^(${NAMES})\\s+none`, "i");
const TESTS = { "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b, "=": (a, b) => a === b };

// Class of a tree in the ground truth; "none" where it has nothing there, "" without ground truth.
function kindOf(tree) {
  if (!state.truth) return "";
  return nearest(state.truth, (truth) => distance(truth, tree), state.parameters?.values["evaluation.match_distance"] ?? 0.5)?.kind ?? "none";
}

// [text, test] of the condition at the beginning of a text; null if there is none.
function firstCondition(text) {
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
  if ((match = /^(un)?(?:reviewed|judged)\b/i.exec(text))) {
    const wanted = !match[1];
    return [match[0], (tree) => isReviewed(tree) === wanted];
  }
  if ((match = new RegExp(`^(${STATES.join("|")})\\b`, "i").exec(text))) {
    const wanted = match[1].toLowerCase();
    return [match[0], (tree) => reviewOf(tree) === wanted];
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

// {holds, refused}: the test of a tree, and the part of the text that was not understood ("" if all was).
export function filterOf(text) {
  const conditions = [];
  let rest = text.trim().replaceAll("−", "-").replace(/,(?=\s|$)/g, " ");
  while (rest) {
    const next = firstCondition(rest);
    if (!next || !/^(\s|$)/.test(rest.slice(next[0].length))) return { holds: () => false, refused: rest };
    conditions.push(next[1]);
    rest = rest.slice(next[0].length).trim();
  }
  return { holds: (tree) => conditions.every((condition) => condition(tree)), refused: "" };
}
