// The live connection: takes what the server tells, says when it is lost, and comes back by itself.

import { state, changed } from "./state.js";

const FIRST_WAIT = 500, LONGEST_WAIT = 5000;
let socket = null;
let wait = FIRST_WAIT;

const takers = {
  status(message) { state.status = message; },
  map(message) { takeMap(message); },
  parameters(message) { state.parameters = message; },
  sets(message) { state.sets = message; },
  truth(message) { state.truth = message.trees ?? null; },
  evaluation(message) { state.evaluation = message.TA ? message : null; },
  annotations(message) { state.annotations = message; },
  selection(message) { Object.assign(state, { selected: message.tree ?? null, selectedCluster: message.cluster ?? null }); },
  events(message) { state.events = message.events; },
  view(message) { state.view = message; },
  loop(message) { state.loop = message.to_s === undefined ? null : message; },
  missing(message) { state.missing = message; },
};

function takeMap({ path, ...map }) {
  state.path.length = Math.min(state.path.length, path.start);
  state.path.push(...path.points);
  if (path.start === 0) state.odometry.length = 0; // another run
  state.map = map.index < 0 ? null : map; // -1: another run is opened, and nothing of it is mapped yet
  if (map.odom) state.odometry[map.index] = map.odom;
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

export const select = (tree) => send({ type: "select", tree });
export const selectCluster = (scan, cluster) => send({ type: "select_cluster", scan, cluster });
