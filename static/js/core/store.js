// What the page knows, and who wants to be told when a part of it changes.

export const state = {
  status: null,      // the newest status message
  map: null,         // the newest map message, without its path
  path: [],          // [[x, y], ...] one for each scan, frame of the map
  odometry: [],      // [x, y] by index of the scan, holes where the page was not looking
  truth: null,
  evaluation: null,
  annotations: null, // {run, serial, problem, used, same_thing_m, trees: [{id, x, y, kind, dbh_cm, who, at_s, version}]}
  learning: null,    // {state, words, learned}: decision trees that are grown from annotations
  parameters: null,  // {preset, set, revision, undo, redo, values, changed}
  sets: null,        // {sets: [{name, who, at_s}]}: parameters that were saved
  selected: null,    // number of a tree
  selectedCluster: null, // {scan, cluster, verdict, x, y} as it was when it was selected
  view: null,        // layers and choices of the 3D scene
  ghost: null,       // `remapped` while the map before is drawn beside
  compare: null,     // clusters of the standing scan by set A and by set B, while they are compared
  measure: null,     // {from, to, fixed} while a distance is measured on the map
  events: [],        // [{t, kind, text}] in the order of time
  remapped: null,    // {revision, scans, before, after, ghost: [[x, y, dbh]], renamed, changes: [{kind, number, x, y, why}]}: the whole run was mapped again
  rough: null,       // {revision, places: [[x, y]], score, ghost, changes}: what mapping the run again will come to, roughly
  sensitivity: null, // {name, of, points: [{value, f1, TA, TA_of, false, …} or {value, error}], asked_with, error}: how much a parameter matters
  search: null,      // {state, goal, made, wanted, go_on, start, best, points, held_out, scores, importance, better, changes}: a search for parameters
  loop: null,        // {from_s, to_s}: the part that is played again and again
  connected: false,
  lostAt: 0,         // when the connection was lost [ms], 0 if it stands
  heardAt: 0,        // when the server was last heard [ms]
};

const listeners = new Map();

export function on(parts, listener) {
  for (const part of parts.split(" ")) {
    if (!listeners.has(part)) listeners.set(part, []);
    listeners.get(part).push(listener);
  }
}

export function changed(part) {
  for (const listener of listeners.get(part) ?? []) listener(state);
}
