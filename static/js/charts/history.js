// The course of the run: figures of each scan that this page has received, by the index of the scan.

import { changed, on, state } from "../core/store.js";

const MOST = 20_000; // scans; of more, every second one is kept, then every fourth and so on

const known = (value) => (value === undefined || value === null ? null : value);
const total = (counts) => Object.values(counts ?? {}).reduce((sum, number) => sum + number, 0);
const perCent = (share) => (share === null || share === undefined ? null : 100 * share);

// name: [title, unit, function of the map and the status]
export const QUANTITIES = {
  trees: ["trees", "", ({ trees }) => trees.length],
  clusters: ["clusters", "", ({ verdicts }) => total(verdicts)],
  stems: ["clusters that are trees", "", ({ verdicts }) => verdicts.tree ?? 0],
  right: ["detections at true trees", "", ({ right }) => right],
  wrong: ["detections at no true tree", "", ({ wrong }) => wrong],
  sigma: ["sigma of the position", "cm", ({ health, sigma_xy: sigma }) => 100 * (health?.sigma_xy_m ?? sigma)],
  yaw: ["sigma of the heading", "°", ({ health }) => health?.sigma_yaw_deg],
  n_eff: ["effective particles", "", (map) => map.n_eff],
  detections: ["detections used by SLAM", "", ({ health }) => health?.detections],
  recognised: ["detections associated", "%", ({ health }) => perCent(health?.recognised)],
  ambiguous: ["detections ambiguous", "%", ({ health }) => perCent(health?.ambiguous)],
  innovation: ["normalised innovation", "", ({ health }) => health?.innovation],
  odometry: ["deviation from the odometry", "sigma", ({ health }) => health?.odometry_sigmas],
  drift: ["distance from the odometry", "m", ({ pose, odom }) => (odom ? Math.hypot(pose[0] - odom[0], pose[1] - odom[1]) : null)],
  x: ["x of the robot", "m", ({ pose }) => pose[0]],
  y: ["y of the robot", "m", ({ pose }) => pose[1]],
  heading: ["heading of the robot", "°", ({ pose }) => (180 * pose[2]) / Math.PI],
  driven: ["driven distance", "m", (map, status) => status.distance_m],
  clearance: ["distance to an obstacle ahead", "m", ({ clearance }) => clearance?.ahead_m],
  raw: ["points of the scan", "", ({ layers }) => layers.raw],
  filtered: ["points after the filters", "", ({ layers }) => layers.filtered],
  mapping: ["mapping time", "ms", (map, status) => status.mapping_ms],
  rate: ["scan rate", "Hz", (map, status) => status.scan_rate_hz],
  behind: ["scans behind", "", (map, status) => status.scans_behind],
};

let scans = new Map(); // index -> {time, revision, stages, value of each quantity}
let step = 1, of = ""; // every step-th scan is kept; run of the scans

function record({ map, status }) {
  if (!status) return;
  if (!map || status.source !== of) {
    of = status.source;
    scans = new Map();
    step = 1;
  }
  if (!map || map.index % step) return;
  const values = Object.fromEntries(Object.entries(QUANTITIES).map(([name, [, , read]]) => [name, known(read(map, status))]));
  scans.set(map.index, { time: map.time_s, revision: status.revision, stages: { ...status.stage_ms }, values });
  if (scans.size > MOST) {
    step *= 2;
    for (const index of [...scans.keys()]) if (index % step) scans.delete(index);
  }
  changed("history");
}

// Whether a recorded scan was mapped with earlier parameters: a re-mapping sends its last scan only.
export const isOutdated = () => [...scans.values()].some(({ revision }) => revision !== state.status?.revision);

// The recorded scans in the order of time, at most about `most`.
export function recorded(most) {
  const all = [...scans.entries()].sort(([a], [b]) => a - b).map(([, scan]) => scan);
  const each = Math.ceil(all.length / most);
  return all.filter((_, k) => k % each === 0 || k === all.length - 1);
}

// The names of the quantities that any recorded scan has.
export function available() {
  const list = [...scans.values()];
  return Object.keys(QUANTITIES).filter((name) => list.some(({ values }) => values[name] !== null));
}

export function startHistory() {
  on("map", record);
  record(state);
}
