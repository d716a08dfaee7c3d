// The page's state, and listeners that are called when a part of it changes.

export const state = {
  status: null,      // the newest status message
  source: null,      // source request of the open run: {uri, odometry, seed, topics, mount, preset, parameters}
  map: null,         // the newest map message, without its path
  path: [],          // [x, y, odometry x, odometry y] of each scan, the first two in the frame of the map
  truth: null,       // ground truth trees
  evaluation: null,  // the map scored against the ground truth
  annotations: null, // {run, serial, problem, used, same_thing_m, doubt, trees: [{id, x, y, kind, dbh_cm, reach_m, who, dbh_who, by, at_s, version}], skipped: likewise, others: {class: [...]}, frame}
  parameters: null,  // {preset, set, revision, undo, redo, values, changed}
  sets: null,        // {sets: [{name, who, at_s}]}: saved sets of parameters
  holds: null,       // test of a tree by the filter of the table; null without a filter
  selected: null,    // number of the selected tree
  selectedElsewhere: false, // whether the server chose it: for another page, or by a click in the scene
  selectedByOthers: [], // numbers of the trees that other pages have selected
  isOtherFirst: null, // whether another page selected the same tree before this one; null until the server tells
  keepsSelection: false, // whether the selections of other pages leave that of this page as it is: while it shows the tab Annotate or Repair, which edit the selected tree
  place: null,       // [x, y, z] of the selection on the ground, once the server has answered
  selectedCluster: null, // {scan, cluster, verdict, x, y} as it was when selected
  selectedTruth: null, // object of the ground truth without a tree or a cluster of this scan, when clicked
  obstacle: null,    // {x, y, outline, zone: "slow" or "stop"} ahead of the robot, while it is reported below the strip
  view: null,        // layers and choices of the 3D scene
  ghost: null,       // `remapped` or `rough` while the previous map is drawn as an overlay
  compare: null,     // clusters of the current scan by set A and by set B, while they are compared
  measure: null,     // {from, to, fixed} while a distance is measured on the map
  events: [],        // [{t, kind, text, for_s, noted_s}] in order of time
  eventsStart: 0,    // time of the first scan [s since 1970]
  remapped: null,    // {revision, scans, before, after, ghost: [[x, y, dbh]], changes: [{kind, number, x, y, why}]}
  rough: null,       // {revision, places: [[x, y]], ghost, changes}: preview of a re-mapping, not a score
  loop: null,        // {from_s, to_s}: the part that playback repeats
  connected: false,
  lostAt: 0,         // when the connection was lost [ms], 0 while it is open
  refused: false,    // whether the server refuses this page
  heardAt: 0,        // when the last message arrived [ms]
  statusAt: 0,       // when the status arrived [ms]
};

// --- selectors ---------------------------------------------------------------------------------

export const trees = () => state.map?.trees ?? [];
export const treeOf = (number) => trees().find((tree) => tree.number === number) ?? null;
export const selectedTree = () => treeOf(state.selected);
export const isDrive = () => !state.status?.one_step;
export const isPlaying = () => state.status?.state === "playing";

// Clusters of the current scan as [{row, x, y, verdict}].
export function clusters() {
  const { x = [], y = [], verdict = [] } = state.map?.clusters ?? {};
  return x.map((_, row) => ({ row, x: x[row], y: y[row], verdict: verdict[row] }));
}

// --- listeners ---------------------------------------------------------------------------------

const listeners = new Map();

// Calls `listener` after each change of the parts, which are separated by spaces.
export function on(parts, listener) {
  for (const part of parts.split(" ")) {
    if (!listeners.has(part)) listeners.set(part, []);
    listeners.get(part).push(listener);
  }
}

// A listener that throws is reported and does not keep the others from being called.
export function changed(part) {
  for (const listener of listeners.get(part) ?? []) {
    try {
      listener(state);
    } catch (error) {
      reportError(error);
    }
  }
}
