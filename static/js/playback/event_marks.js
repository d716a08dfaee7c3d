// Marks of events below the timeline, and the loop: a part of the run that is played repeatedly.

import { command, post } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { clock } from "../core/format.js";
import { attempted, showProblem } from "../core/problem.js";
import { roving } from "../core/roving.js";
import { on, state } from "../core/store.js";

export const NAMES = { tree: "tree mapped", warning: "warning", change: "parameters changed", health: "SLAM health", annotation: "annotated", stop: "stop zone", slow: "slow zone", silence: "no data", pause: "paused", recording: "recording" };
const keepTabStop = roving(byId("marks"), ".mark", "horizontal");
let start = null; // start of a loop whose end is not set yet [s]

function showMarks() {
  const end = state.status?.end_s;
  const lane = byId("marks");
  const events = end > 0 ? state.events.filter(({ kind }) => kind !== "slow") : []; // there are many; the log lists them
  const key = `${end} ${events.map((event) => `${event.t}${event.text}${event.before ? "b" : ""}`).join()}`;
  if (lane.dataset.shown === key) return;
  lane.dataset.shown = key;
  const focused = lane.contains(document.activeElement) ? document.activeElement.title : null;
  lane.replaceChildren(...(end > 0 ? [loopBar()] : []), ...events.map(({ t, kind, text, before }) => el("button", {
    class: `mark ${kind}${before ? " before" : ""}`, tabindex: "-1", title: `${clock(t)} ${NAMES[kind]}: ${text}${before ? " (before the last change; it is replaced when the run gets there)" : ""}`, "aria-label": `${clock(t)} ${text}`,
    style: { left: `${(100 * t) / end}%` }, onclick: () => attempted(() => command("seek", { time_s: t })),
  })));
  keepTabStop();
  if (focused !== null) [...lane.children].find((mark) => mark.title === focused)?.focus();
}

function loopBar() {
  const bar = el("i", { id: "loop-bar" });
  bar.hidden = true;
  return bar;
}

function showLoop() {
  const loop = state.loop, end = state.status?.end_s, button = byId("loop"), bar = byId("loop-bar");
  button.disabled = !(end > 0);
  button.setAttribute("aria-pressed", String(Boolean(loop)));
  setText(button, loop ? `Loop ${clock(loop.from_s)} to ${clock(loop.to_s)} ✕` : start === null ? "Loop" : `Loop from ${clock(start)}, to …`);
  if (!bar) return;
  const from = loop?.from_s ?? start;
  bar.hidden = from === null || from === undefined;
  if (bar.hidden) return;
  const to = loop?.to_s ?? Math.max(from, state.status.time_s);
  Object.assign(bar.style, { left: `${(100 * from) / end}%`, width: `${(100 * (to - from)) / end}%` });
}

export async function setLoop() {
  const now = state.status?.time_s;
  if (!(state.status?.end_s > 0)) return;
  try {
    if (state.loop) await post("/api/loop", { from_s: null, to_s: null });
    else if (start === null || now - start < 0.5) start = now;
    else {
      await post("/api/loop", { from_s: start, to_s: now });
      start = null;
    }
  } catch (error) {
    start = null;
    showProblem(error);
  }
  showLoop();
}

export function startMarks() {
  byId("loop").addEventListener("click", setLoop);
  on("events status", showMarks);
  on("loop status", showLoop);
  on("selection", () => { if (!state.map) start = null; }); // another run
}
