// The log of a run: its events with their times and durations.

import { byId, el, recall, remember } from "../core/dom.js";
import { saveCsv } from "../core/download.js";
import { capital, clock, figure } from "../core/format.js";
import { isDrive, state } from "../core/store.js";
import { NAMES } from "../playback/event_marks.js";
import { timeLink } from "../playback/time_link.js";

const LASTING = "lasting", ALL = "all";
const OLDEST = 946_684_800; // [s], the year 2000: clocks of simulated runs begin at 0
let filter = recall("log") ?? LASTING;

const lasts = (event) => event.for_s !== undefined;
const fits = (event) => filter === ALL || (filter === LASTING ? lasts(event) : event.kind === filter);
const events = () => state.events.filter((event) => !event.before && fits(event));
const dateOf = ({ t }) => (state.eventsStart > OLDEST ? new Date(1000 * (state.eventsStart + t)) : null);
const duration = (event) => (!lasts(event) ? "" : event.for_s === null ? "lasts" : `${figure(event.for_s)} s`);

export function showLog() {
  const kinds = [...new Set(state.events.map(({ kind }) => kind))].sort();
  const box = byId("log"), key = JSON.stringify([filter, kinds, events(), state.eventsStart]);
  if (box.dataset.shown === key) return;
  box.dataset.shown = key;
  const isFocused = document.activeElement?.id === "log-kind";
  const choice = el("select", { id: "log-kind", "aria-label": "Events of the log", onchange: () => { filter = choice.value; remember("log", filter); showLog(); } },
    el("option", { value: LASTING, text: "Stops, silences, weak and lost poses" }), el("option", { value: ALL, text: "All events" }),
    ...kinds.map((kind) => el("option", { value: kind, text: capital(NAMES[kind] ?? kind) })));
  if (![...choice.options].some(({ value }) => value === filter)) filter = LASTING; // a kind of another run
  choice.value = filter;
  const canSeek = isDrive() && !state.status?.live;
  const rows = events().map((event) => el("tr", {},
    el("td", {}, canSeek ? timeLink(event.t) : clock(event.t)), el("td", { text: dateOf(event)?.toLocaleTimeString("sv-SE") ?? "" }),
    el("td", { class: "figure", text: duration(event) }), el("td", { text: event.text })));
  box.replaceChildren(choice, rows.length
    ? el("table", {}, el("thead", {}, el("tr", {}, ...["run", "clock", "lasted", "what"].map((text) => el("th", { scope: "col", text })))), el("tbody", {}, ...rows))
    : el("p", { class: "empty", text: filter === LASTING ? "No stop, no silence, and the pose was good." : "No such event." }));
  if (isFocused) choice.focus();
}

export const saveLog = () => saveCsv("log.csv", [["time_s", "date", "kind", "duration_s", "what"],
  ...events().map((event) => [event.t, dateOf(event)?.toISOString(), event.kind, event.for_s, event.text])]);
