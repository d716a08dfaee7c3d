// Messages of the open run from the server, and the selection. The server holds one selection, the newest one of all pages, which the
// scene marks. A page follows it, or keeps its own one (`keepsSelection`).

import { randomId } from "./dom.js";
import { looksOnly } from "./permissions.js";
import { connectTo } from "./socket.js";
import { changed, state } from "./store.js";

const ANSWER_WAIT = 3000; // [ms] for which a selection made here overrules what the server still sends
let sendMessage = () => false;
const page = randomId(); // until the page is loaded again
let chosen = null; // {tree, until}: selected here, not yet confirmed by the server
let run = null; // number of the run of the last selection

const receivers = {
  status(message) { Object.assign(state, { status: message, statusAt: performance.now() }); },
  source({ type, ...source }) { state.source = source; },
  map(message) { receiveMap(message); },
  parameters(message) { state.parameters = message; },
  sets(message) { state.sets = message; },
  truth(message) { state.truth = message.trees ?? null; },
  evaluation(message) { state.evaluation = message.TA ? message : null; },
  annotations(message) { state.annotations = message; },
  selection: receiveSelection,
  events(message) { Object.assign(state, { events: message.events, eventsStart: message.start_s }); },
  view(message) { state.view = message; },
  remapped(message) { state.remapped = message.ghost ? message : null; },
  rough(message) { state.rough = message.places ? { ...message, ghost: message.places.map(([x, y]) => [x, y, null]), changes: [] } : null; },
  loop(message) { state.loop = message.to_s === undefined ? null : message; },
  missing(message) { state.missing = message; },
};

// A further kind of message, as of an extension. A receiver returns false if it has changed nothing.
export const receive = (type, receiver) => { receivers[type] = receiver; };

function receiveMap({ path, ...map }) {
  state.path.length = Math.min(state.path.length, path.start);
  state.path.push(...path.points);
  state.map = map.index < 0 ? null : map; // -1: another run is opening and nothing of it is mapped yet
  if (!state.map && state.selectedTruth) {
    state.selectedTruth = null; // an object of the former run
    changed("selection");
  }
}

// An answer to an earlier click must not undo a later one. Of another run than before, numbers of trees mean nothing any more.
function receiveSelection({ tree, cluster, place, by, pages, run: now }) {
  const known = Object.entries(pages), own = known.findIndex(([each, number]) => each === page && number === state.selected);
  state.selectedByOthers = known.filter(([each]) => each !== page).map(([, number]) => number);
  const isTaken = (own < 0 ? known : known.slice(0, own)).some(([, number]) => number === state.selected);
  state.isOtherFirst = isTaken || own >= 0 ? isTaken : null;
  const isKept = state.keepsSelection && ![null, page].includes(by) && now === run;
  run = now;
  changed("others");
  if (isKept || (chosen && chosen.tree !== tree && performance.now() < chosen.until)) return false;
  chosen = null;
  if (tree !== state.selected) state.selectedElsewhere = true;
  Object.assign(state, { selected: tree, selectedCluster: cluster, place });
  return true;
}

export function connect() {
  sendMessage = connectTo(`/api/live?page=${page}`, {
    onMessage(message) {
      state.heardAt = performance.now();
      if (receivers[message.type] && receivers[message.type](message) !== false) changed(message.type);
    },
    onOpen() {
      chosen = null; // a message sent over the lost connection may not have arrived
      Object.assign(state, { connected: true, lostAt: 0, refused: false, heardAt: performance.now() });
      changed("connection");
    },
    onClose() {
      Object.assign(state, { connected: false, lostAt: state.lostAt || performance.now() });
      changed("connection");
    },
    onRefused() {
      state.refused = true;
      changed("connection");
    },
  });
}

// Selects a tree at once: a key pressed right after a click acts on the clicked tree, however slow the server is.
export function select(tree) {
  if (!sendMessage({ type: "select", tree })) return;
  // A tree that is selected already gets no answer; waiting for one would hide the next selection made elsewhere.
  if (state.selected !== tree || state.selectedCluster) chosen = { tree, until: performance.now() + ANSWER_WAIT };
  Object.assign(state, { selected: tree, selectedElsewhere: false, selectedCluster: null, selectedTruth: null, place: null });
  changed("selection");
}

export function selectCluster(scan, cluster) {
  chosen = null; // the server answers with the tree of the cluster
  if (!looksOnly()) {
    sendMessage({ type: "select_cluster", scan, cluster });
    return;
  }
  const { x = [], y = [], verdict = [] } = (state.map?.index === scan && state.map.clusters) || {};
  Object.assign(state, { selected: null, selectedCluster: { scan, cluster, verdict: verdict[cluster], x: x[cluster], y: y[cluster], time_s: state.status?.time_s } });
  changed("selection"); // of this page only
}
