// The live connection: takes what the server tells, says when it is lost, and comes back by itself.

import { looksOnly } from "./permissions.js";
import { changed, state } from "./store.js";

const FIRST_WAIT = 500, LONGEST_WAIT = 5000;
const ANSWER_WAIT = 3000; // [ms] that a choice made here stands against what the server still says
let socket = null;
let wait = FIRST_WAIT;
let chosen = null; // {tree, until}: selected here, and not yet heard of from the server

const takers = {
  status(message) { state.status = message; },
  map(message) { takeMap(message); },
  parameters(message) { state.parameters = message; },
  sets(message) { state.sets = message; },
  truth(message) { state.truth = message.trees ?? null; },
  evaluation(message) { state.evaluation = message.TA ? message : null; },
  annotations(message) { state.annotations = message; },
  learning(message) { state.learning = message; },
  selection(message) { takeSelection(message.tree ?? null, message.cluster ?? null); },
  events(message) { state.events = message.events; },
  view(message) { state.view = message; },
  remapped(message) { state.remapped = message.ghost ? message : null; },
  rough(message) { state.rough = message.places ? { ...message, ghost: message.places.map(([x, y]) => [x, y, null]), changes: [] } : null; },
  search(message) { state.search = message; },
  loop(message) { state.loop = message.to_s === undefined ? null : message; },
  sensitivity(message) { state.sensitivity = message.name ? message : null; },
  missing(message) { state.missing = message; },
};

function takeMap({ path, ...map }) {
  state.path.length = Math.min(state.path.length, path.start);
  state.path.push(...path.points);
  if (path.start === 0) state.odometry.length = 0; // another run
  state.map = map.index < 0 ? null : map; // -1: another run is opened, and nothing of it is mapped yet
  if (map.odom) state.odometry[map.index] = map.odom;
}

// An answer to an earlier click must not undo a later one.
function takeSelection(tree, cluster) {
  if (chosen && chosen.tree !== tree && performance.now() < chosen.until) return;
  chosen = null;
  Object.assign(state, { selected: tree, selectedCluster: cluster });
}

function receive(event) {
  let message;
  try {
    message = JSON.parse(event.data);
  } catch {
    return; // not ours
  }
  state.heardAt = performance.now();
  const take = takers[message.type];
  if (!take) return;
  take(message);
  changed(message.type);
}

export function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/api/live`);
  socket.onopen = () => {
    wait = FIRST_WAIT;
    chosen = null; // what was sent over the link before may never have arrived
    Object.assign(state, { connected: true, lostAt: 0, heardAt: performance.now() });
    state.odometry.length = 0;
    changed("connection");
  };
  socket.onmessage = receive;
  socket.onclose = () => {
    Object.assign(state, { connected: false, lostAt: state.lostAt || performance.now() });
    changed("connection");
    setTimeout(connect, wait);
    wait = Math.min(2 * wait, LONGEST_WAIT);
  };
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

// Selected at once: a key pressed right after the click acts on what was clicked, however far the server is.
export function select(tree) {
  if (socket?.readyState !== WebSocket.OPEN) return;
  send({ type: "select", tree });
  // What is selected already has no answer, and to wait for one would hide what is selected next, elsewhere.
  if (state.selected !== tree || state.selectedCluster) chosen = { tree, until: performance.now() + ANSWER_WAIT };
  Object.assign(state, { selected: tree, selectedCluster: null });
  changed("selection");
}

export function selectCluster(scan, cluster) {
  chosen = null; // which tree it is, the server says
  if (looksOnly()) {
    const { x = [], y = [], verdict = [] } = (state.map?.index === scan && state.map.clusters) || {};
    Object.assign(state, { selected: null, selectedCluster: { scan, cluster, verdict: verdict[cluster], x: x[cluster], y: y[cluster], time_s: state.status?.time_s } });
    changed("selection"); // of this page alone
    return;
  }
  send({ type: "select_cluster", scan, cluster });
}
